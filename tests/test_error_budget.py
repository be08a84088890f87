"""The error budget of a recipe: rows, totals, the command line and the chart."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, SMALL, run
from matplotlib.figure import Figure

import vlcrender as vr
from vlcrender.dataset.world.budget_plot import draw_budget
from vlcrender.dataset.world.error_budget import _both, _parts

RECIPE = str(ROOT / "datasets/quickstart.toml")
OVERRIDES = [*SMALL, "poses.count=3", "belief.preset=calibrated"]
ARGUMENTS = [part for assignment in OVERRIDES for part in ("--set", assignment)]


def budget_of(*assignments: str, bound: bool = False, poses: int = 3) -> vr.ErrorBudget:
    return vr.budget(RECIPE, overrides=[*SMALL, "poses.count=3", *assignments], poses=poses, bound=bound)


@pytest.fixture(scope="module")
def calibrated() -> vr.ErrorBudget:
    return budget_of("belief.preset=calibrated", bound=True)


def test_rows_are_the_unknowns_in_order_of_size_and_add_up(calibrated: vr.ErrorBudget) -> None:
    sizes = [row.share.total_mm for row in calibrated.rows]
    assert sizes == sorted(sizes, reverse=True)
    for total, rows in (
        (calibrated.total, [row.share for row in calibrated.rows]),
        (calibrated.trusting_total, [row.trusting for row in calibrated.rows]),
    ):
        assert total.horizontal_mm == pytest.approx(np.hypot.reduce([row.horizontal_mm for row in rows]), rel=1e-9)
        assert total.vertical_mm == pytest.approx(np.hypot.reduce([row.vertical_mm for row in rows]), rel=1e-9)
    assert calibrated.poses == 3
    assert calibrated.trusting_total.total_mm > calibrated.total.total_mm
    assert [row.key for row in calibrated.rows if row.exact_mm is None] == ["noise"]
    # Without an unknown, at least its own contribution goes: for the same weights that alone would.
    for row in calibrated.rows:
        without_mm2 = calibrated.total.total_mm**2 - row.share.total_mm**2
        assert row.exact_mm is None or row.exact_mm**2 <= without_mm2 * (1 + 1e-9)
    keys = {row.key for row in calibrated.rows}
    assert {"focal_device", "focal_shot", "luminaire_xy", "led_gradient", "accelerometer_device", "noise"} <= keys
    assert not {"datum", "scale", "mounting"} & keys  # of sigma 0, or of other cameras


def test_the_bound_is_below_the_total_and_near_it(calibrated: vr.ErrorBudget) -> None:
    """Pixels tell more than spots: gradients, here 5 % of the face, and LEDs that the image's border cuts."""
    assert calibrated.bound is not None
    assert 0.8 * calibrated.total.total_mm < calibrated.bound.total_mm < calibrated.total.total_mm


def test_distortion_is_told_by_its_size_at_the_corner() -> None:
    """1.2 um at the corner, and 0.36 um of decentering, are 0.1 px and 0.03 px of 12 um."""
    rows = {row.key: row for row in budget_of("belief.camera={radial_corner_um=1.2,decentering_corner_um=0.36}").rows}
    assert rows["radial"].sigma == "0.1 px at the corner"
    assert rows["decentering"].sigma == "0.03 px at the corner"


def test_device_and_shot_share_an_unknown_by_their_variances(calibrated: vr.ErrorBudget) -> None:
    """Focal length 0.1 % by device, 0.03 % by shot; accelerometer 0.3 and 0.05 deg."""
    rows = {row.key: row for row in calibrated.rows}
    for name, ratio in (("focal", 0.1 / 0.03), ("accelerometer", 0.3 / 0.05), ("principal_point", 6.0 / 3.6)):
        device, shot = rows[f"{name}_device"].share, rows[f"{name}_shot"].share
        assert device.total_mm / shot.total_mm == pytest.approx(ratio, rel=1e-9)


@pytest.mark.parametrize("belief", [["belief.preset=calibrated"], []])
def test_the_parts_of_an_effect_are_the_whole_of_it(belief: list[str]) -> None:
    """Rows share the variance of an effect, between device and shot if both have an error; noise is one row."""
    recipe = vr.load_recipe(RECIPE, [*SMALL, *belief]).recipe
    shares: dict[str, float] = {}
    for part in _parts(recipe, recipe.cameras[0]):
        shares[part.effect] = shares.get(part.effect, 0.0) + part.share
    assert {"noise", "accelerometer"} <= shares.keys()
    assert list(shares.values()) == pytest.approx([1.0] * len(shares), rel=1e-12)


def test_an_estimator_that_trusts_lens_and_map_is_right_where_they_are_exact() -> None:
    """The accelerometer alone errs, and its error is stated to both estimators: they are the same."""
    of_tilts = budget_of("belief.accelerometer={device_error_deg=0.3}")
    assert {row.key for row in of_tilts.rows} == {"accelerometer_device", "noise"}
    for row in of_tilts.rows:
        assert row.trusting.total_mm == pytest.approx(row.share.total_mm, rel=1e-9)


def test_bars_and_labels_of_the_chart_do_not_overlap(
    calibrated: vr.ErrorBudget, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Labels of 10 points, 1.2 of these apart; title, axis and margins take 1.8 inches beside."""
    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    draw_budget(calibrated, tmp_path / "chart.svg")
    spans = sorted((bar.get_y(), bar.get_y() + bar.get_height()) for bar in drawn[0].axes[0].patches)
    assert len(spans) == 2 * len(calibrated.rows)
    for (_, end), (start, _) in pairwise(spans):
        assert start > end - 1e-9
    assert drawn[0].get_figheight() - 1.8 > len(calibrated.rows) * 1.2 * 10 / 72


@pytest.mark.slow
def test_datum_adds_its_own_size() -> None:
    """1, 2 and 2 mm: 2.236 mm horizontally, 2 mm vertically, whatever the weights."""
    rows = {row.key: row for row in budget_of("belief.datum.position_mm=[1.0, 2.0, 2.0]").rows}
    for share in (rows["datum"].share, rows["datum"].trusting):
        assert share.horizontal_mm == pytest.approx(np.sqrt(5), rel=1e-6)
        assert share.vertical_mm == pytest.approx(2.0, rel=1e-6)
    assert rows["datum"].sigma == "1, 2, 2 mm"


@pytest.mark.slow
def test_without_a_belief_noise_and_accelerometer_remain() -> None:
    exact = budget_of(bound=True)
    assert [row.key for row in exact.rows] in (["noise", "accelerometer"], ["accelerometer", "noise"])
    assert exact.bound is not None
    # A disc's shape tells something too, which spots do not show.
    assert exact.bound.total_mm < exact.total.total_mm < 3 * exact.bound.total_mm


@pytest.mark.slow
def test_half_the_sigmas_halve_the_error_where_noise_is_small() -> None:
    """All sigmas halved. Noise, 0.2 of 38 mm, stays: the ratio falls by 3/2 (0.2 / 38)^2 = 4e-5 of itself."""
    table = "belief.leds.position_mm=[{0}, {0}, {0}]"
    accelerometer = "belief.accelerometer={{device_error_deg={0}}}"
    whole, half = (budget_of(table.format(size), accelerometer.format(size)).total.total_mm for size in (1.0, 0.5))
    assert whole / half == pytest.approx(2.0, rel=1e-4)


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("motion={angular_velocity_deg_s=[1.0,0.0,0.0]}", "remove [motion]"),
        ("sensor.noise=none", "sensor.noise must not be"),
    ],
)
def test_recipes_without_a_budget_are_refused(assignment: str, message: str) -> None:
    with pytest.raises(vr.InputError) as error:
        budget_of(assignment)
    assert message in str(error.value)


def test_camera_and_poses_are_checked() -> None:
    with pytest.raises(vr.InputError, match="camera 'left': is not on the rig; cameras: main"):
        vr.budget(RECIPE, overrides=OVERRIDES, camera="left")
    with pytest.raises(vr.InputError, match="poses = 0"):
        budget_of(poses=0)


def test_a_camera_beside_main_has_the_mounting_among_its_unknowns() -> None:
    plan = vr.load_recipe(
        ROOT / "datasets/stereo.toml",
        ["poses.count=2", "belief.preset=calibrated", "camera.width_px=400", "camera.height_px=300"]
        + ["camera.pixel_pitch_um=12.0", "poses.border_px=4.0"],
    )
    name = plan.recipe.cameras[1].name
    rows = {row.key for row in vr.budget(plan, poses=2, camera=name, bound=False).rows}
    assert "mounting" in rows
    assert "mounting" not in {row.key for row in vr.budget(plan, poses=2, bound=False).rows}


def test_command_prints_a_table_json_and_a_chart(tmp_path: Path) -> None:
    chart = tmp_path / "budget.svg"
    found = run("vlcrender", "budget", RECIPE, *ARGUMENTS, "--poses", "2", "--no-bound", "--plot", str(chart))
    assert found.returncode == 0, found.stderr
    for text in (
        "luminaires, yaw",
        "focal length, each shot",
        "0.03 %",
        "pixel noise",
        "trusting",
        f"{chart}: written",
    ):
        assert text in found.stdout
    assert "bound" not in found.stdout
    assert "<svg" in chart.read_text(encoding="utf-8")
    as_json = run("vlcrender", "budget", RECIPE, *ARGUMENTS, "--poses", "2", "--no-bound", "--json")
    tree = json.loads(as_json.stdout)
    assert tree["poses"] == 2
    assert tree["bound"] is None
    assert tree["rows"][0]["total_mm"] >= tree["rows"][-1]["total_mm"]
    squares = sum(row["horizontal_mm"] ** 2 for row in tree["rows"])
    assert tree["total"]["horizontal_mm"] == pytest.approx(np.sqrt(squares))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--plot", "budget.txt"], "--plot budget.txt: has to end in .png, .svg or .pdf"),
        (["--plot", "nowhere/budget.png"], "--plot nowhere/budget.png: there is no folder nowhere"),
        (["--set", "belief.preset=perfect"], 'preset = "perfect": unknown'),
    ],
)
def test_command_refuses_in_one_line(arguments: list[str], message: str) -> None:
    found = run("vlcrender", "budget", RECIPE, *arguments)
    assert found.returncode == 2
    assert message in found.stderr
    assert len(found.stderr.strip().splitlines()) == 1


def test_two_lengths_are_written_once_where_they_agree() -> None:
    assert (_both("3", "3"), _both("3", "5")) == ("3 mm", "3, 5 mm")
