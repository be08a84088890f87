"""Reception end to end: datasets whose identities are in the pixels, through `run` and `score`."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import copy_of
from downlink_signals import Sent, balanced_codes, remainder
from estimator_synthetic import (
    FRAMES_SCHEMA,
    TRUTH_SCHEMA,
    description,
    grid,
    poisson,
    render,
    view_of,
    write_dataset,
    write_exr,
)

import estimator as est
from estimator.errors import EstimationFailure, InputError
from estimator.evaluate.batch import bursts, estimate_dataset
from estimator.evaluate.identities import _Frame, score_identities
from estimator.io.camera import Camera
from estimator.io.device import DeviceFrame
from estimator.io.truth import TrueLed, TruthRow, read_true_map, read_truth
from estimator.methods.catalogue import VARIANTS
from estimator.methods.maximum_likelihood import ml
from estimator.methods.variant import DeviceMethod, Estimate, Variant
from estimator.receiver.known import with_known_gains
from estimator.receiver.receive import receive, receive_frames, with_identities
from estimator.spots.striped import Lamp, find_lamps

ROW_TIME_S, EXPOSURE_S = 10e-6, 40e-6
CENTRE_M = (3.5, 3.6, 3.5)
LEDS_M = grid(4, 3, 0.33, CENTRE_M)
"""LEDs 10 to 21, 40 px in radius: 80 lines each."""
RADIUS_M = 0.08
DELAYS = (30, 80, 0, 110, 50, 10, 90, 20, 70, 100, 40, 60)
CODES = balanced_codes(40, 32, np.random.default_rng(3))
SEEN_CODES = CODES[:12]
START_S = (4.2, 4.2 + 1 / 30, 9.1, 9.1 + 1 / 30)


def packet() -> str:
    x, y, z = (round(1000 * value) for value in CENTRE_M)
    data = f"{x:013b}{y:013b}{z:013b}0"
    return "00011011000111" + "".join("10" if bit == "1" else "01" for bit in data + remainder(data, 0x3D65))


def write_modulated(folder: Path, sent: list[Sent], downlink: dict[str, Any], with_map: bool) -> Path:
    """Two bursts of two frames of 800 x 600 pixels, with gains by rows; the first burst is level, the other tilted."""
    size = (800, 600, 1500.0)
    views = [view_of(CENTRE_M, 3.0, *tilt, size=size) for tilt in ((0.0, 0.0, 10.0), (6.0, -5.0, 195.0)) for _ in "ab"]
    write_dataset(folder, views, LEDS_M, RADIUS_M)
    frames = pq.read_table(folder / "frames.parquet").to_pylist()
    truth = pq.read_table(folder / "truth.parquet").to_pylist()
    for number, (view, row, true) in enumerate(zip(views, frames, truth, strict=True)):
        image = np.full((view.height_px, view.width_px), 40.0)
        gains_at = START_S[number] + np.arange(view.height_px) * ROW_TIME_S
        for led, wave in zip(LEDS_M, sent, strict=True):
            image += render(view, led[None], RADIUS_M, 1000.0, 0.0, samples=4) * wave.gains(gains_at)[:, None]
        row.update(
            sha256=write_exr(folder / row["file"], poisson(image, number)),
            **{"spots": [], "exposure_s": EXPOSURE_S, "burst": number // 2, "start_s": START_S[number]},
        )
        for led in true["leds"]:
            led["bits"] = sent[led["led"] - 10].chips
    pq.write_table(pa.Table.from_pylist(frames, FRAMES_SCHEMA), folder / "frames.parquet")
    pq.write_table(pa.Table.from_pylist(truth, TRUTH_SCHEMA), folder / "truth.parquet")
    told = json.loads((folder / "dataset.json").read_text())
    told["cameras"]["main"]["shutter"] = {"kind": "rolling", "row_time_us": 1e6 * ROW_TIME_S, "direction": "down"}
    told["downlink"] = downlink
    if not with_map:
        true_map = [
            {"map": 0, "led": 10 + k, "position_m": led, "size_m": RADIUS_M} for k, led in enumerate(LEDS_M.tolist())
        ]
        pq.write_table(pa.Table.from_pylist(true_map), folder / "truth_map.parquet")
        told["led_map"] = None
    (folder / "dataset.json").write_text(json.dumps(told))
    return folder


@pytest.fixture(scope="module")
def by_codes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map holds 12 LEDs in view; their code book holds 12."""
    entry = {"send": "code", "chip_us": 25.0, "depth": 1.0, "clock_error": 1e-4, "leds": list(range(10, 22))}
    downlink = {"demodulation": "pixels", "transmitters": [{**entry, "codes": list(SEEN_CODES)}]}
    sent = [Sent(code, 25e-6 / (1 + 1e-4), 3.7) for code in SEEN_CODES]
    return write_modulated(tmp_path_factory.mktemp("codes"), sent, downlink, with_map=True)


@pytest.fixture(scope="module")
def by_packets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    packets = {
        **{"send": "packet", "chip_us": 50.0, "depth": 1.0, "clock_error": 1e-4, "preamble": "00011011000111"},
        **{"polynomial": 0x3D65, "coordinate_bits": 13, "coordinate_unit_m": 0.001, "delays_chips": list(DELAYS)},
        "offsets_m": (LEDS_M[:, :2] - CENTRE_M[:2]).tolist(),
        "led": {"shape": "disc", "radius_m": RADIUS_M},
    }
    downlink = {"demodulation": "pixels", "transmitters": [packets]}
    sent = [Sent(packet(), 50e-6 / (1 - 1e-4), 77.7 - late) for late in DELAYS]
    return write_modulated(tmp_path_factory.mktemp("packets"), sent, downlink, with_map=False)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["by_codes", "by_packets"])
def test_positions_come_from_the_pixels_alone(kind: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """All LED images are found and named; noise of 0.02 px of 1500 at 3 m is 0.04 mm, by the lever some 5 times that.

    A wrong identity, or gains of another frame, would put a position off by decimetres.
    """
    folder = copy_of(request.getfixturevalue(kind), tmp_path / "set")
    rows = est.run(folder, ["gravity-fit"])["gravity-fit"]
    scores = est.score(folder)
    (score,) = scores.variants
    assert [row.status for row in rows] == ["ok"] * 4
    assert score.error_3d is not None
    assert score.error_3d.max_m < 1e-3
    found = score.downlink
    assert found is not None
    counts = (found.leds, found.right, found.wrong, found.rejected, found.missed, found.wrong_elsewhere)
    assert counts == (48, 48, 0, 0, 0, 0)
    assert found.bit_errors == 0
    # 80 lines of 10 us and the exposure: some 30 chips of 25 us, 15 of 50.
    assert found.bits > 48 * (12 if kind == "by_packets" else 24)
    # 40 px in radius at 3 m, 37 where the tilted view has them furthest.
    assert sum(one.leds for one in found.by_rows if one.low >= 60) == 48
    assert sum(one.leds for one in found.by_distance) == sum(one.leds for one in found.by_tilt) == 48
    assert [(one.low, one.leds) for one in found.by_tilt if one.leds] == [(0, 48)]
    assert scores.to_pandas()["downlink_right"].tolist() == [48]


@pytest.mark.slow
def test_packets_tell_the_leds_and_where_they_are(by_packets: Path) -> None:
    dataset = est.read_dataset(by_packets)
    frames = receive_frames([est.read_frame(dataset, number) for number in (0, 1)])
    number = ((3500 << 13) + 3600 << 13) + 3500 << 13
    for frame in frames:
        assert sorted(frame.leds) == [number + k for k in range(12)]
        positions = np.array([frame.leds[number + k].position_m for k in range(12)])
        assert np.abs(positions - LEDS_M).max() < 1e-9
        assert frame.identities is not None
        assert {spot.led for spot in frame.spots} == {one.led for one in frame.identities}
        gains = frame.gains[number](np.arange(600))
        sent = Sent(packet(), 50e-6 / (1 - 1e-4), 77.7 - DELAYS[0])
        # A chip's edge is good to a tenth of a line, which a gain rises over by 0.1 * 10 us / 40 us of 2 levels.
        assert np.abs(gains - sent.gains(frame.start_s + np.arange(600) * ROW_TIME_S)).max() < 0.1


@pytest.fixture(scope="module")
def by_tones(tmp_path_factory: pytest.TempPathFactory) -> Path:
    frequencies = [1500.0 + 300.0 * k for k in range(12)]
    entry = {"send": "tone", "duty": 0.5, "depth": 1.0, "clock_error": 1e-4, "leds": list(range(10, 22))}
    downlink = {"demodulation": "pixels", "transmitters": [{**entry, "frequencies_hz": frequencies}]}
    sent = [Sent("10", 0.5 / hz, 0.7) for hz in frequencies]
    return write_modulated(tmp_path_factory.mktemp("tones"), sent, downlink, with_map=True)


def handed_over(received: DeviceFrame) -> DeviceFrame:
    """A received frame as if its identities had been handed over."""
    assert received.downlink is not None
    downlink = received.downlink.model_copy(update={"demodulation": "given"})
    return replace(received, downlink=downlink, identities=None, gains={})


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["by_codes", "by_packets", "by_tones"])
def test_identities_handed_over_have_the_gains_of_decoded_ones(kind: str, request: pytest.FixtureRequest) -> None:
    """By the same lines, but packets by one frame instead of two: their clocks of 1e-4 are 3 us apart after 33 ms, of
    40 us of exposure. Tones are looked for in the same band, by the same fit.
    """
    dataset = est.read_dataset(request.getfixturevalue(kind))
    received, _ = receive_frames([est.read_frame(dataset, number) for number in (0, 1)])
    given = handed_over(received)
    assert given.unknown_gains == received.leds.keys()
    known = with_known_gains(given)
    assert known.gains.keys() == received.gains.keys() == received.leds.keys()
    assert known.unknown_gains == frozenset()
    assert with_known_gains(received) is received
    for led, gains in received.gains.items():
        # The lines of its own image; a chip's edge moves a gain by 2 levels in 40 us, and packets' by 3 us of them.
        (v_px,) = (spot.v_px for spot in received.spots if spot.led == led)
        lines = np.arange(int(v_px) - 30, int(v_px) + 30)
        assert np.abs(known.gains[led](lines) - gains(lines)).max() < (2 * 3 / 40 if kind == "by_packets" else 0.02)


@pytest.mark.slow
def test_ml_is_as_good_with_identities_handed_over(by_codes: Path) -> None:
    """The same pixels and gains: positions differ by less than a tenth of a standard deviation. With an LED that the
    light contradicts, by the code of another, that one has no gains and is left out. With two spots and no gains at all
    there is nothing to fit.
    """
    received, _ = receive_frames([est.read_frame(est.read_dataset(by_codes), number) for number in (0, 1)])
    given = handed_over(received)
    decoded, known = ml(received), ml(given)
    assert decoded.covariance_m2 is not None
    off_m = known.position_m - decoded.position_m
    assert off_m @ np.linalg.solve(decoded.covariance_m2, off_m) < 0.01
    assert given.downlink is not None
    (codes,) = given.downlink.transmitters
    swapped = codes.model_copy(update={"codes": (CODES[20], *SEEN_CODES[1:])})
    wrong = replace(given, downlink=given.downlink.model_copy(update={"transmitters": (swapped,)}))
    assert with_known_gains(wrong).unknown_gains == {10}
    without = ml(wrong)
    assert np.linalg.norm(without.position_m - decoded.position_m) < 1e-3
    hidden = replace(
        given,
        spots=given.spots[:2],
        downlink=wrong.downlink.model_copy(
            update={"transmitters": (codes.model_copy(update={"codes": CODES[20:32]}),)}
        ),
    )
    with pytest.raises(EstimationFailure, match="phases are not found"):
        ml(hidden)


@pytest.mark.slow
def test_a_frame_alone_is_received_where_it_is_estimated(by_codes: Path) -> None:
    frame = est.read_frame(est.read_dataset(by_codes), 3)
    assert (frame.spots, frame.identities) == ((), None)
    received = with_identities(frame)
    assert sorted(spot.led for spot in received.spots) == list(range(10, 22))
    assert with_identities(received) is received
    estimate = est.estimate(frame, "gravity-fit")
    (result,) = est.estimate_device([frame], "gravity-fit")
    assert isinstance(result, Estimate)
    assert np.array_equal(estimate.position_m, result.position_m)


@pytest.mark.slow
def test_frames_of_a_burst_share_the_time_of_their_reception(by_codes: Path) -> None:
    """Both kinds of variants get received frames; a frame that cannot be read takes no other one with it."""
    dataset = est.read_dataset(by_codes)
    assert [[record.frame for record in burst] for burst in bursts(dataset, dataset.frames)] == [[0, 1], [2, 3]]

    def looks(frame: est.DeviceFrame) -> Estimate:
        assert len(frame.spots) == 12
        return Estimate(np.zeros(3))

    method = DeviceMethod(looks, lambda some: list(some))
    steps: list[None] = []
    variants = [Variant("a", "", looks), Variant.over_device("b", "", method)]
    rows = estimate_dataset(dataset, variants, lambda: steps.append(None))
    for of_variant in rows.values():
        assert [row.status for row in of_variant] == ["ok"] * 4
        assert all(len(row.identities or ()) == 12 for row in of_variant)
        # The variants do nothing: their time is that of the reception, which takes milliseconds for each LED image.
        assert all(row.time_s > 0.01 for row in of_variant)
    assert len(steps) == 8


@pytest.mark.slow
def test_led_images_are_found_once_for_the_receiver_and_all_variants(
    by_codes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their time is that of the reception, and counts once: the clock advances by 5 s where they are searched."""
    dataset, clock = est.read_dataset(by_codes), [0.0]

    def counted(*arguments: object) -> tuple[Lamp, ...]:
        clock[0] += 5.0
        return find_lamps(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr("time.perf_counter", lambda: clock[0])
    monkeypatch.setattr("estimator.spots.lamps.find_lamps", counted)
    rows = estimate_dataset(dataset, [VARIANTS["gravity-fit"], VARIANTS["pnp"]], lambda: None)
    assert {row.time_s for of_variant in rows.values() for row in of_variant} == {5.0}
    assert clock[0] == 5.0 * len(dataset.frames)
    clock[0] = 0.0
    est.estimate(est.read_frame(dataset, 0), "gravity-fit")
    assert clock[0] == 5.0


@pytest.mark.slow
def test_a_receiver_that_fails_fails_the_frames_of_its_burst(by_codes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = est.read_dataset(by_codes)
    for error, reason in (
        (ValueError("x"), "receive: crashed (ValueError)"),
        (EstimationFailure("level", "y"), "level: y"),
    ):

        def fails(frames: list[est.DeviceFrame], error: Exception = error) -> tuple[est.DeviceFrame, ...]:
            if frames[0].burst == 1:
                raise error
            return tuple(frames)

        monkeypatch.setattr("estimator.evaluate.batch.receive_frames", fails)
        rows = estimate_dataset(dataset, [Variant("a", "", lambda _: Estimate(np.zeros(3)))], lambda: None)["a"]
        assert [row.reason for row in rows] == ["", "", reason, reason]


def test_frames_out_of_order_are_refused(by_codes: Path) -> None:
    dataset = est.read_dataset(by_codes)
    with pytest.raises(InputError, match="start_s has to increase"):
        receive([est.read_frame(dataset, number) for number in (1, 0)])
    assert receive([]) == ()


@pytest.mark.slow
def test_scores_tell_wrong_from_rejected_from_missed(by_codes: Path, by_packets: Path) -> None:
    """Identities changed by hand: one named as its neighbour, one without a name, one moved off all LEDs."""
    dataset = est.read_dataset(by_codes)
    rows = list(estimate_dataset(dataset, [Variant("a", "", lambda _: Estimate(np.zeros(3)))], lambda: None)["a"])
    truth = read_truth(by_codes / "truth.parquet", 4)
    first = list(rows[0].identities or ())
    first[0] = replace(first[0], led=first[1].led)
    first[2] = replace(first[2], led=None)
    bits = first[4].bits or ""
    turned = bits.replace("0", "x").replace("1", "0").replace("x", "1")
    first[4] = replace(first[4], bits=turned)
    first[3] = replace(first[3], u_px=-500.0)
    rows[0] = rows[0].model_copy(update={"identities": tuple(first)})
    found = score_identities(rows, truth, dataset, ())
    assert found is not None
    assert (found.leds, found.right, found.wrong, found.rejected, found.missed) == (48, 45, 1, 1, 1)
    assert found.wrong_elsewhere == 1
    assert found.bit_errors == len(bits) - bits.count("-")
    unseen = [row.model_copy(update={"identities": None}) for row in rows]
    assert score_identities(unseen, truth, dataset, ()) is None
    assert len(read_true_map(by_packets / "truth_map.parquet")) == 12


@pytest.mark.parametrize("yaw_deg", [0.0, 3.75, 7.5, 11.25, 15.0])
def test_an_led_image_spans_its_diameter_of_lines_however_the_camera_is_turned(yaw_deg: float) -> None:
    """A disc of 80 mm, 3 m above a level camera of 1500 px: 80 lines. Points every 15 deg miss its top by 7.5 deg at
    most, a share of 1 - cos(7.5 deg) of the radius.
    """
    view = view_of(CENTRE_M, 3.0, 0.0, 0.0, yaw_deg, size=(800, 600, 1500.0))
    described = description(view, 1, LEDS_M, RADIUS_M)
    camera = Camera.model_validate_json(json.dumps(described["cameras"]["main"]))
    truth = TruthRow(
        **{"frame": 0, "position_m": view.position_m, "bound_m2": None, "bound_exact_m2": None, "map": 0, "leds": ()},
        R_cam_world=tuple(view.R_cam_world.ravel().tolist()),
        tilt_x_deg=0.0,
        tilt_y_deg=0.0,
        yaw_deg=0.0,
    )
    led = TrueLed(led=1, u_px=400.0, v_px=300.0, bits=None, visible_fraction=1.0)
    lines, distance_m, tilt_deg = _Frame(truth, camera, {1: (np.array(CENTRE_M), RADIUS_M)}).geometry(led)
    assert 80 * np.cos(np.radians(7.5)) - 1e-9 <= lines <= 80 + 1e-9
    assert (distance_m, tilt_deg) == (pytest.approx(3.0), pytest.approx(0.0, abs=1e-6))
