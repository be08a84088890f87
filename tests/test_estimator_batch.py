"""Rows of a batch: what a variant returns or raises, and the frames that it sees."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from estimator_synthetic import small_dataset

from estimator.errors import EstimationFailure
from estimator.evaluate.batch import Observed, bursts, estimate_burst, estimate_dataset, estimate_device, estimate_frame
from estimator.io.dataset import Dataset, read_dataset, read_frame
from estimator.io.device import DeviceFrame
from estimator.io.estimates import EstimateRow
from estimator.io.records import MAX_NUMBER
from estimator.methods.variant import DeviceMethod, Estimate, Variant

HERE = np.array([1.0, 2.0, 0.5])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames; the first two are of one shot."""
    folder = small_dataset(tmp_path_factory.mktemp("batch"), noise=False)
    table = pq.read_table(folder / "frames.parquet")
    rows = table.to_pylist()
    for row, shot in zip(rows, (0, 0, 1), strict=True):
        row["shot"] = row["burst"] = shot
    pq.write_table(table.from_pylist(rows, table.schema), folder / "frames.parquet")
    return folder


@pytest.fixture(scope="module")
def dataset(folder: Path) -> Dataset:
    return read_dataset(folder)


@pytest.fixture(scope="module")
def frame(dataset: Dataset) -> DeviceFrame:
    return read_frame(dataset, 2)


def row_of(frame: DeviceFrame, estimate: Callable[[DeviceFrame], object]) -> EstimateRow:
    return estimate_frame(Variant("x", "", estimate), frame, 5)  # type: ignore[arg-type]


def test_an_estimate_is_written_as_it_is(frame: DeviceFrame) -> None:
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 2.0], [0.0, 2.0, 16.0]]) * 1e-6
    row = row_of(frame, lambda _: Estimate(HERE, {10: 3.25, 11: 3.5}, covariance, ambiguous=True))
    assert (row.frame, row.status, row.reason, row.position_m) == (5, "ok", "", (1.0, 2.0, 0.5))
    assert [(one.led, one.range_m) for one in row.ranges] == [(10, 3.25), (11, 3.5)]
    assert row.covariance_m2 == tuple(covariance.ravel())
    assert row.ambiguous
    assert not row_of(frame, lambda _: Estimate(HERE)).ambiguous


WRONG: dict[str, tuple[Estimate, str]] = {
    "two numbers": (Estimate(HERE[:2]), "position: the result is not three numbers"),
    "a column": (Estimate(HERE[:, None]), "position: the result is not three numbers"),
    "not a number": (Estimate(HERE * np.nan), "position: the result is not a finite number"),
    "infinite": (Estimate(HERE * np.inf), "position: the result is not a finite number"),
    "too large": (Estimate(HERE * MAX_NUMBER), "position: the result is not a finite number"),
    "two by two": (Estimate(HERE, {}, np.eye(2)), "covariance: not a symmetric, positive definite matrix"),
    "asymmetric": (
        Estimate(HERE, {}, np.eye(3) + np.eye(3, k=1) / 2),
        "covariance: not a symmetric, positive definite matrix",
    ),
    "indefinite": (
        Estimate(HERE, {}, np.diag([1.0, 1.0, -1.0])),
        "covariance: not a symmetric, positive definite matrix",
    ),
    "an unknown LED": (Estimate(HERE, {9: 3.0}), "ranges: to an LED that is not on the map"),
    "a known and an unknown LED": (Estimate(HERE, {10: 3.0, 9: 3.0}), "ranges: to an LED that is not on the map"),
    "an endless range": (Estimate(HERE, {10: np.inf}), "ranges: the result is not a finite number"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_result_that_is_no_position_is_a_failed_frame(frame: DeviceFrame, case: str) -> None:
    estimate, reason = WRONG[case]
    row = row_of(frame, lambda _: estimate)
    assert (row.status, row.reason, row.position_m, row.covariance_m2) == ("failed", reason, None, None)


def test_a_frame_that_fails_keeps_the_ranges_that_were_found(frame: DeviceFrame) -> None:
    def fails(_: DeviceFrame) -> Estimate:
        raise EstimationFailure("position", "why", {10: 3.25})

    def fails_wrongly(_: DeviceFrame) -> Estimate:
        raise EstimationFailure("position", "why", {9: 3.25})

    found = row_of(frame, fails)
    assert (found.reason, [(one.led, one.range_m) for one in found.ranges]) == ("position: why", [(10, 3.25)])
    assert (row_of(frame, fails_wrongly).reason, row_of(frame, fails_wrongly).ranges) == ("position: why", ())
    kept = row_of(frame, lambda _: Estimate(HERE * np.nan, {10: 3.25}))
    assert [(one.led, one.range_m) for one in kept.ranges] == [(10, 3.25)]


def test_a_variant_sees_the_other_frames_of_the_shot_and_cannot_change_the_image(dataset: Dataset) -> None:
    seen: list[tuple[int, list[int]]] = []
    gravity = {record.accelerometer_m_s2: record.frame for record in dataset.frames}

    def looks(frame: DeviceFrame) -> Estimate:
        others = [gravity[other.accelerometer_m_s2] for other in frame.other_cameras]
        seen.append((gravity[frame.accelerometer_m_s2], others))
        assert not frame.parts[0].image_dn.flags.writeable
        assert not any(part.image_dn.flags.writeable for other in frame.other_cameras for part in other.parts)
        return Estimate(HERE)

    done: list[None] = []
    rows = estimate_dataset(dataset, [Variant("a", "", looks), Variant("b", "", looks)], lambda: done.append(None))
    assert seen == [(0, [1]), (0, [1]), (1, [0]), (1, [0]), (2, []), (2, [])]
    assert {name: [(row.frame, row.status) for row in of_variant] for name, of_variant in rows.items()} == {
        name: [(0, "ok"), (1, "ok"), (2, "ok")] for name in "ab"
    }
    assert len(done) == 3
    assert [[record.frame for record in shot] for shot in bursts(dataset, dataset.frames)] == [[0, 1], [2]]


def test_a_frame_that_cannot_be_read_fails_and_is_no_other_camera(dataset: Dataset) -> None:
    """The second frame of the shot is missing: it fails for every variant, and the first is estimated without it."""
    lost = dataset.frames[1].model_copy(update={"file": "frames/none.exr"})
    others: list[int] = []

    def counts(frame: DeviceFrame) -> Estimate:
        others.append(len(frame.other_cameras))
        return Estimate(HERE)

    rows = estimate_burst(dataset, (dataset.frames[0], lost), [Variant("a", "", counts)]).rows["a"]
    assert [row.status for row in rows] == ["ok", "failed"]
    assert rows[1].reason.startswith("read: frames/none.exr: ")
    assert rows[1].time_s == 0
    assert others == [0]


def test_the_time_of_a_frame_is_from_the_numbers_to_the_position(
    frame: DeviceFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that advances by 2 s in the variant: 2 s, failed or not."""
    clock = [100.0]
    monkeypatch.setattr("estimator.evaluate.batch.time.perf_counter", lambda: clock[0])

    def slow(result: Exception | None) -> Callable[[DeviceFrame], Estimate]:
        def estimate(_: DeviceFrame) -> Estimate:
            clock[0] += 2.0
            if result is not None:
                raise result
            return Estimate(HERE)

        return estimate

    for result in (None, EstimationFailure("a", "b"), ValueError("c")):
        assert row_of(frame, slow(result)).time_s == 2.0


def interleaved(dataset: Dataset) -> Dataset:
    """Frames 0 and 2 of device 7, frame 1 of device 3."""
    frames = [record.model_copy(update={"device": 3 if record.frame == 1 else 7}) for record in dataset.frames]
    return replace(dataset, frames=tuple(frames))


def test_frames_of_a_device_are_solved_together_in_order(dataset: Dataset) -> None:
    """Each frame's x is the number of frames of its device, y its place among them, z what was observed of it."""
    heights = {record.accelerometer_m_s2: float(record.frame) for record in dataset.frames}

    def solve(observed: Sequence[float]) -> list[Estimate]:
        return [Estimate(np.array([len(observed), k, z])) for k, z in enumerate(observed)]

    method = DeviceMethod(lambda frame: heights[frame.accelerometer_m_s2], solve)
    done: list[None] = []
    variants = [Variant.over_device("joint", "", method), Variant("each", "", lambda _: Estimate(HERE))]
    rows = estimate_dataset(interleaved(dataset), variants, lambda: done.append(None))
    assert [row.frame for row in rows["joint"]] == [row.frame for row in rows["each"]] == [0, 1, 2]
    assert [row.position_m for row in rows["joint"]] == [(2.0, 0.0, 0.0), (1.0, 0.0, 1.0), (2.0, 1.0, 2.0)]
    assert len(done) == 6  # a frame has two steps
    alone = variants[0].estimate(read_frame(dataset, 2))
    assert alone.position_m.tolist() == [1.0, 0.0, 2.0]


def test_a_frame_that_is_not_observed_fails_alone(dataset: Dataset) -> None:
    """Frame 0 fails in `observe`, frame 2 by the common solution; frame 1, of the other device, is not touched."""

    def observe(frame: DeviceFrame) -> float:
        if frame.accelerometer_m_s2 == dataset.frames[0].accelerometer_m_s2:
            raise EstimationFailure("spots", "none", {10: 3.25})
        return frame.exposure_s

    def solve(observed: Sequence[float]) -> list[Estimate | EstimationFailure]:
        return [EstimationFailure("joint", "too few") for _ in observed]

    method = DeviceMethod(observe, solve)
    rows = estimate_dataset(interleaved(dataset), [Variant.over_device("x", "", method)], lambda: None)["x"]
    assert [row.reason for row in rows] == ["spots: none", "joint: too few", "joint: too few"]
    assert [(one.led, one.range_m) for one in rows[0].ranges] == [(10, 3.25)]
    with pytest.raises(EstimationFailure, match="joint: too few"):
        method.alone(read_frame(dataset, 2))


def failing(_: Sequence[object]) -> list[Estimate]:
    raise EstimationFailure("joint", "no minimum")


BROKEN: dict[str, tuple[Callable[[Sequence[object]], object], str]] = {
    "fewer": (lambda observed: [Estimate(HERE)] * (len(observed) - 1), "another number of results than of frames"),
    "nothing": (lambda _: None, "variant: crashed (TypeError)"),
    "numbers": (lambda observed: [1.0] * len(observed), "variant: returned no Estimate"),
    "failure": (failing, "joint: no minimum"),
    "not finite": (lambda observed: [Estimate(HERE * np.nan)] * len(observed), "not a finite number"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_what_goes_wrong_with_a_device_is_the_reason_of_each_of_its_frames(dataset: Dataset, case: str) -> None:
    solve, reason = BROKEN[case]
    variant = Variant.over_device("x", "", DeviceMethod(lambda _: 0, solve))  # type: ignore[arg-type]
    rows = estimate_dataset(dataset, [variant], lambda: None)["x"]
    assert [reason in row.reason for row in rows] == [True, True, True]


def test_the_time_of_a_frame_of_a_device_is_its_own_and_its_share(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Observed in 1 s and 3 s, solved together in 8 s: 5 s and 7 s. A frame that was not observed has no share."""
    clock = [0.0]
    monkeypatch.setattr("estimator.evaluate.batch.time.perf_counter", lambda: clock[0])

    def solve(observed: Sequence[object]) -> list[Estimate]:
        clock[0] += 8.0
        return [Estimate(HERE) for _ in observed]

    observed = [Observed(4, 0, "a", 1.0), Observed(5, 0, EstimationFailure("a", "b"), 2.0), Observed(9, 0, "b", 3.0)]
    variant = Variant.over_device("x", "", DeviceMethod(lambda _: 0, solve))
    rows = estimate_device(dataset, {"x": observed}, [variant])["x"]
    assert [(row.frame, row.status, row.time_s) for row in rows] == [(4, "ok", 5.0), (5, "failed", 2.0), (9, "ok", 7.0)]
