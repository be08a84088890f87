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
from statistics import median
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.errors import EstimationFailure
from estimator.spots.boxes import Box, boxes_near, overlapping
from estimator.spots.led_light import (
    MARGIN_PX,
    MIN_PIECE,
    RING_PX,
    SMOOTHING_PX,
    Ellipse,
    Light,
    LightSums,
    Mask,
    Pair,
    Pixels,
    Readout,
    centroid_on,
    light_of,
    light_on,
    surface_of,
)
from estimator.spots.light_loops import above_half_level, brightest
from estimator.spots.sampling import PIXEL_VARIANCE, SHARP, LensBlur, sampling_error, sampling_variance_px2
from estimator.spots.shape_loops import ellipse_spans, pieces_of, pixels_of

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
# A sampling error with a smaller share of the noise's variance is left alone.
MIN_SAMPLING_SHARE = 1e-3
# Covariance of a centroid without one.
UNKNOWN = np.full((2, 2), np.nan)
UNKNOWN.setflags(write=False)


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


class _Measured(NamedTuple):
    """A spot before the correction for sampling, and the sums over its light."""

    spot: Spot
    sums: LightSums


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
    `denoise_radius_px` is the radius of the box that the denoiser averaged over, 0 for raw images, whose centroids
    alone are corrected for sampling. Denoised images may be measured without covariances. An LED image that may be cut
    by the border of its region is reported and flagged. Raises EstimationFailure, which says what was seen in place of
    LEDs, if there is none at all.
    """
    readouts = [readout.contiguous() for readout in readouts]
    size = (SMOOTHING_PX, SMOOTHING_PX)
    smooth = [cv2.blur(readout.image_e, size, borderType=cv2.BORDER_REPLICATE) for readout in readouts]
    whole = sum(image.size for image in smooth) == sensor_px and len(smooth) == 1
    boxes = boxes_near(readouts, decoded_px, near_px)
    background_e, threshold_e = levels_of(smooth, whole, brightest_of(smooth, boxes))
    peak_e = brightest_of([readout.image_e for readout in readouts], boxes)
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
    if len(ellipses) < 2:
        yield from ((ellipse, []) for ellipse in ellipses)
        return
    margin_px = MARGIN_PX + max(denoise_radius_px, *(ellipse.fringe_px for ellipse in ellipses))
    boxes = np.array([ellipse.centre_px + ellipse.half_extent(margin_px + RING_PX) for ellipse in ellipses])
    others: list[list[Ellipse]] = [[] for _ in ellipses]
    for one, other in overlapping(boxes).tolist():
        others[one].append(ellipses[other])
    yield from zip(ellipses, others, strict=True)


def brightest_of(images: Sequence[NDArray[np.float32]], boxes: Sequence[Box]) -> float:
    """Brightness of the LEDs, electrons: median of the maxima in boxes of the regions' images, or, without a box, the
    maximum of all images.
    """
    parts = [images[box.region][box.top : box.bottom, box.left : box.right] for box in boxes]
    # OpenCV takes half of NumPy's time.
    peaks = [cv2.minMaxLoc(part)[1] for part in parts or images]
    return median(peaks) if parts else max(peaks)


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
        outermost = np.sort(np.concatenate([line for s in smooth for line in (s[0], s[-1], s[:, 0], s[:, -1])]))
        low, background = _of_sorted(outermost, 0.05), _of_sorted(outermost, 0.25)
        sigma = (background - low) / 0.9704  # between these percentiles of a normal distribution
    above_walls = THRESHOLD_OF_BRIGHTEST * (brightest_e - background)
    return background, background + max(THRESHOLD_SIGMA * sigma, above_walls)


def _of_sorted(values: NDArray[np.float32], share: float) -> float:
    """Quantile of sorted numbers, linear between them; NumPy's takes five times as long with the sorting."""
    place = share * (len(values) - 1)
    before = int(place)
    return float(values[before]) + (place - before) * float(values[min(before + 1, len(values) - 1)] - values[before])


def _ellipses(
    smooth: NDArray[np.float32], background_e: float, threshold_e: float, largest_px: float, stretch: float
) -> tuple[list[Ellipse], tuple[int, int]]:
    """Blobs above the threshold, cut at half of their own level, as ellipses with axes longer by `stretch`.

    Also returns how many blobs are too small, and too large.
    """
    mask = (smooth > threshold_e).view(np.uint8)
    # Finding contours is a hundred times faster than labelling a large image.
    outlines, nesting = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    parents = nesting[0, :, 3].tolist() if outlines else []
    outer = [outline for outline, parent in zip(outlines, parents, strict=True) if parent < 0]
    ellipses = []
    small, large = 0, 0
    for outline in sorted(outer, key=len, reverse=True)[:MAX_BLOBS]:
        left, top, width, height = cv2.boundingRect(outline)
        blob = np.ascontiguousarray(mask[top : top + height, left : left + width]).view(np.bool_)
        if len(outer) > 1:
            column, row = outline[0, 0].tolist()
            blob = _piece_at(blob, row - top, column - left)
        area_px = cv2.countNonZero(blob.view(np.uint8))
        if not MIN_BLOB_PX <= area_px <= largest_px:
            small, large = small + (area_px < MIN_BLOB_PX), large + (area_px > largest_px)
            continue
        core = above_half_level(smooth, left, top, blob, background_e)
        pieces, runs = pieces_of(core)
        least_px, alone = MIN_PIECE * int(pieces[:, 0].max()), len(pieces) == 1
        for number, piece in enumerate(pieces.tolist()):
            if piece[0] >= least_px:
                own = core if alone else pixels_of(runs, number, height, width)
                ellipses.append(_ellipse(own, piece, left, top, stretch, alone))
    return ellipses, (small, large)


def _piece_at(mask: Mask, row: int, column: int) -> Mask:
    """The piece of a mask that one of its pixels is in."""
    pieces, runs = pieces_of(mask)
    if len(pieces) == 1:
        return mask
    here = (runs[:, 0] == row) & (runs[:, 1] <= column) & (column < runs[:, 2])
    return pixels_of(runs, int(runs[here, 3][0]), *mask.shape)


def _ellipse(mask: Mask, piece: Sequence[int], left: int, top: int, stretch: float, alone: bool) -> Ellipse:
    """Ellipse with the centroid and second moments of a piece; (left, top) is the first pixel of its mask.

    The mask has the size of the box around the piece's blob, which is its fringe if it is `alone` in it.
    """
    count, of_u, of_v, of_uu, of_uv, of_vv, first_column, first_row, last_column, last_row = piece
    # Sums of whole numbers: exact before they are divided.
    uu, uv, vv = count * of_uu - of_u * of_u, count * of_uv - of_u * of_v, count * of_vv - of_v * of_v
    variances, axis = _principal_axes(uu / count**2, uv / count**2, vv / count**2)
    semi_axes_px = _semi_axes_px(variances, stretch)
    uses_core = semi_axes_px[0] > (LARGE_PX if stretch == 1.0 else SMALL_PX)
    height, width = mask.shape
    wider_px = max(first_column, first_row, width - last_column - 1, height - last_row - 1)
    return Ellipse(
        centre_px=(of_u / count + left + 0.5, of_v / count + top + 0.5),
        axis=axis,
        semi_axes_px=semi_axes_px,
        low_px=(left + first_column, top + first_row),
        high_px=(left + last_column + 1, top + last_row + 1),
        area_px=count,
        stretch=stretch,
        fringe_px=_fringe_px(wider_px, semi_axes_px[0]) if alone else 0.0,
        core=mask[first_row : last_row + 1, first_column : last_column + 1] if uses_core else None,
    )


def _fringe_px(wider_px: int, semi_axis_px: float) -> float:
    """Fringe of an LED image whose blob's box exceeds its core's by `wider_px`, some of which the smoothing adds.

    A fringe wider than the LED image itself, by its larger semi-axis, is not its blur but another bright object: 0.
    """
    fringe_px = wider_px - SMOOTHING_PX // 2
    return FRINGE_EXTENSION * fringe_px if 0 < fringe_px < semi_axis_px else 0.0


def _principal_axes(uu: float, uv: float, vv: float) -> tuple[Pair, Pair]:
    """Eigenvalues of second moments, the larger first, and its unit eigenvector (u, v)."""
    angle, middle, half = math.atan2(2 * uv, uu - vv) / 2, (uu + vv) / 2, math.hypot(uu - vv, 2 * uv) / 2
    return (middle + half, middle - half), (math.cos(angle), math.sin(angle))


def _semi_axes_px(variances: Pair, stretch: float) -> Pair:
    """Semi-axes, longer by `stretch`, of an ellipse by the variances along them."""
    # A uniform ellipse has variance a^2 / 4 along its semi-axis a.
    a, b = (2 * stretch * math.sqrt(max(variance, 0.0)) + 0.5 for variance in variances)
    return a, b


def _parted(readout: Readout, ellipse: Ellipse, others: list[Ellipse], reach_px: int) -> list[Ellipse]:
    """The ellipse, or those of the small LED images in it, which the smoothing has merged."""
    if min(ellipse.semi_axes_px) > SMALL_PX:
        return [ellipse]
    parts = light_of(readout, ellipse, others, 0).lit(reach_px)
    if len(parts) == 1:
        return [ellipse]
    areas_px = [int(np.count_nonzero(part.signal_e > part.signal_e.max() / 2)) for part in parts]
    return [replace(_of_moments(ellipse, part), area_px=area) for part, area in zip(parts, areas_px, strict=True)]


def _of_moments(ellipse: Ellipse, light: Light) -> Ellipse:
    """The ellipse of the second moments of light in it."""
    sums = light.sums
    variances, axis = _principal_axes(*sums.moments_px2())
    semi_axes_px = _semi_axes_px(variances, ellipse.stretch)
    found = replace(ellipse, centre_px=(sums.u, sums.v), axis=axis, semi_axes_px=semi_axes_px)
    half_width, half_height = found.half_extent(0.0)
    low_px, high_px = (sums.u - half_width, sums.v - half_height), (sums.u + half_width, sums.v + half_height)
    return replace(found, low_px=low_px, high_px=high_px)


def _narrowed(readout: Readout, ellipse: Ellipse, others: list[Ellipse], sharp_reach_px: int | None) -> Ellipse:
    """The ellipse, or that of the light's second moments if the smoothing has widened it."""
    if max(ellipse.semi_axes_px) > SMALL_PX:
        return ellipse
    lit_px = sharp_reach_px if min(ellipse.semi_axes_px) <= TINY_SMOOTH_PX else None
    for _ in range(2):
        light = light_of(readout, ellipse, others, 0)
        if light.sums.signal_to_noise < MIN_SIGNAL_FOR_MOMENTS:
            return ellipse
        found = _of_moments(ellipse, light if lit_px is None else light.lit(lit_px)[0])
        if any(new >= old for new, old in zip(found.semi_axes_px, ellipse.semi_axes_px, strict=True)):
            return ellipse
        ellipse = found
    return ellipse


def _corrected_for_sampling(
    measured: Sequence[_Measured], any_square: bool, lens: LensBlur, crosstalk: float
) -> list[Spot]:
    """Spots without their sampling errors as far as these are known, the rest in the covariances.

    The image of a square depends on its orientation, that of a lens with blur on the blur: there the error is variance
    alone, as over all positions. All spots at once: one by one takes fifty times as long.
    """
    spots = [one.spot for one in measured]
    covariances = np.array([spot.covariance_px2 for spot in spots])
    # Crosstalk moves a share crosstalk / 4 of the light by a pixel to each side: the centroid stays, by symmetry.
    moments = np.array([one.sums.moments_px2()[::2] for one in measured]) - crosstalk / 2
    noise_px2 = np.diagonal(covariances, axis1=1, axis2=2)
    # A semi-ellipse of half extent a has the second moment a^2 / 4, a line a^2 / 3.
    half_px = np.sqrt((3 if any_square else 4) * np.maximum(moments - PIXEL_VARIANCE, 0.0))
    added_px2 = lens.transfer**2 * sampling_variance_px2(half_px.ravel(), any_square).reshape(-1, 2)
    matters = np.flatnonzero((added_px2 >= MIN_SAMPLING_SHARE * noise_px2).any(axis=1)).tolist()
    if not matters:
        return spots
    centroids = np.array([(spots[k].u_px, spots[k].v_px) for k in matters])
    covariances, added_px2, moments = covariances[matters], added_px2[matters], moments[matters]
    if lens.sharp and not any_square:
        sigmas = np.array([measured[k].sums.moment_sigmas_px2() for k in matters])
        found = sampling_error(centroids.ravel(), moments.ravel(), sigmas.ravel())
        slope = found.slope.reshape(-1, 2)
        centroids -= found.error_px.reshape(-1, 2)
        covariances /= slope[:, :, None] * slope[:, None, :]
        added_px2 = found.variance_px2.reshape(-1, 2)
    covariances += added_px2[:, :, None] * np.eye(2)
    for k, (u_px, v_px), covariance in zip(matters, centroids.tolist(), covariances, strict=True):
        spots[k] = replace(spots[k], u_px=u_px, v_px=v_px, covariance_px2=covariance)
    return spots


def _measure(
    readout: Readout,
    ellipse: Ellipse,
    others: list[Ellipse],
    denoise_radius_px: int,
    with_covariance: bool,
    sharp_reach_px: int | None,
) -> _Measured | None:
    """Centroid and covariance of one spot; None if its signal-to-noise ratio is too small."""
    surface = surface_of(readout, ellipse, others, denoise_radius_px)
    light = light_on(surface, readout) if with_covariance else None
    sums = centroid_on(surface, readout) if light is None else light.sums
    if sums.signal_to_noise <= MIN_SIGNAL_TO_NOISE:
        return None
    left, top, *_ = surface.rectangle
    inside = ellipse_spans(ellipse.form(0.0), *surface.rectangle)
    row, column, saturated = brightest(readout.image_e, readout.clipped, left, top, inside)
    if light is not None and sharp_reach_px is not None and max(ellipse.semi_axes_px) <= TINY_PX:
        light = light.lit(sharp_reach_px)[0]
        sums = light.sums
    height_px, width_px = readout.image_e.shape
    margin_px = MARGIN_PX + max(denoise_radius_px, ellipse.fringe_px)
    (first_u, first_v), (last_u, last_v) = ellipse.low_px, ellipse.high_px
    outside_px = max(-first_u, -first_v, last_u - width_px, last_v - height_px)
    spot = Spot(
        u_px=sums.u + readout.column,
        v_px=sums.v + readout.row,
        covariance_px2=UNKNOWN if light is None else light.covariance_px2(denoise_radius_px),
        brightest_u_px=column + 0.5 + readout.column,
        brightest_v_px=row + 0.5 + readout.row,
        area_px=ellipse.area_px,
        peak_e=float(readout.image_e[row, column]),
        touches_border=outside_px + margin_px > 0,
        saturated=saturated,
        flux_e=sums.flux,
    )
    return _Measured(spot, sums)
