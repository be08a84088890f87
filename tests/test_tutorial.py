"""docs/tutorial_hall.md, run from its own page: its figures and statements are those of the run."""

import json
import re
import resource
from dataclasses import dataclass
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from conftest import ROOT, run
from test_reference import script

PAGE = ROOT / "docs/tutorial_hall.md"
NUMBER = re.compile(r"\d+(?:\.\d+)?")
MAX_CPU_S = 300.0

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Tutorial:
    """The page with the outputs of this run, the folder of the run, and its CPU time."""

    text: str
    folder: Path
    cpu_s: float


@pytest.fixture(scope="module")
def tutorial(tmp_path_factory: pytest.TempPathFactory) -> Tutorial:
    folder = tmp_path_factory.mktemp("tutorial")
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    text = script("make_tutorial").executed(PAGE.read_text(encoding="utf-8"), folder)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return Tutorial(text, folder, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)


def unit_in_last_place(number: str) -> float:
    return 10.0 ** -len(number.partition(".")[2])


def test_the_page_shows_what_its_commands_print(tutorial: Tutorial) -> None:
    shown = PAGE.read_text(encoding="utf-8")
    assert shown.count("```text\n") == 4
    words, here = (NUMBER.sub("#", text).split() for text in (shown, tutorial.text))
    assert here == words, "run make docs"
    # Frames are the same bits on every machine. Positions are the result of iterations in floating point, whose sums
    # the libraries of another processor order differently: rounding to the digits shown may fall on the other side.
    for page, new in zip(NUMBER.findall(shown), NUMBER.findall(tutorial.text), strict=True):
        assert abs(float(page) - float(new)) <= 1.001 * unit_in_last_place(page), f"{page} on the page, {new} here"


def test_the_page_takes_less_than_five_minutes(tutorial: Tutorial) -> None:
    assert tutorial.cpu_s < MAX_CPU_S


def median_errors_m(folder: Path) -> dict[str, float]:
    scores = json.loads(run("estimator", "score", str(folder), "--json").stdout)
    return {row["variant"]: row["error_3d"]["median_m"] for row in scores["variants"]}


def test_the_statements_of_the_page_hold(tutorial: Tutorial) -> None:
    content = json.loads((tutorial.folder / "ideal/dataset.json").read_text(encoding="utf-8"))
    assert [led["id"] for led in content["led_map"]] == list(range(128))
    assert pq.read_table(tutorial.folder / "ideal/frames.parquet").num_rows == 6
    ideal, calibrated = (median_errors_m(tutorial.folder / name) for name in ("ideal", "calibrated"))
    assert sorted(ideal, key=ideal.__getitem__) == ["ml", "gravity-fit", "pnp", "huynh2016"]
    assert all(1e-3 < error < 0.1 for error in calibrated.values())
    assert max(ideal["ml"], ideal["gravity-fit"]) < 1e-4
    assert (tutorial.folder / "report.html").stat().st_size > 10_000
