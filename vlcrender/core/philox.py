"""Random numbers by counter: those of a pixel depend on a key, on the pixel, and on nothing else.

So a window of a frame gets the numbers that the whole frame would, in any order and on any number of threads. Philox
4x32-10 (Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC 2011), keyed by a hash of a text. Within
Dr.Jit kernels; callers hold `backend.exact_math`.
"""

import hashlib
from typing import Any

from vlcrender.core.backend import dr, mi

PHILOX: Any = mi.Philox4x32
"""To be used as it is in a loop, through which its objects carry no state."""


def seed_of(key: str) -> Any:
    """A text as a 64-bit key, UInt64 of one element. As data: a literal would make a kernel of each."""
    return dr.opaque(mi.UInt64, int.from_bytes(hashlib.blake2b(key.encode(), digest_size=8).digest(), "little"))


def places(shape: tuple[int, ...], row: int, column: int) -> tuple[Any, Any]:
    """Column and row in the frame of each pixel of a window of this shape (rows, columns), flat, UInt32.

    The window starts at (row, column), which may be negative: numbers go round at 2^32.
    """
    columns, first_row, first_column = (dr.opaque(mi.UInt32, number % 2**32) for number in (shape[1], row, column))
    index = dr.arange(mi.UInt32, shape[0] * shape[1])
    down = index // columns
    return first_column + (index - down * columns), first_row + down


def normals(seed: Any, column: Any, row: Any) -> tuple[Any, Any]:
    """Two independent standard normal numbers a place, Float32 (Box & Muller, Ann. Math. Stat. 29 (1958) 610).

    Uniforms have 23 bits, so that no number is beyond sqrt(2 ln 2^24) = 5.8, where 1e-8 of all would be.
    """
    u = PHILOX(seed, column, row, mi.UInt32(0), iterations=10).next_float32x4()
    radius = dr.sqrt(-2.0 * dr.log(1.0 - u[0]))
    sine, cosine = dr.sincos(2.0 * dr.pi * u[1])
    return radius * cosine, radius * sine
