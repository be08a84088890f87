"""What files state for pages: looks, needs, spots, ratios to the bound, names of presets; and a page of a set."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from browsing import OVERFLOWING, console, open_browser, page_streams, printed, show
from conftest import ROOT, run
from test_estimator_score import LEDS_M, TRUTH, ok, truths

import vlcrender as vr
from estimator.evaluate.entry import entry_of, lacking
from estimator.evaluate.frames import bound_quantiles_m
from estimator.evaluate.score import score_variant
from estimator.evaluate.scores_file import read_or_score
from estimator.io.dataset import read_dataset
from estimator.io.estimates import read_estimates
from estimator.methods.catalogue import OWN
from estimator.methods.looks import MARKS, OWN_LOOKS, look_of
from estimator.methods.variant import Needs
from vlcrender.report.page import page


def test_each_variant_has_a_look_of_its_own() -> None:
    assert set(OWN_LOOKS) == set(OWN)
    assert len({look.model_dump_json() for look in OWN_LOOKS.values()}) == len(OWN)


def test_options_keep_the_family_and_names_fix_the_mark() -> None:
    one = look_of("huynh2016:denoise=none")
    assert (one.family, one.hollow) == ("paper", True)
    assert one == look_of("huynh2016:denoise=none")
    other = look_of("my-variant")
    assert (other.family, other.hollow) == ("other", True)
    assert other.mark in MARKS
    stated = look_of("my-variant", "gravity", "star")
    assert (stated.family, stated.mark, stated.hollow) == ("gravity", "star", False)


def test_what_a_set_lacks_is_said(synthetic_set: Path) -> None:
    """One camera with a normal lens, an accelerometer, discs."""
    dataset = read_dataset(synthetic_set)
    assert lacking(Needs(leds=3), dataset) is None
    assert lacking(Needs(leds=3, sensors=("accelerometer",)), dataset) is None
    assert lacking(Needs(leds=3, sensors=("second camera",)), dataset) == "needs two cameras"
    assert lacking(Needs(leds=3, sensors=("fish-eye lens",)), dataset) == "needs a fish-eye lens"
    assert lacking(Needs(leds=3, faces="square"), dataset) == "needs LEDs with square faces"
    assert entry_of("kim", dataset).inapplicable == "needs two cameras"
    assert entry_of("no such variant").summary == ""


def test_estimates_state_the_spots_and_scores_their_number(scored_set: Path) -> None:
    dataset = read_dataset(scored_set)
    scores = read_or_score(scored_set)
    rows = read_estimates(scored_set / "estimates/pnp.parquet", len(dataset.frames))
    (one,) = [variant for variant in scores.variants if variant.variant == "pnp"]
    for row, frame, record in zip(rows, one.rows, dataset.frames, strict=True):
        assert row.spots is not None
        decoded = {spot.led: (spot.u_px, spot.v_px) for spot in record.spots}
        assert {spot.led for spot in row.spots} <= set(decoded)
        assert frame.spots_found == len(row.spots) > 3
        assert frame.snr == pytest.approx(np.median([spot.snr for spot in row.spots if spot.snr is not None]))
        # Shot noise of some 4000 electrons: about the root of these, and no more than of a full well of 60 000.
        assert frame.snr is not None
        assert 40 < frame.snr < 250
    assert round(one.rows[0].tilt_deg) == 0
    assert scores.made_by is not None


def test_the_ratio_to_the_bound_is_taken_frame_by_frame() -> None:
    """Bounds of 1 and 100 mm, errors twice and half of them: RMS sqrt(2.125); pooled squares would say 0.5."""
    x, y, z = TRUTH
    bounds_m2 = [(s * s / 3, 0.0, 0.0, 0.0, s * s / 3, 0.0, 0.0, 0.0, s * s / 3) for s in (1e-3, 0.1)]
    truth = [row.model_copy(update={"bound_m2": b}) for row, b in zip(truths(2), bounds_m2, strict=True)]
    one = score_variant("x", [ok(0, (x + 2e-3, y, z)), ok(1, (x + 0.05, y, z))], truth, LEDS_M)
    assert one.ratio_to_bound is not None
    assert one.ratio_to_bound.rms == pytest.approx(np.sqrt((4 + 0.25) / 2))
    assert one.ratio_to_bound.frames == 2


def test_quantiles_at_the_bound_are_those_of_chi() -> None:
    """Of equal variances s^2 the size is s times chi of 3: its median is 1.538, its 95 % 2.795.

    200 000 draws: the share below a quantile has a standard error of 0.11 %, which at the median, where the density of
    chi is 0.57, are 0.0020, and at 95 %, of density 0.13, 0.0037; four of them.
    """
    found = bound_quantiles_m(np.tile(1e-6 * np.eye(3), (3, 1, 1)))
    assert found is not None
    assert len(found) == 101
    assert found[50] == pytest.approx(1.538e-3, abs=0.008e-3)
    assert found[95] == pytest.approx(2.795e-3, abs=0.015e-3)
    assert bound_quantiles_m(np.empty((0, 3, 3))) is None


def test_the_plan_names_its_presets() -> None:
    plan = vr.load_recipe(ROOT / "datasets/office200.toml", ["belief.preset=calibrated"])
    assert dict(plan.presets) == {"sensor": "phone-1.2um", "belief": "calibrated"}
    plan = vr.load_recipe(ROOT / "datasets/quickstart.toml", ["camera.preset=phone-wide"])
    assert plan.presets["camera"] == "phone-wide"
    assert dict(vr.load_recipe(ROOT / "datasets/quickstart.toml").presets) == {}


def test_a_set_has_a_page_of_its_own(rendered_set: Path, tmp_path: Path) -> None:
    out = tmp_path / "set.html"
    finished = run("vlcrender", "report", str(rendered_set), "--out", str(out))
    assert finished.returncode == 0, finished.stderr
    html = out.read_text()
    assert html == page(rendered_set)
    tree = json.loads((rendered_set / "dataset.json").read_text())
    assert tree["names"] == {"camera": None, "sensor": None, "accelerometer": None, "belief": None}
    assert "<script" not in html
    assert "default-src &#39;none&#39;" in html
    assert not re.findall(r"""(?:src|href)="(?!data:)""", html)
    assert html.count("data:image/webp;base64,") == tree["frame_count"]
    for heading in ("Room", "Sensor", "What the device is told", "Digest of frames.parquet"):
        assert f"<dt>{heading}</dt>" in html
    assert "3 frames from 3 places in the scene office." in html


def test_a_folder_without_a_set_is_refused(tmp_path: Path) -> None:
    finished = run("vlcrender", "report", str(tmp_path))
    assert finished.returncode == 2
    assert "is not a complete dataset" in finished.stderr


@pytest.mark.parametrize(("width", "dark"), [(400, False), (1280, True), (1600, False)])
def test_the_page_of_a_set_is_silent_and_within_the_window(
    rendered_set: Path, tmp_path: Path, width: int, dark: bool
) -> None:
    path = tmp_path / "set.html"
    path.write_text(page(rendered_set))
    with open_browser() as browser:
        show(browser, path, width, dark)
        assert browser.execute_script(OVERFLOWING) == []
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width
        # Of A4: facts, plan and the first histograms; the other histograms and up to 24 previews.
        assert len(page_streams(printed(browser))) <= 2
        assert console(browser) == []
