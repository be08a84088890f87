"""Noise that pixels have beside what the device states, by the pixels inside LED images.

A pixel minus the mean of its two neighbours in a row or column has 3/2 of a pixel's variance, whatever the light's
level or slope. Inside an LED image the light is even, so that these differences tell the variance of a lit pixel. Where
it is well above the one stated, the rest is taken as noise that does not depend on the light. Noise is alike along rows
and columns. The stripes of an LED that sends are not: where the two variances differ, the smaller one counts.
"""

import math
from collections.abc import Iterable, Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.compiled import compiled_sums
from estimator.io.sensor import Sensor
from estimator.spots.detect import Spot
from estimator.spots.led_light import SMOOTHING_PX, Readout

Floats = NDArray[np.float64] | NDArray[np.float32]
Mask = NDArray[np.bool_]

# Half the side of a square in an LED image, for the radius of a disc of its area: one inside an ellipse of half the
# width that it is long, which is a disc tilted by 60 deg.
SQUARE_SHARE = 0.5
EDGE_PX = 1.5
MAX_HALF_PX = 12
# Half the side of a box around an LED image, for the same radius: around that ellipse, and its rim.
BOX_SHARE = 1.5
# Percentile of the smoothed pixels of a box that is background.
DARK_PERCENT = 10
# Differences along rows or columns, and LED images, that are enough to see that there is no excess.
ENOUGH_DIFFERENCES, ENOUGH_IMAGES = 500, 5
# Variance over the stated one from which on the sensor is noisier than stated. Stated noise stays below by the second
# limit, in standard deviations of the mean of n squares of differences, sqrt(35 / 9 n): those of neighbours overlap.
MIN_RATIO = 1.5
SURE_SIGMA = 6.0
SQUARES_VARIANCE = 35 / 9
# Of single precision, so that a product has the precision of the images.
HALF = np.float32(0.5)


def excess_noise_e2(images: Iterable[tuple[Floats, Mask]], sensor: Sensor) -> float:
    """Variance of a pixel beside that of the sensor as stated, electrons squared; 0 where they agree.

    `images` are electrons around LEDs (rows, columns), and which of them are wholly inside an LED image and known. The
    median of the images decides, so that a few with a structure do not.
    """
    if sensor.gain_e_per_dn is None:
        return 0.0
    stated, measured, differences = [], [], 0
    for electrons, inside in images:
        variances_e2, count = _variances(electrons, inside, sensor)
        if not count:
            continue
        level_e = float(electrons[inside].mean())
        stated.append(level_e + sensor.floor_e2() + (sensor.prnu * level_e) ** 2)
        measured.append(variances_e2)
        differences += count
        enough = differences >= ENOUGH_DIFFERENCES and len(stated) >= ENOUGH_IMAGES
        if enough and not _exceed(measured, stated, differences):
            return 0.0
    if not stated or not _exceed(measured, stated, differences):
        return 0.0
    low_e2, high_e2 = sorted(np.median(np.subtract(measured, np.array(stated)[:, None]), axis=0).tolist())
    alike = high_e2 - low_e2 < SURE_SIGMA * math.sqrt(2 * SQUARES_VARIANCE / differences) * (low_e2 + stated[0])
    return float((low_e2 + high_e2) / 2 if alike else low_e2)


def _variances(electrons: Floats, inside: Mask, sensor: Sensor) -> tuple[tuple[float, float], int]:
    """Variances of a pixel by the differences along rows and along columns, without offsets, and the smaller number of
    these.
    """
    apart = 1 if sensor.mosaic == "none" else 2
    # Copies are in one piece, as compiled loops take arrays.
    of_rows, of_columns, along_rows, along_columns = _squares(electrons.copy(), inside.copy(), apart)
    # Along a row its offset cancels, those of the columns do not.
    along_row_e2 = of_rows / (1.5 * max(along_rows, 1)) - sensor.column_offset_e**2
    along_column_e2 = of_columns / (1.5 * max(along_columns, 1)) - sensor.row_offset_e**2
    return (along_row_e2, along_column_e2), min(along_rows, along_columns)


@compiled_sums
def _squares(electrons: Floats, inside: Mask, apart: int) -> tuple[float, float, int, int]:
    """Sums of the squares of pixels minus the means of the two `apart` from them, along rows and along columns, and the
    numbers of these; all three pixels are inside.
    """
    height, width = electrons.shape
    of_rows, of_columns, along_rows, along_columns = 0.0, 0.0, 0, 0
    for row in range(height):
        line, own = electrons[row], inside[row]
        for column in range(apart, width - apart):
            known = own[column] & own[column - apart] & own[column + apart]
            off = np.float64(line[column] - (line[column - apart] + line[column + apart]) * HALF)
            of_rows += off * off if known else 0.0
            along_rows += known
    for row in range(apart, height - apart):
        line, own = electrons[row], inside[row]
        above, below = electrons[row - apart], electrons[row + apart]
        own_above, own_below = inside[row - apart], inside[row + apart]
        for column in range(width):
            known = own[column] & own_above[column] & own_below[column]
            off = np.float64(line[column] - (above[column] + below[column]) * HALF)
            of_columns += off * off if known else 0.0
            along_columns += known
    return of_rows, of_columns, along_rows, along_columns


def _exceed(measured: Sequence[tuple[float, float]], stated: Sequence[float], differences: int) -> bool:
    """Whether the medians of the variances (n, 2) exceed those stated (n,) along rows and columns."""
    limit = max(MIN_RATIO, 1 + SURE_SIGMA * math.sqrt(SQUARES_VARIANCE / differences))
    # A black image of a sensor with shot noise alone has no variance, stated or measured.
    ratios = np.divide(measured, np.maximum(stated, np.finfo(float).tiny)[:, None])
    return float(np.median(ratios, axis=0).min()) > limit


def excess_noise_of_spots_e2(readouts: Sequence[Readout], spots: Sequence[Spot], sensor: Sensor) -> float:
    """`excess_noise_e2` of detected spots: by squares in their middles, and where these exceed, by all of them."""
    middles = (_middle(*one) for one in _placed(readouts, spots))
    whole = ((middle, np.ones(middle.shape, dtype=bool)) for middle in middles if middle is not None)
    if excess_noise_e2(whole, sensor) == 0:
        return 0.0
    return excess_noise_e2((_lit(*one) for one in _placed(readouts, spots)), sensor)


def _placed(readouts: Sequence[Readout], spots: Sequence[Spot]) -> Iterator[tuple[Readout, Spot]]:
    """Spots without saturated pixels, each with its region."""
    for spot in spots:
        for readout in () if spot.saturated else readouts:
            height_px, width_px = readout.raw_e.shape
            if 0 <= spot.u_px - readout.column < width_px and 0 <= spot.v_px - readout.row < height_px:
                yield readout, spot
                break


def _box(readout: Readout, spot: Spot, half_px: int) -> tuple[slice, slice]:
    """Rows and columns of a region, up to `half_px` from the pixel of the spot."""
    row, column = math.floor(spot.v_px - readout.row), math.floor(spot.u_px - readout.column)
    return tuple(slice(max(at - half_px, 0), at + half_px + 1) for at in (row, column))  # type: ignore[return-value]


def _middle(readout: Readout, spot: Spot) -> NDArray[np.float32] | None:
    """A square inside the LED image; None for a small or cut one."""
    half_px = min(int(SQUARE_SHARE * math.sqrt(spot.area_px / math.pi) - EDGE_PX), MAX_HALF_PX)
    if half_px < 1 or spot.touches_border:
        return None
    return readout.raw_e[_box(readout, spot, half_px)]


def _lit(readout: Readout, spot: Spot) -> tuple[NDArray[np.float32], Mask]:
    """Electrons around a spot, and pixels as far inside its part above half level as the smoothing reaches."""
    box = _box(readout, spot, math.ceil(BOX_SHARE * math.sqrt(spot.area_px / math.pi)) + SMOOTHING_PX)
    raw_e = np.ascontiguousarray(readout.raw_e[box])
    size = (SMOOTHING_PX, SMOOTHING_PX)
    smooth = cv2.blur(raw_e, size, borderType=cv2.BORDER_REPLICATE)
    row, column = (
        math.floor(spot.v_px - readout.row) - box[0].start,
        math.floor(spot.u_px - readout.column) - box[1].start,
    )
    half_e = (float(smooth[row, column]) + float(np.percentile(smooth, DARK_PERCENT))) / 2
    inside = cv2.erode((smooth >= half_e).view(np.uint8), np.ones(size, dtype=np.uint8), borderValue=0)
    return raw_e, inside.view(np.bool_) & ~readout.clipped[box]
