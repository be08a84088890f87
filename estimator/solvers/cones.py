"""Cones and planes through the projection centre: of the image of a disc, and of a straight edge.

A disc and the projection centre span a cone; in the image plane at unit depth the cone is an ellipse, `x^T Q x = 0`
with x = (x, y, 1). A straight edge spans a plane with the normal m, `m . x = 0`.

A cone has two directions of planes that cut it in circles (Apollonius). With eigenvalues l1 >= l2 > 0 > l3 of Q and its
eigenvectors as axes they are the planes `a x +- b z = const` with a^2 = l1 - l2 and b^2 = l2 - l3, because
x^T Q x = l2 |x|^2 + (a x - b z) (a x + b z): on such a plane the cone is part of a sphere.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.spots.contours import find_contours

Floats = NDArray[np.float64]

# Random samples of five points: with 40 % of the points on another edge, one sample of 13 has none of them.
SAMPLES = 100
# Fits without the outliers of the one before: an outlier that moves a fit hides others.
ROUNDS = 6
# Points this many standard deviations off, by the median of the distances, are on another edge.
OUTLIER_SIGMA = 3.0


@dataclass(frozen=True, eq=False)
class DiscCones:
    """Discs of the map, in view: ids, centres `leds_m` (n, 3) and radii (n,), metres, and their cones (n, 3, 3)."""

    ids: tuple[int, ...]
    leds_m: Floats
    radii_m: Floats
    cones: Floats


def disc_cones(frame: DeviceFrame, cut_too: bool = False) -> DiscCones:
    """Cones of the identified discs whose contour is an ellipse; with `cut_too` also of those that a border may cut.

    Raises EstimationFailure, also if there is none.
    """
    leds, cones = [], []
    for contour in find_contours(frame, "disc", cut_too):
        try:
            cones.append(fit_cone(contour.image))
        except EstimationFailure:
            continue
        leds.append(contour.led)
    if not leds:
        raise EstimationFailure("contour", "no ellipse fits the edge of an LED image")
    leds_m, radii_m = np.array([led.position_m for led in leds]), np.array([led.half_width_m for led in leds])
    return DiscCones(tuple(led.id for led in leds), leds_m, radii_m, np.array(cones))


def fit_cone(image: Floats) -> Floats:
    """Cone Q (3, 3), negative inside, whose ellipse most of the points (n, 2) at unit depth, n >= 12, lie on.

    Of the ellipses through five points each the one with the smallest median of distances (Rousseeuw 1984) is refined
    by least squares of the distances to first order (Sampson 1982), without outliers, so that an arc suffices if it
    holds more than half of the points. Raises EstimationFailure if no ellipse fits.
    """
    centre, scale = image.mean(axis=0), float(image.std()) or 1.0
    x, y = ((image - centre) / scale).T
    design = np.column_stack([x * x, 2 * x * y, y * y, 2 * x, 2 * y, np.ones(len(x))])
    generator = np.random.Generator(np.random.Philox(key=len(x)))
    chosen = generator.random((SAMPLES, len(x))).argpartition(5, axis=1)[:, :5]
    samples = np.linalg.svd(design[chosen])[2][:, 5]
    ellipses = samples[samples[:, 0] * samples[:, 2] > samples[:, 1] ** 2]
    if not len(ellipses):
        raise EstimationFailure("contour", "no ellipse fits the edge of an LED image")
    medians = np.median(_distances(design, ellipses)[0], axis=1)
    best = ellipses[int(np.argmin(medians))]
    for _ in range(ROUNDS):
        distances, slopes = _distances(design, best)
        kept = distances <= OUTLIER_SIGMA * 1.4826 * np.median(distances)
        best = np.linalg.svd(design[kept] / slopes[kept, None], full_matrices=False)[2][5]
    a, b, c, d, e, f = best
    if a * c <= b * b:
        raise EstimationFailure("contour", "no ellipse fits the edge of an LED image")
    to_unit = np.array([[1 / scale, 0, -centre[0] / scale], [0, 1 / scale, -centre[1] / scale], [0, 0, 1]])
    cone = to_unit.T @ np.array([[a, b, d], [b, c, e], [d, e, f]]) @ to_unit
    return np.asarray(cone / np.linalg.norm(cone) * np.sign(cone[0, 0]))


def _distances(design: Floats, conics: Floats) -> tuple[Floats, Floats]:
    """Distances (..., n) of points from conics (..., 6) to first order, and lengths (..., n) of the gradients there."""
    x, y = design[:, 3] / 2, design[:, 4] / 2
    a, b, c, d, e, _ = np.moveaxis(conics[..., None], -2, 0)
    slopes = np.maximum(2 * np.hypot(a * x + b * y + d, b * x + c * y + e), np.finfo(float).tiny)
    return np.abs(conics @ design.T) / slopes, slopes


def ellipse_centre(cone: Floats) -> Floats:
    """Centre (2,) of a cone's ellipse at unit depth."""
    return np.asarray(np.linalg.solve(cone[:2, :2], -cone[:2, 2]))


def ellipse_centres(centres: Floats, radii: Floats, normal: Floats) -> Floats:
    """Centres (n, 2) of the ellipses at unit depth of discs at `centres` (n, 3), camera axes, with a common normal.

    The dual conic of a disc's image is `r^2 (I - n n^T) - c c^T`; the last column is the pole of infinity, the centre.
    """
    across = np.array([0.0, 0.0, 1.0]) - normal * normal[2]
    poles = radii[:, None] ** 2 * across - centres * centres[:, 2:]
    return np.asarray(poles[:, :2] / poles[:, 2:])


def discs(cone: Floats) -> tuple[Floats, Floats]:
    """The two discs of unit radius on a cone: centres (2, 3) and unit normals (2, 3), which point away from the camera.

    Camera axes; the centres are in front of the camera. Raises EstimationFailure if the matrix is of no cone.
    """
    values, axes = np.linalg.eigh(cone)
    (l3, l2, l1), axes = values, axes[:, ::-1]
    if not l3 < 0 < l2:
        raise EstimationFailure("contour", "no ellipse fits the edge of an LED image")
    a, b, c = np.sqrt([l1 - l2, l2 - l3, l1 - l3])
    centres, normals = np.empty((2, 3)), np.empty((2, 3))
    for k, sign in enumerate((1, -1)):
        normal = np.array([a, 0.0, sign * b]) / c
        # The cone on the plane `normal . x = 1` lies on a sphere through the projection centre.
        middle = -c / (2 * l2) * np.array([a, 0.0, -sign * b])
        beyond = 1 - normal @ middle
        centre = (middle + beyond * normal) / np.sqrt(middle @ middle - beyond**2)
        front = np.sign((axes @ centre)[2])
        centres[k], normals[k] = front * (axes @ centre), front * (axes @ normal)
    return centres, normals


def fit_plane(image: Floats) -> Floats:
    """Unit normal (3,) of the plane through the projection centre and most of n >= 6 points (n, 2) at unit depth."""
    rays = np.column_stack([image, np.ones(len(image))])
    kept = np.ones(len(rays), dtype=bool)
    for _ in range(ROUNDS):
        normal = np.linalg.svd(rays[kept], full_matrices=False)[2][2]
        distances = np.abs(rays @ normal)
        kept = distances <= OUTLIER_SIGMA * 1.4826 * np.median(distances)
    return np.asarray(normal)
