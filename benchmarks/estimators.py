"""Speed of the estimators: ratios beside peers, where a frame's time goes, and frames a second of two processes.

    vlcrender generate datasets/office200.toml --out regions --set poses.count=60 --set bound=false
    vlcrender generate datasets/office20.toml --out full --set poses.count=8 --set bound=false
    python benchmarks/estimators.py regions full

The ratios are held for the first dataset. They are of processor time on one core, measured in turn, medians over
frames. Peers that are not installed are skipped.

Then for each dataset and variant, times of one core for a frame in milliseconds (the median over frames, each the best
of TRIES): to read it, to detect its spots (`detect`, without the denoiser), and the rest; their shares; and the
estimate's time over the first variant's. At last frames a second, reading included, of WORKERS processes in wall time,
which depends on the machine and its load: the rate of `ml` is held against that of photutils' segmentation of the same
frames, in the same minute.
"""

import statistics
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from target import Targets, alternating_s, peer, ratio

import estimator.spots.correspondences
from estimator.evaluate.batch import estimate_burst, estimate_dataset, estimate_frame
from estimator.evaluate.process import prepare_process
from estimator.io.dataset import Dataset, read_dataset, read_frame
from estimator.io.device import DeviceFrame
from estimator.io.shared import SharedResults
from estimator.methods.catalogue import VARIANTS
from estimator.methods.gravity_fit import fit_correspondences
from estimator.methods.variant import Variant
from estimator.spots.correspondences import centroids_px, find_correspondences, led_positions_m
from estimator.spots.detect import MIN_BLOB_PX, SMOOTHING_PX, THRESHOLD_OF_BRIGHTEST, THRESHOLD_SIGMA, detect
from estimator.spots.lamps import readouts_of

WORKERS = 2
RATE_ROUNDS = 2
RATES = 3
"""Rates of which the median counts."""
TRIES = 3
MAX_FRAMES = 20
ROUNDS = 5
FRAMES_TOGETHER = 8
"""Frames of a dataset for the ratio of all variants to `ml`."""
EVERY = 3
"""Detection is timed in each so manieth frame."""
MAX_ALL_VARIANTS, MAX_FIT, MAX_DETECTION = 1.6, 4.0, 0.8
ML_RATE, MIN_ML_OF_PEER = 50.0, 0.69
"""Frames a second of `ml` on office regions that are wanted where the first version makes 27 to 29; and over the rate
of photutils the same, for any machine: the first version makes 0.37 of that (0.32 to 0.41, five runs in turn), times
50 / 27.
"""
POSELIB_PX = 3.0
"""Reprojection error up to which PoseLib's RANSAC counts a spot as an inlier."""


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
            frame = replace(read_frame(dataset, record), shared=SharedResults())
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
    """Read and estimate every WORKERS-th frame, RATE_ROUNDS times; returns the rate of that.

    The dataset's own description is read before, and the compiled loops of the variant, with a first frame.
    """
    cv2.setNumThreads(1)
    dataset = read_dataset(folder)
    chosen = dataset.frames[first::WORKERS]
    estimate_burst(dataset, chosen[:1], [VARIANTS[name]])
    start = time.perf_counter()
    for record in RATE_ROUNDS * chosen:
        estimate_burst(dataset, (record,), [VARIANTS[name]])
    return RATE_ROUNDS * len(chosen) / (time.perf_counter() - start)


def segmented_per_s(folder: Path, first: int) -> float:
    """As `frames_per_s`, of photutils' segmentation of the frames."""
    cv2.setNumThreads(1)
    warnings.simplefilter("ignore")  # regions without an LED above the threshold
    dataset, segmentation = read_dataset(folder), peer("photutils.segmentation")
    chosen = dataset.frames[first::WORKERS]
    segmented(read_frame(dataset, chosen[0]), segmentation)
    start = time.perf_counter()
    for record in RATE_ROUNDS * chosen:
        segmented(read_frame(dataset, record), segmentation)
    return RATE_ROUNDS * len(chosen) / (time.perf_counter() - start)


def all_variants(targets: Targets, folder: Path, limit: float | None) -> None:
    """All variants over `ml` alone, reading counted; printed alone where `limit` is None."""
    dataset = read_dataset(folder)
    few = replace(dataset, frames=dataset.frames[:FRAMES_TOGETHER])

    def run(variants: Sequence[Variant]) -> None:
        estimate_dataset(few, variants, lambda: None)

    everything, ml = list(VARIANTS.values()), [VARIANTS["ml"]]
    all_s, ml_s = alternating_s([partial(run, everything), partial(run, ml)], ROUNDS, time.process_time)
    all_ms, ml_ms = (1e3 * float(np.median(one)) / len(few.frames) for one in (all_s, ml_s))
    print(f"{folder.name}: all variants {all_ms:.1f} ms a frame, ml alone {ml_ms:.1f}")
    title = f"{folder.name}: all variants / ml alone, reading counted"
    if limit is None:
        targets.beside(title, ratio(all_s, ml_s))
    else:
        targets.at_most(title, ratio(all_s, ml_s), limit)


def fit_beside_peers(targets: Targets, dataset: Dataset) -> None:
    """`gravity-fit` beyond detection over RANSAC with refinement of PoseLib, and of OpenCV, from the same spots."""
    poselib = peer("poselib")
    of_poselib, of_opencv = [], []
    for record in dataset.frames[:MAX_FRAMES]:
        frame = read_frame(dataset, record)
        spots = find_correspondences(frame)
        pixels, leds_m, K = centroids_px(spots), led_positions_m(spots), frame.camera.matrix()
        works: list[Callable[[], object]] = [
            partial(fit_correspondences, frame, spots),
            partial(cv2.solvePnPRansac, leds_m, pixels, K, None),
        ]
        if poselib is not None:
            size = {"width": frame.camera.width_px, "height": frame.camera.height_px}
            lens = {"model": "PINHOLE", **size, "params": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]}
            options = {"max_reproj_error": POSELIB_PX}
            works.append(partial(poselib.estimate_absolute_pose, pixels, leds_m, lens, options, {}))
        fit_s, opencv_s, *poselib_s = alternating_s(works, ROUNDS, time.process_time)
        of_opencv.append(ratio(fit_s, opencv_s))
        of_poselib += [ratio(fit_s, one) for one in poselib_s]
    if of_poselib:
        name = "gravity-fit beyond detection / PoseLib's RANSAC with refinement"
        targets.at_most(name, statistics.median(of_poselib), MAX_FIT)
    targets.beside("gravity-fit beyond detection / cv2.solvePnPRansac", statistics.median(of_opencv))


def detection_beside_peers(targets: Targets, folder: Path, held: bool) -> None:
    """Detection over segmentation by photutils, and over sep, with the same threshold and smoothing in all."""
    photutils, sep = peer("photutils.segmentation"), peer("sep")
    dataset = read_dataset(folder)
    found: dict[str, list[float]] = {}
    for record in dataset.frames[:MAX_FRAMES:EVERY]:
        frame = read_frame(dataset, record)
        works: dict[str, Callable[[], object]] = {"": partial(detected, frame)}
        if photutils is not None:
            works["photutils' segmentation"] = partial(segmented, frame, photutils)
        if sep is not None:
            works["sep"] = partial(extracted, frame, sep)
        ours_s, *others_s = alternating_s(list(works.values()), ROUNDS, time.process_time)
        for name, seconds in zip(list(works)[1:], others_s, strict=True):
            found.setdefault(name, []).append(ratio(ours_s, seconds))
    for name, ratios in found.items():
        title = f"{folder.name}: detection with covariances / {name}"
        if name == "sep" or not held:
            targets.beside(title, statistics.median(ratios))
        else:
            targets.at_most(title, statistics.median(ratios), MAX_DETECTION)


def detected(frame: DeviceFrame) -> object:
    """Spots as every variant but `huynh2016` has them, before identification."""
    decoded_px = np.array([(spot.u_px, spot.v_px) for spot in frame.spots])
    return detect(readouts_of(frame), frame.camera.width_px * frame.camera.height_px, 0, decoded_px)


def thresholded(frame: DeviceFrame) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Of each region, electrons above the background, the same smoothed, and the threshold of detection, electrons."""
    regions = []
    for part in frame.parts:
        electrons = frame.electrons(part)
        smooth = cv2.blur(electrons, (SMOOTHING_PX, SMOOTHING_PX))
        step = max(1, smooth.shape[1] // 500)
        sample = smooth[::step, ::step]
        background_e = np.median(sample)
        noise_e = 1.4826 * float(np.median(np.abs(sample - background_e)))
        brightest_e = float(smooth.max() - background_e)
        threshold_e = max(THRESHOLD_SIGMA * noise_e, THRESHOLD_OF_BRIGHTEST * brightest_e)
        regions.append((electrons - background_e, smooth - background_e, threshold_e))
    return regions


def segmented(frame: DeviceFrame, segmentation: Any) -> list[object]:
    """Centroids and second moments by photutils."""
    found: list[object] = []
    for electrons, smooth, threshold_e in thresholded(frame):
        segments = segmentation.detect_sources(smooth, threshold_e, MIN_BLOB_PX)
        if segments is not None:
            sources = segmentation.SourceCatalog(electrons, segments)
            found += [sources.centroid, sources.covariance]
    return found


def extracted(frame: DeviceFrame, sep: Any) -> list[object]:
    """Centroids and second moments by sep."""
    return [
        sep.extract(smooth, threshold_e, minarea=MIN_BLOB_PX, filter_kernel=None)
        for _, smooth, threshold_e in thresholded(frame)
    ]


def main() -> None:
    """Measure and print; exits with 1 where a ratio falls short."""
    cv2.setNumThreads(1)
    prepare_process()  # as `estimator run` and its workers do
    targets, folders = Targets(), [Path(one) for one in sys.argv[1:]]
    for folder in folders:
        first = folder == folders[0]
        all_variants(targets, folder, MAX_ALL_VARIANTS if first else None)
        detection_beside_peers(targets, folder, held=first)
    fit_beside_peers(targets, read_dataset(folders[0]))
    with ProcessPoolExecutor(WORKERS, get_context("spawn"), prepare_process) as pool:
        list(pool.map(read_dataset, WORKERS * folders[:1]))  # modules are loaded
        for folder in folders:
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
        rate_beside_peer(targets, pool, folders[0])
    targets.finish()


def rate_beside_peer(targets: Targets, pool: ProcessPoolExecutor, folder: Path) -> None:
    """Frames a second of `ml`, and over those of photutils' segmentation, in turn."""

    def rate(one: Callable[[int], float]) -> float:
        return sum(pool.map(one, range(WORKERS)))

    with_peer = peer("photutils.segmentation") is not None
    of_ml, of_peer = [], []
    for _ in range(RATES):
        of_ml.append(rate(partial(frames_per_s, folder, "ml")))
        if with_peer:
            of_peer.append(rate(partial(segmented_per_s, folder)))
    ml_rate = statistics.median(of_ml)
    name = f"{folder.name}: ml, frames a second of {WORKERS} processes"
    targets.beside(f"{name}, of {ML_RATE:g} on a fast machine", ml_rate)
    if with_peer:
        targets.beside(f"{folder.name}: photutils, frames a second of {WORKERS} processes", statistics.median(of_peer))
        targets.at_least(f"{name} / photutils' segmentation", ratio(of_ml, of_peer), MIN_ML_OF_PEER)


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
