"""Positions from the lamps of a picture: identities by geometry where tones leave a choice, handedness, fits.

A hypothesis says which axis of the map is reversed and which lamp is which LED. The likeliest one is taken if no other
is nearly as likely. A real lamp's centroid errs by more than its noise: the further standard deviation of centroids
follows from the residuals, with the prior that photographs have shown.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from estimator.camera.pose import Pose
from estimator.camera.projection import project
from estimator.camera.undistort import pinhole_image
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.io.led_map import AnyLed
from estimator.methods import gravity_fit, pnp, up2p
from estimator.methods.gravity_fit import initial_poses
from estimator.methods.maximum_likelihood import ml
from estimator.methods.variant import Estimate
from estimator.photo.led_table import LedTable, Mirror, mirror_signs
from estimator.solvers.local_minima import minima
from estimator.solvers.observations import observe
from estimator.spots.detect import Spot
from estimator.spots.identify import Correspondence

Floats = NDArray[np.float64]

MIN_LEDS = 3
# Standard deviation of a coordinate of a real lamp's centroid, pixels, and the number of residuals that it counts as.
PRIOR_SIGMA_PX = 1.5
PRIOR_RESIDUALS = 4.0
SIGMA_ROUNDS = 3
# Standard deviation of the centroids of hypotheses, as a share of the picture's width: the map may be off by as much.
ROUGH_SHARE = 5e-4
# A hypothesis is taken if it is this many times as likely as every other one: chi-square by 13.8.
MIN_CLEAR_CHI2 = 2 * float(np.log(1000))
MAX_HYPOTHESES = 4096
# Residuals above this share of the picture's diagonal, root mean square, are no error of centroids: 5 mm at 2.5 m with
# a wide lens.
MAX_RESIDUAL_SHARE = 1.5e-3
MIN_INLIER_SHARE = 0.6
VARIANTS = ("gravity-fit", "up2p", "ml", "pnp", "ippe", "sqpnp")
# An error is covered where its chi-square of three degrees of freedom is not beyond 95 %.
COVERED_CHI2 = 7.815


@dataclass(frozen=True)
class Centre:
    """Centre (u, v) of a lamp, its covariance (2, 2) row by row, and the LEDs that it may be."""

    u_px: float
    v_px: float
    covariance_px2: tuple[float, float, float, float]
    candidates: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """An assignment of LEDs (by id, None for none) to the centres, in maps with an axis reversed or not."""

    mirror: Mirror
    leds: tuple[int | None, ...]
    chi2: float


@dataclass(frozen=True, eq=False)
class Answer:
    """Estimate of a variant in the map's own units and axes; `failure` says why there is none.

    `position` (3,), `covariance` (3, 3) or None, `residuals_px` (n, 2) of the spots at that position with the best
    orientation, measured minus model.
    """

    variant: str
    position: Floats | None = None
    covariance: Floats | None = None
    residuals_px: Floats | None = None
    ambiguous: bool = False
    failure: str = ""

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals' coordinates, pixels."""
        return float(np.sqrt((self.residuals_px**2).mean())) if self.residuals_px is not None else np.nan


@dataclass(frozen=True, eq=False)
class Solved:
    """Answers of all variants; `spots` are (LED id, u, v) in the order of the residuals.

    `misplaced` are LEDs, by id, whose lamps are far from where the map puts them, with the distance in pixels: they are
    left out of `leds`, `spots` and answers.
    """

    mirror: Mirror
    leds: tuple[int | None, ...]
    spots: tuple[tuple[int, float, float], ...]
    sigma_px: float
    answers: tuple[Answer, ...]
    handed: str
    misplaced: tuple[tuple[int, float], ...] = ()


def solve(
    frame: DeviceFrame,
    table: LedTable,
    centres: Sequence[Centre],
    mirrors: Sequence[Mirror],
    sigma_px: float | None = None,
) -> Solved:
    """Positions of a picture's camera; of the frame, camera and accelerometer are used.

    `mirrors` are the ways to reverse an axis of the map that are tried. `sigma_px` is the further standard deviation
    of each coordinate of a centroid; None for one by the residuals. Raises EstimationFailure if too few LEDs are
    identified, no assignment is clearly the likeliest, or the map does not fit the spots.
    """
    identified = sum(bool(centre.candidates) for centre in centres)
    if identified < MIN_LEDS:
        raise EstimationFailure("identify", f"{identified} LEDs identified, needed {MIN_LEDS}")
    ranked = sorted(_hypotheses(frame, table, centres, mirrors), key=lambda one: one.chi2)
    if not ranked:
        raise EstimationFailure("position", "no pose has the camera below the LEDs and the LEDs in front of it")
    best = ranked[0]
    others = [one for one in ranked[1:] if one.leds != best.leds or one.mirror != best.mirror]
    leds = table.leds(best.mirror)

    def answered(chosen: Sequence[Correspondence]) -> tuple[float, tuple[Answer, ...], Floats]:
        added_px = _sigma_px(frame, chosen) if sigma_px is None else sigma_px
        answers = tuple(_answer(name, frame, table, best.mirror, chosen, added_px) for name in VARIANTS)
        return added_px, answers, _check_fit(frame, answers)

    ids = best.leds
    chosen = _correspondences(centres, ids, leds)
    added_px, answers, off_px = answered(chosen)
    far = off_px > 3 * _limit_px(frame)
    misplaced = tuple((chosen[k].led.id, float(off_px[k])) for k in np.flatnonzero(far))
    if misplaced and (~far).sum() >= MIN_LEDS:
        ids = tuple(None if led in dict(misplaced) else led for led in ids)
        chosen = _correspondences(centres, ids, leds)
        added_px, answers, _ = answered(chosen)
    if others and others[0].chi2 < best.chi2 + MIN_CLEAR_CHI2:
        what = "handedness of the map" if others[0].leds == best.leds else "assignment of the LEDs of one frequency"
        raise EstimationFailure("identify", f"the spots do not tell the {what}; give --mirror or --spots")
    spots = tuple((one.led.id, one.spot.u_px, one.spot.v_px) for one in chosen)
    return Solved(best.mirror, ids, spots, added_px, answers, _handed(best.mirror, mirrors), misplaced)


def _handed(mirror: Mirror, mirrors: Sequence[Mirror]) -> str:
    if len(mirrors) == 1:
        return "as given" if mirror == "none" else f"{mirror} reversed, as given"
    return (
        "right-handed"
        if mirror == "none"
        else f"left-handed: {mirror} is reversed inside, positions are in the map's axes"
    )


def _correspondences(
    centres: Sequence[Centre], ids: Sequence[int | None], leds: dict[int, AnyLed]
) -> list[Correspondence]:
    made = []
    for centre, led in zip(centres, ids, strict=True):
        if led is not None:
            covariance = np.reshape(centre.covariance_px2, (2, 2))
            u, v = centre.u_px, centre.v_px
            made.append(
                Correspondence(leds[led], Spot(u, v, covariance, u, v, 0, 0.0, touches_border=False, saturated=False))
            )
    return made


def _hypotheses(
    frame: DeviceFrame, table: LedTable, centres: Sequence[Centre], mirrors: Sequence[Mirror]
) -> Iterator[Hypothesis]:
    """Hypotheses with a pose, and their chi-square with rough centroids, of which each counts to a limit."""
    rough_px = ROUGH_SHARE * frame.camera.width_px
    for mirror in mirrors:
        leds = table.leds(mirror)
        for ids in _assignments(centres):
            correspondences = _correspondences(centres, ids, leds)
            if len(correspondences) < MIN_LEDS:
                continue
            try:
                observations = observe(frame, correspondences, rough_px)
                fits = minima(observations, initial_poses(observations), robust=True)
            except EstimationFailure:
                continue
            if fits:
                # A lamp left out counts as an outlier.
                left_out = sum(bool(centre.candidates) for centre in centres) - len(correspondences)
                yield Hypothesis(mirror, ids, fits[0].cost + left_out * MIN_CLEAR_CHI2)


def _assignments(centres: Sequence[Centre]) -> Iterator[tuple[int | None, ...]]:
    """Ways to give each centre one of its candidates, each LED at most once; as many centres as possible have one."""
    options: list[tuple[int | None, ...]] = []
    shared = {led for centre in centres for led in centre.candidates}
    rivals = {led: sum(led in centre.candidates for centre in centres) for led in shared}
    count = 1
    for centre in centres:
        contested = any(rivals[led] > len(centre.candidates) for led in centre.candidates)
        choice: tuple[int | None, ...] = (*centre.candidates, *((None,) if contested or not centre.candidates else ()))
        options.append(choice)
        count *= len(choice)
    if count > MAX_HYPOTHESES:
        raise EstimationFailure("identify", "too many lamps of one frequency; give --spots")
    for ids in product(*options):
        named = [led for led in ids if led is not None]
        if len(set(named)) == len(named):
            yield ids


def _sigma_px(frame: DeviceFrame, correspondences: Sequence[Correspondence]) -> float:
    """Further standard deviation of a coordinate of a centroid, by the residuals and the prior, pixels."""
    own_px2 = float(np.mean([np.trace(one.spot.covariance_px2) / 2 for one in correspondences]))
    sigma_px = PRIOR_SIGMA_PX
    for _ in range(SIGMA_ROUNDS):
        observations = observe(frame, correspondences, sigma_px)
        fits = minima(observations, initial_poses(observations), robust=True)
        if not fits:
            return sigma_px
        residuals = _residuals_px(frame, correspondences, fits[0].pose)
        # Outliers are not to widen it: squares are limited to those of four standard deviations.
        total_px2 = float(np.minimum(residuals**2, 16 * (sigma_px**2 + own_px2)).sum())
        freedom = max(residuals.size - 6 + (2 if frame.accelerometer is not None else 0), 0)
        mean_px2 = (PRIOR_RESIDUALS * PRIOR_SIGMA_PX**2 + total_px2) / (PRIOR_RESIDUALS + freedom)
        sigma_px = float(np.sqrt(max(mean_px2 - own_px2, 0.25 * PRIOR_SIGMA_PX**2)))
    return sigma_px


def _residuals_px(frame: DeviceFrame, correspondences: Sequence[Correspondence], pose: Pose) -> Floats:
    """Spots minus the images of their LEDs, (n, 2), pixels."""
    leds_m = np.array([one.led.position_m for one in correspondences])
    measured = np.array([(one.spot.u_px, one.spot.v_px) for one in correspondences])
    return np.asarray(measured - project(leds_m, pose, frame.camera).pixels)


def _answer(
    name: str,
    frame: DeviceFrame,
    table: LedTable,
    mirror: Mirror,
    correspondences: Sequence[Correspondence],
    sigma_px: float,
) -> Answer:
    methods: dict[str, Callable[[], Estimate]] = {
        "gravity-fit": lambda: gravity_fit.fit_correspondences(frame, correspondences, sigma_px),
        "up2p": lambda: up2p.fit_correspondences(frame, correspondences, sigma_px),
        "ml": lambda: ml(frame),
        "pnp": lambda: pnp.fit_correspondences(frame, correspondences),
        "ippe": lambda: pnp.fit_correspondences(frame, correspondences, pnp.IPPE_ONLY),
        "sqpnp": lambda: pnp.fit_correspondences(frame, correspondences, pnp.SQPNP_ONLY),
    }
    try:
        estimate = methods[name]()
    except EstimationFailure as failure:
        return Answer(name, failure=str(failure))
    scale = mirror_signs(mirror) / table.unit_m
    covariance = None if estimate.covariance_m2 is None else scale[:, None] * estimate.covariance_m2 * scale
    residuals = _at_position(frame, correspondences, estimate.position_m)
    return Answer(name, scale * estimate.position_m, covariance, residuals, estimate.ambiguous)


def _at_position(frame: DeviceFrame, correspondences: Sequence[Correspondence], position_m: Floats) -> Floats:
    """Residuals (n, 2), pixels, at a position with the orientation that fits best."""
    leds_m = np.array([one.led.position_m for one in correspondences])
    measured = np.array([(one.spot.u_px, one.spot.v_px) for one in correspondences])
    camera = frame.camera
    image = pinhole_image(measured, camera)
    rays = np.column_stack([image, np.ones(len(image))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    to_leds = leds_m - position_m
    to_leds /= np.linalg.norm(to_leds, axis=1, keepdims=True)
    start = Rotation.align_vectors(rays, to_leds)[0]

    def residuals(step: Floats) -> Floats:
        pose = Pose(position_m, np.asarray((Rotation.from_rotvec(step) * start).as_matrix()))
        return np.nan_to_num(_residuals_px(frame, correspondences, pose), nan=1e4).ravel()

    found = least_squares(residuals, np.zeros(3), loss="soft_l1", f_scale=5.0, x_scale=1e-3)
    return residuals(found.x).reshape(-1, 2)


def _limit_px(frame: DeviceFrame) -> float:
    return MAX_RESIDUAL_SHARE * float(np.hypot(frame.camera.width_px, frame.camera.height_px))


def _check_fit(frame: DeviceFrame, answers: Sequence[Answer]) -> Floats:
    """Distances (n,) of the spots from the best variant's model, pixels; refuses a map that fits none of them."""
    usable = [answer for answer in answers if answer.residuals_px is not None]
    if not usable:
        # Of a photograph's pixels `ml` never has a position: the reason is not in the picture.
        why = "; ".join(dict.fromkeys(answer.failure for answer in answers if answer.variant != "ml"))
        raise EstimationFailure("position", f"no variant has a position ({why})")
    limit_px = _limit_px(frame)
    distances = [np.linalg.norm(one.residuals_px, axis=1) for one in usable if one.residuals_px is not None]
    off = min(distances, key=lambda some: float(np.median(some)))
    fitting = off <= 3 * limit_px
    if fitting.mean() < MIN_INLIER_SHARE or np.sqrt((off[fitting] ** 2).mean()) > limit_px:
        raise EstimationFailure(
            "position",
            f"the map does not fit the spots: residuals of {np.sqrt((off**2).mean()):.0f} px, at most {limit_px:.0f} "
            "px are allowed; check the map, its frequencies, --mirror, and the focal length",
        )
    return np.asarray(off)


def covered(answer: Answer, truth: Floats) -> float | None:
    """Chi-square of an error by the stated covariance, None without one; see COVERED_CHI2."""
    if answer.position is None or answer.covariance is None:
        return None
    off = answer.position - truth
    return float(off @ np.linalg.solve(answer.covariance, off))
