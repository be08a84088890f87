"""Cost of the denoisers on a 12 Mpx image, as multiples of OpenCV's plain 11 x 11 box filter of the same image.

    python benchmarks/denoise.py [ROUNDS]

All are timed in turn, round after round. Compare multiples, and only within one run.
"""

import sys
from functools import partial

import cv2
import numpy as np
from target import Targets, alternating_s, ratio

from estimator.spots.denoise import DENOISERS, NEIGHBOURHOOD_PX

HEIGHT_PX, WIDTH_PX = 3000, 4000
READ_NOISE_E = 2.0
MAX_CORRECTED = 6.0
"""Upper limit of the cost of `corrected`, which `huynh2016` applies to every frame."""


def main() -> None:
    """Measure and print; exits with 1 where `corrected` costs more than allowed."""
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 7
    image = np.random.default_rng(1).poisson(40, (HEIGHT_PX, WIDTH_PX)).astype(np.float32)
    image[1400:1500, 1900:2000] += 3000
    size = (NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX)
    names = list(DENOISERS)
    works = [partial(DENOISERS[name].apply, image, READ_NOISE_E) for name in names]
    box_s, *seconds = alternating_s([lambda: cv2.boxFilter(image, cv2.CV_32F, size), *works], rounds)
    targets = Targets()
    for name, of_name in zip(names, seconds, strict=True):
        title = f"denoiser {name} / cv2.boxFilter, {WIDTH_PX} x {HEIGHT_PX} pixels"
        if name == "corrected":
            targets.at_most(title, ratio(of_name, box_s), MAX_CORRECTED)
        else:
            targets.beside(title, ratio(of_name, box_s))
    targets.finish()


if __name__ == "__main__":
    main()
