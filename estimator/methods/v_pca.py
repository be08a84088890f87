"""V-PCA: Zhu, Guo, Bao, Chen, Saad & Yang, "Positioning using visible light communications: a perspective arcs
approach", arXiv 2204.08131, 2022: orientation and place of round luminaires from their ellipses or arcs.

Published, as far as known from its abstract: round luminaires, whose arcs in the image and whose coordinates, sent by
light, give the pose by plane and solid geometry and single-view geometry; no inertial sensor and no limit of tilt; a
luminaire may be in view in part. A later paper (arXiv 2602.01577) names it as the method to compare with for discs.

Chosen here: the arc is what a robust fit of an ellipse keeps of the contour, so that a part behind an obstacle, or
beyond the border of the image, may be missing (`estimator.solvers.cones.fit_cone`); images that the border cuts are
used. A cone of known radius leaves two discs (`discs`). The tilts of all luminaires agree, and so do their heights with
the map's: of all solutions' normals the one with the smallest squares of both, as angles, decides; its tilt is the mean
of the nearest normals. Leveled by it, the vectors to the centres give yaw and position as in `kim`. A second luminaire
is needed: one has no yaw and two solutions.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.camera.leveling import tilt_from_gravity
from estimator.camera.pose import rotation
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.methods.kim import position_from_vectors
from estimator.methods.variant import Estimate, Needs, Variant
from estimator.solvers.cones import disc_cones, discs

Floats = NDArray[np.float64]

MIN_LEDS = 2


def v_pca(frame: DeviceFrame) -> Estimate:
    """Position from the cones of discs; raises EstimationFailure."""
    found = disc_cones(frame, cut_too=True)
    vectors_m, up = decide(found.leds_m, found.radii_m, found.cones)
    level = vectors_m @ rotation(*tilt_from_gravity((float(up[0]), float(up[1]), float(up[2]))))
    distances_m = np.linalg.norm(vectors_m, axis=1)
    ranges_m = {led: float(d) for led, d in zip(found.ids, distances_m, strict=True)}
    return Estimate(position_from_vectors(found.leds_m, level), ranges_m)


def decide(leds_m: Floats, radii_m: Floats, cones: Sequence[Floats] | Floats) -> tuple[Floats, Floats]:
    """Vectors (n, 3) to the centres of discs at `leds_m` (n, 3) on their cones, and the world's z (3,), camera axes.

    Raises EstimationFailure for fewer than two discs.
    """
    if len(cones) < MIN_LEDS:
        raise EstimationFailure("position", f"LEDs identified: {len(cones)}, needed: {MIN_LEDS}")
    solutions = [discs(cone) for cone in cones]
    centres_m = np.array([found[0] for found in solutions]) * radii_m[:, None, None]
    normals = np.array([found[1] for found in solutions])
    every, best, min_misfit = np.arange(len(cones)), np.zeros(len(cones), dtype=int), np.inf
    for up in normals.reshape(-1, 3):
        nearest = (normals @ up).argmax(axis=1)
        chosen_m = centres_m[every, nearest]
        below_m = leds_m[:, 2] - chosen_m @ up
        off = (below_m - below_m.mean()) / np.linalg.norm(chosen_m, axis=1).mean()
        misfit = float(((normals[every, nearest] - up) ** 2).sum() + (off**2).sum())
        if misfit < min_misfit:
            best, min_misfit = nearest, misfit
    mean = normals[every, best].mean(axis=0)
    return centres_m[every, best], mean / np.linalg.norm(mean)


V_PCA = Variant(
    "v-pca",
    "Zhu et al. 2022: ellipse or arc to cone, the disc's normal from its eigenvalues, a second luminaire decides",
    v_pca,
    needs=Needs(2, faces="disc", sizes=True),
)
