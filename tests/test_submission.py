"""Submissions: a bundle is what was submitted or is refused by name; the leaderboard ranks by the third quartile."""

import hashlib
import io
import json
import zipfile
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from conftest import copy_of, run

import estimator as est
from estimator.evaluate.statistics import percentile_of_all
from estimator.evaluate.submission import MAX_ESTIMATES_BYTES, read_bundle, score_bundles, submit
from estimator.io.estimates import EstimateRow, write_estimates

Members = dict[str, bytes]


@pytest.fixture
def bundle(scored_set: Path, tmp_path: Path) -> Path:
    path = tmp_path / "a.zip"
    submit(scored_set, path, "A", "B. C.", ["pnp", "gravity-fit"])
    return path


def test_a_bundle_holds_the_estimates_and_what_they_are_of(scored_set: Path, bundle: Path, tmp_path: Path) -> None:
    read = read_bundle(bundle)
    assert list(read.files) == ["pnp", "gravity-fit"]
    for variant, data in read.files.items():
        assert data == (scored_set / f"estimates/{variant}.parquet").read_bytes()
    frames = (scored_set / "frames.parquet").read_bytes()
    assert read.description.frames_sha256 == hashlib.sha256(frames).hexdigest()
    submit(scored_set, tmp_path / "again.zip", "A", "B. C.", ["pnp", "gravity-fit"])
    assert (tmp_path / "again.zip").read_bytes() == bundle.read_bytes()
    scores = {score.variant: score for score in est.score(copy_of(scored_set, tmp_path / "set")).variants}
    for entry in score_bundles([bundle], scored_set):
        assert entry.score == scores[entry.score.variant]


def described(members: Members, **changes: object) -> None:
    tree = json.loads(members["submission.json"])
    for key, value in changes.items():
        if key in tree:
            tree[key] = value
        else:
            tree["estimates"][0][key] = value
    members["submission.json"] = json.dumps(tree).encode()


def damage(members: Members) -> None:
    members["estimates/pnp.parquet"] = members["estimates/pnp.parquet"][:-1] + b"x"


def of_other_frames(members: Members) -> None:
    """Estimates that say themselves that they are of other frames than their bundle says."""
    table = pq.read_table(io.BytesIO(members["estimates/pnp.parquet"]))
    written = io.BytesIO()
    pq.write_table(table.replace_schema_metadata({"frames_sha256": "0" * 64}), written)
    members["estimates/pnp.parquet"] = data = written.getvalue()
    described(members, sha256=hashlib.sha256(data).hexdigest(), bytes=len(data))


DAMAGES: dict[str, tuple[Callable[[Members], object], str]] = {
    "outside": (lambda m: m.__setitem__("../../evil.parquet", b"x"), r"'../../evil.parquet' is not in submission.json"),
    "absolute": (lambda m: m.__setitem__("/etc/passwd", b"x"), r"'/etc/passwd' is not in submission.json"),
    "listed outside": (lambda m: described(m, variant="../../evil"), "estimates.0.variant"),
    "missing": (lambda m: m.pop("estimates/pnp.parquet"), "'estimates/pnp.parquet' is missing"),
    "changed": (damage, "pnp.parquet: damaged or changed"),
    "longer than said": (lambda m: described(m, bytes=10), "pnp.parquet: has more than 10 bytes"),
    "too large": (lambda m: described(m, bytes=MAX_ESTIMATES_BYTES + 1), "estimates.0.bytes"),
    "huge description": (lambda m: m.__setitem__("submission.json", b" " * 2_000_000), "has more than 1000000 bytes"),
    "no description": (lambda m: m.pop("submission.json"), "not a submission"),
    "other version": (lambda m: described(m, version=2), "version"),
    "name of two lines": (lambda m: described(m, name="a\nb"), "name"),
    "twice": (
        lambda m: described(m, estimates=json.loads(m["submission.json"])["estimates"] * 2),
        "variant is there twice",
    ),
    "other frames": (lambda m: described(m, frames_sha256="0" * 64), "estimates of other frames"),
    "rows of other frames": (of_other_frames, "estimates/pnp.parquet: estimates of another dataset"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_bundles_that_are_damaged_or_odd_are_refused(name: str, bundle: Path, scored_set: Path) -> None:
    change, problem = DAMAGES[name]
    with zipfile.ZipFile(bundle) as archive:
        members = {member: archive.read(member) for member in archive.namelist()}
    change(members)
    with zipfile.ZipFile(bundle, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, data in members.items():
            archive.writestr(member, data)
    with pytest.raises(est.InputError, match=problem) as caught:
        score_bundles([bundle], scored_set)
    assert str(caught.value).startswith(str(bundle))
    assert "\n" not in str(caught.value)


def test_other_files_are_refused(bundle: Path, scored_set: Path, tmp_path: Path) -> None:
    data = bundle.read_bytes()
    for content in (b"", b"no zip", data[: len(data) // 2]):
        bundle.write_bytes(content)
        with pytest.raises(est.InputError, match="not a readable bundle"):
            read_bundle(bundle)
    with pytest.raises(est.InputError, match="no such file"):
        read_bundle(tmp_path / "none.zip")


def test_estimates_of_another_set_or_number_of_frames_are_refused(scored_set: Path, tmp_path: Path) -> None:
    folder = copy_of(scored_set, tmp_path / "set")
    path = folder / "estimates/pnp.parquet"
    table = pq.read_table(path)
    pq.write_table(table.replace_schema_metadata({"frames_sha256": "0" * 64}), path)
    with pytest.raises(est.InputError, match="estimates of another dataset: frames_sha256 is 0000"):
        submit(folder, tmp_path / "a.zip", "A", variants=["pnp"])
    pq.write_table(table.slice(1), path)
    with pytest.raises(est.InputError, match="2 rows, needed one for each of the 3 frames"):
        submit(folder, tmp_path / "a.zip", "A", variants=["pnp"])
    with pytest.raises(est.InputError, match="none of variant nothing"):
        submit(folder, tmp_path / "a.zip", "A", variants=["nothing"])
    assert not (tmp_path / "a.zip").exists()


def test_a_percentile_of_all_counts_failures_as_infinite() -> None:
    errors_m = [4.0, None, 1.0, 3.0, 2.0, None, 6.0, 5.0]
    # Of eight frames the sixth smallest is the third quartile; six have an answer.
    assert percentile_of_all(errors_m, 75) == 6.0
    assert percentile_of_all(errors_m, 76) is None
    finite = [error_m for error_m in errors_m if error_m is not None]
    assert percentile_of_all(finite, 50) == np.percentile(finite, 50, method="inverted_cdf")


def submitted(scored_set: Path, tmp_path: Path, name: str, errors_m: list[float | None], along: int) -> Path:
    """A bundle whose estimates are off along an axis by the given errors; None fails."""
    folder = copy_of(scored_set, tmp_path / f"set {along} {errors_m}")
    for path in (folder / "estimates").iterdir():
        path.unlink()
    rows = []
    for frame, (error_m, true_m) in enumerate(
        zip(errors_m, pq.read_table(folder / "truth.parquet")["position_m"].to_pylist(), strict=True)
    ):
        if error_m is None:
            rows.append(EstimateRow(frame=frame, status="failed", reason="a: b", position_m=None, ranges=(), time_s=0))
            continue
        true_m[along] += error_m
        rows.append(EstimateRow(frame=frame, status="ok", reason="", position_m=tuple(true_m), ranges=(), time_s=0))
    write_estimates(folder, "mine", rows)
    submit(folder, out := tmp_path / f"{along} {errors_m}.zip", name)
    return out


class Page(HTMLParser):
    """Texts of the table's cells, and addresses that the page loads or links."""

    def __init__(self) -> None:
        super().__init__()
        self.cells: list[str] = []
        self.resources: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.resources += [f"{tag} {name}={value}" for name, value in attrs if name in ("src", "href", "onload")]
        self.resources += [tag] * (tag in ("script", "img", "iframe"))
        if tag in ("td", "th"):
            self.cells.append("")

    def handle_data(self, data: str) -> None:
        if self.cells:
            self.cells[-1] += data.strip()


def test_the_leaderboard_ranks_by_the_third_quartile(scored_set: Path, tmp_path: Path) -> None:
    # Of three frames the third quartile is the largest error.
    steady = submitted(scored_set, tmp_path, "steady", [0.02, 0.02, 0.02], 0)
    wild = submitted(scored_set, tmp_path, "wild", [0.001, 0.001, 0.05], 0)
    silent = submitted(scored_set, tmp_path, "<img src=x onerror=alert(1)> | [a](http://b)", [0.001, 0.001, None], 0)
    high = submitted(scored_set, tmp_path, "high", [0.03, 0.03, 0.03], 2)
    bundles = [str(one) for one in (silent, high, wild, steady)]

    def table(by: str) -> list[list[str]]:
        out = tmp_path / "page.html"
        finished = run(
            "estimator", "leaderboard", *bundles, "--dataset", str(scored_set), "--out", str(out), "--by", by
        )
        assert finished.returncode == 0, finished.stderr
        page = Page()
        page.feed(out.read_text(encoding="utf-8"))
        assert page.resources == []
        return [page.cells[at : at + 11] for at in range(0, len(page.cells), 11)]

    by_3d = table("3d")
    assert [row[:2] for row in by_3d[1:]] == [
        ["1", "steady"],
        ["2", "high"],
        ["3", "wild"],
        ["4", "<img src=x onerror=alert(1)> | [a](http://b)"],
    ]
    assert by_3d[1][4:] == ["20 mm"] * 6 + ["100 %"]
    assert by_3d[4][4:7] == ["∞", "1 mm", "∞"]
    assert by_3d[4][10].startswith("66.6 %")
    assert [row[1] for row in table("horizontal")[1:3]] == ["high", "steady"]
    out = tmp_path / "page.md"
    assert run("estimator", "leaderboard", *bundles, "--dataset", str(scored_set), "--out", str(out)).returncode == 0
    lines = [line for line in out.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    assert len(lines) == 6
    assert {line.replace("\\|", "").count("|") for line in lines} == {12}
    assert "<img" not in lines[5]


def test_commands_name_what_they_need(bundle: Path, scored_set: Path, tmp_path: Path) -> None:
    for arguments, problem in (
        (("score", str(bundle)), "--dataset: needed"),
        (("submit", str(scored_set), "--out", str(tmp_path / "x.tar"), "--name", "a"), "needed the name of a .zip"),
        (("leaderboard", str(bundle), "--dataset", str(scored_set), "--out", "x.pdf"), "an .html or .md"),
        (("submit", str(scored_set), "--out", str(tmp_path / "x.zip"), "--name", ""), "name"),
    ):
        finished = run("estimator", *arguments)
        assert finished.returncode == 2, finished.stdout
        assert problem in finished.stderr
    finished = run("estimator", "score", str(bundle), "--dataset", str(scored_set))
    assert finished.returncode == 0, finished.stderr
    assert "A: pnp" in finished.stdout
