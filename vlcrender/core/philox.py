"""Random numbers by counter, for Dr.Jit kernels: a pixel's numbers depend on a key, the pixel, and nothing else.

A region of a frame therefore gets the numbers of the whole frame, in any order and on any number of threads. Generator:
Philox 4x32-10 (Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC 2011). Callers hold `backend.exact_math`.
"""

from typing import Any

from vlcrender.core.backend import dr, mi
from vlcrender.core.random_keys import KERNEL_KEY_BITS, key_number

ROUNDS = 10
MULTIPLIERS = 0xD2511F53, 0xCD9E8D57
KEY_STEPS = 0x9E3779B9, 0xBB67AE85
"""Constants of Philox 4x32, table 2 of the paper's source `philox.h`."""


def kernel_seed(*parts: int | str) -> Any:
    """Seed of the key with these parts (`random_keys.random_key`), UInt64 of one element.

    The seed is data of the kernel: a literal would compile a new kernel for each key.
    """
    return dr.opaque(mi.UInt64, key_number(KERNEL_KEY_BITS, *parts))


def uniforms(seed: Any, column: Any, row: Any, number: Any) -> list[Any]:
    """Four independent numbers in [0, 1) of 23 bits, Float32.

    seed: of `kernel_seed`; column, row, number: UInt32. The bits are those of Dr.Jit's `Philox4x32` with 10 rounds,
    which takes both halves of a product from one of 64 bits: two products of 32 bits take 0.6 of its time.
    """
    key: list[Any] = [mi.UInt32(seed >> 32), mi.UInt32(seed)]
    counter: list[Any] = [column, row, number, mi.UInt32(0)]
    for _ in range(ROUNDS):
        (high_0, low_0), (high_1, low_1) = (
            (dr.mul_hi(half, multiplier), half * multiplier)
            for half, multiplier in zip(counter[::2], MULTIPLIERS, strict=True)
        )
        counter = [high_1 ^ counter[1] ^ key[0], low_1, high_0 ^ counter[3] ^ key[1], low_0]
        key = [half + step for half, step in zip(key, KEY_STEPS, strict=True)]
    mantissas: list[Any] = [dr.reinterpret_array(mi.Float, (bits >> 9) | 0x3F800000) for bits in counter]  # in [1, 2)
    return [number - 1.0 for number in mantissas]


def normals(seed: Any, column: Any, row: Any) -> tuple[Any, Any]:
    """Two independent standard normal numbers a pixel, Float32 (Box & Muller, Ann. Math. Stat. 29 (1958) 610).

    seed: of `kernel_seed`; column, row: UInt32. Uniform numbers have 23 bits, so that no normal number is beyond
    sqrt(2 ln 2^24) = 5.8, where a share of 1e-8 would lie.
    """
    u = uniforms(seed, column, row, mi.UInt32(0))
    normal = mi.warp.square_to_std_normal(mi.Point2f(u[0], u[1]))
    return normal.x, normal.y
