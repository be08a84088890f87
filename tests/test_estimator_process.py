"""Memory that a process which estimates keeps from frame to frame, and threads that it does not use."""

import subprocess
import sys

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from estimator.evaluate.process import use_one_blas_thread

PAGE_FAULTS = """
import resource, sys
import numpy as np
from estimator.evaluate.process import KEPT_BYTES, LARGE_BYTES, keep_freed_memory

if "keep" in sys.argv and not keep_freed_memory():
    sys.exit(77)
sizes = [LARGE_BYTES // 4] * (KEPT_BYTES // LARGE_BYTES)

def frame():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    arrays = [np.ones(size, dtype=np.uint8) for size in sizes]
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

frame()
print(frame())
"""


def page_faults(*arguments: str) -> int:
    """New pages that the second of two frames needs, each of which frees 16 MiB in 4 arrays at its end."""
    done = subprocess.run([sys.executable, "-c", PAGE_FAULTS, *arguments], capture_output=True, text=True, check=False)
    if done.returncode == 77:
        pytest.skip("this C library has no mallopt")
    assert done.returncode == 0, done.stderr
    return int(done.stdout)


def test_a_frame_uses_the_memory_of_the_one_before() -> None:
    """16 MiB are 4096 pages of 4 KiB; fewer than a hundredth of them are new."""
    assert page_faults("keep") < 41


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="of glibc alone")
def test_without_it_the_system_clears_each_frame_s_pages_again() -> None:
    """The premise: where this fails, `keep_freed_memory` is of no use any more."""
    assert page_faults() > 41


def test_linear_algebra_runs_in_one_thread() -> None:
    """That of NumPy and that of SciPy, which have a library each in most installations."""
    with threadpool_limits(limits=2, user_api="blas"):
        use_one_blas_thread()
        threads = [one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"]
    assert threads
    assert set(threads) == {1}
