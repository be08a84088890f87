"""The light of one LED image: which pixels hold it, and the background beneath it.

The light is summed over an ellipse padded by a margin, or over the padded part above half level itself. The background
is that of a ring around them. It has the lens's fall-off, as the light of the LED has: across the image of a luminaire
of 60 cm by a wide lens it changes by a third, which moved the centroid by 0.4 px of 560. A large LED image therefore
tells the fall-off by its own light, and the background is subtracted with it.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.spots.light_loops import (
    BACKGROUND_SIGMA,
    LEVEL,
    Background,
    Noise,
    Plane,
    background_of,
    centroid_within,
    fall_off,
    light_sums,
    light_within,
    median,
)
from estimator.spots.shape_loops import Form, around_ellipse, around_face, share_among

Pixels = NDArray[np.float64]
Mask = NDArray[np.bool_]
Pair = tuple[float, float]

# Blobs are searched in a 5 x 5 mean, which keeps an LED image of a few electrons a pixel in one piece.
SMOOTHING_PX = 5
MARGIN_PX = 2.0
RING_PX = 3.0
# Standard deviation of normal numbers over the median of their absolute deviations.
SIGMA_OF_MEDIAN = 1.4826
# A pixel that a sharp LED image touches is beside one with more than this share of its brightest pixel's light.
LIT_SHARE = 0.1
# Pieces of a blob count as separate LED images from this share of the largest piece on, by area or by light.
MIN_PIECE = 0.2


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

    @property
    def noise(self) -> Noise:
        """A pixel's noise as `estimator.spots.light_loops` takes it."""
        return self.floor_e2, self.prnu, self.rounding_e2

    def denoised(self, image_e: NDArray[np.float32]) -> "Readout":
        """The region with a denoised image."""
        return Readout(self.row, self.column, image_e, self.raw_e, self.clipped, *self.noise)

    def contiguous(self) -> "Readout":
        """The region with its images row by row in memory, as compiled loops take them."""
        if self.image_e.flags.c_contiguous and self.raw_e.flags.c_contiguous and self.clipped.flags.c_contiguous:
            return self
        images = np.ascontiguousarray(self.image_e), np.ascontiguousarray(self.raw_e)
        return replace(self, image_e=images[0], raw_e=images[1], clipped=np.ascontiguousarray(self.clipped))


@dataclass(frozen=True, eq=False)
class Ellipse:
    """Part of a blob above half level: its centroid (u, v) and the ellipse of the same second moments.

    `axis` (u, v) is the unit vector along the first of its `semi_axes_px`. `low_px` and `high_px` (u, v) are opposite
    vertices of the upright box around the part itself. `stretch` is the factor that makes the ellipse enclose a square.
    `fringe_px` is the width of the light found around the ellipse beyond that of a sharp LED image. `core` are the
    pixels of the part, the first of them at `low_px`; None where the ellipse describes the LED image better.
    """

    centre_px: Pair
    axis: Pair
    semi_axes_px: Pair
    low_px: Pair
    high_px: Pair
    area_px: int
    stretch: float
    fringe_px: float = 0.0
    core: Mask | None = None

    def form(self, padding_px: float) -> Form:
        """The padded ellipse as `estimator.spots.shape_loops` takes it."""
        (u, v), (c, s), (a, b) = self.centre_px, self.axis, self.semi_axes_px
        along, across = (a + padding_px) ** -2, (b + padding_px) ** -2
        return u, v, c * c * along + s * s * across, c * s * (along - across), s * s * along + c * c * across

    def half_extent(self, padding_px: float) -> Pair:
        """Half width and half height of the upright box around the padded ellipse."""
        (c, s), (a, b) = self.axis, self.semi_axes_px
        a, b = a + padding_px, b + padding_px
        return math.hypot(c * a, s * b), math.hypot(s * a, c * b)


class LightSums(NamedTuple):
    """Sums over the pixels of an LED image: flux and centroid (u, v) of the signal, and the pixels' variances; then the
    signal times du^2, du dv and dv^2 about the centroid, and the variances times du^2, du dv, dv^2, du^4 and dv^4. The
    latter are NaN where they were not asked for.
    """

    flux: float
    u: float
    v: float
    noise: float
    uu: float = math.nan
    uv: float = math.nan
    vv: float = math.nan
    noise_uu: float = math.nan
    noise_uv: float = math.nan
    noise_vv: float = math.nan
    noise_uuuu: float = math.nan
    noise_vvvv: float = math.nan

    @property
    def signal_to_noise(self) -> float:
        """Flux over its standard deviation."""
        return self.flux / max(math.sqrt(self.noise), 1e-300)

    def moments_px2(self) -> tuple[float, float, float]:
        """Second moments about the centroid: of u, of u and v, and of v."""
        return self.uu / self.flux, self.uv / self.flux, self.vv / self.flux

    def moment_sigmas_px2(self) -> Pair:
        """Standard deviations of the second moments of u and of v by the pixels' noise."""
        uu, _, vv = self.moments_px2()
        # The sums of variance times (du^2 - uu)^2 and (dv^2 - vv)^2.
        of_uu = self.noise_uuuu - 2 * uu * self.noise_uu + uu * uu * self.noise
        of_vv = self.noise_vvvv - 2 * vv * self.noise_vv + vv * vv * self.noise
        return math.sqrt(max(of_uu, 0.0)) / self.flux, math.sqrt(max(of_vv, 0.0)) / self.flux


@dataclass(frozen=True, eq=False)
class Light:
    """Light of an LED image in the rectangle of its region with the first column `left` and the first row `top`.

    `support` (rows, columns) are the pixels that hold it, `above_e` the electrons of all pixels above the background,
    `variance_e2` their variances. Noise of the background stays below `gate_e`, as far as the device knows of it;
    `ring_off_e` (n,) is how far pixels of the ring are from it. `sums` are those over the support.
    """

    left: int
    top: int
    support: Mask
    above_e: Pixels
    variance_e2: Pixels
    gate_e: float
    ring_off_e: Pixels
    sums: LightSums

    @property
    def signal_e(self) -> Pixels:
        """Electrons above the background in the support, 0 outside it, (rows, columns)."""
        return np.where(self.support, self.above_e, 0.0)

    @property
    def noise_e(self) -> float:
        """What noise of the background stays below, by the device and by the ring's own spread."""
        if not len(self.ring_off_e):
            return self.gate_e
        return max(self.gate_e, BACKGROUND_SIGMA * SIGMA_OF_MEDIAN * median(self.ring_off_e))

    def lit(self, reach_px: int) -> "list[Light]":
        """The light of each sharp LED image in it, brightest first, in the pixels that it can touch and up to
        `reach_px` from them; all in one where noise does not tell which these are.

        A background that is not even moves a centroid by its light in all pixels of the support. A dim pixel beside two
        LED images has light of both, half of it of either by default.
        """
        signal_e = self.signal_e
        limit_e = LIT_SHARE * float(signal_e.max())
        if limit_e <= self.noise_e:
            return [self]
        bright = self.above_e > limit_e
        count, images = cv2.connectedComponents(bright.view(np.uint8), connectivity=8)
        fluxes, in_support = (
            np.bincount(images.ravel(), np.where(bright, light, 0.0).ravel(), count)
            for light in (self.above_e, signal_e)
        )
        # An LED image that the border of the support cuts is the neighbour's that has most of it.
        fluxes[2 * in_support <= fluxes] = 0.0
        if not fluxes.any():
            return [self]
        own = np.argsort(-fluxes)[: np.count_nonzero(fluxes >= MIN_PIECE * fluxes.max())].tolist()
        found = [self._lit_by(images == image, bright, 1 + reach_px) for image in own]
        return [light for light in found if light.sums.flux > 0] or [self]

    def _lit_by(self, own: Mask, bright: Mask, reach_px: int) -> "Light":
        """The light up to `reach_px` from `own` of the pixels that are `bright`.

        Where the pixels beside these are of another surface than most of the ring, their median is the background.
        """
        square = np.ones((2 * reach_px + 1, 2 * reach_px + 1), dtype=np.uint8)
        near, near_others = (cv2.dilate(one.view(np.uint8), square).view(np.bool_) for one in (own, bright & ~own))
        shared = near & near_others & ~bright
        support = (self.support & near & ~bright) | own | shared
        beside = cv2.dilate(near.view(np.uint8), np.ones((3, 3), dtype=np.uint8)).view(np.bool_) & ~near & ~near_others
        beside_e = median(self.above_e[beside]) if beside.any() else 0.0
        above_e = self.above_e - beside_e if abs(beside_e) > self.gate_e else self.above_e
        above_e = np.where(shared, above_e / 2, above_e)
        # The share of light in a pixel is between 0 and 1.
        variance_e2 = self.variance_e2 + np.where(shared, self.above_e**2 / 12, 0.0)
        sums = LightSums(*light_sums(above_e, support, variance_e2, self.left, self.top))
        return replace(self, support=support, above_e=above_e, variance_e2=variance_e2, sums=sums)

    def covariance_px2(self, denoise_radius_px: int) -> Pixels:
        """Covariance of the centroid by the pixels' noise, (2, 2)."""
        s = self.sums
        if denoise_radius_px == 0:
            uu, uv, vv = s.noise_uu / s.flux**2, s.noise_uv / s.flux**2, s.noise_vv / s.flux**2
            return np.array([[uu, uv], [uv, vv]])
        # A centroid of box means is a sum over the raw pixels, weighted by the box means of the centroid's weights.
        rows, columns = self.support.shape
        du, dv = np.arange(columns) + (self.left + 0.5 - s.u), np.arange(rows) + (self.top + 0.5 - s.v)
        box = (2 * denoise_radius_px + 1, 2 * denoise_radius_px + 1)
        levers = self.support * (du / s.flux), self.support * (dv / s.flux)[:, None]
        along_u, along_v = (cv2.blur(lever, box, borderType=cv2.BORDER_CONSTANT) for lever in levers)
        of_u, of_v = self.variance_e2 * along_u, self.variance_e2 * along_v
        # Not np.vdot: the BLAS shares its sums among threads, which cost far more than these.
        mixed = np.einsum("ij,ij", of_u, along_v)
        return np.array([[np.einsum("ij,ij", of_u, along_u), mixed], [mixed, np.einsum("ij,ij", of_v, along_v)]])


class Surface(NamedTuple):
    """The pixels that hold the light of an LED image, and its background.

    They are a rectangle (left, top, width, height) of the region, and in it the `support` (height, width).
    `illumination` is that by the lens, `ring_off_e` (n,) is how far pixels of the ring are from the background.
    """

    rectangle: tuple[int, int, int, int]
    support: Mask
    illumination: Plane
    background: Background
    ring_off_e: Pixels


def surface_of(readout: Readout, ellipse: Ellipse, others: list[Ellipse], denoise_radius_px: int) -> Surface:
    """The ellipse and a margin, without what is of the others; the background is that of a ring around them."""

    def margin_px(of: Ellipse) -> float:
        return MARGIN_PX + max(denoise_radius_px, of.fringe_px)

    own_px = margin_px(ellipse)
    left, top, right, bottom = _surroundings(ellipse, own_px + RING_PX, readout.image_e.shape)
    width, height, illumination = right - left, bottom - top, LEVEL
    if ellipse.core is None:
        support, ring = around_ellipse(ellipse.form(own_px), ellipse.form(own_px + RING_PX), left, top, width, height)
    else:
        face = np.zeros((height, width), dtype=bool)
        column, row = int(ellipse.low_px[0]) - left, int(ellipse.low_px[1]) - top
        face[row : row + ellipse.core.shape[0], column : column + ellipse.core.shape[1]] = ellipse.core
        paddings_px = own_px, RING_PX, SMOOTHING_PX // 2 + ellipse.fringe_px
        support, ring, inside = around_face(face, *paddings_px)
        illumination = fall_off(readout.image_e, left, top, inside) if inside.any() else LEVEL
    if others:
        padded = np.array([other.form(margin_px(other)) for other in others])
        bare = np.array([other.form(0.0) for other in others])
        ring = share_among(support, ring, left, top, ellipse.form(own_px), padded, bare)
    background, off_e = background_of(readout.image_e, readout.raw_e, left, top, ring, illumination, readout.noise)
    return Surface((left, top, width, height), support, illumination, background, off_e)


def light_of(readout: Readout, ellipse: Ellipse, others: list[Ellipse], denoise_radius_px: int) -> Light:
    """Light on the `surface_of` an ellipse."""
    return light_on(surface_of(readout, ellipse, others, denoise_radius_px), readout)


def light_on(surface: Surface, readout: Readout) -> Light:
    """Light on a surface of a region."""
    left, top, *_ = surface.rectangle
    on = left, top, surface.support, surface.illumination, surface.background
    above_e, variance_e2, sums = light_within(readout.image_e, readout.raw_e, *on, readout.noise)
    _, gate_e, _ = surface.background
    return Light(left, top, surface.support, above_e, variance_e2, gate_e, surface.ring_off_e, LightSums(*sums))


def centroid_on(surface: Surface, readout: Readout) -> LightSums:
    """The sums of `light_on` a surface without moments."""
    left, top, *_ = surface.rectangle
    on = left, top, surface.support, surface.illumination, surface.background
    return LightSums(*centroid_within(readout.image_e, readout.raw_e, *on, readout.noise))


def _surroundings(ellipse: Ellipse, padding_px: float, shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """First column and row, and those after the last, of a padded LED image in an image of this shape."""
    if ellipse.core is None:
        (u, v), (half_width, half_height) = ellipse.centre_px, ellipse.half_extent(padding_px)
        left, top, right, bottom = u - half_width, v - half_height, u + half_width, v + half_height
    else:
        (left, top), (right, bottom) = ellipse.low_px, ellipse.high_px
        left, top, right, bottom = left - padding_px, top - padding_px, right + padding_px, bottom + padding_px
    height_px, width_px = shape
    last = min(math.ceil(right), width_px), min(math.ceil(bottom), height_px)
    return max(math.floor(left), 0), max(math.floor(top), 0), *last
