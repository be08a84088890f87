"""Cramér-Rao bound of a frame: the smallest covariance of the camera's position that its information allows.

No unbiased estimator has a smaller covariance than the inverse of the Fisher information (S. M. Kay, Fundamentals of
Statistical Signal Processing: Estimation Theory, 1993, chapter 3). Unknown are the camera's position, tilts and yaw;
and, as nuisance parameters, the brightness of each LED and the background level of each group of LEDs whose margins
overlap. Known are the shapes and positions of the LEDs, the lens, the sensor, and which LED each image is of, whether
its identity was decoded or not. With the expected image mu(p) and its variance var(p) of pixel p, the information about
unknowns i and j is

    J_ij = sum over p of (d mu / d i) (d mu / d j) / var,

exact for Poisson counts (var = mu); for a sensor with further noise it is the information in the mean, without the
information in the variance, which goes as 1 / mu. The derivatives with respect to the pose are central differences of
images whose edges are exact. The accelerometer adds 1 / sigma^2 to each of the two tilts.

The hybrid bound (Y. Rockah and P. Schultheiss, Array shape calibration using sources in unknown locations, IEEE Trans.
ASSP 35(3), 1987) lets lens and map err too, by the sigmas of `Uncertainty`: each such error is an unknown with a normal
prior, which adds 1 / sigma^2 to its own information. In units of the sigmas all priors are rows of the identity; the
bound is found by QR from the slopes themselves, never from their products, because these lose the pose where priors are
wide. All slopes follow from those by the pose. With I an LED's image, X its position, p the camera's:

- its position: d I / d X = -d I / d p, since an image depends on X - p alone;
- its size: d I / d ln r = (X - p) . d I / d p, since a larger face is the same as a nearer one;
- the lens: an image that a parameter displaces by w(u, v) px changes by w . T, with T the change for 1 px along u and
  v, from d I / d p and the derivative of the pixel's point on the LED's plane. It takes w as constant in a pixel;
- a gradient of its luminance: the image times the position on the face over its radius, at the pixel's centre.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import Mounted
from vlcrender.camera.roi import LedRegions, RegionImage, Roi, led_regions
from vlcrender.rendering.expected_image import LedPatch
from vlcrender.rendering.led_coverage import intersections_with_plane
from vlcrender.rendering.led_radiance import face_of_led
from vlcrender.rendering.uncertainty import (
    INTRINSICS,
    MapLevers,
    Uncertainty,
    intrinsics_displacements_px,
    tilt_covariance_rad2,
)
from vlcrender.scene.leds import Leds

Array = NDArray[np.float64]

MARGIN_PX = 10.0
"""Background around each LED that counts: its level is an unknown, and more pixels of it add little information."""
STEP_PX = 1e-5
"""Displacement of the two images of a difference to either side. The slope of a pixel's coverage jumps where the edge
enters or leaves the pixel. So small a step crosses such a point in very few pixels. This matters because directions
that are hardly determined depend on small differences between slopes. Images are exact to some 1e-12, slopes then to
1e-7."""
MAX_CONDITION = 1e12
"""Condition number of the information, in units of the steps, above which a direction holds only rounding errors."""
PIXELS_AT_ONCE = 100_000
"""Pixels whose slopes are reduced together: bounds the memory for an LED as large as the image."""
POSITION = slice(0, 3)
"""Unknowns of the pose: x, y, z; after them the tilts and the yaw."""

Render = Callable[[PosedCamera], Sequence[LedPatch]]


def position_bound_m2(
    mounted: Mounted,
    main: Pose,
    render: Render,
    exposure_s: float,
    variance_e2: Sequence[RegionImage],
    distance_m: float,
    tilt_sigmas_deg: tuple[float, float],
    overscan: bool = False,
) -> Array | None:
    """Bound of the covariance of a camera's position, (3, 3), m2, world; None where the frame does not determine it.

    mounted: the camera on its rig. main: the pose of `main`, to which the accelerometer is fixed. render: patches of
    the LEDs with the camera at poses near this, electrons a second. variance_e2: the regions read out, with the
    variance of each pixel, inf for pixels without information (saturated ones). distance_m: from the camera to the
    LEDs, roughly. tilt_sigmas_deg: standard deviations of the accelerometer on tilt_x and tilt_y; 0 means that both
    tilts are known. overscan: whether LEDs count beyond the sensor.
    """
    slopes = FrameSlopes.rendered(mounted, main, render, exposure_s, variance_e2, distance_m, overscan)
    return None if slopes is None else slopes.exact_bound_m2(tilt_sigmas_deg)


@dataclass(frozen=True)
class FrameSlopes:
    """The LED images of a frame and their changes with the pose: what every bound of the frame derives from."""

    mounted: Mounted
    main: Pose
    at_pose: Sequence[LedPatch]
    pairs: Sequence[tuple[Mapping[int, LedPatch], Mapping[int, LedPatch]]]
    """For each unknown of the pose, patches by LED id at a step to either side."""
    steps: tuple[float, ...]
    """Steps of x, y, z in metres and tilt_x, tilt_y, yaw in radians."""
    exposure_s: float
    variance_e2: Sequence[RegionImage]
    overscan: bool

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
    ) -> "FrameSlopes | None":
        """Render a frame's LEDs at the steps of its pose; arguments as in `position_bound_m2`. None without LEDs."""

        def patches_at(pose: Pose) -> Sequence[LedPatch]:
            return render(mounted.posed(pose))

        at_pose = patches_at(main)
        if not at_pose:
            return None
        # Each step moves images by about STEP_PX.
        angle = STEP_PX / mounted.camera.focal_px
        steps = (angle * distance_m,) * 3 + (angle,) * 3
        pairs = []
        for i, step in enumerate(steps):
            plus, minus = (
                {patch.led_id: patch for patch in patches_at(_moved(main, i, sign * step))} for sign in (1, -1)
            )
            pairs.append((plus, minus))
        return cls(mounted, main, at_pose, pairs, steps, exposure_s, variance_e2, overscan)

    def exact_bound_m2(self, tilt_sigmas_deg: tuple[float, float]) -> Array | None:
        """Bound of the position, (3, 3), m2, where lens and map are known; None where it is not determined."""
        information = np.zeros((6, 6))
        for box in self._boxes():
            for common, inside, weight in self._parts(box):
                slopes = np.stack(
                    [
                        (_image(common, plus, inside) - _image(common, minus, inside)) * self.exposure_s / (2 * step)
                        for (plus, minus), step in zip(self.pairs, self.steps, strict=True)
                    ]
                )
                nuisances = [self._light(common, patch) for patch in inside]
                nuisances.append(np.ones((common.rows, common.columns)))
                information += _marginal(slopes, np.stack(nuisances), weight)
        return _position_covariance(information, np.radians(tilt_sigmas_deg), self.steps, self._lever())

    def hybrid_bound_m2(
        self, tilt_sigmas_deg: tuple[float, float], leds: Leds, uncertainty: Uncertainty
    ) -> Array | None:
        """Hybrid bound of the position, (3, 3), m2, where lens, map and mounting err by `uncertainty`.

        leds: all LEDs of the scene as told, to which `uncertainty` belongs. Equal to `exact_bound_m2`, to the rounding
        of slopes, where all its sigmas are 0. None where the frame does not determine a position.
        """
        index_of = {int(led_id): i for i, led_id in enumerate(leds.ids)}
        indices = np.array(sorted({index_of[patch.led_id] for patch in self.at_pose}))
        levers = MapLevers(uncertainty, leds, indices)
        place = {int(i): number for number, i in enumerate(indices)}
        nuisances = len(INTRINSICS) + levers.shared.shape[2]
        # Unknowns in units of sigmas: lens, datum and scale, luminaires; then the pose in units of its steps.
        rows = [np.eye(nuisances, nuisances + 6)]
        for box in self._boxes():
            factor, of_box = self._box_factor(box, leds, index_of, uncertainty)
            angles, lens, positions = factor[:, :3], factor[:, 3:10], factor[:, 10:].reshape(len(factor), -1, 3)
            shared = np.einsum("rkx,kxs->rs", positions, levers.shared[[place[i] for i in of_box]])
            pose = np.concatenate([-positions.sum(axis=1), angles], axis=1) * np.array(self.steps)
            rows.append(np.concatenate([lens * uncertainty.intrinsics, shared, pose], axis=1))
        tilts = tilt_covariance_rad2(self.mounted, self.main, tilt_sigmas_deg, uncertainty.mounting_rad)
        free = [0, 1, 2, 5]
        if tilts.any():
            free = [0, 1, 2, 3, 4, 5]
            prior = np.zeros((2, nuisances + 6))
            prior[:, [nuisances + 3, nuisances + 4]] = np.linalg.inv(np.linalg.cholesky(tilts)) * self.steps[3]
            rows.append(prior)
        columns = [*range(nuisances), *(nuisances + i for i in free)]
        triangle = _triangle(np.concatenate(rows)[:, columns])[nuisances:, nuisances:]
        if not np.isfinite(triangle).all() or np.linalg.cond(triangle) ** 2 > MAX_CONDITION:
            return None
        spread = self._lever()[:, free] * np.array(self.steps)[free] @ np.linalg.inv(triangle)
        bound: Array = spread @ spread.T
        return bound

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

    def _light(self, roi: Roi, led: LedPatch) -> Array:
        """Light of one LED in a region, electrons."""
        return _image(roi, {led.led_id: led}, [led]) * self.exposure_s

    def _slope(self, roi: Roi, unknown: int, led: LedPatch) -> Array:
        """Slope of one LED's light in a region by an unknown of the pose, electrons per m or radian."""
        plus, minus = self.pairs[unknown]
        difference = _image(roi, plus, [led]) - _image(roi, minus, [led])
        return difference * self.exposure_s / (2 * self.steps[unknown])

    def _lever(self) -> Array:
        """Jacobian of the camera's position to the unknowns of the pose of `main`, (3, 6)."""
        ends = [
            [self.mounted.posed(_moved(self.main, i, sign * step)).pose.position_m for sign in (1, -1)]
            for i, step in enumerate(self.steps)
        ]
        lever: Array = np.diff(ends, axis=1)[:, 0].T / (-2 * np.array(self.steps))
        return lever

    def _box_factor(
        self, box: Roi, leds: Leds, index_of: Mapping[int, int], uncertainty: Uncertainty
    ) -> tuple[Array, list[int]]:
        """Information of a box as a factor F: its information matrix is F' F. Also the indices of its LEDs, k.

        Columns of F, (at most 10 + 3 k, 10 + 3 k): tilt_x, tilt_y, yaw, radians; the lens (7), in the units of
        INTRINSICS; x, y, z of each LED, m. Brightness, background, and each LED's own errors are eliminated.
        """
        of_box = sorted({index_of[patch.led_id] for _, inside, _ in self._parts(box) for patch in inside})
        k = len(of_box)
        # Per LED: size and both gradients; then the columns of F.
        total = np.zeros((0, 3 * k + 10 + 3 * k))
        for common, inside, weight in self._parts(box):
            total = np.concatenate([total, self._part_factor(common, inside, weight, leds, index_of, of_box)])
        own = np.concatenate(
            [
                np.stack([uncertainty.led_sizes, *[uncertainty.led_gradients] * 2], axis=1)[of_box].ravel(),
                uncertainty.led_positions_m[of_box].ravel(),
            ]
        )
        # An LED's own displacement has the slopes of its position.
        eliminated = np.concatenate([total[:, : 3 * k], total[:, -3 * k :]], axis=1) * own
        with_priors = np.zeros((len(total) + 6 * k, 6 * k + 10 + 3 * k))
        with_priors[: len(total)] = np.concatenate([eliminated, total[:, 3 * k :]], axis=1)
        with_priors[len(total) :, : 6 * k] = np.eye(6 * k)
        return _triangle(with_priors)[6 * k :, 6 * k :], of_box

    def _part_factor(
        self,
        common: Roi,
        inside: Sequence[LedPatch],
        weight: Array,
        leds: Leds,
        index_of: Mapping[int, int],
        of_box: Sequence[int],
    ) -> Array:
        """Factor of the information of some pixels, as of `_box_factor`, before the LEDs' own errors are eliminated."""
        k = len(of_box)
        known_nothing = len(inside) + 1
        factor = np.zeros((0, known_nothing + 3 * k + 10 + 3 * k))
        rows_at_once = max(1, PIXELS_AT_ONCE // common.columns)
        for start in range(0, common.rows, rows_at_once):
            band = Roi(common.row + start, common.column, min(rows_at_once, common.rows - start), common.columns)
            columns = np.zeros((factor.shape[1], band.rows, band.columns))
            columns[len(inside)] = 1.0
            own, pose = columns[known_nothing:], columns[known_nothing + 3 * k :]
            for number, patch in enumerate(inside):
                columns[number] = self._light(band, patch)
                i = index_of[patch.led_id]
                place = of_box.index(i)
                by_position = np.stack([self._slope(band, unknown, patch) for unknown in range(3)])
                for unknown in range(3):
                    pose[unknown] += self._slope(band, 3 + unknown, patch)
                pose[10 + 3 * place : 13 + 3 * place] = -by_position
                displaced = self._displaced(band, leds, i, by_position)
                pose[3:10] += displaced
                own[3 * place : 3 * place + 3] = self._own_slopes(band, leds, i, columns[number], by_position)
            rows = (columns * np.sqrt(weight[common.slices(band)])).reshape(len(columns), -1).T
            factor = _triangle(np.concatenate([factor, rows]))
        # The part that is orthogonal to brightness and background, as in `_marginal`.
        basis, lengths, _ = np.linalg.svd(factor[:, :known_nothing], full_matrices=False)
        basis = basis[:, lengths > 1e-9 * lengths.max()]
        rest = factor[:, known_nothing:]
        orthogonal: Array = rest - basis @ (basis.T @ rest)
        return orthogonal

    def _displaced(self, roi: Roi, leds: Leds, i: int, by_position: Array) -> Array:
        """Slopes of one LED's light by the unknowns of the lens, (7, rows, columns)."""
        u, v = np.broadcast_arrays(*roi.centers_px())
        per_px = self.shift_slopes(roi, leds, i, by_position)
        moved = intrinsics_displacements_px(self.mounted.camera, u, v)
        slopes: Array = (moved * per_px).sum(axis=1)
        return slopes

    def shift_slopes(self, roi: Roi, leds: Leds, i: int, by_position: Array) -> Array:
        """Slopes of one LED's light by a shift of its image along u and v, (2, rows, columns), electrons per pixel.

        by_position: slopes by the camera's x and y, (2 or more, rows, columns). A move of the camera by (dx, dy) shifts
        the point of the LED's plane that a pixel sees by (dx, dy); a shift of the image by du shifts it by -du times
        the derivative of the point by u.
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

    def _own_slopes(self, roi: Roi, leds: Leds, i: int, light: Array, by_position: Array) -> Array:
        """Slopes of one LED's light by the logarithm of its size and its luminance's gradients, (3, rows, columns).

        All 0 for an LED behind a diffuser, which hides its size and profile.
        """
        if leds.diffusers[i] is not None:
            return np.zeros_like(by_position)
        posed = self.mounted.posed(self.main)
        away_m = leds.centers_m[i] - posed.position_m
        x, y = intersections_with_plane(posed, leds.centers_m[i], *roi.centers_px())
        radius = leds.half_widths_m[i]
        across = (light * np.clip(x / radius, -1, 1), light * np.clip(y / radius, -1, 1))
        return np.stack([np.tensordot(away_m, by_position, axes=1), *across])


def _triangle(rows: Array) -> Array:
    """R of the rows' QR decomposition: R' R = rows' rows, without forming the product."""
    triangle: Array = np.asarray(np.linalg.qr(rows, mode="r"))
    return triangle


def _moved(pose: Pose, unknown: int, by: float) -> Pose:
    """The pose with one of x, y, z (m), tilt_x, tilt_y, yaw (rad) changed."""
    x, y, z = pose.position_m
    numbers = [x, y, z, pose.tilt_x_deg, pose.tilt_y_deg, pose.yaw_deg]
    numbers[unknown] += by if unknown < 3 else float(np.degrees(by))
    return Pose((numbers[0], numbers[1], numbers[2]), *numbers[3:])


def _image(roi: Roi, patches: Mapping[int, LedPatch], leds: Sequence[LedPatch]) -> Array:
    """Light of some LEDs in a region, electrons a second: of those in `patches` (by id) that `leds` names."""
    image = np.zeros((roi.rows, roi.columns))
    for led in leds:
        patch = patches.get(led.led_id)
        if patch is not None and roi.overlaps(patch.roi):
            both = roi.intersection(patch.roi)
            image[roi.slices(both)] += patch.electrons_per_s[patch.roi.slices(both)]
    return image


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
