"""The light of one LED image: which pixels hold it, and the background beneath it.

The light is summed over an ellipse padded by a margin, or over the padded part above half level itself. The background
is that of a ring around them. It has the lens's fall-off, as the light of the LED has: across the image of a luminaire
of 60 cm by a wide lens it changes by a third, which moved the centroid by 0.4 px of 560. A large LED image therefore
tells the fall-off by its own light, and the background is subtracted with it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.float64]
Numbers = TypeVar("Numbers", float, Pixels)

# Blobs are searched in a 5 x 5 mean, which keeps an LED image of a few electrons a pixel in one piece.
SMOOTHING_PX = 5
MARGIN_PX = 2.0
RING_PX = 3.0
# Pixels of the ring this many standard deviations from its median are no background of the LED.
BACKGROUND_SIGMA = 3.0
# Standard deviation of normal numbers over the median of their absolute deviations.
SIGMA_OF_MEDIAN = 1.4826
# Of fewer pixels the variance is not measured.
MIN_RING_PIXELS = 20
# Variance of a sample, by n - 1, over its mean square deviation, at most.
MAX_SAMPLE_RATIO = MIN_RING_PIXELS / (MIN_RING_PIXELS - 1)
# Up to this radius a mask is dilated; a larger one by distances takes less time.
MAX_KERNEL_PX = 12.0
# Length of a vector of the processor in bytes, of which OpenCV dilates as many pixels at once.
VECTOR_BYTES = 32
# Of fewer pixels within an LED image the gradient of its light is not measured.
MIN_INSIDE_PIXELS = 20
# Illumination beside an LED image, relative to its middle: luminaires of 60 cm have 0.8 to 1.2; noise may give any.
FALL_OFF_RANGE = 0.5, 2.0
# A ring whose variance exceeds the noise's by this many standard deviations has a structure.
STRUCTURE_SIGMA = 4.0
# A pixel that a sharp LED image touches is beside one with more than this share of its brightest pixel's light.
LIT_SHARE = 0.1
# Pieces of a blob count as separate LED images from this share of the largest piece on, by area or by light.
MIN_PIECE = 0.2
# Below this share of the variance, which noise of half a step exceeds, rounding errors are independent.
MAX_ROUNDING_SHARE = 0.25


@dataclass(frozen=True, eq=False)
class Readout:
    """A region of interest in electrons, `image_e` (rows, columns); its first pixel is (row, column) of the sensor.

    `raw_e` is the image before denoising; `clipped` marks saturated pixels. Beside shot noise a pixel's variance has a
    signal-independent part, `floor_e2`, of which `rounding_e2` is by the ADC's steps, and one proportional to its
    signal squared, by the photo response nonuniformity `prnu`.
    """

    row: int
    column: int
    image_e: NDArray[np.float32]
    raw_e: NDArray[np.float32]
    clipped: NDArray[np.bool_]
    floor_e2: float = 0.0
    prnu: float = 0.0
    rounding_e2: float = 0.0

    def variance_e2(self, raw_e: Numbers) -> Numbers:
        """Variance of pixels with raw electrons, none of them negative."""
        # Shot noise: a raw pixel's variance is its electrons.
        variance_e2 = raw_e + self.floor_e2
        if self.prnu > 0:
            variance_e2 += (self.prnu * raw_e) ** 2
        return variance_e2


@dataclass(frozen=True, eq=False)
class Ellipse:
    """Part of a blob above half level: its centroid (u, v) and the ellipse of the same second moments.

    `axes` (2, 2) are its unit axes as columns, `semi_axes_px` (2,) their lengths. `low_px` and `high_px` (2,) are
    opposite vertices of the upright box around the part itself. `stretch` is the factor that makes the ellipse enclose
    a square. `fringe_px` is the width of the light found around the ellipse beyond that of a sharp LED image. `core`
    are the pixels of the part, the first of them at `low_px`; None where the ellipse describes the LED image better.
    """

    centre_px: NDArray[np.float64]
    axes: NDArray[np.float64]
    semi_axes_px: NDArray[np.float64]
    low_px: NDArray[np.float64]
    high_px: NDArray[np.float64]
    area_px: int
    stretch: float
    fringe_px: float = 0.0
    core: NDArray[np.bool_] | None = None

    def distance2(self, u_px: NDArray[np.float64], v_px: NDArray[np.float64], padding_px: float) -> NDArray[np.float64]:
        """Squared distance from the centre in units of the padded ellipse, at most 1 inside.

        Takes a row of u (1, columns) and a column of v (rows, 1); returns (rows, columns).
        """
        du, dv = u_px - self.centre_px[0], v_px - self.centre_px[1]
        (uu, uv), (_, vv) = ((self.axes / (self.semi_axes_px + padding_px) ** 2) @ self.axes.T).tolist()
        # uu du^2 + vv dv^2 + 2 uv du dv as one product of matrices, which takes a third of the time of its sums.
        by_row, by_column = np.empty((len(dv), 3)), np.empty((3, du.shape[1]))
        by_row[:, :1], by_row[:, 1], by_row[:, 2:] = vv * dv**2, 1.0, 2 * uv * dv
        by_column[0], by_column[1], by_column[2] = 1.0, uu * du[0] ** 2, du[0]
        return np.asarray(by_row @ by_column)

    def distance2_at(self, u_px: float, v_px: float) -> float:
        """`distance2` of one pixel without padding, but for rounding."""
        u, v = self.centre_px.tolist()
        a, b = self.semi_axes_px.tolist()
        (ua, ub), (va, vb) = self.axes.tolist()
        du, dv = u_px - u, v_px - v
        return float(((du * ua + dv * va) / a) ** 2 + ((du * ub + dv * vb) / b) ** 2)

    def half_extent(self, padding_px: float) -> NDArray[np.float64]:
        """Half width and half height, (2,), of the upright box around the padded ellipse."""
        return np.asarray(np.sqrt((self.axes**2) @ (self.semi_axes_px + padding_px) ** 2))


class Moments:
    """Sums of weights (rows, columns): all of them, `total`; `by_column` (columns,) and `by_row` (rows,)."""

    def __init__(self, weights: NDArray[np.float64]) -> None:
        """Sum the weights."""
        rows, columns = weights.shape
        self.weights = weights
        self.by_column = np.asarray(_ones(rows) @ weights)
        self.by_row = np.asarray(weights @ _ones(columns))
        self.total = float(self.by_row.sum())

    def first(self, u_px: Pixels, v_px: Pixels) -> NDArray[np.float64]:
        """Sums (2,) of the weights times u (columns,) and v (rows,)."""
        return np.array([self.by_column @ u_px, self.by_row @ v_px])

    def second(self, du: Pixels, dv: Pixels) -> NDArray[np.float64]:
        """Sums (2, 2) of the weights times du^2, du dv and dv^2; du is along columns, dv along rows."""
        mixed = dv @ (self.weights @ du)
        return np.array([[self.by_column @ du**2, mixed], [mixed, self.by_row @ dv**2]])


@dataclass(frozen=True, eq=False)
class Light:
    """Light of an LED image: pixels of a rectangle `roi` at u (1, columns) and v (rows, 1), of its region's own.

    `above_e` (rows, columns) are electrons above the background, `signal_e` those of the support and 0 outside it;
    `variances_e2` gives the variance of every pixel, none of which exceeds `max_variance_e2`. Noise of the background
    stays below `gate_e`, as far as the device knows of it; `ring_off_e` (n,) is how far pixels of the ring are from it.
    """

    roi: tuple[slice, slice]
    u_px: NDArray[np.float64]
    v_px: NDArray[np.float64]
    electrons: NDArray[np.float64]
    support: NDArray[np.bool_]
    signal_e: NDArray[np.float64]
    variances_e2: Callable[[], Pixels]
    above_e: Pixels
    max_variance_e2: float = math.inf
    gate_e: float = math.inf
    ring_off_e: Pixels | None = None

    @cached_property
    def variance_e2(self) -> Pixels:
        """Variance of every pixel, (rows, columns)."""
        return self.variances_e2()

    @cached_property
    def _signal(self) -> Moments:
        return Moments(self.signal_e)

    @cached_property
    def _noise(self) -> Moments:
        """Variances of the pixels of the support."""
        return Moments(np.where(self.support, self.variance_e2, 0.0))

    @property
    def noise_e(self) -> float:
        """What noise of the background stays below, by the device and by the ring's own spread."""
        if self.ring_off_e is None:
            return self.gate_e
        return max(self.gate_e, BACKGROUND_SIGMA * SIGMA_OF_MEDIAN * _median(self.ring_off_e))

    @property
    def flux_e(self) -> float:
        """Sum of the signal, electrons."""
        return self._signal.total

    @property
    def signal_to_noise(self) -> float:
        """Flux over its standard deviation."""
        return self.flux_e / max(float(np.sqrt(self._noise.total)), 1e-300)

    def is_fainter(self, limit: float) -> bool:
        """Whether `signal_to_noise` is at most a limit."""
        # Most LED images are much brighter even if all pixels had the largest variance; the factor covers rounding.
        max_noise_e = math.sqrt(np.count_nonzero(self.support) * self.max_variance_e2)
        return not self.flux_e > 1.001 * limit * max_noise_e and self.signal_to_noise <= limit

    def lit(self, reach_px: int) -> "list[Light]":
        """The light of each sharp LED image in it, brightest first, in the pixels that it can touch and up to
        `reach_px` from them; all in one where noise does not tell which these are.

        A background that is not even moves a centroid by its light in all pixels of the support. A dim pixel beside two
        LED images has light of both, half of it of either by default.
        """
        limit_e = LIT_SHARE * float(self.signal_e.max())
        if limit_e <= self.noise_e:
            return [self]
        bright = self.above_e > limit_e
        count, images = cv2.connectedComponents(bright.view(np.uint8), connectivity=8)
        fluxes, in_support = (
            np.bincount(images.ravel(), np.where(bright, light, 0.0).ravel(), count)
            for light in (self.above_e, self.signal_e)
        )
        # An LED image that the border of the support cuts is the neighbour's that has most of it.
        fluxes[2 * in_support <= fluxes] = 0.0
        if not fluxes.any():
            return [self]
        own = np.argsort(-fluxes)[: np.count_nonzero(fluxes >= MIN_PIECE * fluxes.max())].tolist()
        found = [self._lit_by(images == image, bright, 1 + reach_px) for image in own]
        return [light for light in found if light.flux_e > 0] or [self]

    def _lit_by(self, own: NDArray[np.bool_], bright: NDArray[np.bool_], reach_px: int) -> "Light":
        """The light up to `reach_px` from `own` of the pixels that are `bright`.

        Where the pixels beside these are of another surface than most of the ring, their median is the background.
        """
        square = np.ones((2 * reach_px + 1, 2 * reach_px + 1), dtype=np.uint8)
        near, near_others = (cv2.dilate(one.view(np.uint8), square).view(np.bool_) for one in (own, bright & ~own))
        shared = near & near_others & ~bright
        support = (self.support & near & ~bright) | own | shared
        beside = cv2.dilate(near.view(np.uint8), np.ones((3, 3), dtype=np.uint8)).view(np.bool_) & ~near & ~near_others
        beside_e = _median(self.above_e[beside]) if beside.any() else 0.0
        above_e = self.above_e - beside_e if abs(beside_e) > self.gate_e else self.above_e
        signal_e = np.where(support, above_e, 0.0)
        signal_e[shared] /= 2
        # The share of light in a pixel is between 0 and 1.
        by_share_e2 = np.where(shared, self.above_e**2 / 12, 0.0)
        variances_e2 = self.variances_e2
        return replace(self, support=support, signal_e=signal_e, variances_e2=lambda: variances_e2() + by_share_e2)

    def centroid_px(self) -> NDArray[np.float64]:
        """Centroid (u, v), (2,)."""
        return self._signal.first(self.u_px[0], self.v_px[:, 0]) / self.flux_e

    def moments_px2(self, centroid_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Second moments about the centroid, (2, 2)."""
        return self._signal.second(*self._offsets(centroid_px)) / self.flux_e

    def moments_along_px2(self, centroid_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Second moments about the centroid along u and v, (2,)."""
        du, dv = self._offsets(centroid_px)
        return self._signal.first(du**2, dv**2) / self.flux_e

    def covariance_px2(self, centroid_px: NDArray[np.float64], denoise_radius_px: int) -> NDArray[np.float64]:
        """Covariance of the centroid by the pixels' noise, (2, 2)."""
        du, dv = self._offsets(centroid_px)
        if denoise_radius_px == 0:
            return self._noise.second(du, dv) / self.flux_e**2
        # A centroid of box means is a sum over the raw pixels, weighted by the box means of the centroid's weights.
        box = (2 * denoise_radius_px + 1, 2 * denoise_radius_px + 1)
        levers = self.support * (du / self.flux_e), self.support * (dv / self.flux_e)[:, None]
        along_u, along_v = (cv2.blur(lever, box, borderType=cv2.BORDER_CONSTANT) for lever in levers)
        of_u, of_v = self.variance_e2 * along_u, self.variance_e2 * along_v
        # Not np.vdot: the BLAS shares its sums among threads, which cost far more than these.
        mixed = np.einsum("ij,ij", of_u, along_v)
        return np.array([[np.einsum("ij,ij", of_u, along_u), mixed], [mixed, np.einsum("ij,ij", of_v, along_v)]])

    def moment_sigmas_px2(self, centroid_px: NDArray[np.float64], moments: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviations (2,) of the second moments (2,) along u and v by the pixels' noise."""
        du, dv = self._offsets(centroid_px)
        along_u, along_v = (du**2 - moments[0]) ** 2, (dv**2 - moments[1]) ** 2
        return np.asarray(np.sqrt(self._noise.first(along_u, along_v)) / self.flux_e)

    def _offsets(self, centroid_px: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Offsets of columns along u, and of rows along v, from the centroid."""
        return self.u_px[0] - centroid_px[0], self.v_px[:, 0] - centroid_px[1]


def light_of(readout: Readout, ellipse: Ellipse, others: list[Ellipse], denoise_radius_px: int) -> Light:
    """Light in the ellipse and a margin; the background is that of a ring around them."""
    margin_px = MARGIN_PX + max(denoise_radius_px, ellipse.fringe_px)
    left, top, right, bottom = _surroundings(ellipse, margin_px + RING_PX, readout.image_e.shape)
    roi = np.s_[top:bottom, left:right]
    u_px, v_px = _centres_px(left, right)[None, :], _centres_px(top, bottom)[:, None]
    electrons = readout.image_e[roi].astype(np.float64)
    fall_off: Pixels | None = None
    if ellipse.core is None or others:
        distance2 = ellipse.distance2(u_px, v_px, margin_px)
    if ellipse.core is None:
        support = distance2 <= 1
        ring = ellipse.distance2(u_px, v_px, margin_px + RING_PX) <= 1
    else:
        face = np.zeros(electrons.shape, dtype=bool)
        column, row = ellipse.low_px.astype(int) - (left, top)
        last_row, last_column = row + ellipse.core.shape[0], column + ellipse.core.shape[1]
        face[row:last_row, column:last_column] = ellipse.core
        # The nearest pixel beside the face is at most a pixel away from the box around it.
        box = np.s_[max(row - 1, 0) : last_row + 1, max(column - 1, 0) : last_column + 1]
        inside = np.zeros_like(face)
        (outside,) = _within(~face[box], SMOOTHING_PX // 2 + ellipse.fringe_px)
        inside[box] = ~outside
        fall_off = _relative_fall_off(electrons, inside)
        support, ring = _within(face, margin_px, margin_px + RING_PX)
    ring &= ~support
    around = ring.copy()
    for other in others:
        # A pixel in two supports belongs to the nearer spot.
        other_distance2 = other.distance2(u_px, v_px, MARGIN_PX + max(denoise_radius_px, other.fringe_px))
        support &= distance2 <= other_distance2
        ring &= other_distance2 > 1
    if not ring.any():  # only the margins of others are beside it
        ring = around
        for other in others:
            ring &= other.distance2(u_px, v_px, 0.0) > 1
    above_e, raw_e, gate_e = electrons, readout.raw_e[roi], math.inf
    off_e: Pixels | None = None
    of_ring = np.flatnonzero(ring)
    if len(of_ring):
        ring_e = raw_e.take(of_ring)
        ring_variance_e2 = readout.variance_e2(np.maximum(ring_e, 0.0, dtype=np.float64))
        # One electron more: the noise of a pixel with fewer is not normal.
        gate_e = BACKGROUND_SIGMA * math.sqrt(_median(ring_variance_e2) + 1.0)
        ring_fall_off = 1.0 if fall_off is None else fall_off.take(of_ring)
        even_e = electrons.take(of_ring) / ring_fall_off
        # The ring without pixels of another surface or light; all of it where its median is between two surfaces.
        off_e = np.abs(even_e - _median(even_e))
        even = off_e <= gate_e
        if not even.any():
            even[:] = True
        background_e = float(even_e[even].mean())
        above_e = electrons - (background_e if fall_off is None else background_e * fall_off)

    def variances_e2() -> Pixels:
        variance_e2 = readout.variance_e2(np.maximum(raw_e, 0.0, dtype=np.float64))
        if len(of_ring) and np.count_nonzero(even) >= MIN_RING_PIXELS:
            model_e2 = float(ring_variance_e2[even].mean())
            excess_e2 = _excess_variance(readout, (ring_e / ring_fall_off)[even], model_e2)
            if excess_e2 != 0:
                unlit = support & (above_e <= gate_e)
                variance_e2[unlit] = np.maximum(variance_e2[unlit] + excess_e2, 0.0)
        return variance_e2

    # The excess is at most the variance of the ring's electrons over the fall-off, which their square exceeds.
    max_e = max(float(raw_e.max()), -float(raw_e.min()))
    max_variance_e2 = readout.variance_e2(max_e) + MAX_SAMPLE_RATIO * (max_e / FALL_OFF_RANGE[0]) ** 2
    signal_e = np.where(support, above_e, 0.0)
    return Light(roi, u_px, v_px, electrons, support, signal_e, variances_e2, above_e, max_variance_e2, gate_e, off_e)


def _median(values: NDArray[np.float64]) -> float:
    """Median of numbers (n,): NumPy's own takes several times as long for a ring's pixels."""
    middle = len(values) // 2
    around = np.partition(values, (middle - 1 + len(values) % 2, middle))
    return float(around[middle - 1 + len(values) % 2] + around[middle]) / 2


@lru_cache(maxsize=1024)
def _ones(count: int) -> Pixels:
    """Ones (count,), the same array each time."""
    ones = np.ones(count)
    ones.setflags(write=False)
    return ones


def _centres_px(first: int, last: int) -> Pixels:
    return np.arange(first, last, dtype=np.float64) + 0.5


def _within(mask: NDArray[np.bool_], *radii_px: float) -> list[NDArray[np.bool_]]:
    """Pixels of a mask, and those at most this far from one, for each radius."""
    if max(radii_px) > MAX_KERNEL_PX:
        distance_px = cv2.distanceTransform((~mask).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        return [np.asarray(distance_px <= radius_px) for radius_px in radii_px]
    rows, columns = mask.shape
    # OpenCV takes up to twice as long for rows that are not of whole vectors.
    whole = np.zeros((rows, columns + -columns % VECTOR_BYTES), dtype=np.uint8)
    whole[:, :columns] = mask
    dilated = [cv2.dilate(whole, _disc(radius_px))[:, :columns] for radius_px in radii_px]
    return [np.ascontiguousarray(one).view(np.bool_) for one in dilated]


@lru_cache(maxsize=256)
def _disc(radius_px: float) -> NDArray[np.uint8]:
    """Pixels at most this far from the middle one."""
    along = np.arange(-int(radius_px), int(radius_px) + 1)
    return (along[:, None] ** 2 + along**2 <= radius_px**2).view(np.uint8)


def _surroundings(ellipse: Ellipse, padding_px: float, shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """First column and row, and those after the last, of a padded LED image in an image of this shape."""
    low_px, high_px = ellipse.low_px - padding_px, ellipse.high_px + padding_px
    if ellipse.core is None:
        half_extent = ellipse.half_extent(padding_px)
        low_px, high_px = ellipse.centre_px - half_extent, ellipse.centre_px + half_extent
    (left, top), (right, bottom) = low_px.tolist(), high_px.tolist()
    height_px, width_px = shape
    last = min(math.ceil(right), width_px), min(math.ceil(bottom), height_px)
    return max(math.floor(left), 0), max(math.floor(top), 0), *last


def _relative_fall_off(electrons: Pixels, inside: NDArray[np.bool_]) -> Pixels:
    """Illumination by the lens in each pixel: the plane that the light inside an LED image follows, 1 at its middle.

    With the second moments S of the pixels inside, a relative gradient g of the light moves their centroid by S g.
    """
    face = Moments(inside.astype(np.float64))
    if face.total < MIN_INSIDE_PIXELS:
        return np.ones(electrons.shape)
    light = Moments(np.where(inside, electrons, 0.0))
    v, u = (np.arange(size, dtype=np.float64) for size in electrons.shape)
    middle = face.first(u, v) / face.total
    du, dv = u - middle[0], v - middle[1]
    gradient = np.linalg.solve(face.second(du, dv) / face.total, light.first(du, dv) / light.total)
    fall_off = gradient[0] * du + (1 + gradient[1] * dv)[:, None]
    # NumPy's clip takes twice the time.
    np.maximum(fall_off, FALL_OFF_RANGE[0], out=fall_off)
    return np.asarray(np.minimum(fall_off, FALL_OFF_RANGE[1], out=fall_off))


def _excess_variance(readout: Readout, ring_e: NDArray[np.floating[Any]], model_e2: float) -> float:
    """Variance of a pixel without light of an LED, by the ring's pixels, less that by the model, electrons squared.

    It is negative where the ADC's steps exceed the noise: neighbouring pixels are then rounded alike, while the model's
    rounding errors are independent. It is positive where the background has a structure.
    """
    excess_e2 = float(ring_e.var(ddof=1, dtype=np.float64)) - model_e2
    if readout.rounding_e2 > MAX_ROUNDING_SHARE * model_e2:
        return excess_e2
    # The variance of n normal numbers has a relative standard deviation of sqrt(2 / n).
    return excess_e2 if excess_e2 > STRUCTURE_SIGMA * np.sqrt(2 / ring_e.size) * model_e2 else 0.0
