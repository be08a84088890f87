"""Plans of rolling shutters: what is refused, warned of and metered."""

from pathlib import Path

import pytest
from conftest import ROOT, SMALL
from test_rolling_shutter import MOTION, ROLLING, plan_of, scene_file

import vlcrender as vr
from vlcrender.dataset.recipe.light_checks import light_warnings
from vlcrender.dataset.recipe.plan import Plan
from vlcrender.errors import InputError

REFUSED = {
    "overlapping frames": (["burst={frames=2,frame_rate_hz=40.0}"], r"burst.frame_rate_hz = 40: a frame takes 29.9"),
    "overscan": (['regions={kind="leds",overscan=true}'], r"overscan = true: camera 'main' has a rolling shutter"),
    "map without pixels": (
        ['map="sent"'],
        r'map = "sent": the map comes out of the light; set demodulation = "pixels"',
    ),
    "map from codes": (['map="sent"', 'demodulation="pixels"'], r'map = "sent": LEDs of scene .* send "code"'),
    "bound in motion": (["bound=true", MOTION], r"bound = true: needs a camera at rest; remove \[motion\]"),
    "bound with glare": (
        ["bound=true", "camera.glare={share=0.1,radius_um=600.0}"],
        r"bound = true: is not computed for a lens with glare where light is modulated",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_a_rolling_shutter_cannot_do_is_refused(tmp_path: Path, name: str) -> None:
    assignments, message = REFUSED[name]
    shutter = 'camera.shutter={kind="rolling",row_time_us=100.0}'
    with pytest.raises(InputError, match=message):
        plan_of(tmp_path, shutter, *assignments)


def test_pixels_need_light_that_tells_its_led(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r'demodulation = "pixels": no LED of scene .* transmits what identifies it'):
        plan_of(tmp_path, 'demodulation="pixels"', downlink='send = "pwm"')


def test_a_scale_keeps_the_readout_and_is_refused_where_stripes_would_vanish(tmp_path: Path) -> None:
    """Chips of 250 us: two binned lines of 100 us are shorter, four are longer."""
    small = plan_of(tmp_path, *ROLLING, scale=2).recipe.camera
    assert small.shutter.row_time_s == pytest.approx(200e-6)
    assert small.line_starts_s().max() == pytest.approx(149 * 200e-6)
    with pytest.raises(InputError, match=r"--scale 4: a binned line takes 400 us, and the shortest level .* 250 us"):
        plan_of(tmp_path, *ROLLING, scale=4)
    assert plan_of(tmp_path, *ROLLING, downlink='send = "steady"', scale=4).recipe.camera.height_px == 75


def warnings_of(plan: Plan) -> list[str]:
    return list(light_warnings(plan.recipe, plan.scene))


def test_lit_levels_that_saturate_and_bursts_in_step_are_warned_of(tmp_path: Path) -> None:
    """The brightest LED gives 3 309 electrons in the small camera's frame: lit 6 618 of 4 095; 8 ms are a code."""
    (warning,) = warnings_of(plan_of(tmp_path, *ROLLING))
    assert "when lit, gives a pixel 66" in warning
    assert "4095 saturate it" in warning
    assert warnings_of(plan_of(tmp_path, *ROLLING, "exposure_s=0.9e-6")) == []
    dark = ("exposure_s=0.9e-6", "burst={frames=2,frame_rate_hz=25.0}")
    (warning,) = warnings_of(plan_of(tmp_path, *ROLLING, *dark))
    assert "a frame takes 5.000 periods of 8 ms" in warning
    assert warnings_of(plan_of(tmp_path, *ROLLING, "exposure_s=0.9e-6", "burst={frames=2,frame_rate_hz=27.0}")) == []


def test_peak_metering_counts_the_mean(tmp_path: Path) -> None:
    path = scene_file(tmp_path)
    for share, count in ((0.6, 1), (0.45, 0)):
        metering = f'exposure={{kind="peak",share_of_saturation={share},max_s=1e-3}}'
        changes = [c for c in SMALL if "exposure" not in c] + [f"scene={path}", metering, "poses.min_leds=2"]
        plan = vr.load_recipe(ROOT / "datasets/quickstart.toml", changes)
        assert len(warnings_of(plan)) == count
