"""Plots of tables: where values stand on the axes, bands, gaps, heat maps, and marks fixed by a variant's name."""

import re
import xml.etree.ElementTree as ET
from math import inf, nan
from pathlib import Path

import pytest
from conftest import run
from estimator_sets import write_set, write_sweep

from estimator.errors import InputError
from estimator.evaluate.table import Key, Statistic, Table, TableRow
from estimator.methods.catalogue import VARIANTS
from estimator.report.axes import Axis
from estimator.report.plot import COLOUR_MAP, HEIGHT, LEFT, PANEL, TOP, WIDTH, plot
from estimator.report.svg import COLOURS, MARKS, slots_of

SVG = "{http://www.w3.org/2000/svg}"
NAMES = list(VARIANTS)


def made(points: dict[str, list[tuple[float | str, float, float, float]]], statistic: str = "median") -> Table:
    """A table of one key: key, value and ends of each group's rows."""
    rows = [
        TableRow((Key(x),), (group,), 10, 9, (Statistic(value, low, high),), {"a: b": 1})
        for group, some in points.items()
        for x, value, low, high in some
    ]
    return Table("error_3d_m", ("sigma",), ("variant",), (statistic,), tuple(rows))


def marks(svg: str, kind: str = "circle") -> dict[str, tuple[float, float]]:
    """Places of the first variant's marks by their titles."""
    found = {}
    for one in ET.fromstring(svg).iter(f"{SVG}{kind}"):
        if (title := one.findtext(f"{SVG}title")) is not None:
            found[title] = (float(one.get("cx", "0")), float(one.get("cy", "0")))
    return found


def across(share: float) -> float:
    return LEFT + WIDTH * share


def up(share: float) -> float:
    return TOP + HEIGHT * (1 - share)


def test_values_stand_on_linear_axes() -> None:
    """0 to 10 across and 0.1 to 0.2 m up, with 4 % of the span beyond each end: shares 0.04/1.08, 0.5, 1.04/1.08."""
    table = made({NAMES[0]: [(0.0, 0.1, nan, nan), (5.0, 0.15, nan, nan), (10.0, 0.2, nan, nan)]})
    places = list(marks(plot(table)).values())
    shares = [0.04 / 1.08, 0.5, 1.04 / 1.08]
    for place, share in zip(places, shares, strict=True):
        assert place == pytest.approx((across(share), up(share)), abs=0.06)


def test_values_that_span_decades_stand_on_logarithmic_axes() -> None:
    table = made({NAMES[0]: [(1.0, 0.001, nan, nan), (10.0, 0.01, nan, nan), (100.0, 0.1, nan, nan)]})
    middle = (across(0.5), up(0.5))
    assert list(marks(plot(table)).values())[1] == pytest.approx(middle, abs=0.06)
    assert list(marks(plot(table, ["x"])).values())[1][1] != pytest.approx(middle[1], abs=5)
    assert list(marks(plot(table, [])).values())[1][0] != pytest.approx(middle[0], abs=5)


def test_a_title_says_what_a_mark_is() -> None:
    (title,) = marks(
        plot(made({"up2p": [(1.0, 0.02, 0.01, inf)]}), []), "path" if NAMES.index("up2p") >= 7 else "circle"
    )
    assert title == "up2p, sigma 1: 20 mm (10 mm to ∞), 9 of 10 frames answered"


def test_a_band_reaches_from_the_lower_to_the_upper_ends() -> None:
    """Ends at 0 and 4 m of a linear axis from 0 - 0.16 to 4 + 0.16 m: shares 0.16/4.32 and 4.16/4.32."""
    table = made({NAMES[0]: [(0.0, 1.0, 0.5, 4.0), (1.0, 2.0, 1.0, inf)]})
    (band,) = [
        one.get("d", "")
        for one in ET.fromstring(plot(table, [])).iter(f"{SVG}path")
        if "band" in (one.get("class") or "")
    ]
    corners = [(float(a), float(b)) for a, b in re.findall(r"(-?[\d.]+) (-?[\d.]+)", band)]
    axis = Axis.of([1.0, 2.0, 0.5, 4.0, 1.0], False)
    expected = [up(axis.share(4.0)), up(1.0), up(axis.share(1.0)), up(axis.share(0.5))]
    assert [v for _, v in corners] == pytest.approx(expected, abs=0.06)
    assert corners[0][0] == corners[3][0] < corners[1][0] == corners[2][0]


def test_a_value_that_is_infinite_is_a_cross_and_ends_the_line() -> None:
    table = made(
        {NAMES[0]: [(0.0, 1.0, nan, nan), (1.0, inf, nan, nan), (2.0, 1.5, nan, nan), (3.0, 2.0, nan, nan)]},
        "median_of_all",
    )
    svg = plot(table, [])
    curves = [
        one.get("d", "")
        for one in ET.fromstring(svg).iter(f"{SVG}path")
        if (one.get("class") or "").startswith("curve")
    ]
    assert [curve.count("L") for curve in curves] == [0, 1]
    assert len(marks(svg)) == 3
    assert any("∞" in title for title in marks(svg, "path"))


def test_lines_stand_at_their_values_with_their_labels() -> None:
    table = made({NAMES[0]: [(0.0, 1.0, nan, nan), (1.0, 2.0, nan, nan)]})
    root = ET.fromstring(plot(table, [], [(4.0, "paper <1>")]))
    (bound,) = [one for one in root.iter(f"{SVG}line") if one.get("class") == "bound"]
    assert float(bound.get("y1", "0")) == pytest.approx(up(1 - 0.04 / 1.08), abs=0.06)  # the axis holds the line
    assert "paper <1>" in [one.text for one in root.iter(f"{SVG}text")]


def test_texts_stand_side_by_side() -> None:
    table = made({NAMES[0]: [("raw", 1.0, nan, nan), ("median", 2.0, nan, nan)]})
    places = marks(plot(table, []))
    assert [place[0] for place in places.values()] == pytest.approx([across(0.25), across(0.75)], abs=0.06)


def slots(names: list[str]) -> list[int]:
    return slots_of([(name, "") for name in names], NAMES)


def test_marks_are_fixed_by_the_name() -> None:
    """Whatever else is drawn, a variant of the catalogue has its mark, and another name has one by its hash."""
    alone = {name: slots([name])[0] for name in [*NAMES, "mine", "huynh2016:denoise=none"]}
    assert [alone[name] for name in NAMES] == list(range(len(NAMES)))
    together = dict(zip(alone, slots(list(alone)), strict=True))
    assert {name: together[name] for name in NAMES} == {name: alone[name] for name in NAMES}
    assert len(set(together.values())) == len(together)
    many = [f"variant {number}" for number in range(len(COLOURS) * len(MARKS) + 3)]
    assert max(slots(many)) < len(COLOURS) * len(MARKS)
    assert slots(many) == slots(many[::-1])[::-1]


def test_cameras_of_a_variant_have_its_colour_and_marks_of_their_own() -> None:
    groups = [(name, camera) for name in NAMES[:3] for camera in ("left", "main", "right")]
    found = slots_of(groups, NAMES)
    assert [slot % len(COLOURS) for slot in found] == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert len(set(found)) == len(found)
    rows = [
        TableRow((Key(x),), (camera, name), 1, 1, (Statistic(x + 1, nan, nan),), {})
        for name, camera in groups
        for x in (0.0, 1.0)
    ]
    svg = plot(Table("error_3d_m", ("sigma",), ("camera", "variant"), ("mean",), tuple(rows)), [])
    for slot in found:
        assert f'class="curve v{slot}"' in svg


def test_the_same_table_gives_the_same_bytes(tmp_path: Path) -> None:
    folder = write_set(tmp_path / "set", {"pnp": [0.01, 0.02], "kim": [0.1, 0.3]})
    for name in ("a.svg", "b.svg"):
        finished = run(
            "estimator", "plot", str(folder), "--x", "x_m", "--out", str(tmp_path / name), "--line", "0.2:paper"
        )
        assert finished.returncode == 0, finished.stderr
        assert finished.stdout.split() == [str(tmp_path / name), str((tmp_path / name).with_suffix(".csv"))]
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    header, *lines = (tmp_path / "a.csv").read_text().splitlines()
    assert (
        header == "x_m,variant,frames,answered,error_3d_m_median,error_3d_m_median_low,error_3d_m_median_high,failures"
    )
    assert len(lines) == 4


def test_two_keys_give_a_heat_map(tmp_path: Path) -> None:
    """Errors of 1 to 6 by a (across) and b (up): 1 has the first colour, 6 the last; 5 stands at a = 2, b = 1."""
    cells = [({"a": float(a), "b": float(b)}, {"pnp": [1.0 + 2 * a + b]}) for a in range(3) for b in range(2)]
    folder = write_sweep(tmp_path / "sweep", cells)
    out = tmp_path / "map.svg"
    finished = run("estimator", "plot", str(folder), "--x", "a", "--x", "b", "--stat", "mean", "--out", str(out))
    assert finished.returncode == 0, finished.stderr
    found = {}
    for one in ET.parse(out).getroot().iter(f"{SVG}rect"):
        if (title := one.findtext(f"{SVG}title")) is not None:
            found[title.split(" (")[0]] = one
    assert len(found) == 6
    first, last = found["pnp, a 0, b 0: 1 m"], found["pnp, a 2, b 1: 6 m"]
    assert [first.get("fill"), last.get("fill")] == ["#" + bytes(COLOUR_MAP[end]).hex() for end in (0, -1)]
    assert float(last.get("x", "0")) - float(first.get("x", "0")) == pytest.approx(2 / 3 * PANEL, abs=0.1)
    assert float(first.get("y", "0")) - float(last.get("y", "0")) == pytest.approx(PANEL / 2, abs=0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--stat", "of_all"], "a plot shows one; of_all is two, median_of_all and p95_of_all"),
        (["--x", "y_m", "--x", "z_m"], "keys x_m, y_m, z_m: a plot has one or two"),
        (["--log", "z"], "log z: unknown axis; allowed: x, y, value"),
        (["--x", "y_m", "--line", "1:a"], "lines: a heat map has none; give one key"),
        (["--line", "a:1"], "--line a:1: needed VALUE:LABEL with a number"),
        (["--bins", "100,101"], "the table has no rows: no frame has a value of each key"),
    ],
)
def test_bad_input_is_one_line(tmp_path: Path, arguments: list[str], message: str) -> None:
    folder = write_set(tmp_path / "set", {"pnp": [0.01, 0.02]})
    finished = run("estimator", "plot", str(folder), "--x", "x_m", "--out", str(tmp_path / "a.svg"), *arguments)
    assert (finished.returncode, finished.stderr.count("\n")) == (2, 1)
    assert message in finished.stderr
    finished = run("estimator", "plot", str(folder), "--x", "x_m", "--out", str(tmp_path / "a.png"))
    assert "a.png: needed the name of an .svg file" in finished.stderr


def test_heat_maps_stand_three_to_a_row() -> None:
    """Seven maps: three rows, each below the one before, and no map beyond the picture."""
    rows = [
        TableRow((Key(x), Key(y)), (f"v{number}",), 1, 1, (Statistic(x + y, nan, nan),), {})
        for number in range(7)
        for x in (1.0, 2.0)
        for y in (1.0, 2.0)
    ]
    root = ET.fromstring(plot(Table("error_3d_m", ("a", "b"), ("variant",), ("median",), tuple(rows))))
    wide, high = (float(part) for part in root.attrib["viewBox"].split()[2:])
    cells = [one for one in root.iter(f"{SVG}rect") if one.find(f"{SVG}title") is not None]
    corners = [(float(one.attrib["x"]), float(one.attrib["y"])) for one in cells]
    assert len({x for x, _ in corners}) == len({y for _, y in corners}) == 3 * 2
    assert len(set(corners)) == len(cells) == 7 * 4
    assert max(x for x, _ in corners) + PANEL / 2 < wide
    assert max(y for _, y in corners) + PANEL / 2 < high


def test_too_many_heat_maps_are_refused() -> None:
    rows = [TableRow((Key(0.0), Key(0.0)), (str(group),), 1, 1, (Statistic(1.0, nan, nan),), {}) for group in range(21)]
    with pytest.raises(InputError, match="21 groups: a figure has room for 20 heat maps"):
        plot(Table("error_3d_m", ("a", "b"), ("camera",), ("mean",), tuple(rows)))


def test_labels_of_axes_are_round() -> None:
    assert Axis.of([0.0, 10.0], False).labels() == [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]
    assert Axis.of([1.0, 100.0], True).labels() == [1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0]
    assert Axis.of([1e-6, 1e6], True).labels() == pytest.approx([1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e4, 1e6])
    assert Axis.of([3.0], None).labels()[0] >= 2.88
    assert Axis.of([], None).labels()
    assert Axis.of([inf, nan], None).share(inf) == 1.0
