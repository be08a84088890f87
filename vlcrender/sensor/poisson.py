"""Counter-based Poisson draws: the count of a pixel depends on the key, the pixel and its mean, and on nothing else.

A region therefore gets the draws of the whole frame, in any order and on any number of threads. Means of 10 and more:
transformed rejection (PTRS, W. Hoermann, Insurance: Mathematics and Economics 12 (1993) 39), without its two squeezes:
they decide early what the density decides too, and a kernel computes the density in every lane anyway. Below: products
of uniforms (Knuth). Uniforms: `philox`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.roi import Roi
from vlcrender.core.backend import dr, exact_math, mi
from vlcrender.core.philox import kernel_seed, uniforms
from vlcrender.sensor.pixel_indices import pixel_places

PIXELS_A_LANE = 16
"""Pixels for which a lane of a vector draws one after another: a cache line of float32."""
MAX_TURNS = 1000
"""Bound of the loop. A turn accepts with a probability of 0.7 or more, so no draw reaches it."""
INFINITY_BITS = np.float32(np.inf).view(np.uint32)
MAX_MEAN = 2.0**22
"""Beyond it the rounding of float32 in the kernel would bias the draws."""


def poisson(means: NDArray[np.float32], key: str, row: int = 0, column: int = 0) -> NDArray[np.uint32]:
    """Poisson counts of a region of pixels, same shape as `means`.

    means: (rows, columns), 0 to MAX_MEAN. The region starts at pixel (row, column), which may be negative, of the frame
    that `key` names. Raises ValueError for other means.
    """
    rows, columns = means.shape
    if means.max() > MAX_MEAN:
        raise ValueError(f"means up to {means.max()} electrons; 0 to {MAX_MEAN:.0f} are allowed")
    return poisson_of_regions(means.ravel(), key, [Roi(row, column, rows, columns)]).reshape(means.shape)


def poisson_of_regions(
    means: NDArray[np.float32], key: str, rois: Sequence[Roi], most: int = 2**32 - 1
) -> NDArray[np.uint32]:
    """`poisson` of all pixels of all regions, region by region, row by row, (pixels,): one launch of one kernel.

    Means beyond MAX_MEAN count as that, counts beyond `most` as `most`. Raises ValueError for negative means and NaN.
    """
    flat = np.ascontiguousarray(means, dtype=np.float32)
    # The bits of negative numbers and of most NaN are larger than those of infinity: one pass over memory finds them.
    if flat.view(np.uint32).max() > INFINITY_BITS and not flat.min() >= 0:
        raise ValueError(f"means from {flat.min()} electrons; 0 and more are allowed")
    with exact_math():
        counts: NDArray[np.uint32] = draw(mi.Float(flat), kernel_seed(key), rois, most).numpy()
    return counts


@dr.syntax
def draw(means: Any, seed: Any, rois: Sequence[Roi], most: int = 2**32 - 1) -> Any:
    """Poisson counts of all pixels of all regions, evaluated, UInt32; counts beyond `most` count as that.

    means: Float32, of pixels as `pixel_indices` has them, 0 and more; beyond MAX_MEAN they count as that. A lane of a
    vector draws for PIXELS_A_LANE pixels, and goes on to the next as soon as it has a count: lanes that need another
    try do not hold up the others.
    """
    places = pixel_places(rois)
    size = len(means)
    counts: Any = dr.empty(mi.UInt32, size)
    pixels_a_lane, pixels, largest = (dr.opaque(mi.UInt32, number) for number in (PIXELS_A_LANE, size, most))
    pixel: Any = dr.arange(mi.UInt32, -(-size // PIXELS_A_LANE)) * pixels_a_lane
    end = dr.minimum(pixel + pixels_a_lane, pixels)
    product: Any = mi.Float(1.0)
    count: Any = mi.Float(0.0)
    turn: Any = mi.UInt32(0)
    while pixel < end:
        mean = dr.minimum(dr.gather(mi.Float, means, pixel), MAX_MEAN)
        column, row = places(pixel)
        u = uniforms(seed, column, row, turn)
        large = mean >= 10.0
        mu = dr.maximum(mean, 10.0)
        b = 0.931 + 2.53 * dr.sqrt(mu)
        a = -0.059 + 0.02483 * b
        inverse_alpha = 1.1239 + 1.1328 / (b - 3.4)
        # PTRS uses one pair of uniforms a try; two tries a turn take longer.
        centred = u[0] - 0.5
        edge = 0.5 - dr.abs(centred)
        tried = dr.floor((2.0 * a / edge + b) * centred + mu + 0.43)
        density = dr.log(u[1] * inverse_alpha / (a / (edge * edge) + b))
        accepted = (tried >= 0.0) & (density <= _log_probability(tried, mu))
        # Knuth: multiply uniforms until the product is below exp(-mean); four factors a turn.
        limit = dr.exp(-mean)
        low: Any = mi.Bool(False)
        for i in range(4):
            product = product * u[i]
            low |= product <= limit
            count += dr.select(low, 0.0, 1.0)
        done = dr.select(large, accepted, low) | (turn >= MAX_TURNS)
        dr.scatter(counts, dr.minimum(mi.UInt32(dr.select(large, tried, count)), largest), pixel, done)
        pixel = dr.select(done, pixel + 1, pixel)
        product = dr.select(done, 1.0, product)
        count = dr.select(done, 0.0, count)
        turn = dr.select(done, 0, turn + 1)
    dr.eval(counts)
    return counts


def _log_probability(k: Any, mu: Any) -> Any:
    """log of mu^k exp(-mu) / k! by C. Loader's saddle-point form (2000); the factors themselves overflow float32."""
    safe = dr.maximum(k, 1.0)
    inverse = 1.0 / safe
    squared = inverse * inverse
    stirling = inverse * (1.0 / 12.0 - squared * (1.0 / 360.0 - squared / 1260.0))
    difference = safe - mu
    x = difference / (safe + mu)
    x2 = x * x
    series = difference * x + 2.0 * safe * x * x2 * (1.0 / 3.0 + x2 * (1.0 / 5.0 + x2 * (1.0 / 7.0 + x2 / 9.0)))
    deviance = dr.select(dr.abs(x) < 0.1, series, safe * dr.log(safe / mu) - difference)
    saddle = -0.5 * dr.log(2.0 * dr.pi * safe) - stirling - deviance
    return dr.select(k >= 1.0, saddle, -mu)
