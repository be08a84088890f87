"""Point spread function of the lens: the disc of defocus, and the Airy pattern or a measured kernel.

Thin lens and similar triangles: with the pupil D = f / N and the sensor at the image distance f_i, focused at s, a
point at depth z spreads over a disc of diameter D f_i |1/s - 1/z|. Airy pattern: Born & Wolf, Principles of Optics,
7th ed., 8.5.2, Eq. 14.
"""

from functools import lru_cache, reduce

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.special import j1

from estimator.io.camera import Camera
from estimator.pixels.polygon_raster import MAX_EDGE_PX, Outlines, RoiStack, cover

Floats = NDArray[np.float64]

# A smaller disc is negligible: it blurs the step of an edge by about 0.05^2 / 48 of a pixel.
MIN_DISC_PX = 0.05
# Radius of the Airy pattern, in units of lambda N: beyond it is 1 % of the light, spread like background.
AIRY_RADIUS = 20.5
AIRY_SAMPLES = 8
# Diameter, in units of lambda N, of a disc with the same blur: determines the kernel's pixels.
AIRY_WIDTH = 2.0
# Pixels across a kernel, see `LensBlur`; pixels are subdivided at most by 2^MAX_DOUBLINGS along each axis, and by
# 2^AIRY_DOUBLINGS for the Airy pattern, which is smooth and wide.
CELLS_ACROSS = 20.0
MAX_DOUBLINGS = 4
AIRY_DOUBLINGS = 2
# Maximum subdivision for derivatives, which need less accuracy.
DISC_SLOPES = 4
AIRY_SLOPES = 2
# LEDs whose discs differ by less than this share a kernel.
DISC_STEP_PX = 0.005


class LensBlur:
    """Kernels of n LEDs at given depths, `kernels`, each on pixels subdivided by `factors` (n,).

    `slope_kernels` are the same on pixels subdivided by `slope_factors`, divisors of `factors`: derivatives need less
    accuracy.

    Images and kernels both hold averages over pixels, so their convolution applies the pixel's square twice. The error
    at a sharp straight edge is at most 0.2 / (pixels across a disc)^1.5, which `factors` reduces: below 0.8 % of the
    LED's light from 1 px on (tested), where whole pixels would have 11 %.
    `radius_px` is the half width of the widest kernel, 0 without blur; then there are no kernels.
    """

    def __init__(self, camera: Camera, depth_m: Floats) -> None:
        """Make the kernels of a camera for LEDs at `depth_m` (n,)."""
        discs_px = disc_diameter_px(camera, depth_m)
        airy_px = airy_scale_px(camera) if camera.psf == "diffraction" else 0.0
        self.kernels: list[Floats] = []
        self.slope_kernels: list[Floats] = []
        self.factors = np.ones(len(depth_m), dtype=np.int64)
        self.slope_factors = self.factors
        self.radius_px = 0
        if camera.psf == "none" and (discs_px < MIN_DISC_PX).all():
            return
        width_px = np.maximum(discs_px, AIRY_WIDTH * airy_px)
        blurred = width_px > MIN_DISC_PX
        max_doublings, max_slope_factor = (AIRY_DOUBLINGS, AIRY_SLOPES) if airy_px > 0 else (MAX_DOUBLINGS, DISC_SLOPES)
        needed = np.ceil(np.log2(CELLS_ACROSS / np.where(blurred, width_px, CELLS_ACROSS)))
        self.factors = 2 ** np.clip(needed, 0, max_doublings).astype(np.int64)
        cache: dict[tuple[int, int], Floats] = {}
        for disc_px, factor in zip(discs_px.tolist(), self.factors.tolist(), strict=True):
            step = round(disc_px / DISC_STEP_PX)
            slope_factor = min(factor, max_slope_factor)
            for subdivision, kernels in ((slope_factor, self.slope_kernels), (factor, self.kernels)):
                if (step, subdivision) not in cache:
                    cache[step, subdivision] = _kernel(camera, step * DISC_STEP_PX, airy_px, subdivision)
                kernels.append(cache[step, subdivision])
        self.slope_factors = np.minimum(self.factors, max_slope_factor)
        widths = np.array([[len(k) for k in kernels] for kernels in (self.slope_kernels, self.kernels)])
        self.radius_px = int(np.ceil((widths / np.stack([self.slope_factors, self.factors])).max() / 2))


def disc_diameter_px(camera: Camera, depth_m: Floats) -> Floats:
    """Diameters (n,) of the defocus discs of points at depths (n,), pixels."""
    if camera.focus_distance_m is None:
        return 0 * depth_m
    focus = 0.0 if camera.focus_distance_m == "infinity" else 1 / float(camera.focus_distance_m)
    pupil_px = camera.focal_length_mm / camera.f_number * 1000 / camera.pixel_pitch_um
    return np.asarray(pupil_px * camera.image_distance_mm / 1000 * np.abs(focus - 1 / depth_m))


def airy_scale_px(camera: Camera) -> float:
    """Wavelength times the working f-number, f_i / D, in pixels."""
    working = camera.f_number * camera.image_distance_mm / camera.focal_length_mm
    return working * camera.psf_wavelength_nm / 1000 / camera.pixel_pitch_um


def _kernel(camera: Camera, disc_px: float, airy_px: float, factor: int) -> Floats:
    """Convolution of all blurs, on pixels subdivided by `factor`, (n, n) with n odd, normalized to 1."""
    parts = []
    if disc_px >= MIN_DISC_PX:
        parts.append(_disc(disc_px * factor))
    if airy_px > 0:
        parts.append(_airy(airy_px * factor))
    if camera.psf_kernel is not None:
        # Measured on whole pixels: it applies at whole-pixel shifts alone.
        measured = np.array(camera.psf_kernel)
        comb = np.zeros((np.array(measured.shape) - 1) * factor + 1)
        comb[::factor, ::factor] = measured
        parts.append(comb)
    kernel = reduce(_convolved, parts) if parts else np.ones((1, 1))
    return np.asarray(kernel / kernel.sum())


def _convolved(one: Floats, other: Floats) -> Floats:
    """Full convolution. SciPy's own is not imported: it brings all of `scipy.stats`, two seconds."""
    rows, columns = np.array(one.shape) + other.shape - 1
    shape = next_fast_len(int(rows), real=True), next_fast_len(int(columns), real=True)
    return np.asarray(irfft2(rfft2(one, shape) * rfft2(other, shape), shape)[:rows, :columns], dtype=np.float64)


def _disc(diameter: float) -> Floats:
    """Area of a disc in each pixel, centred on the middle pixel."""
    half_width = int(np.ceil(diameter / 2 + 0.5))
    size = 2 * half_width + 1
    points = max(64, int(np.ceil(2 * np.pi * diameter / MAX_EDGE_PX)))
    step = 2 * np.pi / points
    angles = step * np.arange(points)
    radius = diameter / 2 * np.sqrt(step / np.sin(step))
    rim = radius * np.column_stack([np.cos(angles), np.sin(angles)]) + size / 2
    one = np.zeros(1, dtype=np.int64)
    rois = RoiStack(one, one, one + size, one + size)
    following = np.roll(np.arange(points), -1)
    covered, _ = cover(rois, Outlines(rim, following, np.zeros(points, dtype=np.int64)))
    return rois.roi(covered, 0) / (np.pi * diameter**2 / 4)


@lru_cache(maxsize=16)
def _airy(scale: float) -> Floats:
    """Airy pattern in each pixel, centred on the middle pixel: means over AIRY_SAMPLES^2 points."""
    half_width = int(np.ceil(AIRY_RADIUS * scale))
    inside = (np.arange(AIRY_SAMPLES) + 0.5) / AIRY_SAMPLES - 0.5
    at = (np.arange(-half_width, half_width + 1)[:, None] + inside).ravel()
    x = np.pi / scale * np.hypot(at[:, None], at)
    pattern = (2 * j1(x) / x) ** 2
    pixels = pattern.reshape(2 * half_width + 1, AIRY_SAMPLES, 2 * half_width + 1, AIRY_SAMPLES).mean(axis=(1, 3))
    return np.asarray(pixels)
