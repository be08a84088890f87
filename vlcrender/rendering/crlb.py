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
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import Mounted
from vlcrender.camera.roi import LedRegions, RegionImage, Roi, led_regions
from vlcrender.rendering.expected_image import Gains, LedPatch, gain_in
from vlcrender.rendering.face_motions import FACE_NUMBERS, OWN, face_motions, moved
from vlcrender.rendering.led_coverage import intersections_with_plane
from vlcrender.rendering.led_radiance import face_of_led
from vlcrender.rendering.led_slopes import Cameras
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
PIXELS_AT_ONCE = 100_000
"""Pixels whose slopes are reduced together: bounds the memory for an LED as large as the image."""

Render = Callable[[PosedCamera, Sequence[Cameras]], Sequence[Sequence[LedPatch]]]
"""`led_slopes` of a renderer: the patches of some LEDs at a camera, and their changes with each change of it."""
HaloOf = Callable[[Sequence[LedPatch], Roi], Array]
"""The halo of some patches in a region of the sensor, electrons a second."""


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

    mounted: the camera on its rig. main: the pose of `main`, to which the accelerometer is fixed. render: patches of
    the LEDs and their changes, electrons a second. variance_e2: the regions read out, with the
    variance of each pixel, inf for pixels without information (saturated ones). distance_m: from the camera to the
    LEDs, roughly. tilt_sigmas_deg: standard deviations of the accelerometer on tilt_x and tilt_y; 0 means that both
    tilts are known. overscan: whether LEDs count beyond the sensor. halo_of: halos of a lens with glare.
    """
    slopes = FrameSlopes.rendered(mounted, main, render, exposure_s, variance_e2, distance_m, overscan, halo_of)
    return None if slopes is None else slopes.exact_bound_m2(tilt_sigmas_deg)


@dataclass(frozen=True)
class FrameSlopes:
    """The LED images of a frame and their changes with the pose: what every bound of the frame derives from."""

    mounted: Mounted
    main: Pose
    at_pose: Sequence[LedPatch]
    changes: Sequence[Mapping[int, LedPatch]]
    """For each unknown of the pose, by LED id, the change of a patch from a step to one side to a step to the other."""
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
        at_pose, *changed = render(mounted.posed(main), cameras)
        if not at_pose:
            return None
        changes = [{patch.led_id: patch for patch in patches} for patches in changed]
        return cls(mounted, main, at_pose, changes, steps, exposure_s, variance_e2, overscan, halo_of)

    def exposed(self, variance_e2: Sequence[RegionImage], gains: Gains | None = None) -> "FrameSlopes":
        """The slopes of one exposure of the same view: with the variance of its pixels, and known gains of LEDs by id.

        Gains belong to lines of the sensor, not to the images that move. Of a lens with glare they have to be 1.
        """

        def lit(patch: LedPatch) -> LedPatch:
            if gains is None or patch.led_id not in gains:
                return patch
            gain = gain_in(gains[patch.led_id], patch.roi)
            return replace(patch, electrons_per_s=patch.electrons_per_s * gain)

        return replace(
            self,
            at_pose=[lit(patch) for patch in self.at_pose],
            changes=[{led: lit(patch) for led, patch in change.items()} for change in self.changes],
            variance_e2=variance_e2,
        )

    def exact_bound_m2(self, tilt_sigmas_deg: tuple[float, float]) -> Array | None:
        """Bound of the position, (3, 3), m2, where lens and map are known; None where it is not determined."""
        return _position_covariance(self._information, np.radians(tilt_sigmas_deg), self.steps, self.lever())

    @cached_property
    def _information(self) -> Array:
        """Information of the pose in the pixels, (6, 6), per m and radian, where lens and map are known."""
        information = np.zeros((6, 6))
        for box in self._boxes():
            for common, inside, weight in self._parts(box):
                slopes = np.empty((6, common.rows, common.columns))
                for slope, change, step in zip(slopes, self.changes, self.steps, strict=True):
                    np.multiply(self._of(common, change, inside), self.exposure_s, out=slope)
                    slope /= 2 * step
                nuisances = [self._light(common, patch) for patch in inside]
                nuisances.append(np.ones((common.rows, common.columns)))
                information += _marginal(slopes, np.stack(nuisances), weight)
        return information

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
        indices = np.array(sorted({index_of[patch.led_id] for patch in self.at_pose}))
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
                rows.append(_triangle(np.concatenate([priors, with_own]))[len(priors) :, len(priors) :])
        tilts = tilt_covariance_rad2(self.mounted, self.main, tilt_sigmas_deg, uncertainty.mounting_rad)
        free = [0, 1, 2, 5]
        if tilts.any():
            free = [0, 1, 2, 3, 4, 5]
            prior = np.zeros((2, nuisances + 6))
            prior[:, [nuisances + 3, nuisances + 4]] = np.linalg.inv(np.linalg.cholesky(tilts)) * self.steps[3]
            rows.append(prior)
        columns = [*range(nuisances), *(nuisances + i for i in free)]
        triangle = _triangle(np.concatenate(rows)[:, columns])[nuisances:, nuisances:]
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
            for common, inside, weight in self._parts(box):
                nuisances = [self._light(common, patch) for patch in inside]
                nuisances.append(np.ones((common.rows, common.columns)))
                for patch in inside:
                    i = index_of[patch.led_id]
                    by_position = np.stack([self._slope(common, unknown, patch) for unknown in range(2)])
                    shifts = self.shift_slopes(common, leds, i, by_position)
                    part = _marginal(shifts, np.stack(nuisances), weight)
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
        return led_regions((patch.roi for patch in self.at_pose), self.mounted.camera, with_margin)

    def _parts(self, box: Roi) -> Iterator[tuple[Roi, list[LedPatch], Array]]:
        """What the regions read out show of a box: pixels, LEDs in them, and 1 / variance of each pixel."""
        for roi, variance in self.variance_e2:
            if roi.overlaps(box):
                common = roi.intersection(box)
                inside = [patch for patch in self.at_pose if common.overlaps(patch.roi)]
                yield common, inside, 1 / variance[roi.slices(common)].astype(np.float64)

    def _of(self, roi: Roi, patches: Mapping[int, LedPatch], leds: Sequence[LedPatch]) -> Array:
        """Light of some LEDs in a region, electrons a second: of those in `patches` (by id) that `leds` names."""
        found = [patches[led.led_id] for led in leds if led.led_id in patches]
        image = np.zeros((roi.rows, roi.columns))
        if self.halo_of is not None:
            for sign in (1.0, -1.0):  # a halo is that of light, which is positive
                light = [replace(p, electrons_per_s=np.maximum(sign * p.electrons_per_s, 0.0)) for p in found]
                image += sign * self.halo_of(light, roi)
        for patch in found:
            if roi.overlaps(patch.roi):
                both = roi.intersection(patch.roi)
                image[roi.slices(both)] += patch.electrons_per_s[patch.roi.slices(both)]
        return image

    def _light(self, roi: Roi, led: LedPatch) -> Array:
        """Light of one LED in a region, electrons."""
        return self._of(roi, {led.led_id: led}, [led]) * self.exposure_s

    def _slope(self, roi: Roi, unknown: int, led: LedPatch) -> Array:
        """Slope of one LED's light in a region by an unknown of the pose, electrons per m or radian."""
        return self._of(roi, self.changes[unknown], [led]) * self.exposure_s / (2 * self.steps[unknown])

    def _box_factor(
        self, box: Roi, leds: Leds, index_of: Mapping[int, int], uncertainty: Uncertainty
    ) -> tuple[Array, list[int]]:
        """Information of a box as a factor F, such that its information matrix is F' F, and the indices of its k LEDs.

        Columns of F, (at most 6 k, 6 k): the FACE_NUMBERS of each LED. Brightness, background and the gradients of
        luminance are eliminated.
        """
        of_box = sorted({index_of[patch.led_id] for _, inside, _ in self._parts(box) for patch in inside})
        k = len(of_box)
        total = np.zeros((0, 2 * k + FACE_NUMBERS * k))
        for common, inside, weight in self._parts(box):
            total = np.concatenate([total, self._part_factor(common, inside, weight, leds, index_of, of_box)])
        total[:, : 2 * k] *= np.repeat(uncertainty.led_gradients[of_box], 2)
        priors = np.eye(2 * k, total.shape[1])
        return _triangle(np.concatenate([priors, total]))[2 * k :, 2 * k :], of_box

    def _part_factor(
        self,
        common: Roi,
        inside: Sequence[LedPatch],
        weight: Array,
        leds: Leds,
        index_of: Mapping[int, int],
        of_box: Sequence[int],
    ) -> Array:
        """Factor of the information of some pixels about gradients (2 k) and faces (6 k), without other unknowns."""
        k, free = len(of_box), len(inside) + 1
        factor = np.zeros((0, free + 2 * k + FACE_NUMBERS * k))
        rows_at_once = max(1, PIXELS_AT_ONCE // common.columns)
        for start in range(0, common.rows, rows_at_once):
            band = Roi(common.row + start, common.column, min(rows_at_once, common.rows - start), common.columns)
            columns = np.zeros((factor.shape[1], band.rows, band.columns))
            columns[len(inside)] = 1.0
            gradients, faces = columns[free : free + 2 * k], columns[free + 2 * k :]
            for number, patch in enumerate(inside):
                columns[number] = self._light(band, patch)
                i = index_of[patch.led_id]
                led = of_box.index(i)
                x, y, rim_x, rim_y = self._on_face(band, leds, i)
                radius = leds.half_widths_m[i]
                if leds.diffusers[i] is None:
                    gradients[2 * led : 2 * led + 2] = columns[number] * np.clip(np.stack([x, y]) / radius, -1, 1)
                by_shift = [-self._slope(band, unknown, patch) for unknown in range(2)]
                faces[FACE_NUMBERS * led : FACE_NUMBERS * (led + 1)] = [
                    slope * arm for arm in (1.0, rim_x, rim_y) for slope in by_shift
                ]
            rows = (columns * np.sqrt(weight[common.slices(band)])).reshape(len(columns), -1).T
            factor = _triangle(np.concatenate([factor, rows]))
        # The part that is orthogonal to brightness and background, as in `_marginal`.
        basis, lengths, _ = np.linalg.svd(factor[:, :free], full_matrices=False)
        basis = basis[:, lengths > 1e-9 * lengths.max()]
        rest = factor[:, free:]
        orthogonal: Array = rest - basis @ (basis.T @ rest)
        return orthogonal

    def _on_face(self, roi: Roi, leds: Leds, i: int) -> tuple[Array, Array, Array, Array]:
        """Of each pixel's centre, the point (x, y) on an LED's plane and the point of the rim next to it, from the
        face's centre, m.

        An LED's light changes at the rim, however far the lens blurs the change.
        """
        face = face_of_led(leds, i)
        x, y = intersections_with_plane(self.mounted.posed(self.main), face.center_m, *roi.centers_px())
        return x, y, *face.shape.nearest_on_rim(x, y)

    def shift_slopes(self, roi: Roi, leds: Leds, i: int, by_position: Array) -> Array:
        """Slopes of one LED's light by a shift of its image along u and v, (2, rows, columns), electrons per pixel.

        by_position: slopes by the camera's x and y, (2, rows, columns). A move of the camera by (dx, dy) shifts the
        point of the LED's plane that a pixel sees by (dx, dy); a shift of the image by du shifts it by -du times the
        derivative of the point by u.
        """
        posed = self.mounted.posed(self.main)
        center_m = face_of_led(leds, i).center_m
        u, v = roi.centers_px()
        slopes = []
        for du, dv in ((0.5, 0.0), (0.0, 0.5)):
            x1, y1 = intersections_with_plane(posed, center_m, u + du, v + dv)
            x0, y0 = intersections_with_plane(posed, center_m, u - du, v - dv)
            slopes.append(-((x1 - x0) * by_position[0] + (y1 - y0) * by_position[1]))
        return np.stack(slopes)


def _triangle(rows: Array) -> Array:
    """R of the rows' QR decomposition: R' R = rows' rows, without forming the product."""
    triangle: Array = np.asarray(np.linalg.qr(rows, mode="r"))
    return triangle


def _marginal(slopes: Array, nuisances: Array, weight: Array) -> Array:
    """Information about the pose with unknown nuisance parameters: the Schur complement, (6, 6).

    slopes: (6, rows, columns), nuisances: (n, rows, columns), derivatives of the image; weight: 1 / variance.
    """
    scale = np.sqrt(weight).ravel()
    pose_part = slopes.reshape(len(slopes), -1) * scale
    nuisance_part = nuisances.reshape(len(nuisances), -1) * scale
    # The part of each slope that is orthogonal to all nuisances.
    basis, lengths, _ = np.linalg.svd(nuisance_part.T, full_matrices=False)
    basis = basis[:, lengths > 1e-9 * lengths.max()]
    orthogonal = pose_part - (pose_part @ basis) @ basis.T
    product: Array = orthogonal @ orthogonal.T
    return product


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
