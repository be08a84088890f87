"""Blur of regions: images on subdivided pixels, convolved with kernels and averaged over the sensor's pixels.

Both are one convolution. With pixels subdivided by f, the subpixels at one place in their pixels are an image of the
sensor's own resolution. There are f^2 of these, and the result is the sum of their convolutions with as many kernels,
which hold the averages (polyphase decomposition). Each convolution is a product of Fourier transforms.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from estimator.pixels.polygon_raster import RoiStack

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]
Ints = NDArray[np.int64]


class RegionBlur:
    """Blur of n regions `sharp`, beyond which there is no light, on pixels subdivided by `factors`; `fine` are these.

    The results are wanted in the regions `rois`, which may extend by the kernels' radius beyond the sharp ones.
    """

    def __init__(self, sharp: RoiStack, rois: RoiStack, kernels: Sequence[Floats], factors: Ints) -> None:
        """Prepare for `kernels`, one a region, with odd numbers of subdivided pixels along each axis."""
        self.fine = sharp.subdivided(factors)
        self._rois, self._factors = rois, factors
        self._kernels = kernels
        widths = np.array([kernel.shape for kernel in kernels]).T
        rows, columns = -(-(widths // 2) // factors)
        self._blurred = RoiStack(
            sharp.rows - rows, sharp.columns - columns, sharp.heights + 2 * rows, sharp.widths + 2 * columns
        )
        every = np.arange(len(kernels))
        self._shared = self._blurred.intersections(every, rois, every)

    def __call__(self, image: Floats) -> Floats:
        """Blurred image in the cells of `rois` by one in those of `fine`."""
        blurred = np.zeros(self._rois.cells())
        for k, spectrum in enumerate(self._spectra):
            factor = self._factors[k]
            region = self.fine.roi(image, k)
            height, width = region.shape
            phases = region.reshape(height // factor, factor, width // factor, factor).transpose(1, 3, 0, 2)
            product = (rfft2(phases, self._shape(k)) * spectrum).sum(axis=(0, 1))
            source, target = self._shared[k]
            self._rois.roi(blurred, k)[target] = irfft2(product, self._shape(k))[source]
        return blurred

    def _shape(self, k: int) -> tuple[int, int]:
        """Pixels of the transforms of region k, so many that what leaves on one side does not enter on the other."""
        rows, columns = int(self._blurred.heights[k]), int(self._blurred.widths[k])
        return next_fast_len(rows, real=True), next_fast_len(columns, real=True)

    @cached_property
    def _spectra(self) -> list[Complex]:
        """Transforms of the kernels of each region's phases, (f, f, rows, columns)."""
        return [
            np.asarray(rfft2(phase_kernels(kernel, int(factor)), self._shape(k)), dtype=np.complex128)
            for k, (kernel, factor) in enumerate(zip(self._kernels, self._factors, strict=True))
        ]


def phase_kernels(kernel: Floats, factor: int) -> Floats:
    """Kernels (f, f, rows, columns) on whole pixels, of the subpixels at each place (row, column) in their pixels.

    Each holds the share of a subpixel's light that `kernel` gives to the pixels around its own, the middle one.
    """
    (rows, row_radius), (columns, column_radius) = ((n, -(-(n // 2) // factor)) for n in kernel.shape)
    # Offsets from a subpixel to all subpixels of those pixels, wherever it lies in its own.
    reach = [radius * factor + factor - 1 for radius in (row_radius, column_radius)]
    padded = np.pad(kernel, [(reach[0] - rows // 2,) * 2, (reach[1] - columns // 2,) * 2])
    height, width = 2 * row_radius + 1, 2 * column_radius + 1
    made = np.empty((factor, factor, height, width))
    for row in range(factor):
        for column in range(factor):
            top, left = factor - 1 - row, factor - 1 - column
            around = padded[top : top + height * factor, left : left + width * factor]
            made[row, column] = around.reshape(height, factor, width, factor).sum(axis=(1, 3))
    return made / factor**2
