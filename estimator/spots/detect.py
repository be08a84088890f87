"""Detection: LED images with centroids to a hundredth of a pixel, and the centroids' covariances.

Blobs are found in a lightly smoothed copy with one low threshold. The part of a blob above half of its own level gives
an ellipse. The ellipse of a small LED image, which the smoothing widens, is replaced by that of its light's second
moments. The centroid is computed over the ellipse padded by a margin, so that it contains all light of the LED image,
blurred or not, and the background around it cancels. What the sampling by pixels adds is subtracted
(`estimator.spots.sampling`). The light of a small LED image by a sharp lens is that of the pixels which it touches: a
background that is not even would move the centroid by several times its noise.

The light of a large LED image, or of one that may be square, is summed over the padded part above half level itself,
which holds less background than an ellipse around it (`estimator.spots.led_light`).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure
from estimator.spots.led_light import (
    MARGIN_PX,
    MIN_PIECE,
    RING_PX,
    SMOOTHING_PX,
    Ellipse,
    Light,
    Moments,
    Pixels,
    Readout,
    light_of,
)
from estimator.spots.sampling import PIXEL_VARIANCE, SHARP, LensBlur, sampling_error, sampling_variance_px2

# Share of the brightest level: above ceiling and walls at 1/100 of an LED, below an LED at a quarter of it.
THRESHOLD_OF_BRIGHTEST = 0.05
# The mean dilutes LED images of a pixel or two to a tenth and less: the threshold is twice the share of ceiling and
# walls, in any case, of the brightest pixels before the mean.
MIN_THRESHOLD_OF_PEAK = 0.02
THRESHOLD_SIGMA = 6.0
# One bright pixel covers 25 when smoothed; smaller blobs are noise near the threshold.
MIN_BLOB_PX = 16
# More than any scene has LEDs: further blobs are noise in an image without an LED.
MAX_BLOBS = 1000
# A blob larger than a tenth of the frame is a wall or a window of the room.
MAX_BLOB_OF_FRAME = 0.1
# A square of half side r has the second moments of a disc of radius 2 r / sqrt(3), and its vertices at sqrt(2) r.
SQUARE_STRETCH = 1.5**0.5
# A disc of blur extends a quarter further than to where it has fallen to the threshold.
FRINGE_EXTENSION = 1.25
MIN_SIGNAL_TO_NOISE = 5.0
# The 5 x 5 mean widens the part above half level of LED images with a smaller semi-axis than about its own width.
SMALL_PX = 6.0
# The background in the margin matters for LED images with smaller semi-axes, and for the smoothed ones, 1 px larger:
# their light is that of the pixels they touch.
TINY_PX = 3.0
TINY_SMOOTH_PX = 4.0
# Across a disc with a larger semi-axis the lens's fall-off changes the background by more than noise. The ellipse
# around a square contains so much background that this holds from SMALL_PX on.
LARGE_PX = 40.0
# Second moments replace the ellipse where noise changes them by a few percent at most.
MIN_SIGNAL_FOR_MOMENTS = 50.0
# A pixel at a smaller squared distance is in an ellipse, however its distance is rounded.
CLEARLY_INSIDE = 1 - 1e-9
# A sampling error with a smaller share of the noise's variance is left alone.
MIN_SAMPLING_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class Spot:
    """An LED image: its centroid (u, v), continuous pixels with pixel centres at +0.5, and properties.

    `covariance_px2` (2, 2) is the centroid's covariance by the pixels' noise; NaN where it was not asked for. The
    brightest pixel is given by its centre; in a flat or clipped LED image noise decides which it is, and of equal ones
    the first, row by row, is taken. `area_px` are the pixels above half level. `touches_border` marks an LED image that
    may be cut by the border of its region, which biases the centroid; `saturated` one with a pixel that is or may be
    saturated. `flux_e` is the sum of its light, electrons; NaN where it was not measured.
    """

    u_px: float
    v_px: float
    covariance_px2: NDArray[np.float64]
    brightest_u_px: float
    brightest_v_px: float
    area_px: int
    peak_e: float
    touches_border: bool
    saturated: bool
    flux_e: float = math.nan


@dataclass(frozen=True, eq=False)
class _Measured:
    """A spot before the correction for sampling, and its light with the centroid in its region."""

    spot: Spot
    light: Light
    centroid_px: NDArray[np.float64]

    @cached_property
    def moments_px2(self) -> NDArray[np.float64]:
        """Second moments along u and v, (2,)."""
        return self.light.moments_along_px2(self.centroid_px)


def detect(
    readouts: Sequence[Readout],
    sensor_px: int,
    denoise_radius_px: int,
    decoded_px: Pixels | None = None,
    any_square: bool = False,
    near_px: float = 40.0,
    lens: LensBlur = SHARP,
    crosstalk: float = 0.0,
    with_covariances: bool = True,
) -> tuple[Spot, ...]:
    """Detect LED images in the regions read out of a sensor of `sensor_px` pixels: one full frame, or several.

    The brightness scale is measured within `near_px` of `decoded_px` (n, 2), the rough pixels of decoded LEDs, so that
    a brighter light elsewhere does not hide them; without them, or if nothing was read out there, it is the image's
    maximum. `any_square` says that LEDs may be square: the ellipse for the centroid then encloses the square.
    `lens` says how sharp LED images are, `crosstalk` which share of a pixel's electrons its four neighbours collect.
    `denoise_radius_px` is the radius of the box that the denoiser averaged over,
    0 for raw images, whose centroids alone are corrected for sampling. Denoised images may be measured without
    covariances, which take a sixth of the time. An LED image that may be cut by the border of
    its region is reported and flagged. Raises EstimationFailure, which says what was seen in place of LEDs, if there is
    none at all.
    """
    size = (SMOOTHING_PX, SMOOTHING_PX)
    smooth = [cv2.blur(readout.image_e, size, borderType=cv2.BORDER_REPLICATE) for readout in readouts]
    whole = sum(image.size for image in smooth) == sensor_px and len(smooth) == 1
    background_e, threshold_e = levels_of(smooth, whole, brightest_of(readouts, smooth, decoded_px, near_px))
    peak_e = brightest_of(readouts, [readout.image_e for readout in readouts], decoded_px, near_px)
    threshold_e = max(threshold_e, background_e + MIN_THRESHOLD_OF_PEAK * (peak_e - background_e))
    measured: list[_Measured] = []
    found, small, large = 0, 0, 0
    for readout, image in zip(readouts, smooth, strict=True):
        stretch = SQUARE_STRETCH if any_square else 1.0
        ellipses, sizes = _ellipses(image, background_e, threshold_e, MAX_BLOB_OF_FRAME * sensor_px, stretch)
        found, small, large = found + len(ellipses), small + sizes[0], large + sizes[1]
        sharp_reach_px = (0 if crosstalk == 0 else 1) if lens.sharp and denoise_radius_px == 0 else None
        measured += _spots(readout, ellipses, denoise_radius_px, with_covariances, sharp_reach_px)
    if not measured:
        causes = [
            (small, f"smaller than {MIN_BLOB_PX} px"),
            (large, f"larger than {MAX_BLOB_OF_FRAME:g} of the sensor"),
            (found, f"fainter than {MIN_SIGNAL_TO_NOISE:g} sigma"),
        ]
        told = [f"{count} {cause}" for count, cause in causes if count]
        why = f"bright areas: {', '.join(told)}" if told else f"no area is brighter than {threshold_e:.3g} e"
        raise EstimationFailure("detect", f"no spot found; {why}")
    if denoise_radius_px > 0:
        return tuple(one.spot for one in measured)
    return tuple(_corrected_for_sampling(measured, any_square, lens, crosstalk))


def _spots(
    readout: Readout,
    ellipses: Sequence[Ellipse],
    denoise_radius_px: int,
    with_covariances: bool,
    sharp_reach_px: int | None,
) -> list[_Measured]:
    """Measure each ellipse of a region, given those near it.

    `sharp_reach_px` says how far from a sharp LED image its light is; None where it is blurred.
    """
    if sharp_reach_px is not None:
        around = list(_with_neighbours(ellipses, denoise_radius_px))
        ellipses = [part for e, others in around for part in _parted(readout, e, others, sharp_reach_px)]
    if denoise_radius_px == 0:
        around = list(_with_neighbours(ellipses, denoise_radius_px))
        ellipses = [_narrowed(readout, e, others, sharp_reach_px) for e, others in around]
    measured = [
        _measure(readout, ellipse, others, denoise_radius_px, with_covariances, sharp_reach_px)
        for ellipse, others in _with_neighbours(ellipses, denoise_radius_px)
    ]
    return [spot for spot in measured if spot is not None]


def _with_neighbours(ellipses: Sequence[Ellipse], denoise_radius_px: int) -> Iterator[tuple[Ellipse, list[Ellipse]]]:
    """Each ellipse with the others whose surroundings overlap its own."""
    if len(ellipses) == 1:
        yield ellipses[0], []
        return
    fringe_px = max((ellipse.fringe_px for ellipse in ellipses), default=0.0)
    margin_px = MARGIN_PX + max(denoise_radius_px, fringe_px)
    centres = np.array([ellipse.centre_px for ellipse in ellipses]).reshape(-1, 2)
    extents = np.array([ellipse.half_extent(margin_px + RING_PX) for ellipse in ellipses]).reshape(-1, 2)
    for index, ellipse in enumerate(ellipses):
        overlaps = (np.abs(centres - centres[index]) < extents + extents[index]).all(axis=1)
        overlaps[index] = False
        yield ellipse, [ellipses[other] for other in np.flatnonzero(overlaps).tolist()]


def brightest_of(
    readouts: Sequence[Readout], images: Sequence[NDArray[np.float32]], decoded_px: Pixels | None, near_px: float
) -> float:
    """Brightness of the LEDs, electrons: median of the maxima near the decoded pixels, or the image's maximum.

    `images` are those of the readouts, smoothed or not.
    """
    peaks = []
    if decoded_px is not None:
        first = np.array([(readout.column, readout.row) for readout in readouts])
        size = np.array([image.shape[::-1] for image in images])
        low = np.clip(decoded_px[:, None] - near_px - first, 0, size).astype(int)
        high = np.clip(decoded_px[:, None] + near_px - first, 0, size).astype(int)
        spots, parts = np.nonzero((low < high).all(axis=2))
        boxes = np.concatenate([low[spots, parts], high[spots, parts]], axis=1).tolist()
        for part, (left, top, right, bottom) in zip(parts.tolist(), boxes, strict=True):
            peaks.append(float(images[part][top:bottom, left:right].max()))
    return float(np.median(peaks)) if peaks else max(float(image.max()) for image in images)


def levels_of(smooth: Sequence[NDArray[np.float32]], whole: bool, brightest_e: float) -> tuple[float, float]:
    """Background and the threshold for blobs, electrons.

    In a full frame most pixels are background, and a subset of them suffices. An LED image may fill most of its region
    of interest, but not most of the region's outermost pixels: the darkest quarter of these is background.
    """
    if whole:
        (image,) = smooth
        step = max(1, image.shape[1] // 500)
        sample = image[::step, ::step]
        background = float(np.median(sample))
        sigma = 1.4826 * float(np.median(np.abs(sample - background)))
    else:
        outermost = np.concatenate([np.concatenate([s[0], s[-1], s[:, 0], s[:, -1]]) for s in smooth])
        low, background = map(float, np.percentile(outermost, [5, 25]))
        sigma = (background - low) / 0.9704  # between these percentiles of a normal distribution
    above_walls = THRESHOLD_OF_BRIGHTEST * (brightest_e - background)
    return background, background + max(THRESHOLD_SIGMA * sigma, above_walls)


def _ellipses(
    smooth: NDArray[np.float32], background_e: float, threshold_e: float, largest_px: float, stretch: float
) -> tuple[list[Ellipse], tuple[int, int]]:
    """Blobs above the threshold, cut at half of their own level, as ellipses with axes longer by `stretch`.

    Also returns how many blobs are too small, and too large.
    """
    mask = (smooth > threshold_e).view(np.uint8)
    # Finding contours is a hundred times faster than labelling a large image.
    outlines, nesting = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    outer = (
        [outline for outline, (*_, parent) in zip(outlines, nesting[0], strict=True) if parent < 0] if outlines else []
    )
    ellipses = []
    small, large = 0, 0
    for outline in sorted(outer, key=len, reverse=True)[:MAX_BLOBS]:
        left, top, width, height = cv2.boundingRect(outline)
        roi = np.s_[top : top + height, left : left + width]
        own = mask[roi].view(bool)
        if len(outer) > 1:
            column, row = outline[0, 0]
            count, labels = cv2.connectedComponents(mask[roi], connectivity=8)
            own = labels == labels[row - top, column - left] if count > 2 else own
        values = smooth[roi][own]
        if not MIN_BLOB_PX <= len(values) <= largest_px:
            small, large = small + (len(values) < MIN_BLOB_PX), large + (len(values) > largest_px)
            continue
        # The upper quartile is the plateau of an LED image; the maximum would be its noise.
        quartile = 3 * len(values) // 4
        half_e = background_e + (float(np.partition(values, quartile)[quartile]) - background_e) / 2
        core = (own & (smooth[roi] >= half_e)).view(np.uint8)
        count, pieces = cv2.connectedComponents(core, connectivity=8)
        areas = np.bincount(pieces.ravel())[1:] if count > 2 else np.ones(1)
        for piece in np.flatnonzero(areas >= MIN_PIECE * areas.max()).tolist():
            own_piece = pieces == piece + 1 if count > 2 else core.view(bool)
            ellipses.append(_ellipse(own_piece, left, top, stretch, alone=len(areas) == 1))
    return ellipses, (small, large)


def _ellipse(core: NDArray[np.bool_], left: int, top: int, stretch: float, alone: bool) -> Ellipse:
    """Ellipse with the centroid and second moments of the pixels set; (left, top) is the first pixel of `core`.

    `core` has the size of the box around its blob, which is its fringe if it is `alone` in it.
    """
    pixels = Moments(core.astype(np.float64))
    count = pixels.total
    u_px = np.arange(core.shape[1], dtype=np.float64) + (left + 0.5)
    v_px = np.arange(core.shape[0], dtype=np.float64) + (top + 0.5)
    centre = pixels.first(u_px, v_px) / count
    variances, axes = _principal_axes(pixels.second(u_px - centre[0], v_px - centre[1]) / count)
    # A uniform ellipse has variance a^2 / 4 along its semi-axis a.
    semi_axes_px = 2 * stretch * np.sqrt(np.maximum(variances, 0)) + 0.5
    (columns,), (rows,) = pixels.by_column.nonzero(), pixels.by_row.nonzero()
    first_row, last_row, first_column, last_column = map(int, (rows[0], rows[-1], columns[0], columns[-1]))
    low_px = np.array([first_column + left, first_row + top], dtype=np.float64)
    high_px = np.array([last_column + left + 1, last_row + top + 1], dtype=np.float64)
    longest_px = float(semi_axes_px.max())
    uses_core = longest_px > (LARGE_PX if stretch == 1.0 else SMALL_PX)
    own = core[first_row : last_row + 1, first_column : last_column + 1] if uses_core else None
    height, width = core.shape
    wider_px = max(first_column, first_row, width - last_column - 1, height - last_row - 1)
    fringe_px = _fringe_px(wider_px, longest_px) if alone else 0.0
    return Ellipse(centre, axes, semi_axes_px, low_px, high_px, int(count), stretch, fringe_px, own)


def _fringe_px(wider_px: int, semi_axis_px: float) -> float:
    """Fringe of an LED image whose blob's box exceeds its core's by `wider_px`, some of which the smoothing adds.

    A fringe wider than the LED image itself, by its larger semi-axis, is not its blur but another bright object: 0.
    """
    fringe_px = wider_px - SMOOTHING_PX // 2
    return FRINGE_EXTENSION * fringe_px if 0 < fringe_px < semi_axis_px else 0.0


def _principal_axes(moments: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Eigenvalues (2,) and, as columns, unit eigenvectors (2, 2) of second moments (2, 2)."""
    (uu, uv), (_, vv) = moments.tolist()
    angle, middle, half = math.atan2(2 * uv, uu - vv) / 2, (uu + vv) / 2, math.hypot(uu - vv, 2 * uv) / 2
    c, s = math.cos(angle), math.sin(angle)
    return np.array([middle + half, middle - half]), np.array([[c, -s], [s, c]])


def _parted(readout: Readout, ellipse: Ellipse, others: list[Ellipse], reach_px: int) -> list[Ellipse]:
    """The ellipse, or those of the small LED images in it, which the smoothing has merged."""
    if ellipse.semi_axes_px.min() > SMALL_PX:
        return [ellipse]
    parts = light_of(readout, ellipse, others, 0).lit(reach_px)
    if len(parts) == 1:
        return [ellipse]
    areas_px = [int(np.count_nonzero(part.signal_e > part.signal_e.max() / 2)) for part in parts]
    return [replace(_of_moments(ellipse, part), area_px=area) for part, area in zip(parts, areas_px, strict=True)]


def _of_moments(ellipse: Ellipse, light: Light) -> Ellipse:
    """The ellipse of the second moments of light in it."""
    centroid = light.centroid_px()
    variances, axes = _principal_axes(light.moments_px2(centroid))
    semi_axes_px = 2 * ellipse.stretch * np.sqrt(np.maximum(variances, 0)) + 0.5
    found = replace(ellipse, centre_px=centroid, axes=axes, semi_axes_px=semi_axes_px)
    half_extent = found.half_extent(0.0)
    return replace(found, low_px=centroid - half_extent, high_px=centroid + half_extent)


def _narrowed(readout: Readout, ellipse: Ellipse, others: list[Ellipse], sharp_reach_px: int | None) -> Ellipse:
    """The ellipse, or that of the light's second moments if the smoothing has widened it."""
    if ellipse.semi_axes_px.max() > SMALL_PX:
        return ellipse
    lit_px = sharp_reach_px if ellipse.semi_axes_px.min() <= TINY_SMOOTH_PX else None
    for _ in range(2):
        light = light_of(readout, ellipse, others, 0)
        if light.signal_to_noise < MIN_SIGNAL_FOR_MOMENTS:
            return ellipse
        found = _of_moments(ellipse, light if lit_px is None else light.lit(lit_px)[0])
        if (found.semi_axes_px >= ellipse.semi_axes_px).any():
            return ellipse
        ellipse = found
    return ellipse


def _corrected_for_sampling(
    spots: Sequence[_Measured], any_square: bool, lens: LensBlur, crosstalk: float
) -> list[Spot]:
    """Spots without their sampling errors as far as these are known, the rest in the covariances.

    The image of a square depends on its orientation, that of a lens with blur on the blur: there the error is variance
    alone, as over all positions. All spots at once: one by one takes fifty times as long.
    """
    if not spots:
        return []
    centroids = np.array([(one.spot.u_px, one.spot.v_px) for one in spots])
    covariances = np.array([one.spot.covariance_px2 for one in spots])
    # Crosstalk moves a share crosstalk / 4 of the light by a pixel to each side: the centroid stays, by symmetry.
    moments = np.array([one.moments_px2 for one in spots]) - crosstalk / 2
    noise_px2 = np.diagonal(covariances, axis1=1, axis2=2)
    # A semi-ellipse of half extent a has the second moment a^2 / 4, a line a^2 / 3.
    half_px = np.sqrt((3 if any_square else 4) * np.maximum(moments - PIXEL_VARIANCE, 0.0))
    added_px2 = lens.transfer**2 * sampling_variance_px2(half_px.ravel(), any_square).reshape(-1, 2)
    matters = (added_px2 >= MIN_SAMPLING_SHARE * noise_px2).any(axis=1)
    added_px2[~matters] = 0.0
    if lens.sharp and not any_square and matters.any():
        sigmas = np.array([one.light.moment_sigmas_px2(one.centroid_px, one.moments_px2) for one in spots])
        found = sampling_error(centroids[matters].ravel(), moments[matters].ravel(), sigmas[matters].ravel())
        slope = found.slope.reshape(-1, 2)
        centroids[matters] -= found.error_px.reshape(-1, 2)
        covariances[matters] /= slope[:, :, None] * slope[:, None, :]
        added_px2[matters] = found.variance_px2.reshape(-1, 2)
    covariances += added_px2[:, :, None] * np.eye(2)
    return [
        replace(one.spot, u_px=float(u_px), v_px=float(v_px), covariance_px2=covariance)
        for one, (u_px, v_px), covariance in zip(spots, centroids, covariances, strict=True)
    ]


def _measure(
    readout: Readout,
    ellipse: Ellipse,
    others: list[Ellipse],
    denoise_radius_px: int,
    with_covariance: bool,
    sharp_reach_px: int | None,
) -> _Measured | None:
    """Centroid and covariance of one spot; None if its signal-to-noise ratio is too small."""
    height_px, width_px = readout.image_e.shape
    light = light_of(readout, ellipse, others, denoise_radius_px)
    if light.is_fainter(MIN_SIGNAL_TO_NOISE):
        return None
    if sharp_reach_px is not None and ellipse.semi_axes_px.max() <= TINY_PX:
        light = light.lit(sharp_reach_px)[0]
    centroid, u_px, v_px = light.centroid_px(), light.u_px, light.v_px

    brightest, saturated = _brightest(light, ellipse, readout.clipped[light.roi])
    margin_px = MARGIN_PX + max(denoise_radius_px, ellipse.fringe_px)
    (left, top), (right, bottom) = (ellipse.low_px - margin_px).tolist(), (ellipse.high_px + margin_px).tolist()
    covariance = light.covariance_px2(centroid, denoise_radius_px) if with_covariance else np.full((2, 2), np.nan)
    spot = Spot(
        u_px=float(centroid[0]) + readout.column,
        v_px=float(centroid[1]) + readout.row,
        covariance_px2=covariance,
        brightest_u_px=float(u_px[0, brightest[1]]) + readout.column,
        brightest_v_px=float(v_px[brightest[0], 0]) + readout.row,
        area_px=ellipse.area_px,
        peak_e=float(light.electrons[brightest]),
        touches_border=left < 0 or top < 0 or right > width_px or bottom > height_px,
        saturated=saturated,
        flux_e=light.flux_e,
    )
    return _Measured(spot, light, centroid)


def _brightest(light: Light, ellipse: Ellipse, clipped: NDArray[np.bool_]) -> tuple[tuple[int, int], bool]:
    """Row and column of the brightest pixel in an ellipse, and whether one there is among those `clipped`."""
    row, column = divmod(int(light.electrons.argmax()), light.electrons.shape[1])
    here = ellipse.distance2_at(float(light.u_px[0, column]), float(light.v_px[row, 0]))
    if here < CLEARLY_INSIDE and not clipped.any():
        return (row, column), False
    inside = ellipse.distance2(light.u_px, light.v_px, 0.0) <= 1
    row, column = divmod(int(np.argmax(np.where(inside, light.electrons, -np.inf))), inside.shape[1])
    return (row, column), bool(clipped[inside].any())
