"""Point spread function of the lens: defocus, diffraction, off-axis blur, measured kernels, and images blurred by them.

Sources: thin lens and similar triangles; G. B. Airy, On the diffraction of an object-glass with circular aperture,
Trans. Camb. Phil. Soc. 5 (1835) 283; Born & Wolf, Principles of Optics, 7th ed., 8.5.2.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.special import j1, ndtr

from vlcrender.camera.intrinsics import Camera
from vlcrender.core.planar_shapes import circle_polygon_area

Array = NDArray[np.float64]

AIRY_TAIL = 0.01
"""Share of the Airy pattern's light in rings that are left out; the rest is scaled up by it."""
MAX_AIRY_PX = 150
"""Maximum radius of the Airy kernel; at 1.2 um and f/16 AIRY_TAIL lies beyond it."""
PARTS_FOR_DISC = 12.0
PARTS_FOR_AIRY = 8.0
"""Parts across a pixel that a disc of 1 px and an Airy pattern of lambda N = 1 px need."""
DISC_OF_GAUSSIAN = 4 / np.pi * np.sqrt(2 * np.pi)
"""Diameter of the disc whose line spread function is as high as a normal one's, in standard deviations."""
MAX_DEVIATIONS = 4.5
"""Radius of the kernel of a normal blur, in standard deviations: exp(-4.5^2 / 2) = 4e-5 of the light is beyond."""
MIN_DEVIATION = 2e-5
"""Least share of a part's light by which its kernel differs from that of its whole pixel. An Airy pattern of 1 px
differs by less from 8 px on. Parts of an edge pixel hold at most a quarter of its light too much or too little: each
pixel beyond errs by 5e-6 of an LED's luminance for each edge pixel, of either sign."""
BAND_ROWS = 1000
"""Rows that are blurred together."""
MAX_PARTS = 64
"""Most parts across a pixel. A disc narrower than a part is ignored: it moves 0.2 % of an edge pixel's light."""


def defocus_diameter_px(camera: Camera, depth_m: Any) -> Any:
    """Diameter in pixels of the defocus disc of a point at this depth (a number or an array, along the axis).

    D f_i |1/s - 1/z|. The point's image lies at v with 1/v = 1/f - 1/z, the sensor at f_i with 1/f_i = 1/f - 1/s; the
    cone from the pupil D to v has width D |f_i - v| / v = D f_i |1/v - 1/f_i| on the sensor, the same at any field
    angle, since pupil and sensor are parallel. For a fish-eye lens, which has no plane of focus, the depth is the
    distance. 0 where the camera has no focus distance.
    """
    depth = np.abs(1.0 / depth_m)
    if camera.focus_distance_m is None:
        return 0.0 * depth
    focus = 1.0 / camera.focus_distance_m if isinstance(camera.focus_distance_m, float) else 0.0
    return camera.aperture_mm * 1000 / camera.pixel_pitch_um * camera.image_distance_mm / 1000 * np.abs(focus - depth)


def off_axis_sigma_px(camera: Camera, image_px: Array) -> Array:
    """Standard deviation in pixels of the off-axis blur at image positions (n, 2), (n,).

    It grows with the square of the distance from the axis, as astigmatism and field curvature of the third order do
    (Born & Wolf, Principles of Optics, 7th ed., 5.3), to `off_axis_sigma_um` at the sensor's corner farthest from the
    axis, and stays at that beyond it. Where an LED's centre is not imaged (NaN), as at the corner.
    """
    corner_px = camera.corner_radius_px
    share = np.hypot(*(image_px - np.array(camera.center_px)).T) / corner_px
    sigma: Array = (
        camera.off_axis_sigma_um / camera.pixel_pitch_um * np.minimum(np.nan_to_num(share, nan=1.0), 1.0) ** 2
    )
    return sigma


def blur_kernel(camera: Camera, depth_m: float, sigma_px: float = 0.0) -> Array | None:
    """Blur kernel of a point of light at this depth, (m, m) with m odd, sum 1; None where the kernel is one pixel.

    The disc of `defocus_diameter_px` averaged over each pixel, exactly, convolved with the `psf`, and with a normal
    blur of `sigma_px` (`off_axis_sigma_px`).

    The kernel is for images whose pixels hold averages over their areas already. It puts the light of each such pixel
    at the pixel's centre, which widens the image by about 1/12 px^2 too much, as if the pixel's square were counted
    twice. The error of the step at a sharp straight edge is at most 11 % for a disc of 1 px, 6 % for 2 px, 2 % for
    4 px, 0.8 % for 8 px, 0.1 % for 35 px: less than 0.2 / diameter^1.5 (tested). This is enough for the room behind
    the LEDs; LEDs, whose edges are high, have `split_kernel` where the blur is narrow.
    """
    kernel = _kernel(camera, float(defocus_diameter_px(camera, depth_m)), sigma_px, 1)
    if camera.psf_kernel is not None:
        kernel = scipy.signal.convolve(kernel, np.array(camera.psf_kernel), method="direct")
    kernel = kernel / kernel.sum()
    return kernel if kernel.size > 1 else None


@dataclass(frozen=True)
class SplitKernel:
    """Blur kernels from n x n parts of a pixel to whole pixels.

    `parts`: the kernel of light at each part's centre, (n, n, m, m) with m odd, sum 1 each; rows before columns.
    """

    parts: Array

    @property
    def split(self) -> int:
        """Number n of parts across a pixel."""
        return len(self.parts)

    @property
    def whole(self) -> Array:
        """Kernel of a pixel whose parts are equally bright, (m, m)."""
        mean: Array = self.parts.mean(axis=(0, 1))
        return mean

    @cached_property
    def deviations(self) -> Array:
        """Kernels of the parts minus their mean, (n, n, k, k) with k odd: all that exceed MIN_DEVIATION; sum 0 each."""
        deviations = self.parts - self.whole
        radius = self.parts.shape[-1] // 2
        far = np.maximum(*np.abs(np.indices(deviations.shape[2:]) - radius))[
            np.abs(deviations).max(axis=(0, 1)) > MIN_DEVIATION
        ]
        cut = radius - int(far.max(initial=0))
        near = deviations[:, :, cut : 2 * radius + 1 - cut, cut : 2 * radius + 1 - cut]
        near = near - near.mean(axis=(2, 3), keepdims=True)  # no light is lost
        return np.ascontiguousarray(near)


def split_for(camera: Camera, depth_m: float, sigma_px: float = 0.0) -> int:
    """Number of parts across an edge pixel that the blur at this depth needs, a power of 2; 1 means no split.

    With the light of parts of 1 / n px at their centres, the error of a pixel at a straight edge of step 1 is at most
    D / (12 n^2), where D is the greatest change of the blurred image of a line from one pixel to the next: 4 / (pi d)
    for discs of a diameter d below 1 px, about d^-1.5 for wide ones; a normal blur counts as the disc of
    DISC_OF_GAUSSIAN. With these numbers of parts the square of the
    error is below 5 % of the shot noise's variance in every pixel along an edge of 4000 e beside a background of 24 e,
    which is the ceiling beside an LED of the quickstart (tested).
    """
    disc_px = float(defocus_diameter_px(camera, depth_m))
    discs_px = (disc_px, DISC_OF_GAUSSIAN * sigma_px)
    needed = [PARTS_FOR_DISC / diameter**0.5 for diameter in discs_px if diameter > 1 / MAX_PARTS]
    if camera.psf == "diffraction":
        needed.append(PARTS_FOR_AIRY / _airy_scale_px(camera) ** 0.9)
    # light blurred twice is as smooth as the smoother of the two blurs makes it
    return min(1 << max(0, int(np.ceil(np.log2(min(needed, default=1.0))))), MAX_PARTS)


def split_kernel(camera: Camera, depth_m: float, sigma_px: float = 0.0) -> SplitKernel | None:
    """`blur_kernel` of the parts of pixels split by `split_for`, averaged over whole pixels; None without a split.

    A measured `psf_kernel` is known on whole pixels and is applied last.
    """
    n = split_for(camera, depth_m, sigma_px)
    if n == 1:
        return None
    fine = _kernel(camera, float(defocus_diameter_px(camera, depth_m)), sigma_px, n)
    # Light of a point in each pixel, for points in steps of a part: sums of n x n elements of the fine kernel.
    radius = -(-(fine.shape[0] // 2) // n)
    padded = np.pad(fine / fine.sum(), (radius + 1) * n - 1 - fine.shape[0] // 2)
    sums = np.pad(padded, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    in_pixel = sums[n:, n:] - sums[:-n, n:] - sums[n:, :-n] + sums[:-n, :-n]
    # in_pixel[k] is the pixel whose first part lies k - (radius + 1) n + 1 parts from the point.
    parts = np.stack([[in_pixel[n - 1 - i :: n, n - 1 - j :: n] for j in range(n)] for i in range(n)])
    parts = np.maximum(parts, 0.0)
    if camera.psf_kernel is not None:
        parts = scipy.signal.oaconvolve(parts, np.array(camera.psf_kernel)[None, None], mode="full", axes=(2, 3))
    return SplitKernel(parts / parts.sum(axis=(2, 3), keepdims=True))


def _kernel(camera: Camera, disc_px: float, sigma_px: float, n: int) -> Array:
    """Disc, Airy pattern and normal blur on pixels split n x n."""
    kernel = _blurred_airy(_airy_scale_px(camera), disc_px, n) if camera.psf == "diffraction" else _disc(disc_px * n)
    line = _normal_line(sigma_px * n)
    if line.size == 1:
        return kernel
    blurred: Array = np.maximum(scipy.signal.oaconvolve(kernel, np.outer(line, line), mode="full"), 0.0)
    return blurred


def _normal_line(sigma: float) -> Array:
    """Share of a normal distribution in each pixel along a line; it is centred on the middle pixel."""
    radius = max(0, int(np.ceil(MAX_DEVIATIONS * sigma - 0.5)))
    if radius == 0:
        return np.ones(1)
    edges = (np.arange(2 * radius + 2) - radius - 0.5) / sigma
    shares = np.diff(ndtr(edges))
    line: Array = shares / shares.sum()
    return line


def _airy_scale_px(camera: Camera) -> float:
    """lambda N / pitch."""
    return camera.working_f_number * camera.psf_wavelength_nm / 1000 / camera.pixel_pitch_um


def _disc(diameter: float) -> Array:
    """Share of a disc's area in each pixel; the disc is centred on the middle pixel."""
    radius = max(0, int(np.ceil(diameter / 2 - 0.5)))
    if radius == 0:
        return np.ones((1, 1))
    left = np.arange(radius + 1) - 0.5
    u, v = (axis[..., None] for axis in np.meshgrid(left, left))
    quads = np.concatenate([u, v], axis=2)[:, :, None] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    quarter = circle_polygon_area(quads.reshape(-1, 4, 2), diameter / 2).reshape(radius + 1, radius + 1)
    return _four_quarters(quarter / (np.pi * diameter**2 / 4))


def _blurred_airy(scale_px: float, disc_px: float, n: int) -> Array:
    """The Airy pattern of `scale_px` = lambda N / pitch, convolved with a disc, averaged over pixels split n x n."""
    if _disc(disc_px * n).size == 1:
        return _airy(scale_px, n)
    # Where the pattern is narrow, convolve on finer pixels: otherwise the average over a pixel would enter twice.
    finer = 5 if scale_px * n < 3 else 1
    fine = scipy.signal.fftconvolve(_disc(disc_px * n * finer), _airy(scale_px, n * finer))
    radius = int(np.ceil((fine.shape[0] // 2 - finer // 2) / finer))
    padded = np.pad(fine, radius * finer + finer // 2 - fine.shape[0] // 2)
    pixels = 2 * radius + 1
    kernel: Array = np.maximum(padded.reshape(pixels, finer, pixels, finer).sum(axis=(1, 3)), 0.0)
    return kernel


@cache
def _airy(scale_px: float, finer: int) -> Array:
    """The Airy pattern on pixels split `finer` x `finer`, integrated over each part by Gauss-Legendre quadrature.

    Encircled energy is 1 - 2 / (pi x) far out, on average, with x = pi r / (lambda N).
    """
    radius_px = min(int(np.ceil(2 / (np.pi**2 * AIRY_TAIL) * scale_px)), MAX_AIRY_PX)
    radius = radius_px * finer + finer // 2
    # a ring is lambda N wide: four nodes, and four more for each ring in a pixel
    nodes, weights = np.polynomial.legendre.leggauss(4 + int(np.ceil(4 / (scale_px * finer))))
    at = (np.arange(radius + 1)[:, None] + nodes / 2) / finer
    lines = []
    for row in at:
        r = np.hypot(row[:, None, None], at)
        x = np.pi / scale_px * np.maximum(r, 1e-9)
        lines.append(np.einsum("i,ijk,k->j", weights, (2 * j1(x) / x) ** 2, weights))
    whole = _four_quarters(np.stack(lines))
    kernel: Array = whole / whole.sum()
    return kernel


def _four_quarters(quarter: Array) -> Array:
    """A symmetric kernel from its lower right quarter, which includes the middle row and column."""
    half = np.concatenate([quarter[:0:-1], quarter])
    return np.concatenate([half[:, :0:-1], half], axis=1)


def blur(image: NDArray[Any], kernel: Array | None, border: str = "zero") -> NDArray[Any]:
    """Convolve an image of light (rows, columns) with a kernel; the result has the image's dtype.

    border "zero": the image is dark beyond its border; the result is padded by the kernel's radius on each side and
    holds all the light (LED patches); in double precision. border "edge": border pixels are repeated; the result has
    the image's shape (backgrounds); in the image's precision. Negative pixels from rounding become 0. Without a kernel
    the image is returned.
    """
    if kernel is None:
        return image
    if border == "edge":
        return _blurred_in_bands(image, kernel.astype(image.dtype))
    return np.maximum(spread(image.astype(np.float64), kernel), 0.0).astype(image.dtype)


def _blurred_in_bands(image: NDArray[Any], kernel: NDArray[Any]) -> NDArray[Any]:
    """An image whose border pixels are repeated, blurred in bands of rows, which bounds the memory."""
    radius, (rows, columns) = kernel.shape[0] // 2, image.shape
    blurred = np.empty_like(image)
    size = [scipy.fft.next_fast_len(n + 2 * radius, real=True) for n in (min(BAND_ROWS, rows), columns)]
    of_kernel = scipy.fft.rfft2(kernel, size)
    for start in range(0, rows, BAND_ROWS):
        end = min(start + BAND_ROWS, rows)
        inside = image[max(0, start - radius) : end + radius]
        above, below = max(0, radius - start), max(0, end + radius - rows)
        wide = np.pad(inside, ((above, below), (radius, radius)), mode="edge")
        spectrum = scipy.fft.rfft2(wide, size, overwrite_x=True)
        spectrum *= of_kernel
        # What the period of the transform wraps around falls on the first 2 * radius rows and columns.
        band = scipy.fft.irfft2(spectrum, size, overwrite_x=True)[2 * radius :, 2 * radius :]
        np.maximum(band[: end - start, :columns], 0.0, out=blurred[start:end])
    return blurred


def spread(light: Array, kernel: Array | None) -> Array:
    """Convolve numbers of either sign with a kernel; the result is padded by the kernel's radius on each side."""
    if kernel is None:
        return light
    spread: Array = scipy.signal.oaconvolve(light, kernel, mode="full")
    return spread


def kernel_radius_px(kernel: Array | None) -> int:
    """Radius of a kernel: pixels from its middle to its border; 0 for None."""
    return 0 if kernel is None else kernel.shape[0] // 2
