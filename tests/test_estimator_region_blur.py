"""Blur of regions against the convolution that it stands for, on the subdivided pixels themselves."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import convolve2d

from estimator.pixels.polygon_raster import RoiStack
from estimator.pixels.region_blur import RegionBlur, phase_kernels

Floats = NDArray[np.float64]


def stack(*boxes: tuple[int, int, int, int]) -> RoiStack:
    """Regions of these rows, columns, heights and widths."""
    return RoiStack(*np.array(boxes, dtype=np.int64).T)


def directly(region: Floats, kernel: Floats, factor: int, radii: tuple[int, int]) -> Floats:
    """All pixels that the region's light reaches: `radii` more on each side, by convolution and means of blocks."""
    padded = np.pad(region, [(radius * factor,) * 2 for radius in radii])
    convolved = convolve2d(padded, kernel, mode="same")
    height, width = convolved.shape
    return np.asarray(convolved.reshape(height // factor, factor, width // factor, factor).mean(axis=(1, 3)))


@pytest.mark.parametrize(
    ("factor", "kernel_shape"), [(1, (1, 1)), (1, (5, 5)), (2, (9, 9)), (4, (7, 7)), (4, (33, 33)), (3, (5, 13))]
)
def test_a_blurred_region_is_its_convolution_averaged(
    factor: int, kernel_shape: tuple[int, int], rng: np.random.Generator
) -> None:
    """Both are sums of less than 1e5 products in double precision, whose rounding errors are below 1e-12 of the light.

    The regions wanted are one within what the light reaches and one of a single corner of it.
    """
    sharp, rois = stack((10, 20, 6, 9), (-3, 5, 4, 4)), stack((9, 19, 5, 11), (-4, 4, 2, 3))
    kernels = [rng.random(kernel_shape), rng.random(kernel_shape)]
    radii = tuple(-(-(n // 2) // factor) for n in kernel_shape)
    blur = RegionBlur(sharp, rois, kernels, np.full(2, factor))
    image = rng.random(blur.fine.cells())
    blurred = blur(image)
    for k, kernel in enumerate(kernels):
        whole = directly(blur.fine.roi(image, k), kernel, factor, (radii[0], radii[1]))
        around = RoiStack(
            sharp.rows - radii[0], sharp.columns - radii[1], sharp.heights + 2 * radii[0], sharp.widths + 2 * radii[1]
        )
        expected = np.zeros((int(rois.heights[k]), int(rois.widths[k])))
        ((source, target),) = around.intersections(np.array([k]), rois, np.array([k]))
        expected[target] = whole[source]
        np.testing.assert_allclose(rois.roi(blurred, k), expected, rtol=0, atol=1e-12 * whole.max())
        assert expected.any()


def test_the_phases_share_the_kernel_s_light(rng: np.random.Generator) -> None:
    """A subpixel's light is all given away, at 1 / f^2 of a pixel's area."""
    kernel = rng.random((11, 11))
    shares = phase_kernels(kernel, 4)
    np.testing.assert_allclose(shares.sum(axis=(2, 3)), kernel.sum() / 16, rtol=1e-12)
