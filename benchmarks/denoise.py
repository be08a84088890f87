"""Cost of the denoisers on a 12 Mpx image, as multiples of OpenCV's plain 11 x 11 box filter of the same image.

    python benchmarks/denoise.py [ROUNDS]

All are timed in turn, round after round, and the fastest time of each counts: on a shared machine other programs take
the rest. Compare multiples, and only within one run.
"""

import sys
import time

import cv2
import numpy as np

from estimator.spots.denoise import DENOISERS, NEIGHBOURHOOD_PX

HEIGHT_PX, WIDTH_PX = 3000, 4000
ALLOWED = 6.0
"""Upper limit of the cost of `corrected`, which `huynh2016` applies to every frame."""


def main() -> None:
    """Measure and print; exits with 1 where `corrected` costs more than allowed."""
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 7
    image = np.random.default_rng(1).poisson(40, (HEIGHT_PX, WIDTH_PX)).astype(np.float32)
    image[1400:1500, 1900:2000] += 3000
    size = (NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX)
    work = {"cv2.boxFilter": lambda: cv2.boxFilter(image, cv2.CV_32F, size)}
    work |= {name: lambda chosen=chosen: chosen.apply(image, 2.0) for name, chosen in DENOISERS.items()}
    fastest_s = dict.fromkeys(work, np.inf)
    for _ in range(rounds):
        for name, run in work.items():
            start = time.perf_counter()
            run()
            fastest_s[name] = min(fastest_s[name], time.perf_counter() - start)
    unit_s = fastest_s["cv2.boxFilter"]
    print(f"{WIDTH_PX} x {HEIGHT_PX} pixels, float32, fastest of {rounds}")
    for name, took_s in fastest_s.items():
        print(f"{name:14} {1e3 * took_s:7.1f} ms  {took_s / unit_s:5.1f} x")
    if fastest_s["corrected"] > ALLOWED * unit_s:
        sys.exit(f"corrected costs more than {ALLOWED:g} times cv2.boxFilter")


if __name__ == "__main__":
    main()
