"""What the variants of a frame share: spots are detected once a denoiser, with the same rows and times as alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from estimator_synthetic import Array

import estimator as est
from estimator.camera.pose import Pose
from estimator.errors import EstimationFailure
from estimator.evaluate.batch import estimate_dataset
from estimator.io.shared import SharedResults
from estimator.methods.catalogue import VARIANTS, variant_named
from estimator.methods.gravity_fit import agreement
from estimator.methods.variant import DeviceMethod, Estimate, Variant
from estimator.solvers.observations import Observations
from estimator.solvers.ordinary_covariance import ordinary_covariance
from estimator.solvers.robust_fit import Consensus
from estimator.spots.correspondences import find_correspondences
from estimator.spots.denoise import Image, neighbourhood_mean
from estimator.spots.detect import Spot, detect


def at_the_camera(frame: est.DeviceFrame) -> Estimate:
    find_correspondences(frame)
    return Estimate(np.zeros(3))


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [50.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    return now


def test_a_result_is_computed_once_and_its_time_counts_each_time(clock: list[float]) -> None:
    shared, calls = SharedResults(), []

    def slow() -> str:
        clock[0] += 3.0
        calls.append(None)
        return "found"

    assert [shared.once("a", slow) for _ in range(3)] == ["found"] * 3
    assert (len(calls), shared.spared_s) == (1, 6.0)
    assert shared.once("b", slow) == "found"
    assert (len(calls), shared.spared_s) == (2, 6.0), "another key is another result"
    # What a result is made of counts in its time, computed or found.
    shared.once("c", lambda: shared.once("a", slow))
    assert shared.spared_s == 9.0
    shared.once("c", slow)
    assert (len(calls), shared.spared_s) == (2, 12.0)
    shared.settle()
    shared.once("c", slow)
    assert (len(calls), shared.spared_s) == (2, 12.0), "paid for"


def test_a_failure_is_a_result_too(clock: list[float]) -> None:
    shared, calls = SharedResults(), []

    def fails() -> str:
        clock[0] += 1.0
        calls.append(None)
        raise EstimationFailure("detect", "nothing")

    for _ in range(2):
        with pytest.raises(EstimationFailure, match="detect: nothing"):
            shared.once("a", fails)
    assert (len(calls), shared.spared_s) == (1, 1.0)


def test_spots_are_detected_once_a_denoiser_and_charged_to_every_variant(
    synthetic_set: Path, clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock advances in the detection alone, by 4 s; a variant for whole devices takes part."""
    dataset, calls = est.read_dataset(synthetic_set), []

    def counted(*arguments: object) -> tuple[Spot, ...]:
        calls.append(None)
        clock[0] += 4.0
        return detect(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr("estimator.spots.correspondences.detect", counted)
    one, two = Variant("one", "", at_the_camera), VARIANTS["huynh2016"]
    device = Variant.over_device("all", "", DeviceMethod(at_the_camera, lambda some: list(some)))
    # "none" detects on the raw image, as `find_correspondences` does by default.
    variants = [one, two, VARIANTS["pnp"], variant_named("huynh2016:denoise=none"), device]
    rows = estimate_dataset(dataset, variants, lambda: None)
    assert len(calls) == 2 * len(dataset.frames)
    assert {row.time_s for of_variant in rows.values() for row in of_variant} == {4.0}


@pytest.mark.slow
def test_denoisers_share_the_means_of_a_frame(synthetic_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset, calls = est.read_dataset(synthetic_set), []

    def counted(image: Image) -> Image:
        calls.append(None)
        return neighbourhood_mean(image)

    monkeypatch.setattr("estimator.spots.correspondences.neighbourhood_mean", counted)
    estimate_dataset(dataset, [VARIANTS["huynh2016"], VARIANTS["huynh2016-as-printed"]], lambda: None)
    assert len(calls) == sum(len(est.read_frame(dataset, frame).parts) for frame in range(len(dataset.frames)))


def test_estimates_are_those_of_each_variant_alone(synthetic_set: Path) -> None:
    dataset, variants = est.read_dataset(synthetic_set), list(VARIANTS.values())
    together = estimate_dataset(dataset, variants, lambda: None)
    for variant in variants:
        alone = estimate_dataset(dataset, [variant], lambda: None)[variant.name]
        for one, other in zip(together[variant.name], alone, strict=True):
            assert one.model_copy(update={"time_s": 0.0}) == other.model_copy(update={"time_s": 0.0})


def test_spots_of_another_frame_are_not_taken(synthetic_set: Path) -> None:
    """With the same results to share: other identities, another sensor and other images are detected anew."""
    frame = replace(est.read_frame(est.read_dataset(synthetic_set), 0), shared=SharedResults())
    (part,) = frame.parts
    others = [
        replace(frame, parts=(replace(part, image_dn=part.image_dn // 2),)),
        replace(frame, sensor=frame.sensor.model_copy(update={"read_noise_e": 5.0})),
        replace(frame, spots=frame.spots[:2]),
    ]
    found = [[one.spot.covariance_px2 for one in find_correspondences(other)] for other in (frame, *others)]
    for other, covariances in zip((frame, *others), found, strict=True):
        alone = [one.spot.covariance_px2 for one in find_correspondences(replace(other, shared=None))]
        np.testing.assert_array_equal(covariances, alone)
    assert len(found[3]) == 2
    assert not np.array_equal(found[0], found[1])
    assert not np.array_equal(found[0], found[2])


def test_the_consensus_of_a_frame_is_found_once(synthetic_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset, calls = est.read_dataset(synthetic_set), []

    def counted(observations: Observations) -> Consensus:
        calls.append(None)
        return agreement(observations)

    monkeypatch.setattr("estimator.methods.gravity_fit.agreement", counted)
    variants = [VARIANTS["gravity-fit"], variant_named("gravity-fit:centroid-sigma=0.5"), VARIANTS["self-calibrated"]]
    rows = estimate_dataset(dataset, variants, lambda: None)
    assert len(calls) == 2 * len(dataset.frames), "one more for the other standard deviation"
    alone = estimate_dataset(dataset, variants[1:2], lambda: None)
    for one, other in zip(rows[variants[1].name], alone[variants[1].name], strict=True):
        assert one.model_copy(update={"time_s": 0.0}) == other.model_copy(update={"time_s": 0.0})


def test_the_covariance_of_a_pose_is_found_once(synthetic_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`pnp` has the pose of `ippe` or of `sqpnp`, which differ."""
    dataset, calls = est.read_dataset(synthetic_set), []

    def counted(observations: Observations, pose: Pose) -> Array:
        calls.append(None)
        return ordinary_covariance(observations, pose)

    monkeypatch.setattr("estimator.methods.pnp.ordinary_covariance", counted)
    estimate_dataset(dataset, [VARIANTS[name] for name in ("pnp", "ippe", "sqpnp")], lambda: None)
    assert len(calls) == 2 * len(dataset.frames)
