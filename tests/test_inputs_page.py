"""docs/inputs.md: its files make the set that it says."""

import re
from pathlib import Path

import pytest
from conftest import ROOT

from vlcrender.dataset.recipe.plan import load_plan


def test_the_files_of_the_page_are_a_recipe(tmp_path: Path) -> None:
    page = (ROOT / "docs/inputs.md").read_text(encoding="utf-8")
    blocks = re.findall(r"(?s)```\n# (\S+)\n(.*?)```", page)
    assert [name for name, _ in blocks] == ["recipe.toml", "camera.yaml", "scene.toml", "leds.csv", "trajectory.tum"]
    for name, text in blocks:
        (tmp_path / name).write_text(text)
    plan = load_plan(tmp_path / "recipe.toml")
    assert plan.recipe.camera.focal_xy_px == pytest.approx((1000, 1001))
    assert plan.recipe.camera.center_px == (640, 480)
    assert plan.scene.leds.ids.tolist() == [1, 2, 3, 4, 5]
    assert plan.scene.leds.fluxes_lm == pytest.approx([300, 300, 300, 280, 300])
    assert [pose.time_s for pose in plan.recipe.poses.pose] == [1700000000.25, 1700000000.75]
