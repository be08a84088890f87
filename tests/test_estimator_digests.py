"""Estimates belong to one dataset, by the digest of its frames; results of a dataset that cannot be written."""

import errno
import hashlib
import json
import os
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from conftest import copy_of, run, unchanged

import estimator as est
import estimator.evaluate.run
import estimator.io.lock
from estimator.errors import InputError
from estimator.io.estimates import read_estimates, write_estimates

COMMANDS = (("score",), ("report", "--out", "page.html"), ("compare", "pnp", "ml"), ("table", "--x", "tilt_deg"))


def refused(folder: Path, command: str, *options: str) -> str:
    """The one line of a command that is refused."""
    result = run("estimator", command, str(folder), *options)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.count("\n") == 1
    return result.stderr


def test_estimates_say_of_which_frames_they_are(scored_set: Path) -> None:
    digest = hashlib.sha256((scored_set / "frames.parquet").read_bytes()).hexdigest()
    for path in (scored_set / "estimates").iterdir():
        assert pq.read_metadata(path).metadata[b"frames_sha256"] == digest.encode()
    sources = json.loads((scored_set / "scores.json").read_text())["sources"]
    files = ["dataset.json", "frames.parquet", "truth.parquet"]
    files += [f"estimates/{path.name}" for path in (scored_set / "estimates").iterdir()]
    assert sources == {name: hashlib.sha256((scored_set / name).read_bytes()).hexdigest() for name in files}


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command[0])
def test_estimates_of_another_set_are_refused(
    scored_set: Path, exact_synthetic_set: Path, tmp_path: Path, command: tuple[str, ...]
) -> None:
    """As many frames of the same poses: nothing but the digest tells them apart. Older scores do not hide it."""
    folder = copy_of(exact_synthetic_set, tmp_path / "set")
    assert run("estimator", "run", str(folder), "--variant", "pnp", "--variant", "ml").returncode == 0
    assert run("estimator", "score", str(folder)).returncode == 0
    shutil.copy2(scored_set / "estimates/pnp.parquet", folder / "estimates/pnp.parquet")
    name, *options = command
    options = [str(tmp_path / one) if one.endswith(".html") else one for one in options]
    line = refused(folder, name, *options)
    assert f"{folder}/estimates/pnp.parquet: estimates of another dataset: frames_sha256 is " in line
    assert "run `estimator run` again" in line


def test_estimates_without_a_digest_are_refused(scored_set: Path, tmp_path: Path) -> None:
    folder = copy_of(scored_set, tmp_path)
    path = folder / "estimates/pnp.parquet"
    pq.write_table(pq.read_table(path).replace_schema_metadata(None), path)
    assert "does not say which frames it is of (no frames_sha256); run `estimator run` again" in refused(
        folder, "score"
    )
    assert len(read_estimates(path, 3)) == 3  # where the caller knows


def test_the_digest_is_that_of_the_frames_that_were_read(
    synthetic_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table is replaced while frames are estimated: the estimates are not of the new one."""
    folder = copy_of(synthetic_set, tmp_path)
    before = hashlib.sha256((folder / "frames.parquet").read_bytes()).hexdigest()

    def replace(done: int, _: int) -> None:
        if done == 1:
            pq.write_table(pq.read_table(folder / "frames.parquet"), folder / "frames.parquet", compression="gzip")

    est.run(folder, ["pnp"], progress=replace)
    assert pq.read_metadata(folder / "estimates/pnp.parquet").metadata[b"frames_sha256"] == before.encode()
    with pytest.raises(InputError, match="estimates of another dataset"):
        est.score(folder)


def test_a_set_whose_frames_are_gone_is_no_failure_of_a_variant(synthetic_set: Path, tmp_path: Path) -> None:
    folder = copy_of(synthetic_set, tmp_path)
    (folder / "frames/000001.exr").write_bytes(b"damaged")
    result = run("estimator", "run", str(folder), "--variant", "pnp")
    assert result.returncode == 2
    assert "1 of 3 frames could not be read; frame 1: frames/000001.exr: damaged or changed" in result.stderr
    assert (folder / "estimates/pnp.parquet").exists()
    shutil.rmtree(folder / "estimates")
    shutil.rmtree(folder / "frames")
    line = refused(folder, "run", "--variant", "pnp")
    assert f"{folder}: the files of all 3 frames are missing, the first frames/000000.exr; generate or copy" in line
    assert not (folder / "estimates").exists()


def test_results_of_a_set_that_is_only_read(synthetic_set: Path, tmp_path: Path) -> None:
    """All commands take the folder of results in place of the dataset; the estimates are those of the dataset."""
    out, relative = tmp_path / "new/results", os.path.relpath(synthetic_set)
    with unchanged(synthetic_set):
        ran = run(
            "estimator", "run", relative, "--variant", "pnp", "--variant", "ml", "--out", str(out), cwd=Path.cwd()
        )
        assert ran.returncode == 0, ran.stderr
        assert f"-> {out}/estimates/pnp.parquet" in ran.stdout
        for command, *options in COMMANDS:
            options = [str(tmp_path / one) if one.endswith(".html") else one for one in options]
            done = run("estimator", command, str(out), *options)
            assert done.returncode == 0, (command, done.stderr)
    assert sorted(path.name for path in out.iterdir()) == ["estimates", "results.json", "scores.json"]
    assert est.read_dataset(out).folder == synthetic_set
    own = copy_of(synthetic_set, tmp_path / "own")
    est.run(own, ["pnp"])
    tables = [pq.read_table(folder / "estimates/pnp.parquet").drop_columns(["time_s"]) for folder in (own, out)]
    assert tables[0].equals(tables[1], check_metadata=True)


def test_results_of_a_sweep(synthetic_set: Path, tmp_path: Path) -> None:
    sweep, out = tmp_path / "sweep", tmp_path / "results"
    cells = [{"folder": f"cells/{number:06d}", "pose": None, "values": {"x": number}} for number in range(2)]
    for cell in cells:
        copy_of(synthetic_set, sweep / str(cell["folder"]))
    content = {"format": "vlcrender-sweep", "version": 1, "name": "s", "sweep": [], "cells": cells, "provenance": {}}
    (sweep / "sweep.json").write_text(json.dumps(content))
    with unchanged(sweep):
        for command in (["run", str(sweep), "--variant", "pnp", "--out", str(out)], ["score", str(out)]):
            done = run("estimator", *command)
            assert done.returncode == 0, done.stderr
        assert run("estimator", "run", str(out), "--variant", "pnp").returncode == 0
    for cell in cells:
        assert (out / str(cell["folder"]) / "scores.json").is_file()


def test_a_folder_of_other_things_takes_no_results(
    synthetic_set: Path, exact_synthetic_set: Path, tmp_path: Path
) -> None:
    out, other = tmp_path / "out", tmp_path / "other"
    est.run(exact_synthetic_set, ["pnp"], out=out)
    with unchanged(out):
        line = refused(synthetic_set, "run", "--out", str(out))
        assert f"{out}: holds results of {exact_synthetic_set}; choose another --out" in line
    other.mkdir()
    (other / "thesis.txt").write_text("years of work")
    assert f"{other}: neither empty nor results of {synthetic_set}" in refused(
        synthetic_set, "run", "--out", str(other)
    )
    (out / "results.json").write_text('{"format": "estimator-results", "version": 1, "dataset": "/nowhere"}')
    assert f"{out}/results.json: dataset '/nowhere': no such folder" in refused(out, "score")
    folder = copy_of(synthetic_set, tmp_path / "set")
    est.run(folder, ["pnp"], out=folder)
    assert (folder / "estimates/pnp.parquet").exists()
    assert not (folder / "results.json").exists()


def test_a_read_only_set_is_scored_and_its_estimates_have_another_place(
    scored_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Refusals of the system are played, since a superuser meets none of a folder's mode."""
    folder = copy_of(scored_set, tmp_path / "set")
    (folder / "scores.json").unlink()

    def read_only(*_: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    with unchanged(folder), monkeypatch.context() as patched:
        patched.setattr(estimator.io.lock, "_opened", lambda _: None)
        patched.setattr("estimator.evaluate.score.write_atomically", read_only)
        patched.setattr(estimator.evaluate.run.os, "access", lambda *_: False)
        scored = run("estimator", "score", str(folder))
        assert scored.returncode == 0
        assert scored.stderr == f"estimator: warning: {folder}/scores.json: not written: Read-only file system\n"
        assert "pnp" in scored.stdout
        line = refused(folder, "run", "--variant", "pnp")
        assert f"{folder}: cannot be written; choose another folder for the estimates with --out" in line


def test_rows_are_written_with_the_digest_of_their_folder(synthetic_set: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"frames.parquet: No such file"):
        write_estimates(tmp_path, "x", [])
