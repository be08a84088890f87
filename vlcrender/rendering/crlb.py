"""Cramér-Rao bound of a frame: the smallest covariance of the camera's position that its information allows.

No unbiased estimator has a smaller covariance than the inverse of the Fisher information (S. M. Kay, Fundamentals of
Statistical Signal Processing: Estimation Theory, 1993, chapter 3). Unknown are the camera's position, tilts and yaw;
and, as nuisance parameters, the brightness of each LED and the background level of each group of LEDs whose margins
overlap. Known are the shapes and positions of the LEDs, the lens, the sensor, and which LED each image is of, whether
its identity was decoded or not. With the expected image mu(p) and its variance var(p) of pixel p, the information about
unknowns i and j is

    J_ij = sum over p of (d mu / d i) (d mu / d j) / var,

exact for Poisson counts (var = mu); for a sensor with further noise it is the information in the mean, without the
information in the variance, which goes as 1 / mu. The derivatives with respect to the pose are those of exact edges
(`led_slopes`). The accelerometer adds 1 / sigma^2 to each of the two tilts.

The hybrid bound (Y. Rockah and P. Schultheiss, Array shape calibration using sources in unknown locations, IEEE Trans.
ASSP 35(3), 1987) lets lens and map err too, by the sigmas of `Uncertainty`: each such error is an unknown with a normal
prior, which adds 1 / sigma^2 to its own information. In units of the sigmas all priors are rows of the identity; the
bound is found by QR from the slopes themselves, never from their products, because these lose the pose where priors are
wide. Every unknown moves an LED's image as a motion of the LED's face in its own plane would: a shift and a linear
deformation (`face_motions`). So the pixels of an image tell six numbers, whose slopes follow from those by the camera's
x and y; all else is geometry. Unknowns that cannot be told apart, such as the map's datum and the position, therefore
remain so in the last digit, as they would not with slopes by pixels for each. Motions within a face that are not linear
are left out: of a disc they show nothing, and of a small square next to nothing.

The glare of a lens is known too: an LED's image includes its halo in the group of LEDs that it belongs to; halos of
other groups are part of the background.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import Mounted
from vlcrender.camera.roi import LedRegions, RegionImage, Roi, led_regions
from vlcrender.rendering.expected_image import Gains
from vlcrender.rendering.face_motions import FACE_NUMBERS, OWN, face_motions, moved
from vlcrender.rendering.led_slopes import Cameras
from vlcrender.rendering.moving_led import MovingLed
from vlcrender.rendering.pixel_slopes import HaloOf, PixelSlopes
from vlcrender.rendering.triangles import (
    PIXELS_AT_ONCE,
    ColumnsOf,
    all_columns,
    marginal,
    triangle_of,
    triangle_of_tiles,
)
from vlcrender.rendering.uncertainty import (
    MapLevers,
    Uncertainty,
    tilt_covariance_rad2,
)
from vlcrender.scene.leds import Leds

Array = NDArray[np.float64]

MARGIN_PX = 10.0
"""Background around each LED that counts: its level is an unknown, and more pixels of it add little information."""
STEP_PX = 1e-3
"""Displacement of LED images to either side, in whose differences each unknown's step results: rounding is then below
1e-9 of it, and terms of the third order, (1e-3 px / focal length)^2, are smaller."""
MAX_CONDITION = 1e12
"""Condition number of the information, in units of the steps, above which a direction holds only rounding errors."""

Render = Callable[[PosedCamera, Sequence[Cameras]], Sequence[MovingLed]]
"""`led_slopes` of a renderer: some LEDs at a camera, and how they change with each change of it."""


def position_bound_m2(
    mounted: Mounted,
    main: Pose,
    render: Render,
    exposure_s: float,
    variance_e2: Sequence[RegionImage],
    distance_m: float,
    tilt_sigmas_deg: tuple[float, float],
    overscan: bool = False,
    halo_of: HaloOf | None = None,
) -> Array | None:
    """Bound of the covariance of a camera's position, (3, 3), m2, world; None where the frame does not determine it.

    mounted: the camera on its rig. main: the pose of `main`, to which the accelerometer is fixed. render: light of the
    LEDs and its changes, electrons a second. variance_e2: the regions read out, with the variance of each pixel, inf
    for pixels without information (saturated ones). distance_m: from the camera to the LEDs, roughly. tilt_sigmas_deg:
    standard deviations of the accelerometer on tilt_x and tilt_y; 0 means that both tilts are known. overscan: whether
    LEDs count beyond the sensor. halo_of: halos of a lens with glare.
    """
    slopes = FrameSlopes.rendered(mounted, main, render, exposure_s, variance_e2, distance_m, overscan, halo_of)
    return None if slopes is None else slopes.exact_bound_m2(tilt_sigmas_deg)


@dataclass(frozen=True)
class FrameSlopes:
    """The LED images of a frame and their changes with the pose: what every bound of the frame derives from."""

    mounted: Mounted
    main: Pose
    seen: Sequence[MovingLed]
    """The LEDs, and by each unknown of the pose their change from a step to one side to a step to the other."""
    steps: tuple[float, ...]
    """Steps of x, y, z in metres and tilt_x, tilt_y, yaw in radians."""
    exposure_s: float
    variance_e2: Sequence[RegionImage]
    overscan: bool
    halo_of: HaloOf | None = None
    """Halos of a lens with glare."""

    @classmethod
    def rendered(
        cls,
        mounted: Mounted,
        main: Pose,
        render: Render,
        exposure_s: float,
        variance_e2: Sequence[RegionImage],
        distance_m: float,
        overscan: bool = False,
        halo_of: HaloOf | None = None,
        unknowns: int = 6,
    ) -> "FrameSlopes | None":
        """Render a frame's LEDs at the steps of its pose; arguments as in `position_bound_m2`. None without LEDs.

        unknowns: render the first ones of the pose only; `spot_covariances_px2` needs 2, the bounds all 6.
        """

        # Each step moves images by about STEP_PX.
        angle = STEP_PX / mounted.camera.focal_px
        steps = (angle * distance_m,) * 3 + (angle,) * 3

        def after(unknown: int, step: float) -> PosedCamera:
            return mounted.posed(moved(main, unknown, step))

        cameras = [(after(i, step), after(i, -step)) for i, step in enumerate(steps[:unknowns])]
        seen = render(mounted.posed(main), cameras)
        if not seen:
            return None
        if halo_of is not None:
            seen = [led.held() for led in seen]  # each halo is of whole images
        return cls(mounted, main, seen, steps, exposure_s, variance_e2, overscan, halo_of)

    def exposed(self, variance_e2: Sequence[RegionImage], gains: Gains | None = None) -> "FrameSlopes":
        """The slopes of one exposure of the same view: with the variance of its pixels, and known gains of LEDs by id.

        Gains belong to lines of the sensor, not to the images that move. Of a lens with glare they have to be 1.
        """
        lit = self.seen
        if gains is not None:
            lit = [led.times(gains[led.led_id]) if led.led_id in gains else led for led in self.seen]
        return replace(self, seen=lit, variance_e2=variance_e2)

    @cached_property
    def _pixels(self) -> PixelSlopes:
        return PixelSlopes(self.mounted, self.main, self.steps, self.exposure_s, self.halo_of)

    def exact_bound_m2(self, tilt_sigmas_deg: tuple[float, float]) -> Array | None:
        """Bound of the position, (3, 3), m2, where lens and map are known; None where it is not determined."""
        return _position_covariance(self._information, np.radians(tilt_sigmas_deg), self.steps, self.lever())

    @cached_property
    def _information(self) -> Array:
        """Information of the pose in the pixels, (6, 6), per m and radian, where lens and map are known."""
        information = np.zeros((6, 6))
        for box in self._boxes():
            for common, inside, variance in self._parts(box):
                columns = partial(self._pixels.by_pose, inside)
                rows = self._rows(common, variance, 6 + len(inside) + 1, columns)
                information += marginal(rows[:6], rows[6:])
        by_unit = self.exposure_s / (2 * np.array(self.steps))
        return information * np.outer(by_unit, by_unit)

    def hybrid_bound_m2(
        self, tilt_sigmas_deg: tuple[float, float], leds: Leds, uncertainty: Uncertainty
    ) -> Array | None:
        """Hybrid bound of the position, (3, 3), m2, where lens, map and mounting err by `uncertainty`.

        leds: all LEDs of the scene as told, to which `uncertainty` belongs. The exact bound where all its sigmas are 0.
        None where the frame does not determine a position.
        """
        if uncertainty.is_zero:
            return self.exact_bound_m2(tilt_sigmas_deg)
        return self.bound_of_faces_m2(tilt_sigmas_deg, leds, uncertainty)

    def bound_of_faces_m2(
        self, tilt_sigmas_deg: tuple[float, float], leds: Leds, uncertainty: Uncertainty
    ) -> Array | None:
        """`hybrid_bound_m2` from the place and linear shape of each LED's image, for any `uncertainty`."""
        index_of = {int(led_id): i for i, led_id in enumerate(leds.ids)}
        indices = np.array(sorted({index_of[led.led_id] for led in self.seen}))
        place = {int(i): number for number, i in enumerate(indices)}
        levers = MapLevers(uncertainty, leds, indices)
        motions = face_motions(self.mounted, self.main, leds, indices)
        # In units of sigmas: lens, datum and scale, luminaires; then the pose in units of its steps.
        shared = np.concatenate(
            [
                motions.lens * uncertainty.intrinsics,
                motions.own[:, :, :3] @ levers.shared,
                motions.pose * np.array(self.steps),
            ],
            axis=2,
        )
        tilts_of_faces = [uncertainty.led_faces_rad[:, None]] * 2
        sigmas = np.concatenate([uncertainty.led_positions_m, uncertainty.led_sizes[:, None], *tilts_of_faces], axis=1)
        own = motions.own * sigmas[indices][:, None, :]
        nuisances = shared.shape[2] - 6
        rows = [np.eye(nuisances, nuisances + 6)]
        for box in self._boxes():
            factor, of_box = self._box_factor(box, leds, index_of, uncertainty)
            if of_box:
                places = [place[i] for i in of_box]
                effects = [block_diag(*own[places]), shared[places].reshape(-1, nuisances + 6)]
                with_own = factor @ np.concatenate(effects, axis=1)
                priors = np.eye(OWN * len(of_box), with_own.shape[1])
                rows.append(triangle_of(np.concatenate([priors, with_own]))[len(priors) :, len(priors) :])
        tilts = tilt_covariance_rad2(self.mounted, self.main, tilt_sigmas_deg, uncertainty.mounting_rad)
        free = [0, 1, 2, 5]
        if tilts.any():
            free = [0, 1, 2, 3, 4, 5]
            prior = np.zeros((2, nuisances + 6))
            prior[:, [nuisances + 3, nuisances + 4]] = np.linalg.inv(np.linalg.cholesky(tilts)) * self.steps[3]
            rows.append(prior)
        columns = [*range(nuisances), *(nuisances + i for i in free)]
        triangle = triangle_of(np.concatenate(rows)[:, columns])[nuisances:, nuisances:]
        if len(triangle) < len(free) or not np.isfinite(triangle).all():
            return None
        if np.linalg.cond(triangle) ** 2 > MAX_CONDITION:
            return None
        spread = self.lever()[:, free] * np.array(self.steps)[free] @ np.linalg.inv(triangle)
        bound: Array = spread @ spread.T
        return bound

    def spot_covariances_px2(self, leds: Leds) -> dict[int, Array]:
        """Bound of the covariance (2, 2) of each LED image's position (u, v), px2, by the LED's index.

        Unknown are the image's brightness and the background; size and shape of the image are known. LEDs whose pixels
        do not determine a position, such as saturated ones, are left out. Of LEDs whose margins overlap, the others'
        positions count as known.
        """
        index_of = {int(led_id): i for i, led_id in enumerate(leds.ids)}
        information: dict[int, Array] = {}
        for box in self._boxes():
            for common, inside, variance in self._parts(box):
                free = len(inside) + 1
                columns = partial(self._pixels.by_places, inside, leds, index_of)
                rows = self._rows(common, variance, free + 2 * len(inside), columns)
                for number, led in enumerate(inside):
                    i = index_of[led.led_id]
                    part = marginal(rows[free + 2 * number : free + 2 * number + 2], rows[:free])
                    information[i] = information.get(i, np.zeros((2, 2))) + part
        return {
            i: np.asarray(np.linalg.inv(of_led), dtype=np.float64)
            for i, of_led in information.items()
            if np.isfinite(of_led).all() and np.linalg.cond(of_led) < MAX_CONDITION
        }

    def lever(self) -> Array:
        """Jacobian of the camera's position to the unknowns of the pose of `main`, (3, 6)."""
        ends = [
            [self.mounted.posed(moved(self.main, i, sign * step)).pose.position_m for sign in (1, -1)]
            for i, step in enumerate(self.steps)
        ]
        lever: Array = np.diff(ends, axis=1)[:, 0].T / (-2 * np.array(self.steps))
        return lever

    def _boxes(self) -> tuple[Roi, ...]:
        """The pixels of each group of LEDs whose margins overlap."""
        with_margin = LedRegions(kind="leds", margin_px=MARGIN_PX, overscan=self.overscan)
        return led_regions((led.roi for led in self.seen), self.mounted.camera, with_margin)

    def _parts(self, box: Roi) -> Iterator[tuple[Roi, list[MovingLed], RegionImage]]:
        """What the regions read out show of a box: pixels, LEDs in them, and the variance of each pixel of a region."""
        for region in self.variance_e2:
            if region.roi.overlaps(box):
                common = region.roi.intersection(box)
                yield common, [led for led in self.seen if common.overlaps(led.roi)], region

    def _rows(self, common: Roi, variance: RegionImage, width: int, columns_of: ColumnsOf) -> Array:
        """Numbers of some pixels over their standard deviation, (width, pixels), or fewer with the same products."""

        def scaled(tile: Roi) -> tuple[Array, list[int]]:
            columns, which = columns_of(tile)
            columns *= 1 / np.sqrt(variance.image[variance.roi.slices(tile)].astype(np.float64))
            return columns.reshape(len(columns), -1), which

        # a halo is of whole images: it is not made for each tile
        at_once = self.halo_of is not None or common.pixels <= PIXELS_AT_ONCE
        return all_columns(common, width, scaled) if at_once else triangle_of_tiles(common, width, scaled)

    def _box_factor(
        self, box: Roi, leds: Leds, index_of: Mapping[int, int], uncertainty: Uncertainty
    ) -> tuple[Array, list[int]]:
        """Information of a box as a factor F, such that its information matrix is F' F, and the indices of its k LEDs.

        Columns of F, (at most 6 k, 6 k): the FACE_NUMBERS of each LED. Brightness, background and the gradients of
        luminance are eliminated.
        """
        of_box = sorted({index_of[led.led_id] for _, inside, _ in self._parts(box) for led in inside})
        k = len(of_box)
        total = np.zeros((0, 2 * k + FACE_NUMBERS * k))
        for common, inside, variance in self._parts(box):
            total = np.concatenate([total, self._part_factor(common, inside, variance, leds, index_of, of_box)])
        total[:, : 2 * k] *= np.repeat(uncertainty.led_gradients[of_box], 2)
        priors = np.eye(2 * k, total.shape[1])
        return triangle_of(np.concatenate([priors, total]))[2 * k :, 2 * k :], of_box

    def _part_factor(
        self,
        common: Roi,
        inside: Sequence[MovingLed],
        variance: RegionImage,
        leds: Leds,
        index_of: Mapping[int, int],
        of_box: Sequence[int],
    ) -> Array:
        """Factor of the information of some pixels about gradients (2 k) and faces (6 k), without other unknowns."""
        k, free = len(of_box), len(inside) + 1
        places = [of_box.index(index_of[led.led_id]) for led in inside]
        columns = partial(self._pixels.by_faces, inside, places, leds, index_of, k)
        factor = triangle_of(self._rows(common, variance, free + 2 * k + FACE_NUMBERS * k, columns).T)
        # The part that is orthogonal to brightness and background, as in `marginal`.
        basis, lengths, _ = np.linalg.svd(factor[:, :free], full_matrices=False)
        basis = basis[:, lengths > 1e-9 * lengths.max()]
        rest = factor[:, free:]
        orthogonal: Array = rest - basis @ (basis.T @ rest)
        return orthogonal


def _position_covariance(information: Array, tilt_sigmas: Array, steps: Sequence[float], lever: Array) -> Array | None:
    """Covariance of the position, whose Jacobian to the unknowns is `lever` (3, 6); None where it is not determined."""
    free = [0, 1, 2, 5] if not tilt_sigmas.any() else [0, 1, 2, 3, 4, 5]
    total = information.copy()
    if tilt_sigmas.any():
        total[[3, 4], [3, 4]] += tilt_sigmas**-2
    units = np.array(steps)[free]
    scaled = total[np.ix_(free, free)] * np.outer(units, units)
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > MAX_CONDITION:
        return None
    covariance = np.linalg.inv(scaled) * np.outer(units, units)
    bound: Array = lever[:, free] @ covariance @ lever[:, free].T
    return (bound + bound.T) / 2
