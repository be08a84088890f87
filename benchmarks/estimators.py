"""Speed of the estimators: where a frame's time goes, and frames a second of two processes.

    vlcrender generate datasets/quickstart.toml --out full
    vlcrender generate datasets/quickstart.toml --out regions --set poses.count=60 \
        --set 'regions={kind="leds",margin_px=20}'
    python benchmarks/estimators.py regions full

For each dataset and variant, times of one core for a frame in milliseconds (the median over frames, each the best of
TRIES): to read it, to detect its spots (`detect`, without the denoiser), and the rest; their shares; and the estimate's
time over the first variant's. Then frames a second, reading included, of WORKERS processes in wall time, which depends
on the load of the machine. The last line is the time of an 11 x 11 box filter of 12 Mpx. Compare within one run only.
"""

import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import estimator.spots.correspondences
from estimator.evaluate.batch import estimate_frame
from estimator.io.dataset import read_dataset, read_frame
from estimator.methods.catalogue import VARIANTS

WORKERS = 2
TRIES = 3
MAX_FRAMES = 20


class Clock:
    """Processor time spent in a function."""

    def __init__(self, function: Callable[..., Any]) -> None:
        """Count calls of this function."""
        self.function, self.seconds = function, 0.0

    def __call__(self, *arguments: object) -> object:
        """Call it."""
        start = time.process_time()
        try:
            return self.function(*arguments)
        finally:
            self.seconds += time.process_time() - start


def stages_ms(folder: Path, name: str) -> np.ndarray:
    """Read, detect and all else, (3,) milliseconds a frame."""
    dataset = read_dataset(folder)
    clock = Clock(estimator.spots.correspondences.detect)
    rows = []
    for record in dataset.frames[:MAX_FRAMES]:
        tries = []
        for _ in range(TRIES):
            start = time.process_time()
            frame = read_frame(dataset, record)
            read_s = time.process_time() - start
            clock.seconds = 0.0
            estimator.spots.correspondences.detect = clock
            start = time.process_time()
            estimate_frame(VARIANTS[name], frame, record.frame)
            total_s = time.process_time() - start
            estimator.spots.correspondences.detect = clock.function
            tries.append((read_s, clock.seconds, total_s - clock.seconds))
        rows.append(np.min(tries, axis=0))
    return 1e3 * np.median(rows, axis=0)


def frames_per_s(folder: Path, name: str, first: int) -> float:
    """Read and estimate every WORKERS-th frame; returns the rate of that, the dataset's own description read before."""
    cv2.setNumThreads(1)
    dataset = read_dataset(folder)
    chosen = dataset.frames[first::WORKERS]
    start = time.perf_counter()
    for record in chosen:
        estimate_frame(VARIANTS[name], read_frame(dataset, record), record.frame)
    return len(chosen) / (time.perf_counter() - start)


def main() -> None:
    """Measure and print."""
    cv2.setNumThreads(1)
    with ProcessPoolExecutor(WORKERS, get_context("spawn")) as pool:
        list(pool.map(read_dataset, map(Path, WORKERS * sys.argv[1:2])))  # modules are loaded
        for folder in map(Path, sys.argv[1:]):
            print(f"\n{folder}: {len(read_dataset(folder).frames)} frames")
            print("variant                  read  detect    rest ms     share of each     estimate/first  frames/s")
            first_ms = None
            for name in VARIANTS:
                parts_ms = stages_ms(folder, name)
                estimate_ms = parts_ms[1:].sum()
                first_ms = first_ms or estimate_ms
                rate = sum(pool.map(partial(frames_per_s, folder, name), range(WORKERS)))
                shares = " ".join(f"{100 * part:4.0f}%" for part in parts_ms / parts_ms.sum())
                numbers = " ".join(f"{part:7.1f}" for part in parts_ms)
                print(f"{name:22}{numbers}      {shares}   {estimate_ms / first_ms:14.2f}  {rate:8.1f}")
    print(f"\n11 x 11 box filter of 12 Mpx: {box_ms():.1f} ms of one core")


def box_ms() -> float:
    """Time of a reference operation."""
    image = np.ones((3000, 4000), dtype=np.float32)
    tries = []
    for _ in range(5):
        start = time.process_time()
        cv2.boxFilter(image, -1, (11, 11))
        tries.append(time.process_time() - start)
    return 1e3 * min(tries)


if __name__ == "__main__":
    main()
