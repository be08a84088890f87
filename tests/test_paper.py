"""The reproduction of the paper: its recipes, and the page's numbers against the errors of the frames that are kept."""

import csv
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from conftest import ROOT

import vlcrender as vr

PAPER = ROOT / "docs" / "paper"
RECIPES = sorted(PAPER.glob("*.toml"))
METHOD = "huynh2016:spot=brightest"


@pytest.fixture(scope="module")
def page() -> Iterator[ModuleType]:
    """docs/paper_page.py, which finds the modules beside it."""
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        import paper_page

        yield paper_page
    finally:
        sys.path.remove(str(ROOT / "docs"))


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.stem)
def test_recipes_plan_in_both_sizes(path: Path, page: ModuleType) -> None:
    """Each recipe is of one item; its cells have poses with three seeds, and `--full` makes more frames of it."""
    (one,) = (one for item in page.ITEMS.values() for one in item.sets if one.name == path.stem)
    plan = vr.load_recipe(path)
    seeds = {plan.cells.plan(number).recipe.seed for number in range(len(plan.cells))}
    assert seeds == {1, 2, 3}
    assert plan.recipe.name == path.stem
    full = vr.load_recipe(path, one.full)
    assert len(full.cells) == len(plan.cells)
    assert full.recipe.frame_count > plan.recipe.frame_count or not one.full


def kept(item: str, view: str) -> list[dict[str, object]]:
    """Rows of a kept table."""
    views = json.loads((PAPER / f"{item}.json").read_text())["views"]
    (found,) = (one for one in views if one["name"] == view)
    rows: list[dict[str, object]] = found["rows"]
    return rows


def errors_m(name: str, variant: str, **where: str) -> list[float]:
    """Errors of a variant in the kept scores of a set, of the frames it answered, in metres."""
    with (PAPER / "scores" / f"{name}.csv").open(newline="") as file:
        return [
            float(row[variant])
            for row in csv.DictReader(file)
            if row[variant] and all(row[key] == value for key, value in where.items())
        ]


@pytest.mark.parametrize(
    ("item", "view", "name", "variant", "x", "where"),
    [
        ("table2", "tilted", "table2", "huynh2016", [2.0], {"tilt": "[40.0, 40.0]", "error_deg": "2"}),
        ("table2", "level", "table2", METHOD, [0.0], {"tilt": "[0.0, 0.0]", "error_deg": "0"}),
        ("table1", "errors", "table1", METHOD, ["table1"], {}),
    ],
)
def test_numbers_of_the_page_follow_from_the_kept_scores(
    item: str, view: str, name: str, variant: str, x: list[float | str], where: dict[str, str], page: ModuleType
) -> None:
    """A mean by hand from the frames' errors is the kept table's, and stands in the page as text.

    Errors are kept to six digits: each is off by 5e-6 of its size at most, and so is their mean; the table's own
    rounding adds as much.
    """
    found = np.array(errors_m(name, variant, **where))
    (row,) = (one for one in kept(item, view) if one["x"] == x and one["group"] == variant)
    value = row["mean"][0]  # type: ignore[index]
    assert len(found) == row["answered"] > 0
    assert abs(found.mean() - value) <= 1e-5 * value
    text = (ROOT / "docs" / "paper.md").read_text()
    assert f"{page.value_text('_m', float(found.mean()))} (" in text


def test_the_pages_are_those_of_what_is_kept(page: ModuleType) -> None:
    """docs/paper.md and paper.html follow from docs/paper/ alone."""
    for name, text in page.pages().items():
        assert (ROOT / "docs" / name).read_text(encoding="utf-8") == text, f"{name}: run make_paper.py --pages"


def test_kept_tables_are_of_the_recipes_as_they_are() -> None:
    """A recipe that changed after its set was measured is noticed."""
    import hashlib

    for path in PAPER.rglob("*.json"):
        for one in json.loads(path.read_text())["sets"]:
            recipe = (PAPER / f"{one['name']}.toml").read_bytes()
            assert one["recipe"] == hashlib.sha256(recipe).hexdigest(), one["name"]


def test_verdicts_by_thresholds(page: ModuleType) -> None:
    """At most and at least, at the thresholds themselves and beyond."""
    most = page.Claim("x", "", "", 1, "", 1.5, 3)
    least = page.Claim("x", "", "", 1, "", 2, 1.2, True)
    assert [most.verdict(ratio) for ratio in (1.5, 3, 3.1, float("nan"))] == [
        "holds",
        "in part",
        "does not hold",
        "no answer",
    ]
    assert [least.verdict(ratio) for ratio in (2, 1.2, 1.1)] == ["holds", "in part", "does not hold"]
