"""The step of pose and nuisances that a linear fit gives, by orthogonal elimination.

An LED's image depends on the LOCAL parameters: pose, intrinsics, size, tilts, profile. An LED that moves by d in the
world moves its image as the camera does that moves by -d. So the information of each LED about its LOCAL parameters is
all that the fit needs. Orthogonal elimination (QR) removes first what is an LED's own, then what is a luminaire's:
normal equations would lose the digits of what a loose prior leaves of a precise measurement.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.camera.intrinsics import CAMERA_PARAMETERS
from estimator.camera.pose import POSE_PARAMETERS
from estimator.errors import EstimationFailure
from estimator.pixels.led_model import LOCAL_PARAMETERS
from estimator.pixels.nuisances import LUMINAIRE_PARAMETERS, Gravity, Nuisances, Priors

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Directions with less than this share of the largest information of an LED, and LEDs with less than this share of the
# largest of all, hold rounding errors alone.
MIN_INFORMATION_SHARE = 1e-13
UNDETERMINED = "the LEDs in view do not determine a position"
# Smallest diagonal element of the triangular factor, with columns of unit length, of a determined pose.
MIN_DETERMINED = 1e-10


@dataclass(frozen=True, eq=False)
class Solution:
    """A step of pose and nuisances; covariance of the view, and of each LED's own nuisances.

    The view is the pose (6,), and the velocity (6,) for a rolling shutter: `view_step` (v,), `covariance` (v, v).
    `redundancy` (n, 9) is the share of its prior that each LED's own nuisance keeps, 1 less its variance in prior
    units. `step2` is the squared length of the step of the view in standard deviations, `information` (v, v) the
    inverse of the view's covariance.
    """

    view_step: Floats
    step: Nuisances
    covariance: Floats
    redundancy: Floats
    step2: float
    information: Floats

    @property
    def pose_step(self) -> Floats:
        """The step of the pose, (6,)."""
        return self.view_step[:POSE_PARAMETERS]


def _triangle(matrix: Floats) -> Floats:
    """Triangular factor of QR, of a matrix or of each of n."""
    return np.asarray(np.linalg.qr(matrix, mode="r"), dtype=np.float64)


def square_root(information: Floats, gradient: Floats, parameters: Ints) -> tuple[Floats, Floats]:
    """Rows (n, r, p) and right-hand sides (n, r) of least squares with the information (n, p, p), gradient (n, p).

    Of the `parameters` alone: there are as many rows as those of which any of the n has information.
    """
    diagonal = np.diagonal(information, axis1=1, axis2=2)
    informed = parameters[(diagonal[:, parameters] > 0).any(axis=0)]
    diagonal = diagonal[:, informed]
    scale = np.divide(1.0, np.sqrt(np.maximum(diagonal, 0.0)), out=np.zeros_like(diagonal), where=diagonal > 0)
    scaled = information[:, informed[:, None], informed] * scale[:, :, None] * scale[:, None]
    values, vectors = np.linalg.eigh(np.clip(scaled, -1.0, 1.0))
    kept = values > MIN_INFORMATION_SHARE * values[:, -1:]
    root = np.sqrt(np.where(kept, values, 0.0))
    rows = np.zeros((*values.shape, information.shape[2]))
    rows[:, :, informed] = (vectors * root[:, None]).transpose(0, 2, 1) * np.sqrt(np.maximum(diagonal, 0.0))[:, None]
    right = np.einsum("nij,ni->nj", vectors, gradient[:, informed] * scale)
    return rows, np.divide(right, root, out=np.zeros_like(right), where=kept)


def solve(
    rows: Floats,
    right: Floats,
    priors: Priors,
    now: Nuisances,
    gravity: Gravity,
    angles: Floats,
    damping: Floats | None = None,
) -> Solution:
    """Step of pose and nuisances that minimizes the squares of `rows` (n, r, p) x step - `right` (n, r), and priors.

    The columns are the LOCAL_PARAMETERS and those of the motion; `angles` (3,) are the rig's; `damping` (v, v), if
    given, is an information that keeps the view where it is (Levenberg-Marquardt), and is part of
    `Solution.covariance`. Raises EstimationFailure if the pose is not determined.
    """
    n = len(rows)
    z = now.standardized(priors)
    of_camera = slice(POSE_PARAMETERS, POSE_PARAMETERS + CAMERA_PARAMETERS)
    shifted = -rows[:, :, :3]  # by a shift of the LED
    of_led = slice(POSE_PARAMETERS + CAMERA_PARAMETERS, LOCAL_PARAMETERS)
    # What is known exactly is no unknown.
    uncertain = np.flatnonzero(priors.leds.any(axis=0))
    own = np.concatenate([shifted, rows[:, :, of_led]], axis=2)[:, :, uncertain] * priors.leds[:, None, uncertain]
    uncertain_datum, uncertain_camera = np.flatnonzero(priors.datum), np.flatnonzero(priors.camera)
    by_datum = shifted[:, :, :0]
    if len(uncertain_datum) > 0:
        by_datum = (shifted @ (priors.datum_slopes() * priors.datum))[:, :, uncertain_datum]
    common = np.concatenate(
        [
            by_datum,
            (rows[:, :, of_camera] * priors.camera)[:, :, uncertain_camera],
            rows[:, :, :POSE_PARAMETERS],
            rows[:, :, LOCAL_PARAMETERS:] * priors.motion,
        ],
        axis=2,
    )
    own_count, common_count = len(uncertain), common.shape[2]
    has = priors.luminaire >= 0
    luminaire_count = LUMINAIRE_PARAMETERS if has.any() else 0
    of_luminaire = shifted[:, :, :0]
    if luminaire_count > 0:
        arms = priors.arms()
        arms[has] *= priors.luminaires[priors.luminaire[has]][:, None]
        of_luminaire = shifted @ arms
    system = np.concatenate([own, of_luminaire, common, right[:, :, None]], axis=2)
    prior_rows = np.zeros((n, own_count, system.shape[2]))
    prior_rows[:, :, :own_count] = np.eye(own_count)
    prior_rows[:, :, -1] = -z.leds[:, uncertain]
    triangles = _triangle(np.concatenate([prior_rows, system], axis=1))
    led_rows, rest = triangles[:, :own_count], triangles[:, own_count:, own_count:]

    remaining = [rest[~has][:, :, luminaire_count:].reshape(-1, common_count + 1)]
    luminaire_rows = {}
    for k in sorted(set(priors.luminaire[has].tolist())):
        block = rest[priors.luminaire == k].reshape(-1, rest.shape[2])
        prior = np.zeros((LUMINAIRE_PARAMETERS, rest.shape[2]))
        prior[:, :LUMINAIRE_PARAMETERS] = np.eye(LUMINAIRE_PARAMETERS)
        prior[:, -1] = -z.luminaires[k]
        triangle = _triangle(np.concatenate([prior, block]))
        luminaire_rows[k] = triangle[:LUMINAIRE_PARAMETERS]
        remaining.append(triangle[LUMINAIRE_PARAMETERS:, LUMINAIRE_PARAMETERS:])
    prior = np.zeros((common_count, common_count + 1))
    known = len(uncertain_datum) + len(uncertain_camera)
    prior[:known, :known] = np.eye(known)
    prior[:known, -1] = -np.concatenate([z.datum[uncertain_datum], z.camera[uncertain_camera]])
    tilt = [known + 3, known + 4]
    prior[tilt, tilt] = 1 / gravity.sigma
    prior[tilt, -1] = gravity.residual(angles)
    of_motion = np.arange(known + POSE_PARAMETERS, common_count)
    prior[of_motion, of_motion] = 1.0
    prior[of_motion, -1] = -z.motion
    # From the unknowns of the view to their units: those of the motion are in standard deviations.
    units = np.concatenate([np.ones(POSE_PARAMETERS), priors.motion])
    total = np.concatenate([prior, *remaining])
    if damping is not None:
        held = np.zeros((len(units), common_count + 1))
        held[:, known:-1] = np.linalg.cholesky(damping).T * units
        total = np.concatenate([total, held])
    scale = np.linalg.norm(total[:, :-1], axis=0)
    if not np.isfinite(total).all() or not (scale > 0).all():
        raise EstimationFailure("fit", UNDETERMINED)
    triangle = _triangle(np.column_stack([total[:, :-1] / scale, total[:, -1]]))
    R, q = triangle[:common_count, :-1], triangle[:common_count, -1]
    if not np.abs(np.diag(R)).min() > MIN_DETERMINED:
        raise EstimationFailure("fit", UNDETERMINED)
    inverse = np.linalg.inv(R) / scale[:, None]
    covariance = inverse @ inverse.T
    x = inverse @ q

    of_luminaires = -z.luminaires
    for k, row in luminaire_rows.items():
        rhs = row[:, -1] - row[:, LUMINAIRE_PARAMETERS:-1] @ x
        of_luminaires[k] = np.linalg.solve(row[:, :LUMINAIRE_PARAMETERS], rhs)
    lead, on_luminaire = led_rows[:, :, :own_count], led_rows[:, :, own_count : -common_count - 1]
    on_common = led_rows[:, :, -common_count - 1 : -1]
    rhs = led_rows[:, :, -1] - on_common @ x
    if luminaire_count > 0:
        rhs[has] -= np.einsum("nij,nj->ni", on_luminaire[has], of_luminaires[priors.luminaire[has]])
    of_leds, of_datum, of_intrinsics = np.zeros_like(z.leds), np.zeros_like(z.datum), np.zeros_like(z.camera)
    of_leds[:, uncertain] = np.linalg.solve(lead, rhs[:, :, None])[:, :, 0]
    of_datum[uncertain_datum], of_intrinsics[uncertain_camera] = np.split(x[:known], [len(uncertain_datum)])
    inverse_lead = np.linalg.inv(lead)
    # Of what is common, the luminaires' uncertainty is left out.
    through = inverse_lead @ on_common @ inverse
    redundancy = np.zeros_like(z.leds)
    redundancy[:, uncertain] = 1 - (inverse_lead**2).sum(axis=2) - (through**2).sum(axis=2)
    view_step, view_covariance = x[known:] * units, covariance[known:, known:] * np.outer(units, units)
    root = R[known:, known:] * (scale[known:] / units)
    return Solution(
        view_step=view_step,
        step=Nuisances(
            camera=of_intrinsics * priors.camera,
            datum=of_datum * priors.datum,
            luminaires=of_luminaires * priors.luminaires,
            leds=of_leds * priors.leds,
            motion=view_step[POSE_PARAMETERS:],
        ),
        covariance=view_covariance,
        redundancy=np.clip(redundancy, 0.0, 1.0),
        step2=float(((root @ view_step) ** 2).sum()),
        information=root.T @ root,
    )
