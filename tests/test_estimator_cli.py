"""Command line and report: output, and every error in one line with exit code 2."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import copy_of

import estimator
from estimator.cli import main
from estimator.io.estimates import EstimateRow, write_estimates
from estimator.methods.catalogue import OWN, VARIANTS
from estimator.report.terminal import fitting, print_table


@pytest.fixture(scope="module")
def dataset(scored_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = copy_of(scored_set, tmp_path_factory.mktemp("cli"))
    (folder / "previews").mkdir()
    for index in range(3):
        cv2.imwrite(str(folder / f"previews/{index:06d}.png"), np.full((30, 40), 50, np.uint8))
    return folder


def test_run_writes_the_estimates_of_each_variant(dataset: Path) -> None:
    assert sorted(path.stem for path in (dataset / "estimates").iterdir()) == sorted(VARIANTS)


def test_run_takes_some_variants(synthetic_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = copy_of(synthetic_set, tmp_path)
    assert main(["run", str(folder), "--variant", "pnp", "--variant", "pnp"]) == 0
    assert [path.name for path in (folder / "estimates").iterdir()] == ["pnp.parquet"]
    assert capsys.readouterr().out.startswith("pnp: 3 of 3 frames ok")


@pytest.mark.parametrize(("sigma", "text"), [("0.50", "0.5"), ("10", "10"), ("0", "0")])
def test_a_centroid_sigma_goes_to_the_variants_that_use_it(
    synthetic_set: Path, tmp_path: Path, sigma: str, text: str
) -> None:
    folder = copy_of(synthetic_set, tmp_path)
    assert main(["run", str(folder), "--variant", "pnp", "--variant", "gravity-fit", "--centroid-sigma", sigma]) == 0
    names = sorted(path.stem for path in (folder / "estimates").iterdir())
    assert names == [f"gravity-fit:centroid-sigma={text}", "pnp"]


@pytest.mark.parametrize(
    ("variant", "sigma", "message"),
    [
        ("pnp", "1", "--centroid-sigma: none of the variants uses it; those that do: gravity-fit, up2p"),
        ("up2p", "-1", "centroid-sigma='-1' is not a number of pixels from 0 to 1000"),
        ("up2p", "nan", "centroid-sigma='nan' is not a number of pixels from 0 to 1000"),
    ],
)
def test_a_centroid_sigma_without_a_use_is_refused(
    synthetic_set: Path, capsys: pytest.CaptureFixture[str], variant: str, sigma: str, message: str
) -> None:
    assert main(["run", str(synthetic_set), "--variant", variant, f"--centroid-sigma={sigma}"]) == 2
    assert message in capsys.readouterr().err


def test_variants_are_listed_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["variants"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(OWN)


def test_score_prints_a_row_a_variant(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["score", str(dataset)]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in VARIANTS)
    assert "synthetic <&>" in out


def test_a_table_is_split_where_the_terminal_is_narrow() -> None:
    """Each part has the first column, and fits if two columns do; an interval stays with the column before it.

    The widths are 3 more than the longest cell or word of a header, and a border: 1 + 4 + 8 + 11 + 8 + 6 = 38.
    """
    headers, rows = ["a", "value", "95 % interval", "long words", "b"], [["x", "12345", "1 to 2", "1", "123"]]
    assert fitting(headers, rows, 200) == [[0, 1, 2, 3, 4]]
    assert fitting(headers, rows, 38) == [[0, 1, 2, 3, 4]]
    assert fitting(headers, rows, 37) == [[0, 1, 2, 3], [0, 4]]
    assert fitting(headers, rows, 24) == [[0, 1, 2], [0, 3, 4]]
    assert fitting(headers, rows, 5) == [[0, 1, 2], [0, 3], [0, 4]]


def test_a_table_is_followed_by_its_note_as_written(capsys: pytest.CaptureFixture[str]) -> None:
    print_table("errors", ["variant", "p50"], [["a", "1.25"]], "p50: median [m]; of 3 frames")
    printed = " ".join(capsys.readouterr().out.split())  # a note longer than the table has several lines
    assert "1.25" in printed
    assert printed.endswith("p50: median [m]; of 3 frames")


def test_score_prints_json(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["score", str(dataset), "--json"]) == 0
    scores = json.loads(capsys.readouterr().out)
    assert scores == json.loads((dataset / "scores.json").read_text())
    assert {v["variant"]: v["ok"] for v in scores["variants"]}["pnp"] == 3


def test_compare_prints_a_line_a_number(
    synthetic_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """PnP, which succeeds on three frames of three, against a variant that fails on all."""
    folder = copy_of(synthetic_set, tmp_path)
    assert main(["run", str(folder), "--variant", "pnp"]) == 0
    lost = [
        EstimateRow(frame=k, status="failed", reason="a: b", position_m=None, ranges=(), time_s=0) for k in range(3)
    ]
    write_estimates(folder, "lost", lost)
    capsys.readouterr()
    assert main(["compare", str(folder), "pnp", "lost"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "A = pnp, B = lost"
    cells = {line[:15].strip(): line[15:].strip() for line in lines[1:]}
    assert (cells["both"], cells["only A"], cells["neither"], cells["Wilcoxon p"]) == ("0", "3", "0", "–")
    assert main(["compare", str(folder), "pnp", "lost", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["only_a"] == 3


class Page(HTMLParser):
    """Collects what a page refers to, and checks that its elements close."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in ("meta", "img", "input", "wbr"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_report_is_one_page_that_needs_nothing_else(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "report.html"
    assert main(["report", str(dataset), str(dataset), "--out", str(out)]) == 0
    page = Page()
    html = out.read_text()
    page.feed(html)
    assert page.open == []
    # Pictures are in the data of the scripts; no element of the page itself loads any.
    assert page.sources == []
    assert "http" not in re.sub(r"http://www\.w3\.org/2000/svg|http-equiv", "", html)
    assert "synthetic <&>" in page.text
    assert "synthetic <&>" not in re.sub(r"<script.*?</script>", "", html, flags=re.DOTALL)
    assert "(needs two cameras)" in page.text


def test_a_report_is_the_same_without_the_truth_once_scored(dataset: Path, tmp_path: Path) -> None:
    assert main(["score", str(dataset)]) == 0
    assert main(["report", str(dataset), "--out", str(tmp_path / "a.html")]) == 0
    hidden = tmp_path / "truth.parquet"
    (dataset / "truth.parquet").rename(hidden)
    try:
        assert main(["report", str(dataset), "--out", str(tmp_path / "b.html")]) == 0
    finally:
        hidden.rename(dataset / "truth.parquet")
    assert (tmp_path / "a.html").read_text() == (tmp_path / "b.html").read_text()


ERRORS = [
    (["run", "{tmp}/nowhere"], "nowhere: no such folder"),
    (["run", "{tmp}"], "not a dataset"),
    (["run"], "DATASET"),
    (["run", "{data}", "--variant", "best"], "variant best: unknown; allowed: huynh2016, huynh2016-as-printed, "),
    (["run", "{data}", "--variant"], "--variant"),
    (["run", "{data}", "more"], "more"),
    (["run", "{data}", "--fast"], "--fast"),
    (["walk", "{data}"], "walk"),
    (["--fast"], "--fast"),
    (["score", "{tmp}/nowhere"], "nowhere: no such folder"),
    (["score", "{data}", "--jsn"], "--jsn"),
    (["run", "{data}", "--workers", "0"], "--workers 0: is not 1 or more"),
    (["run", "{data}", "--workers", "many"], "--workers"),
    (["run", "{data}", "--workers", "1.5"], "--workers: 1.5 is not a whole number"),
    (["compare", "{data}", "pnp"], "B"),
    (["compare", "{data}", "pnp", "pnp"], "pnp and pnp: needed two different variants"),
    (["compare", "{data}", "pnp", "best"], "none of variant best; there are: "),
    (["compare", "{tmp}/nowhere", "pnp", "huynh2016"], "nowhere: no such folder"),
    (["report", "--out", "{tmp}/x.html"], "DATASETS"),
    (["report", "{data}"], "--out"),
    (["report", "{data}", "--out", "{tmp}"], "is a folder"),
    (["report", "{data}", "--out", "{tmp}/nowhere/x.html"], "nowhere/x.html: No such file or directory"),
]


@pytest.mark.parametrize(("arguments", "words"), ERRORS, ids=[" ".join(arguments) for arguments, _ in ERRORS])
def test_a_user_s_error_is_one_line_and_exit_code_2(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    filled = [argument.format(data=dataset, tmp=tmp_path) for argument in arguments]
    assert main(filled) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.count("\n") == 1
    assert output.err.startswith("estimator: ")
    assert words in output.err


def test_damage_is_one_line_too(synthetic_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = copy_of(synthetic_set, tmp_path)
    (folder / "dataset.json").write_text('{"format": "vlcrender-dataset"}')
    assert main(["run", str(folder)]) == 2
    output = capsys.readouterr()
    assert output.err == f"estimator: {folder}/dataset.json: version: Field required\n"


def raises(error: BaseException) -> object:
    def command(*_: object, **__: object) -> None:
        raise error

    return command


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (OSError(28, "No space left on device", "x.parquet"), 2, "x.parquet: No space left on device"),
        (PermissionError(13, "Permission denied", "x"), 2, "x: Permission denied"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (ZeroDivisionError("a\nb"), 1, "internal error, please report it: ZeroDivisionError: a b"),
    ],
)
def test_every_exception_is_one_line_without_a_traceback(
    dataset: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: BaseException,
    code: int,
    words: str,
) -> None:
    monkeypatch.setattr(estimator, "score", raises(error))
    assert main(["score", str(dataset)]) == code
    assert capsys.readouterr().err == f"estimator: {words}\n"


def test_version_is_the_installed_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip()[0].isdigit()
