"""Sweeps are run and scored cell by cell, with the rows that each cell has by itself, by any number of processes."""

import json
from pathlib import Path

import pytest
from conftest import copy_of, run

import estimator as est
from estimator.io.estimates import EstimateRow

VARIANTS = ["pnp", "self-calibrated"]


@pytest.fixture(scope="module")
def sweep(synthetic_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three cells of the synthetic frames, of which the first lacks an image."""
    folder = tmp_path_factory.mktemp("sweep")
    cells = []
    for number in range(3):
        copy_of(synthetic_set, folder / f"cells/{number:06d}")
        cells.append({"folder": f"cells/{number:06d}", "pose": None, "values": {"sigma": float(number)}})
    (folder / "cells/000000/frames/000001.exr").unlink()
    swept = [{"name": "sigma", "key": "camera.sigma", "kind": "values"}]
    content = {"format": "vlcrender-sweep", "version": 1, "name": "swept", "sweep": swept, "cells": cells}
    (folder / "sweep.json").write_text(json.dumps(content | {"provenance": {}}))
    return folder


def without_times(rows: tuple[EstimateRow, ...]) -> list[str]:
    return [row.model_dump_json(exclude={"time_s"}) for row in rows]


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_cells_have_the_rows_of_each_by_itself(sweep: Path, tmp_path: Path, workers: int) -> None:
    folder = copy_of(sweep, tmp_path)
    calls: list[tuple[int, int]] = []
    rows = est.run(folder, VARIANTS, workers, lambda done, total: calls.append((done, total)))
    # Nine frames in two steps each, since a variant uses all frames of a device.
    assert calls == [(done, 18) for done in range(19)]
    alone = {
        name: without_times(of)
        for name, of in est.run(copy_of(sweep / "cells/000000", tmp_path / "one"), VARIANTS).items()
    }
    for name in VARIANTS:
        assert len(rows[name]) == 9
        assert without_times(rows[name])[:3] == alone[name]
        assert without_times(rows[name])[3:6] == without_times(rows[name])[6:]
        assert [row.reason.split(":")[0] for row in rows[name] if row.status == "failed"] == ["read"]
        for number in range(3):
            assert (folder / f"cells/{number:06d}/estimates/{name}.parquet").is_file()
    assert not (folder / "estimates").exists()


def test_run_and_score_print_the_sweep_as_a_whole(sweep: Path, tmp_path: Path) -> None:
    folder = copy_of(sweep, tmp_path)
    finished = run("estimator", "run", str(folder), "--variant", "pnp")
    assert finished.returncode == 2
    unread = f"{folder}: 1 of 9 frames could not be read; frame 1: frames/000001.exr: No such file or directory"
    assert finished.stderr.splitlines()[-1] == f"estimator: {unread}"
    assert finished.stdout == f"pnp: 8 of 9 frames ok -> the 3 cells of {folder}\n"
    finished = run("estimator", "score", str(folder))
    assert finished.returncode == 0, finished.stderr
    header, line, *note = finished.stdout.splitlines()
    assert header.split()[:3] == ["variant", "frames", "answered"]
    assert line.split()[:3] == ["pnp", "9", "8"]
    assert line.endswith("1 x read: frames/N.exr: No such file or directory")
    assert note[0].startswith("Statistics with their 95 % intervals.")
    for number in range(3):
        scores = json.loads((folder / f"cells/{number:06d}/scores.json").read_text())
        assert scores["variants"][0]["ok"] == (2 if number == 0 else 3)
    found = json.loads(run("estimator", "score", str(folder), "--json").stdout)
    assert (found["format"], found["rows"][0]["answered"]) == ("estimator-table", 8)


def test_a_cell_that_cannot_be_read_is_refused_before_a_frame_is_estimated(sweep: Path, tmp_path: Path) -> None:
    folder = copy_of(sweep, tmp_path)
    (folder / "cells/000002/frames.parquet").unlink()
    with pytest.raises(est.InputError, match=r"000002/frames.parquet: no such file"):
        est.run(folder, ["pnp"])
    assert not (folder / "cells/000000/estimates").exists()
