"""Automatic exposure: the noise-free image and the frames on disk reach the target."""

from pathlib import Path

import numpy as np
import OpenEXR
import pyarrow.parquet as pq
import pytest
from conftest import ROOT, SMALL
from pydantic import TypeAdapter

from vlcrender.camera.roi import Roi
from vlcrender.dataset.recipe.auto_exposure import Metering, NoiseLevelMetering, PeakMetering
from vlcrender.dataset.recipe.plan import load_plan
from vlcrender.dataset.run.generate import generate
from vlcrender.dataset.verify.verify import verify
from vlcrender.rendering.expected_image import ExpectedImage, ExpectedRegion, LedPatch


def view_of(background: float, led: float) -> ExpectedImage:
    """A part with an LED of 2 x 2 pixels, one of them dark, and one without; the brightest pixel is beside the LED."""
    image = np.full((6, 8), background, dtype=np.float32)
    image[5, 7] = 50 * background
    light = np.full((2, 2), led, dtype=np.float32)
    light[1, 1] = 0
    patch = LedPatch(3, (3.0, 3.0), 2, 2, light, 1.0, 1.0)
    beside = ExpectedRegion(Roi(10, 0, 1, 1), np.full((1, 1), background, dtype=np.float32), ())
    return ExpectedImage((ExpectedRegion(Roi(0, 0, 6, 8), image, (patch,)), beside))


def test_the_peak_holds_the_share() -> None:
    metering = PeakMetering(kind="peak", share_of_saturation=0.7, max_s=10.0)
    view = view_of(100.0, 900.0)  # 5000 e/s in the last pixel
    assert metering.time_s(view, 6000.0) == pytest.approx(4200 / 5000)
    assert metering.time_s(view_of(1.0, 0.0), 6000.0) == 10.0, "84 s would be too long"
    assert metering.time_s(view_of(0.0, 0.0), 6000.0) == 10.0, "nothing to meter"


def test_the_noise_level_is_that_of_the_brightest_led_pixel() -> None:
    view = view_of(100.0, 900.0)
    for level_db, electrons in ((0.0, 1.0), (-9.0, 10**0.9), (-30.0, 1000.0)):
        metering = NoiseLevelMetering(kind="noise-level", level_db=level_db)
        assert metering.time_s(view, 1.0) == pytest.approx(electrons / 1000)
    assert NoiseLevelMetering(kind="noise-level", level_db=0.0).time_s(view_of(5.0, 0.0), 1.0) == 1.0


METERED = {
    "peak": ["exposure.kind=peak", "exposure.share_of_saturation=0.6", "exposure.max_s=1.0"],
    "noise-level": ["exposure.kind=noise-level", "exposure.level_db=-9"],
}


@pytest.mark.parametrize("kind", METERED)
def test_frames_are_exposed_for_the_target(kind: str, tmp_path: Path) -> None:
    assigned = [a for a in SMALL if not a.startswith("exposure_s")]
    plan = load_plan(ROOT / "datasets/quickstart.toml", [*assigned, "poses.count=2", "expected=true", *METERED[kind]])
    generate(plan, tmp_path / "set")
    assert verify(tmp_path / "set") == []
    rows = pq.read_table(tmp_path / "set/frames.parquet").to_pylist()
    times = [row["exposure_s"] for row in rows]
    assert times[0] != times[1], "each frame has its own"
    for row in rows:
        with OpenEXR.File(str(tmp_path / "set" / row["file"])) as file:
            assert file.header()["expTime"] == pytest.approx(row["exposure_s"], rel=1e-7)
        path = tmp_path / f"set/expected/{row['frame']:06d}.exr"
        with OpenEXR.File(str(path), separate_channels=True) as file:
            peak = float(file.channels()["Y"].pixels.max())
        # The LEDs are brightest here; float32. The ADC saturates at 4095 DN of 1 e, before the well of 6000 e.
        assert peak == pytest.approx({"peak": 0.6 * 4095, "noise-level": 10**0.9}[kind], rel=1e-6)


def test_a_recipe_in_json_gives_the_same_metering() -> None:
    metering = NoiseLevelMetering(kind="noise-level", level_db=-3.0)
    assert TypeAdapter(Metering).validate_json(metering.model_dump_json()) == metering
