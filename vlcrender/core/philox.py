"""Random numbers by counter, for Dr.Jit kernels: a pixel's numbers depend on a key, the pixel, and nothing else.

A region of a frame therefore gets the numbers of the whole frame, in any order and on any number of threads. Generator:
Philox 4x32-10 (Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC 2011). Callers hold `backend.exact_math`.
"""

from typing import Any

from vlcrender.core.backend import dr, mi
from vlcrender.core.random_keys import KERNEL_KEY_BITS, key_number

PHILOX: Any = mi.Philox4x32
"""Mitsuba's generator. Loops construct it afresh each turn, since its objects carry no state through a loop."""


def kernel_seed(*parts: int | str) -> Any:
    """Seed of the key with these parts (`random_keys.random_key`), UInt64 of one element.

    The seed is data of the kernel: a literal would compile a new kernel for each key.
    """
    return dr.opaque(mi.UInt64, key_number(KERNEL_KEY_BITS, *parts))


def normals(seed: Any, column: Any, row: Any) -> tuple[Any, Any]:
    """Two independent standard normal numbers a pixel, Float32 (Box & Muller, Ann. Math. Stat. 29 (1958) 610).

    seed: of `kernel_seed`; column, row: UInt32. Uniform numbers have 23 bits, so that no normal number is beyond
    sqrt(2 ln 2^24) = 5.8, where a share of 1e-8 would lie.
    """
    u = PHILOX(seed, column, row, mi.UInt32(0), iterations=10).next_float32x4()
    normal = mi.warp.square_to_std_normal(mi.Point2f(u[0], u[1]))
    return normal.x, normal.y
