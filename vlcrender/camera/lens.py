"""What the lens does to light: dims it off the axis, spreads it where out of focus, and diffracts it.

Sources: thin lens and similar triangles; G. B. Airy, On the diffraction of an object-glass with circular aperture,
Trans. Camb. Phil. Soc. 5 (1835) 283; Born & Wolf, Principles of Optics, 7th ed., 8.5.2.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from scipy.special import j1

from vlcrender.camera.distortion import distort_with_slope
from vlcrender.camera.intrinsics import ON_AXIS, Camera, pixel_on_sensor, ray_of_sensor
from vlcrender.core.planar_shapes import circle_polygon_area

Array = NDArray[np.float64]

AIRY_TAIL = 0.01
"""Share of the light in the Airy pattern's rings that is left out, and made up for by the rest."""
MAX_AIRY_PX = 150
"""How far the Airy pattern is followed at the most; at 1.2 um and f/16 it would leave out AIRY_TAIL there."""
PARTS_OF_DISC = 12.0
PARTS_OF_AIRY = 8.0
"""Parts across a pixel that a disc of 1 px and an Airy pattern of lambda N = 1 px take."""
MAX_PARTS = 64
"""A disc narrower than a part then is none: it takes up to 0.2 % of the light from a pixel at an edge."""


def relative_illumination(camera: Camera, u: Any, v: Any, xp: Any = np, luminance: Any = 1.0) -> Any:
    """Illumination at pixel positions (u, v) by a luminance, relative to the same on the axis; elementwise.

    cos(theta) (the pupil seen at an angle) times a pixel's solid angle over that on the axis, times what the second
    stop leaves: cos^4 for a perspective lens, over the distortion's Jacobian; cos(theta) sin(theta) / theta for an
    equidistant one, 0 beyond 90 deg. Arrays as in `ray_of_pixel`. `luminance`, of the same shape or a number, is
    multiplied by one factor after the other: rounding in float32 depends on the order.
    """
    x_d, y_d = pixel_on_sensor(camera, u, v)
    x, y, z = ray_of_sensor(camera, x_d, y_d, xp)
    if camera.projection == "equidistant":
        facing = xp.maximum(z, 0.0)
        sine = xp.sqrt(x * x + y * y + ON_AXIS)
        tangent = sine / (facing + ON_AXIS)
        light = luminance * facing * (sine / xp.sqrt(x_d * x_d + y_d * y_d + ON_AXIS))
    else:
        tangent = xp.sqrt(x * x + y * y)
        cos2 = 1.0 / (1.0 + x * x + y * y)
        light = luminance * cos2 * cos2
        if camera.distortion is not None:
            _, _, xx, xy, yy = distort_with_slope(camera.distortion, x, y)
            light = light / (xx * yy - xy * xy)
    if camera.vignetting_deg is not None:
        light = light * _pupil_left(tangent / float(np.tan(np.radians(camera.vignetting_deg))), xp)
    return light


def _pupil_left(shift: Any, xp: Any) -> Any:
    """Area that two equal circles share, as a part of one's, whose centres are `shift` diameters apart."""
    s = xp.minimum(shift, 1.0)
    left = (xp.acos(s) - s * xp.sqrt(1.0 - s * s)) * (2 / np.pi)
    return xp.maximum(left, 0.0)  # rounding: light is never negative


def defocus_diameter_px(camera: Camera, depth_m: Any) -> Any:
    """Diameter in pixels of the disc that a point at this depth (a number or an array, along the axis) becomes.

    D f_i |1/s - 1/z|. The point's image lies at v with 1/v = 1/f - 1/z, the sensor at f_i with 1/f_i = 1/f - 1/s; the
    cone from the pupil D to v has width D |f_i - v| / v = D f_i |1/v - 1/f_i| on the sensor, the same at any field
    angle, since pupil and sensor are parallel. Of a fish-eye lens take the distance for the depth: it has no one plane
    of focus. 0 where the camera has no focus.
    """
    depth = np.abs(1.0 / depth_m)
    if camera.focus_distance_m is None:
        return 0.0 * depth
    focus = 1.0 / camera.focus_distance_m if isinstance(camera.focus_distance_m, float) else 0.0
    return camera.aperture_mm * 1000 / camera.pixel_pitch_um * camera.image_distance_mm / 1000 * np.abs(focus - depth)


def blur_kernel(camera: Camera, depth_m: float) -> Array | None:
    """What a point of light at this depth becomes, (m, m) with m odd, adding up to 1; None where it stays one pixel.

    The disc of `defocus_diameter_px` averaged over each pixel, exactly, convolved with the `psf`.

    It is for images whose pixels hold averages over their areas already. Blurring those by a sampled kernel puts the
    light of each of its pixels at that pixel's centre: the image is widened by about 1/12 px^2 more than it should be,
    as if a pixel's square were counted twice. The step at a sharp straight edge is off by 11 % at the worst for a disc
    of 1 px, 6 % of 2 px, 2 % of 4 px, 0.8 % of 8 px, 0.1 % of 35 px: less than 0.2 / diameter^1.5 (tested). That does
    for the room behind; LEDs, whose edges are high, have `split_kernel` where the blur is narrow.
    """
    kernel = _kernel(camera, float(defocus_diameter_px(camera, depth_m)), 1)
    if camera.psf_kernel is not None:
        kernel = signal.convolve(kernel, np.array(camera.psf_kernel), method="direct")
    kernel = kernel / kernel.sum()
    return kernel if kernel.size > 1 else None


@dataclass(frozen=True)
class SplitKernel:
    """What light becomes that is known in n x n parts of each pixel, in whole pixels.

    `parts`: of light at each part's centre, (n, n, m, m) with m odd, each adding up to 1, in rows and columns.
    """

    parts: Array

    @property
    def split(self) -> int:
        """n."""
        return len(self.parts)

    @property
    def whole(self) -> Array:
        """Of a pixel whose parts are alike, (m, m)."""
        mean: Array = self.parts.mean(axis=(0, 1))
        return mean


def split_for(camera: Camera, depth_m: float) -> int:
    """Into how many parts across pixels at an edge have to be split, a power of 2; 1 where they need not be.

    With the light of parts of 1 / n px at their centres, a pixel at a straight edge of step 1 is off by up to
    D / (12 n^2), D being the most by which the blurred image of a line changes from one pixel to the next: 4 / (pi d)
    for discs of a diameter d below 1 px, about d^-1.5 for wide ones. What is allowed falls with the light there is:
    with parts as here the error's square is below 5 % of the shot noise's variance in every pixel along an edge of
    4000 e beside a background of 24 e, the ceiling's beside a quickstart's LED (tested).
    """
    disc_px = float(defocus_diameter_px(camera, depth_m))
    needed = PARTS_OF_DISC / disc_px**0.5 if disc_px > 1 / MAX_PARTS else 1.0
    if camera.psf == "diffraction":
        airy = PARTS_OF_AIRY / _airy_scale_px(camera) ** 0.9
        # light blurred twice is as smooth as the smoother of the two makes it
        needed = min(needed, airy) if disc_px > 1 / MAX_PARTS else airy
    return min(1 << max(0, int(np.ceil(np.log2(needed)))), MAX_PARTS)


def split_kernel(camera: Camera, depth_m: float) -> SplitKernel | None:
    """`blur_kernel` on pixels split as `split_for` says, its results averaged over whole ones; None where that is 1.

    A measured `psf_kernel` is what it is on whole pixels, and comes last.
    """
    n = split_for(camera, depth_m)
    if n == 1:
        return None
    fine = _kernel(camera, float(defocus_diameter_px(camera, depth_m)), n)
    # What a point gives to each pixel, in steps of a part: n x n of the fine kernel's numbers.
    radius = -(-(fine.shape[0] // 2) // n)
    padded = np.pad(fine / fine.sum(), (radius + 1) * n - 1 - fine.shape[0] // 2)
    sums = np.pad(padded, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    gives = sums[n:, n:] - sums[:-n, n:] - sums[n:, :-n] + sums[:-n, :-n]
    # gives[k] is the pixel whose first part lies k - (radius + 1) n + 1 parts from the point.
    parts = np.maximum(np.stack([[gives[n - 1 - i :: n, n - 1 - j :: n] for j in range(n)] for i in range(n)]), 0.0)
    if camera.psf_kernel is not None:
        parts = signal.oaconvolve(parts, np.array(camera.psf_kernel)[None, None], mode="full", axes=(2, 3))
    return SplitKernel(parts / parts.sum(axis=(2, 3), keepdims=True))


def _kernel(camera: Camera, disc_px: float, n: int) -> Array:
    """Disc and Airy pattern on pixels split n x n."""
    if camera.psf == "diffraction":
        return _blurred_airy(_airy_scale_px(camera), disc_px, n)
    return _disc(disc_px * n)


def _airy_scale_px(camera: Camera) -> float:
    """lambda N / pitch."""
    return camera.working_f_number * camera.psf_wavelength_nm / 1000 / camera.pixel_pitch_um


def _disc(diameter: float) -> Array:
    """Share of a disc's area in each pixel, the disc centred on the middle one."""
    reach = max(0, int(np.ceil(diameter / 2 - 0.5)))
    if reach == 0:
        return np.ones((1, 1))
    left = np.arange(reach + 1) - 0.5
    u, v = (axis[..., None] for axis in np.meshgrid(left, left))
    quads = np.concatenate([u, v], axis=2)[:, :, None] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    quarter = circle_polygon_area(quads.reshape(-1, 4, 2), diameter / 2).reshape(reach + 1, reach + 1)
    return _four_quarters(quarter / (np.pi * diameter**2 / 4))


def _blurred_airy(scale_px: float, disc_px: float, n: int) -> Array:
    """The Airy pattern of `scale_px` = lambda N / pitch, convolved with a disc, averaged over pixels split n x n."""
    if _disc(disc_px * n).size == 1:
        return _airy(scale_px, n)
    # Both on finer pixels where the pattern is not wide: else each would be averaged over a pixel.
    finer = 5 if scale_px * n < 3 else 1
    fine = signal.fftconvolve(_disc(disc_px * n * finer), _airy(scale_px, n * finer))
    reach = int(np.ceil((fine.shape[0] // 2 - finer // 2) / finer))
    padded = np.pad(fine, reach * finer + finer // 2 - fine.shape[0] // 2)
    pixels = 2 * reach + 1
    kernel: Array = np.maximum(padded.reshape(pixels, finer, pixels, finer).sum(axis=(1, 3)), 0.0)
    return kernel


@cache
def _airy(scale_px: float, finer: int) -> Array:
    """The Airy pattern in pixels split `finer` x `finer`, integrated over each by Gauss-Legendre quadrature.

    Encircled energy is 1 - 2 / (pi x) far out, on average, with x = pi r / (lambda N).
    """
    reach_px = min(int(np.ceil(2 / (np.pi**2 * AIRY_TAIL) * scale_px)), MAX_AIRY_PX)
    reach = reach_px * finer + finer // 2
    # a ring is lambda N wide: four nodes for each that a pixel holds, and four to start with
    nodes, weights = np.polynomial.legendre.leggauss(4 + int(np.ceil(4 / (scale_px * finer))))
    at = (np.arange(reach + 1)[:, None] + nodes / 2) / finer
    lines = []
    for row in at:
        r = np.hypot(row[:, None, None], at)
        x = np.pi / scale_px * np.maximum(r, 1e-9)
        lines.append(np.einsum("i,ijk,k->j", weights, (2 * j1(x) / x) ** 2, weights))
    whole = _four_quarters(np.stack(lines))
    kernel: Array = whole / whole.sum()
    return kernel


def _four_quarters(quarter: Array) -> Array:
    """A kernel from its part right of and below the middle, the middle's row and column included."""
    half = np.concatenate([quarter[:0:-1], quarter])
    return np.concatenate([half[:, :0:-1], half], axis=1)


def blur(image: NDArray[Any], kernel: Array | None, border: str = "zero") -> NDArray[Any]:
    """Convolve an image (rows, columns) of light with a kernel, in double precision; of the image's dtype.

    border "zero": nothing lies beyond it, the result grows by the kernel's radius on each side and holds all the light
    (LED patches). border "edge": it goes on as its border pixels do, the result has its shape (backgrounds; sum is kept
    but for what crosses the border). Rounding never leaves a pixel below 0. No kernel, no change.
    """
    if kernel is None:
        return image
    if border == "edge":
        wide = np.pad(image, kernel.shape[0] // 2, mode="edge").astype(np.float64)
        blurred = signal.oaconvolve(wide, kernel, mode="valid")
    else:
        blurred = signal.oaconvolve(image.astype(np.float64), kernel, mode="full")
    return np.maximum(blurred, 0.0).astype(image.dtype)
