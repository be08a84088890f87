"""Files that are cut short, garbled or against their own format: read, or refused in one line with exit code 2."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from estimator.cli import main
from estimator.errors import InputError
from estimator.io.estimates import write_estimates


@pytest.fixture(scope="module")
def good(scored_set: Path) -> Path:
    return scored_set


@pytest.fixture
def folder(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "copy"))


def judge(folder: Path, capsys: pytest.CaptureFixture[str]) -> int:
    """The exit code of all that reads the damaged file; 2 comes with one line that names a file of the dataset."""
    codes = []
    # The report uses scores.json unchanged, before `score` would write it again.
    for command in (["report", str(folder), "--out", str(folder / "report.html")], ["score", str(folder)]):
        capsys.readouterr()
        codes.append(main(command))
        error = capsys.readouterr().err
        assert codes[-1] in (0, 2), error
        if codes[-1] == 2:
            assert error.startswith(f"estimator: {folder}")
            assert error.count("\n") == 1
    return max(codes)


@pytest.mark.slow
@pytest.mark.parametrize("file", ["estimates/pnp.parquet", "truth.parquet", "scores.json"])
@settings(max_examples=20, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_damaged_bytes_are_read_or_refused(
    good: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], file: str, data: st.DataObject
) -> None:
    folder = Path(shutil.copytree(good, tmp_path / "damaged", dirs_exist_ok=True))
    content = bytearray((good / file).read_bytes())
    cut = data.draw(st.booleans())
    if cut:
        content = content[: data.draw(st.integers(0, len(content) - 2))]
    else:
        for _ in range(data.draw(st.integers(1, 3))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    if file != "scores.json":
        (folder / "scores.json").unlink(missing_ok=True)  # else the report need not read it
    (folder / file).write_bytes(content)
    code = judge(folder, capsys)
    assert code == 2 or not cut


GOOD_BOUND = np.diag([1e-6, 2e-6, 3e-6])
BOUNDS = {
    "not symmetric": GOOD_BOUND + [[0, 1e-6, 0], [0, 0, 0], [0, 0, 0]],
    "negative": -GOOD_BOUND,
    "indefinite": GOOD_BOUND + 1e-5 * (1 - np.eye(3)),
    "singular": np.ones((3, 3)),
    "zero": np.zeros((3, 3)),
    "NaN": np.full((3, 3), np.nan),
    "infinite": np.diag([np.inf, 1, 1]),
    "too large": np.diag([1e200, 1, 1]),
}


def change_column(path: Path, column: str, values: list[Any], kind: pa.DataType) -> None:
    table = pq.read_table(path)
    pq.write_table(table.set_column(table.schema.get_field_index(column), column, pa.array(values, kind)), path)


@pytest.mark.parametrize("case", BOUNDS)
@pytest.mark.parametrize(("file", "column"), [("truth", "bound_m2"), ("estimates/pnp", "covariance_m2")])
def test_a_matrix_that_is_no_covariance_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], case: str, file: str, column: str
) -> None:
    path = folder / f"{file}.parquet"
    change_column(path, column, [None, BOUNDS[case].ravel().tolist(), None], pa.list_(pa.float64()))
    assert main(["score", str(folder)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"estimator: {path}: row 1.{column}")
    assert error.count("\n") == 1


@pytest.mark.parametrize("length", [0, 3, 8, 10])
def test_a_matrix_of_another_size_is_refused(folder: Path, capsys: pytest.CaptureFixture[str], length: int) -> None:
    change_column(folder / "truth.parquet", "bound_m2", [[1e-6] * length] * 3, pa.list_(pa.float64()))
    assert main(["score", str(folder)]) == 2
    assert "truth.parquet: row 0.bound_m2: Tuple should have at" in capsys.readouterr().err


def test_valid_covariances_are_read(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two of three frames have a bound, one a covariance."""
    bounds = [GOOD_BOUND.ravel().tolist(), None, GOOD_BOUND.ravel().tolist()]
    change_column(folder / "truth.parquet", "bound_m2", bounds, pa.list_(pa.float64(), 9))
    change_column(folder / "estimates/pnp.parquet", "covariance_m2", [bounds[0], None, None], pa.list_(pa.float64()))
    assert main(["score", str(folder), "--json"]) == 0
    (pnp,) = [v for v in json.loads(capsys.readouterr().out)["variants"] if v["variant"] == "pnp"]
    assert pnp["against_bound"]["frames"] == 2
    assert pnp["against_bound"]["bound_rms_m"] == pytest.approx(6e-6**0.5)
    assert pnp["nees"]["frames"] == 1


def first_frame(scores: dict[str, Any]) -> dict[str, Any]:
    """Of a variant that answered it."""
    (pnp,) = [variant for variant in scores["variants"] if variant["variant"] == "pnp"]
    row: dict[str, Any] = pnp["rows"][0]
    return row


SCORES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "not an object": lambda s: [],
    "no version": lambda s: {},
    "a version to come": lambda s: s | {"version": 6},
    "another format": lambda s: s | {"format": "x"},
    "no room": lambda s: s | {"room_m": [0, 1, 1]},
    "frames out of order": lambda s: s["variants"][0]["rows"].reverse(),
    "frames of one variant short": lambda s: s["variants"][1]["rows"].pop(),
    "ok without an error": lambda s: first_frame(s).update(error_3d_m=None),
    "failed with an error": lambda s: first_frame(s).update(status="failed"),
    "a negative error": lambda s: first_frame(s).update(error_3d_m=-1.0),
    "success rate of 2": lambda s: s["variants"][0].update(success_rate=2.0),
}


@pytest.mark.parametrize("case", SCORES)
def test_scores_against_their_format_are_refused(folder: Path, capsys: pytest.CaptureFixture[str], case: str) -> None:
    path = folder / "scores.json"
    content = json.loads(path.read_text())
    result = SCORES[case](content)
    path.write_text(json.dumps(content if result is None or not isinstance(result, (dict, list)) else result))
    assert main(["report", str(folder), "--out", str(folder / "x.html")]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"estimator: {path}: ")
    assert error.count("\n") == 1


def test_scores_of_an_older_version_are_computed_again(folder: Path) -> None:
    path = folder / "scores.json"
    path.write_text('{"format": "estimator-scores", "version": 3}')
    assert main(["report", str(folder), "--out", str(folder / "x.html")]) == 0
    assert json.loads(path.read_text())["version"] == 5


def test_a_missing_row_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / "estimates/pnp.parquet"
    pq.write_table(pq.read_table(path).slice(0, 2), path)
    assert main(["score", str(folder)]) == 2
    assert "2 rows, needed one for each of the 3 frames, in order" in capsys.readouterr().err


def test_a_position_of_nan_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = folder / "estimates/pnp.parquet"
    positions = pq.read_table(path)["position_m"].to_pylist()
    change_column(path, "position_m", [[np.nan] * 3, *positions[1:]], pa.list_(pa.float64()))
    assert main(["score", str(folder)]) == 2
    assert "pnp.parquet: row 0.position_m.0: Input should be" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["a\nb", "\udcff"])
def test_a_file_s_name_that_cannot_be_printed_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    shutil.copy(folder / "estimates/pnp.parquet", folder / f"estimates/{name}.parquet")
    assert main(["score", str(folder)]) == 2
    error = capsys.readouterr().err
    assert "needed a name of printable characters" in error
    assert error.count("\n") == 1


def test_a_name_with_options_comes_back_from_disk(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = "huynh2016:denoise=none,ranges=as-printed"
    shutil.copy(folder / "estimates/pnp.parquet", folder / f"estimates/{name}.parquet")
    assert main(["compare", str(folder), "pnp", name, "--json"]) == 0
    pair = json.loads(capsys.readouterr().out)
    assert (pair["b"], pair["both"], pair["a_nearer"], pair["wilcoxon_p"]) == (name, 3, 0, None)


@pytest.mark.parametrize("name", ["", ".hidden", "../x", "a/b", "a b", "a\nb", "é", "x" * 201])
def test_a_name_that_no_file_should_have_is_not_written(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="the name becomes a file's; allowed: at most 200 of A-Z"):
        write_estimates(tmp_path, name, [])
    assert list(tmp_path.iterdir()) == []
