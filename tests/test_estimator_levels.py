"""Levels: datasets ordered by their bounds, their table, and the plot as a file."""

import re
import xml.etree.ElementTree as ET
from itertools import pairwise
from pathlib import Path

import pytest
from conftest import copy_of
from test_estimator_report import scored

from estimator.cli import main
from estimator.errors import InputError
from estimator.evaluate.levels import Level, level_cells, levels_of
from estimator.evaluate.score import Scores, VariantScore
from estimator.report.levels import level_picture

SVG = "{http://www.w3.org/2000/svg}"


def bound(size_m: float) -> tuple[float, ...]:
    """A bound whose trace has this root."""
    third = size_m**2 / 3
    return (third, 0.0, 0.0, 0.0, third, 0.0, 0.0, 0.0, third)


def level(name: str, *variants: VariantScore) -> tuple[Path, Scores]:
    return Path(name), Scores(dataset=name, room_m=(4.0, 5.0, 3.5), led_map=(), variants=variants)


HARD = level("hard", scored([0.08, 0.06], "a", bound(0.05)), scored([0.1, None], "b", bound(0.05)))
EASY = level("easy", scored([3e-3, 4e-3], "a", bound(2e-3)))


def test_levels_are_ordered_by_their_bounds() -> None:
    """RMSE of 3 and 4 mm: sqrt(12.5) mm. Variant b has no estimates at the easy level, and fails once at the hard."""
    found = levels_of([HARD, EASY])
    assert [(one.name, one.bound_rms_m) for one in found] == [
        ("easy", pytest.approx(2e-3)),
        ("hard", pytest.approx(0.05)),
    ]
    assert found[0].rmse_m("a") == pytest.approx(12.5**0.5 * 1e-3)
    assert found[0].rmse_m("b") is None
    headers, rows = level_cells(found)
    assert headers == ["variant", "easy (2 mm)", "hard (50 mm)"]
    assert rows == [["a", "3.54 mm", "70.7 mm"], ["b", "–", "100 mm, 1 failed"]]


def test_a_set_without_a_bound_is_refused() -> None:
    with pytest.raises(InputError, match=r"plain: no frame has a bound; generate the dataset with bound = true"):
        levels_of([HARD, level("plain", scored([0.1], "a"))])
    with pytest.raises(InputError, match="empty: no frame has a bound"):
        levels_of([level("empty")])


def place_of(mark: ET.Element) -> tuple[float, float]:
    x, y = re.findall(r"-?[\d.]+", mark.attrib["transform"])
    return float(x), float(y)


def marks(levels: list[Level]) -> dict[str, tuple[float, float]]:
    """Places of the marks by their titles."""
    root = ET.fromstring(level_picture(levels))
    return {
        (one.findtext(f"{SVG}title") or ""): place_of(one)
        for one in root.iter(f"{SVG}path")
        if one.find(f"{SVG}title") is not None
    }


def test_a_mark_is_where_bound_and_rmse_are() -> None:
    """On logarithmic axes: an RMSE of the bound is on the diagonal, ten times the bound a decade above it.

    To a tenth of a pixel, in which places are written.
    """
    on, above = scored([0.01], "on", bound(0.01)), scored([0.1], "above", bound(0.01))
    found = levels_of([level("x", on, above), level("y", scored([0.1], "on", bound(0.1)))])
    picture = level_picture(found)
    x1, y1, x2, y2 = (
        float(one)
        for one in re.findall(r'class="bound" x1="([\d.]+)" y1="([\d.]+)" x2="([\d.]+)" y2="([\d.]+)"', picture)[0]
    )
    places = marks(found)
    for title in ("on, x: 10 mm", "on, y: 100 mm"):
        x, y = places[title]
        assert y == pytest.approx(y1 + (x - x1) * (y2 - y1) / (x2 - x1), abs=0.15)
    assert places["above, x: 100 mm"][1] == pytest.approx(places["on, y: 100 mm"][1], abs=0.1)
    assert places["above, x: 100 mm"][0] == pytest.approx(places["on, x: 10 mm"][0], abs=0.1)


def test_the_picture_says_how_many_frames_failed() -> None:
    found = levels_of([HARD, EASY])
    assert "b, hard: 100 mm, 1 of 2 frames failed" in marks(found)
    words = [one.text for one in ET.fromstring(level_picture(found)).iter(f"{SVG}text")]
    assert "1 failed" in words
    assert {"a", "b", "easy", "hard"} <= set(words)


def test_counts_of_failed_frames_do_not_cover_each_other() -> None:
    """Of three variants with one error, at one bound."""
    variants = [scored([0.1, None], name, bound(0.01)) for name in ("a", "b", "c")]
    root = ET.fromstring(level_picture(levels_of([level("x", *variants), EASY])))
    places = sorted(float(one.attrib["y"]) for one in root.iter(f"{SVG}text") if one.text == "1 failed")
    assert len(places) == 3
    # Letters are 12 px high.
    assert min(b - a for a, b in pairwise(places)) >= 12


def test_the_command_writes_a_picture_and_prints_a_table(
    scored_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The synthetic set has no bound; with one of 5 mm in its scores it is a level."""
    out = tmp_path / "levels.svg"
    assert main(["levels", str(scored_set), "--out", str(out)]) == 2
    assert "no frame has a bound" in capsys.readouterr().err
    folder = copy_of(scored_set, tmp_path / "set")
    path = folder / "scores.json"
    path.write_text(path.read_text().replace('"bound_m": null', '"bound_m": 0.005'))
    assert main(["levels", str(folder), "--out", str(out)]) == 0
    assert "(5 mm)" in capsys.readouterr().out
    assert ET.parse(out).getroot().tag == f"{SVG}svg"
    assert main(["levels", str(folder), "--out", str(tmp_path)]) == 2
    assert "is a folder, needed the name of a file" in capsys.readouterr().err
