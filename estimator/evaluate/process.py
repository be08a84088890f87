"""Memory and threads of a process that does nothing but estimate frames."""

import ctypes

import scipy.linalg  # noqa: F401  (its BLAS is another than NumPy's, and has to be there before its threads are set)
from threadpoolctl import threadpool_limits

KEPT_BYTES = 64 * 2**20
"""Memory that stays with the process after it is freed: more than a frame of LED regions takes at once."""
LARGE_BYTES = 16 * 2**20
"""An array of this size is returned to the system: an image of a full frame, larger than any of LED regions."""

# Parameters of mallopt(3).
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3


def prepare_process() -> None:
    """Set memory and threads of this process for estimates of many frames."""
    keep_freed_memory()
    use_one_blas_thread()


def use_one_blas_thread() -> None:
    """Let linear algebra run in the thread that asks for it.

    A frame's matrices are so small that more threads cost a sixth of the processor's time of `ml` and spare no wall
    time; beside a second process they are a tenth slower. Results stay.
    """
    threadpool_limits(limits=1, user_api="blas")


def keep_freed_memory() -> bool:
    """Keep memory that is freed for the next frame, where the C library can (glibc); returns whether it does.

    By default it goes back to the system, which clears the next frame's page by page: a tenth of the time of a frame of
    LED regions by `ml`. For a process of our own alone, since it holds for all that the process allocates.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # another C library
        return False
    return bool(mallopt(_M_TRIM_THRESHOLD, KEPT_BYTES) and mallopt(_M_MMAP_THRESHOLD, LARGE_BYTES))
