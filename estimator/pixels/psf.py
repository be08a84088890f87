"""What the lens makes of a point of light: a disc where it is out of focus, and the Airy pattern or a measured kernel.

Thin lens and similar triangles: with the pupil D = f / N and the sensor at the image distance f_i, focused at s, a
point at depth z spreads over a disc of diameter D f_i |1/s - 1/z|. Airy pattern: Born & Wolf, Principles of Optics,
7th ed., 8.5.2, Eq. 14.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.signal import convolve
from scipy.special import j1

from estimator.io.dataset import Camera
from estimator.pixels.polygon_raster import MAX_EDGE_PX, Canvas, Outlines, cover

Floats = NDArray[np.float64]

# A disc this small moves no light that could be seen: an edge's step by some 0.05^2 / 48 of a pixel.
MIN_DISC_PX = 0.05
# The Airy pattern is followed to here, in units of lambda N: beyond is 1 % of the light, spread like background.
AIRY_REACH = 20.5
AIRY_SAMPLES = 8
# As wide as a disc that blurs as much, for a kernel's pixels.
AIRY_WIDTH = 2.0
# A kernel has so many pixels across, see `LensBlur`; pixels are split at most 2^MOST_DOUBLINGS times either way, and
# 2^AIRY_DOUBLINGS times for the Airy pattern, which is smooth and wide.
CELLS_ACROSS = 20.0
MAX_DOUBLINGS = 4
AIRY_DOUBLINGS = 2
# Slopes need not be so good: pixels split so many times are enough.
DISC_SLOPES = 4
AIRY_SLOPES = 2
# LEDs whose discs differ by less than this many pixels share a kernel.
DISC_STEP_PX = 0.005


class LensBlur:
    """Kernels for n LEDs at given depths, `kernels`, each on pixels `finer` (n,) times finer.

    `slope_kernels` are the same on pixels `slope_finer` times finer, a part of `finer`: slopes need not be so good.

    Images hold averages over pixels, and a kernel does too, so that to convolve them counts a pixel's square twice. The
    step at a sharp straight edge is wrong by 0.2 / (pixels across a disc)^1.5 at the most, which `finer` makes small:
    below 0.8 % of the LED's light from 1 px on (tested), where whole pixels would have 11 %.
    `reach_px` is the half width of the widest kernel, 0 where there is no blur; then there are no kernels either.
    """

    def __init__(self, camera: Camera, depth_m: Floats) -> None:
        """Make the kernels of a camera for LEDs at `depth_m` (n,)."""
        discs_px = disc_diameter_px(camera, depth_m)
        airy_px = airy_scale_px(camera) if camera.psf == "diffraction" else 0.0
        self.kernels: list[Floats] = []
        self.slope_kernels: list[Floats] = []
        self.finer = np.ones(len(depth_m), dtype=np.int64)
        self.slope_finer = self.finer
        self.reach_px = 0
        if camera.psf == "none" and (discs_px < MIN_DISC_PX).all():
            return
        wide = np.maximum(discs_px, AIRY_WIDTH * airy_px)
        narrow = wide > MIN_DISC_PX
        most, slopes = (AIRY_DOUBLINGS, AIRY_SLOPES) if airy_px > 0 else (MAX_DOUBLINGS, DISC_SLOPES)
        doublings = np.clip(np.ceil(np.log2(CELLS_ACROSS / np.where(narrow, wide, CELLS_ACROSS))), 0, most)
        self.finer = 2 ** doublings.astype(np.int64)
        made: dict[tuple[int, int], Floats] = {}
        for disc_px, finer in zip(discs_px.tolist(), self.finer.tolist(), strict=True):
            step = round(disc_px / DISC_STEP_PX)
            coarser = min(finer, slopes)
            for times, kernels in ((coarser, self.slope_kernels), (finer, self.kernels)):
                if (step, times) not in made:
                    made[step, times] = _kernel(camera, step * DISC_STEP_PX, airy_px, times)
                kernels.append(made[step, times])
        self.slope_finer = np.minimum(self.finer, slopes)
        widths = np.array([[len(k) for k in kernels] for kernels in (self.slope_kernels, self.kernels)])
        self.reach_px = int(np.ceil((widths / np.stack([self.slope_finer, self.finer])).max() / 2))


def disc_diameter_px(camera: Camera, depth_m: Floats) -> Floats:
    """Diameters (n,) of what points at these depths (n,) become."""
    if camera.focus_distance_m is None:
        return 0 * depth_m
    focus = 0.0 if camera.focus_distance_m == "infinity" else 1 / float(camera.focus_distance_m)
    pupil_px = camera.focal_length_mm / camera.f_number * 1000 / camera.pixel_pitch_um
    return np.asarray(pupil_px * camera.image_distance_mm / 1000 * np.abs(focus - 1 / depth_m))


def airy_scale_px(camera: Camera) -> float:
    """lambda times the working f-number, f_i / D, in pixels."""
    working = camera.f_number * camera.image_distance_mm / camera.focal_length_mm
    return working * camera.psf_wavelength_nm / 1000 / camera.pixel_pitch_um


def _kernel(camera: Camera, disc_px: float, airy_px: float, finer: int) -> Floats:
    """All blurs one after another, on pixels `finer` times finer, (n, n) with n odd, adding up to 1."""
    kernel = np.ones((1, 1))
    if disc_px >= MIN_DISC_PX:
        kernel = _disc(disc_px * finer)
    if airy_px > 0:
        kernel = convolve(kernel, _airy(airy_px * finer))
    if camera.psf_kernel is not None:
        # Measured in whole pixels, for images of whole pixels: between fine ones there is nothing.
        measured = np.array(camera.psf_kernel)
        comb = np.zeros((np.array(measured.shape) - 1) * finer + 1)
        comb[::finer, ::finer] = measured
        kernel = convolve(kernel, comb)
    return np.asarray(kernel / kernel.sum())


def _disc(diameter: float) -> Floats:
    """A disc's area in each pixel, centred on the middle one."""
    reach = int(np.ceil(diameter / 2 + 0.5))
    size = 2 * reach + 1
    points = max(64, int(np.ceil(2 * np.pi * diameter / MAX_EDGE_PX)))
    step = 2 * np.pi / points
    angles = step * np.arange(points)
    radius = diameter / 2 * np.sqrt(step / np.sin(step))
    rim = radius * np.column_stack([np.cos(angles), np.sin(angles)]) + size / 2
    one = np.zeros(1, dtype=np.int64)
    canvas = Canvas(one, one, one + size, one + size)
    following = np.roll(np.arange(points), -1)
    covered, _ = cover(canvas, Outlines(rim, following, np.zeros(points, dtype=np.int64), np.zeros((points, 2, 0))))
    return canvas.roi(covered, 0) / (np.pi * diameter**2 / 4)


def _airy(scale: float) -> Floats:
    """The Airy pattern in each pixel, centred on the middle one: means over AIRY_SAMPLES^2 places."""
    reach = int(np.ceil(AIRY_REACH * scale))
    inside = (np.arange(AIRY_SAMPLES) + 0.5) / AIRY_SAMPLES - 0.5
    at = (np.arange(-reach, reach + 1)[:, None] + inside).ravel()
    x = np.pi / scale * np.hypot(at[:, None], at)
    pattern = (2 * j1(x) / x) ** 2
    pixels = pattern.reshape(2 * reach + 1, AIRY_SAMPLES, 2 * reach + 1, AIRY_SAMPLES).mean(axis=(1, 3))
    return np.asarray(pixels)
