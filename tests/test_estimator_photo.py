"""Photographs: from a picture, a map and a calibration to positions; what is refused, and by which words."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from photographs import (
    EXPOSURE_S,
    FOCAL_PX,
    HEIGHT_CM,
    LAMPS_CM,
    LINE_RATE_HZ,
    POSITION_CM,
    SIZE_PX,
    photograph,
    pixels_of,
    write_map,
    write_picture,
)
from scipy.stats import chi2

import estimator as est
from estimator.cli import main
from estimator.errors import EstimationFailure, InputError
from estimator.photo.attitude import attitude
from estimator.photo.led_table import read_led_table
from estimator.photo.locate import Located, Options, locate
from estimator.photo.report import lamp_rows
from estimator.photo.session import exposure_s
from estimator.photo.solve import Answer

KNOWN = Options(exposure_s=EXPOSURE_S, focal_px=FOCAL_PX, line_rate_hz=LINE_RATE_HZ)
LEVEL = attitude(level_deg=1.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("photo")
    write_picture(made / "bell.jpg", photograph())
    write_map(made / "right.csv")
    write_map(made / "left.csv", left_handed=True)
    return made


@pytest.fixture(scope="module")
def located(folder: Path) -> Located:
    return locate(folder / "bell.jpg", read_led_table(folder / "left.csv", "cm"), None, LEVEL, KNOWN)


def answer(located: Located, variant: str = "gravity-fit") -> Answer:
    (one,) = [one for one in located.solved.answers if one.variant == variant]
    return one


def test_the_lamps_of_a_jpeg_are_found_by_their_tones(located: Located) -> None:
    expected = pixels_of(np.array(list(LAMPS_CM.values())), 0.5)
    assert len(located.lamps) == len(LAMPS_CM)
    for one in located.lamps:
        assert one.tone is not None
        nearest = int(np.linalg.norm(expected - (one.lamp.u_px, one.lamp.v_px), axis=1).argmin())
        # Saturation cuts the envelope: some pixels of a lamp of 68 px, as in real photographs.
        assert np.linalg.norm(expected[nearest] - (one.lamp.u_px, one.lamp.v_px)) < 2
        assert one.candidates == (nearest,)
        assert one.tone.frequency_hz == pytest.approx(list(LAMPS_CM)[nearest], abs=100)


@pytest.mark.parametrize("variant", ["gravity-fit", "pnp"])
def test_the_position_of_a_left_handed_map_is_in_its_own_units_and_axes(located: Located, variant: str) -> None:
    found = answer(located, variant)
    assert located.solved.mirror == "x"
    assert found.position is not None
    x, y, z = POSITION_CM
    # A tilt of 0.5 deg, which the statement of level leaves open, is 2 cm at 2.3 m.
    assert found.position == pytest.approx([-x, y, z], abs=3.0)


def test_the_covariance_covers_the_error(located: Located) -> None:
    found = answer(located)
    x, y, z = POSITION_CM
    assert found.position is not None
    assert found.covariance is not None
    off = found.position - [-x, y, z]
    assert off @ np.linalg.solve(found.covariance, off) < chi2.isf(1e-3, 3)


@pytest.mark.slow
def test_a_right_handed_map_is_left_as_it_is_and_uniform_lamps_have_edges(folder: Path) -> None:
    picture = write_picture(folder / "discs.png", photograph(bell=False))
    found = locate(picture, read_led_table(folder / "right.csv", "cm"), None, LEVEL, KNOWN)
    assert found.solved.mirror == "none"
    assert all(one.lamp.uniform for one in found.lamps)
    assert answer(found).position == pytest.approx(POSITION_CM, abs=3.0)


@pytest.mark.slow
def test_columns_as_lines_are_found_out(folder: Path) -> None:
    picture = write_picture(folder / "columns.png", photograph(along="columns"))
    found = locate(picture, read_led_table(folder / "right.csv", "cm"), None, LEVEL, KNOWN)
    assert found.frame.camera.shutter.direction == "right"
    assert answer(found).position == pytest.approx(POSITION_CM, abs=3.0)


def exchanged() -> dict[int, tuple[float, float]]:
    return {**LAMPS_CM, 3000: LAMPS_CM[3500], 3500: LAMPS_CM[3000]}


def stretched() -> dict[int, tuple[float, float]]:
    return {hz: (x + 15 * np.sign(x), y) for hz, (x, y) in LAMPS_CM.items()}


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [exchanged, stretched])
def test_a_wrong_map_is_refused(folder: Path, wrong: Callable[[], dict[int, tuple[float, float]]]) -> None:
    table = read_led_table(write_map(folder / "wrong.csv", wrong()), "cm")
    with pytest.raises(EstimationFailure, match="position"):
        locate(folder / "bell.jpg", table, None, LEVEL, KNOWN)


@pytest.mark.slow
def test_one_led_that_hangs_elsewhere_is_left_out_and_named(folder: Path) -> None:
    """35 cm beside its place in the map: some 210 px; no fit is led astray."""
    x, y = LAMPS_CM[2500]
    table = read_led_table(write_map(folder / "moved.csv", {**LAMPS_CM, 2500: (x + 35, y)}), "cm")
    found = locate(folder / "bell.jpg", table, None, LEVEL, Options(**{**vars(KNOWN), "mirror": "none"}))
    ((led, off_px),) = found.solved.misplaced
    assert table.frequencies_hz()[led] == 2500
    assert off_px > 100
    assert any("left out" in remark for remark in found.remarks)
    assert led not in {spot.led for spot in found.frame.spots}
    for variant in ("gravity-fit", "pnp"):
        assert answer(found, variant).rms_px < 10
    # As with all five, but for the larger share of the tilt that four leave open: 0.5 deg are 2 cm at 2.3 m.
    assert answer(found).position == pytest.approx(POSITION_CM, abs=4.0)


@pytest.mark.slow
def test_a_wrong_axis_is_refused_and_the_message_names_the_other(folder: Path) -> None:
    options = Options(**{**vars(KNOWN), "readout": "columns"})
    with pytest.raises(EstimationFailure, match="try --readout rows"):
        locate(folder / "bell.jpg", read_led_table(folder / "left.csv", "cm"), None, LEVEL, options)


@pytest.mark.slow
def test_frequencies_of_other_lamps_are_refused(folder: Path) -> None:
    others = {hz + 7000: place for hz, place in LAMPS_CM.items()}
    with pytest.raises(EstimationFailure, match="no lamp sends a tone of the map"):
        locate(folder / "bell.jpg", read_led_table(write_map(folder / "other.csv", others), "cm"), None, LEVEL, KNOWN)


@pytest.mark.slow
def test_of_two_lamps_of_one_frequency_the_geometry_tells_which_is_which(folder: Path) -> None:
    tones = [2000.0, 2000.0, 3000.0, 3500.0, 4000.0]
    picture = write_picture(folder / "twice.png", photograph(frequencies_hz=tones))
    rows = [f"{name},{x},{y},240,{tone}" for name, (x, y), tone in zip("abcde", LAMPS_CM.values(), tones, strict=True)]
    (folder / "twice.csv").write_text("\n".join(["id,x,y,z,frequency_hz", *rows]))
    found = locate(picture, read_led_table(folder / "twice.csv", "cm"), None, LEVEL, KNOWN)
    assert answer(found).position == pytest.approx(POSITION_CM, abs=3.0)
    assert {led for led, *_ in found.solved.spots} == {0, 1, 2, 3, 4}


@pytest.mark.slow
def test_steady_lamps_need_spots_by_hand(folder: Path) -> None:
    picture = write_picture(folder / "steady.png", photograph(steady=True))
    table = read_led_table(folder / "right.csv", "cm")
    unknown = Options(exposure_s=EXPOSURE_S, focal_px=FOCAL_PX)
    with pytest.raises(InputError, match="--line-rate, or --spots"):
        locate(picture, table, None, LEVEL, unknown)
    rough = pixels_of(np.array(list(LAMPS_CM.values())), 0.5) + 5
    spots = tuple((k, float(u), float(v)) for k, (u, v) in enumerate(rough))
    found = locate(picture, table, None, LEVEL, Options(**{**vars(unknown), "spots": spots}))
    assert answer(found).position == pytest.approx(POSITION_CM, abs=3.0)
    assert not found.frame.camera.shutter.rolls


@pytest.mark.slow
def test_without_gravity_the_fits_that_need_it_say_so(folder: Path) -> None:
    found = locate(folder / "bell.jpg", read_led_table(folder / "left.csv", "cm"), None, attitude(), KNOWN)
    assert answer(found, "pnp").position is not None
    if (failed := answer(found, "up2p")).position is None:
        assert failed.failure in (
            "leveling: the device has no accelerometer",
            "up2p: PoseLib is not installed (pip install vlcrender[poselib])",
        )


def test_a_saved_dataset_is_read_and_estimated_as_any_other(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["photo", str(folder / "bell.jpg"), "--leds", str(folder / "left.csv"), "--units", "cm"]
    arguments += ["--focal-px", str(FOCAL_PX), "--exposure", "60us", "--line-rate", str(LINE_RATE_HZ), "--level", "1"]
    arguments += ["--truth", "-4,-7,10", "--overlay", str(tmp_path / "seen.png"), "--save", str(tmp_path / "set")]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "left-handed: x is reversed" in said
    assert "gravity-fit" in said
    drawn = cv2.imread(str(tmp_path / "seen.png"))
    assert drawn is not None
    assert (drawn[:, :, 1].astype(int) - drawn[:, :, 0] > 50).any()
    description = json.loads((tmp_path / "set" / "dataset.json").read_text())
    assert description["accelerometer"]["error_deg"] == 1
    assert (description["room_m"], description["sensor"]["full_well_e"], description["led_map"][0]["radius_m"]) == (
        None,
    ) * 3
    dataset = est.read_dataset(tmp_path / "set")
    frame = est.read_frame(dataset, 0)
    x, y, z = POSITION_CM
    # The saved map is right-handed, in metres: the world of the photograph as it was made.
    assert 100 * est.estimate(frame, "gravity-fit").position_m == pytest.approx([x, y, z], abs=3.0)
    with pytest.raises(EstimationFailure, match="states no gain"):
        est.estimate(frame, "ml")
    assert main(arguments) == 2
    assert "is there already" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("bell", [True, False])
def test_a_lamp_that_the_border_cuts_is_used_by_its_visible_part(folder: Path, tmp_path: Path, bell: bool) -> None:
    """The uppermost lamp's centre is 24 px below the border, of a radius of 34 px."""
    places = {hz: (x, y * (1.09 if y < 0 else 1.0)) for hz, (x, y) in LAMPS_CM.items()}
    v_px = pixels_of(np.array(list(places.values())), 0.5)[:, 1]
    shift_cm = (v_px.min() - 24.0) / FOCAL_PX * (HEIGHT_CM - POSITION_CM[2])
    position_cm = (POSITION_CM[0], POSITION_CM[1] + shift_cm, POSITION_CM[2])
    write_picture(tmp_path / "cut.png", photograph(places, bell=bell, position_cm=position_cm))
    table = read_led_table(write_map(tmp_path / "map.csv", places), "cm")
    found = locate(tmp_path / "cut.png", table, None, LEVEL, KNOWN)
    cut = [one for one in found.lamps if one.lamp.touches_border]
    assert len(cut) >= 1
    assert len(found.solved.spots) == 5
    rows = lamp_rows(found, table)
    assert [row[-1] for row in rows].count("cut by the border; centre by the visible part") == len(cut)
    error = answer(found).position - np.array(position_cm)
    assert error @ np.linalg.solve(answer(found).covariance, error) < chi2.isf(1e-3, 3)


@pytest.mark.slow
def test_a_faded_lamp_whose_lines_are_cut_is_left_out(folder: Path, tmp_path: Path) -> None:
    """The isophotes of a lamp with its centre 14 px beside the left border end at the border."""
    places = {hz: (x * (1.1 if hz == 3500 else 1.0), y) for hz, (x, y) in LAMPS_CM.items()}
    u_px = pixels_of(np.array(list(places.values())), 0.5)[:, 0].min()
    shift_cm = (u_px - 14.0) / FOCAL_PX * (HEIGHT_CM - POSITION_CM[2])
    position_cm = (POSITION_CM[0] + shift_cm, *POSITION_CM[1:])
    write_picture(tmp_path / "cut.png", photograph(places, position_cm=position_cm))
    table = read_led_table(write_map(tmp_path / "map.csv", places), "cm")
    found = locate(tmp_path / "cut.png", table, None, LEVEL, KNOWN)
    assert len(found.solved.spots) == 4
    assert [row[-1] for row in lamp_rows(found, table)].count("cut by the border too much, left out") == 1


def test_ml_says_why_it_does_not_answer(located: Located) -> None:
    assert answer(located, "ml").failure == (
        "fit: the sensor states no gain, so that the noise of its pixels is not known"
    )


@pytest.mark.slow
def test_a_picture_without_a_position_does_not_stop_the_others(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dark = write_picture(tmp_path / "dark.png", np.zeros(SIZE_PX[::-1], np.uint8))
    arguments = ["photo", str(dark), str(folder / "bell.jpg"), "--leds", str(folder / "left.csv"), "--units", "cm"]
    arguments += ["--focal-px", str(FOCAL_PX), "--exposure", "60us", "--line-rate", str(LINE_RATE_HZ)]
    arguments += ["--readout", "rows", "--overlay", str(tmp_path)]
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert "bell.jpg: positions" in captured.out
    assert "dark.png: identify: no lamp sends a tone of the map (lamps: none found)" in captured.err
    assert captured.err.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "seconds"), [("6e-5", 6e-5), ("1/8000", 1.25e-4), ("60us", 6e-5), ("0.06 ms", 6e-5), ("2s", 2.0)]
)
def test_exposures_may_be_written_in_several_ways(text: str, seconds: float) -> None:
    assert exposure_s(text) == pytest.approx(seconds)


@pytest.mark.parametrize("text", ["", "fast", "0", "-1", "1/0", "1e9", "nan", "60 m"])
def test_other_exposures_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="needed a time such as"):
        exposure_s(text)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"gravity": "0,0,1", "level_deg": 1.0}, "--gravity and --level: give one"),
        ({"gravity": "0,0,0"}, "has no direction"),
        ({"gravity": "1,2"}, "needed 3 numbers"),
        ({"tilt": "1;2"}, "needed 2 numbers"),
        ({"level_deg": 0.0}, "needed a standard deviation"),
        ({"level_deg": 1.0, "sigma_deg": 2.0}, "--attitude-sigma: needs --gravity or --tilt"),
    ],
)
def test_statements_of_attitude_that_are_none_are_refused(given: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        attitude(**given)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_given_tilt_is_the_format_s(folder: Path) -> None:
    """Raising tilt_x moves the image of an LED overhead to +v (datasets/FORMAT.md)."""
    reading = attitude(tilt="10,0").accelerometer_m_s2
    assert reading == pytest.approx((0.0, 9.80665 * np.sin(np.radians(10)), 9.80665 * np.cos(np.radians(10))))
    held = attitude(tilt="0.5,0", sigma_deg=0.05)
    found = locate(folder / "bell.jpg", read_led_table(folder / "left.csv", "cm"), None, held, KNOWN)
    x, y, z = POSITION_CM
    # With the true tilt what is left is centroids of 2 px: 0.3 cm.
    assert answer(found).position == pytest.approx([-x, y, z], abs=1.0)
