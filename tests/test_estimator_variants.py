"""The pipelines from image to position, on images made apart from the renderer."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from estimator_synthetic import grid, view_of, write_dataset

from estimator.errors import EstimationFailure
from estimator.evaluate.batch import estimate_dataset, estimate_frame
from estimator.io.dataset import read_dataset, read_frame
from estimator.io.device import DeviceFrame
from estimator.io.estimates import EstimateRow
from estimator.methods.catalogue import OWN, PUBLISHED_SINCE, VARIANTS, variant_named
from estimator.methods.variant import Estimate, Variant
from estimator.spots.correspondences import centroids_px, find_correspondences
from estimator.spots.denoise import DENOISERS


@pytest.fixture(scope="module")
def noisy(synthetic_set: Path) -> Path:
    return synthetic_set


def estimate(folder: Path) -> dict[str, tuple[EstimateRow, ...]]:
    return estimate_dataset(read_dataset(folder), list(VARIANTS.values()), on_frame=lambda: None)


def errors_m(folder: Path, rows: tuple[EstimateRow, ...]) -> list[float]:
    truth = pq.read_table(folder / "truth.parquet", columns=["position_m"]).to_pylist()
    assert all(row.status == "ok" for row in rows), [row.reason for row in rows]
    return [
        float(np.linalg.norm(np.subtract(row.position_m, true["position_m"])))
        for row, true in zip(rows, truth, strict=True)
    ]


def test_without_noise_the_corrected_variants_err_by_the_ellipse_alone(exact_synthetic_set: Path) -> None:
    """A disc's image has its centroid off the image of its centre by some f (r / h)^2 tan(tilt) = 0.01 px here; digital
    numbers round at 1/4000 of the LED. One pixel is 2 mm on the ceiling, and 20 LEDs share the error.
    """
    rows = estimate(exact_synthetic_set)
    assert max(errors_m(exact_synthetic_set, rows["huynh2016"])) < 1e-3
    assert max(errors_m(exact_synthetic_set, rows["pnp"])) < 1e-3


@pytest.mark.slow
def test_a_full_frame_is_good_to_a_millimetre(tmp_path: Path) -> None:
    """4000 x 3000 pixels, f = 15000 px, shot noise: a disc of 50 px radius and 4000 e a pixel has its centroid to
    25 / sqrt(3e7) = 0.005 px, 1 um on the ceiling, which the distance of 3 m to a pattern of 0.6 m makes some 10 um.
    """
    view = view_of((3.5, 3.5, 3.5), 3.0, 0.0, 0.0, 20.0, size=(4000, 3000, 15000.0))
    folder = write_dataset(tmp_path, [view], grid(6, 4, 0.12, (3.5, 3.5, 3.5)))
    rows = estimate(folder)
    for name in ("huynh2016", "pnp"):
        assert max(errors_m(folder, rows[name])) < 2e-4
        # Fractions of this in fact: only that nothing is done pixel by pixel.
        assert rows[name][0].time_s < 5.0


@pytest.mark.slow
def test_a_full_frame_at_60_degrees_on_both_axes_has_the_ellipses_bias_alone(tmp_path: Path) -> None:
    """Noise-free, 75.5 deg off the vertical: the centroids' offsets from the images of the centres differ by 0.002 px
    from LED to LED. By simulation a pixel costs the two steps 1.8 m at this pose (12 m away, 0.36 x 0.6 m of LEDs), and
    PnP 0.02 m.
    """
    view = view_of((3.5, 3.5, 3.5), 3.0, 60.0, 60.0, size=(4000, 3000, 15000.0))
    folder = write_dataset(tmp_path, [view], grid(6, 4, 0.12, (3.5, 3.5, 3.5)), noise=False)
    rows = estimate(folder)
    assert max(errors_m(folder, rows["huynh2016"])) < 0.002 * 1.8
    assert max(errors_m(folder, rows["pnp"])) < 0.005 * 0.02


def test_with_noise_ranges_and_positions_agree_with_the_truth(noisy: Path) -> None:
    rows = estimate(noisy)
    # 0.02 px of 1500 px focal length, widened by the pattern's narrowness and the tilt: millimetres.
    assert max(errors_m(noisy, rows["huynh2016"])) < 0.02
    assert max(errors_m(noisy, rows["pnp"])) < 0.02
    leds = read_dataset(noisy).leds
    truth = pq.read_table(noisy / "truth.parquet").to_pylist()
    for row, true in zip(rows["huynh2016"], truth, strict=True):
        assert len(row.ranges) >= 10
        for found in row.ranges:
            distance = np.linalg.norm(np.subtract(leds[found.led].position_m, true["position_m"]))
            assert abs(found.range_m - distance) < 0.01


def chosen(folder: Path, name: str) -> tuple[EstimateRow, ...]:
    return estimate_dataset(read_dataset(folder), [variant_named(name)], on_frame=lambda: None)[name]


@pytest.mark.parametrize("name", ["huynh2016-as-printed", "huynh2016:ranges=printed"])
def test_ranges_by_the_printed_equation_3_are_wrong_by_metres(noisy: Path, name: str) -> None:
    """A failed frame keeps its ranges. As printed in all, the shifted LEDs give a position from any ranges at all."""
    truth = pq.read_table(noisy / "truth.parquet").to_pylist()
    leds = read_dataset(noisy).leds
    for row, true in zip(chosen(noisy, name), truth, strict=True):
        distances = [np.linalg.norm(np.subtract(leds[r.led].position_m, true["position_m"])) for r in row.ranges]
        wrong = np.abs(np.subtract([r.range_m for r in row.ranges], distances))
        assert np.median(wrong) > 0.5
        if name == "huynh2016:ranges=printed":
            assert row.reason == "position: the ranges are too short to reach the LEDs from below"
        elif row.position_m is not None:
            assert np.linalg.norm(np.subtract(row.position_m, true["position_m"])) > 0.5


@pytest.mark.parametrize(
    "choice", ["denoise=box", "denoise=none", "denoise=anscombe", "position=nonlinear", "denoise=none,spot=centroid"]
)
def test_sound_choices_are_as_good_as_the_default(noisy: Path, choice: str) -> None:
    """The default's bound: 0.02 px of 1500 px focal length, widened by the pattern's narrowness and the tilt."""
    name = f"huynh2016:{choice}"
    assert max(errors_m(noisy, chosen(noisy, name))) < 0.02
    assert [row.position_m for row in chosen(noisy, name)] != [row.position_m for row in chosen(noisy, "huynh2016")]


def test_the_brightest_pixel_errs_by_the_radius_of_the_led_image(noisy: Path) -> None:
    """An LED image is flat over 5 px of radius: noise picks the pixel, some 3 px away; a centroid errs by 0.02 px."""
    names = [f"huynh2016:denoise=none,spot={spot}" for spot in ("brightest", "centroid")]
    brightest, centroid = (np.median(errors_m(noisy, chosen(noisy, name))) for name in names)
    assert brightest > 20 * centroid


def test_shifted_leds_put_the_camera_at_the_ceiling(noisy: Path) -> None:
    """The camera is 3 m below the LEDs at 3.5 m. 1 mm of range error makes 3 m * 1 mm / 1 cm = 0.3 m of height."""
    for row in chosen(noisy, "huynh2016:position=z-shift"):
        assert row.position_m is not None
        assert row.position_m[2] > 2.5


def test_the_literal_algorithm_1_shifts_every_spot_up_and_left(noisy: Path) -> None:
    """Light shows where the pixel 5 px further right and down differs: around a place 2.5 px up and left of the LED.

    lambda_1 goes as (SSoID - mu)^2, where SSoID = (c - c_k)^2 / 120 = 130000 e for an LED of 4000 e and |mu| is at
    most 4000 e: mu weights one side of the LED by 2 * 4000 / 130000 = 6 % more, and 6 % of 2.5 px are 0.15 px.
    """
    dataset = read_dataset(noisy)
    truth = pq.read_table(noisy / "truth.parquet", columns=["leds"]).to_pylist()
    literal = DENOISERS["literal"]
    for record, true in zip(dataset.frames, truth, strict=True):
        seen = find_correspondences(read_frame(dataset, record), literal)
        exact = {led["led"]: (led["u_px"], led["v_px"]) for led in true["leds"]}
        off = centroids_px(seen) - [exact[correspondence.led.id] for correspondence in seen]
        assert len(off) > 10
        np.testing.assert_allclose(off, -2.5, atol=0.15 + 0.1)  # 0.1 px: four sigma of the noise in the edges


@pytest.mark.slow
def test_estimates_do_not_change_without_truth_and_provenance(noisy: Path, tmp_path: Path) -> None:
    blind = Path(shutil.copytree(noisy, tmp_path / "blind"))
    (blind / "truth.parquet").unlink()
    content = json.loads((blind / "dataset.json").read_text())
    del content["provenance"]
    (blind / "dataset.json").write_text(json.dumps(content))

    def answers(folder: Path) -> list[dict[str, object]]:
        return [row.model_dump(exclude={"time_s"}) for rows in estimate(folder).values() for row in rows]

    assert answers(blind) == answers(noisy)


@pytest.mark.slow
def test_pnp_does_not_use_gravity_and_the_paper_does(noisy: Path, tmp_path: Path) -> None:
    """Two degrees of tilt error cost the paper's method about 60 mm and more (errata to Table 2)."""
    folder = Path(shutil.copytree(noisy, tmp_path / "off"))
    table = pq.read_table(folder / "frames.parquet")
    rows = table.to_pylist()
    for row in rows:
        x, y, z = row["accelerometer_m_s2"]
        row["accelerometer_m_s2"] = [x, y + np.tan(np.radians(2)) * z, z]
    pq.write_table(table.from_pylist(rows, table.schema), folder / "frames.parquet")
    answers = estimate(folder)
    assert [row.position_m for row in answers["pnp"]] == [row.position_m for row in estimate(noisy)["pnp"]]
    assert min(errors_m(folder, answers["huynh2016"])) > 0.02


def test_an_unreadable_image_is_a_failed_frame_and_the_others_go_on(noisy: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(noisy, tmp_path / "holed"))
    (folder / "frames/000001.exr").unlink()
    for rows in estimate(folder).values():
        assert [row.frame for row in rows] == [0, 1, 2]
        assert rows[1].reason == "read: frames/000001.exr: No such file or directory"
        assert rows[0].reason != rows[1].reason != rows[2].reason


def first_frame(folder: Path) -> DeviceFrame:
    dataset = read_dataset(folder)
    return read_frame(dataset, dataset.frames[0])


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
def test_a_position_that_is_no_number_is_a_failure(noisy: Path, bad: float) -> None:
    broken = Variant("broken", "", lambda frame: Estimate(np.array([0.0, bad, 0.0])))
    row = estimate_frame(broken, first_frame(noisy), 0)
    assert (row.status, row.reason) == ("failed", "position: the result is not a finite number")


def test_failures_carry_their_stage(noisy: Path) -> None:
    def fail(frame: DeviceFrame) -> Estimate:
        raise EstimationFailure("stage", "what went wrong", {10: 3.5})

    row = estimate_frame(Variant("failing", "", fail), first_frame(noisy), 0)
    assert (row.status, row.reason, row.position_m) == ("failed", "stage: what went wrong", None)
    assert [(r.led, r.range_m) for r in row.ranges] == [(10, 3.5)]


def test_the_catalogue_keys_are_the_names() -> None:
    rivals = ["yoshino2008", "nakazawa2013", "rahman2011", "kim"]
    fits = ["pnp", "ippe", "sqpnp", "up2p", "gravity-fit", "ml", "self-calibrated"]
    assert list(VARIANTS) == ["huynh2016", "huynh2016-as-printed", *rivals, *fits]
    since = ["gopa", "eca-rssr", "r-p3p", "v-p4l", "v-pca", "circle-centre", "lc-vlp"]
    assert list(PUBLISHED_SINCE) == since
    assert list(OWN) == [*VARIANTS, *since]
    assert all(variant.name == name and "\n" not in variant.summary for name, variant in OWN.items())
