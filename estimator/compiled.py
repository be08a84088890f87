"""Loops over pixels and points: compiled by Numba when they are first called, and kept on disk from then on.

A compiled function calls compiled functions of its own module alone: what is kept is made anew when that file changes,
and not when another does.
"""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

P = ParamSpec("P")
R = TypeVar("R")


def compact(array: ArrayLike) -> NDArray[np.float64]:
    """Numbers as compiled functions take them, in one piece: so each is compiled for one type of array."""
    return np.ascontiguousarray(array, dtype=np.float64)


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """The function, compiled for the types that it is called with; its arrays are not checked for bounds.

    It divides as NumPy does: by zero gives an infinity or NaN. It computes in the order that is written.
    """
    return _compiled(function, fastmath=False)


def compiled_sums(function: Callable[P, R]) -> Callable[P, R]:
    """The function, compiled as by `compiled`, but with sums in the order that suits the processor, as BLAS does."""
    return _compiled(function, fastmath={"reassoc"})


def _compiled(function: Callable[P, R], **options: Any) -> Callable[P, R]:
    options |= {"error_model": "numpy", "nogil": True}
    try:
        jitted: Callable[P, R] = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder that code could be kept in: it is compiled in every process
        jitted = numba.njit(**options)(function)
    return jitted
