"""A dask cluster makes the same bytes as one process."""

from pathlib import Path

import pytest
from conftest import ROOT, SMALL
from distributed import LocalCluster

from vlcrender.core.digest import sha256_of
from vlcrender.dataset.generate import generate
from vlcrender.dataset.plan import load_plan
from vlcrender.errors import InputError


def digests(directory: Path) -> dict[str, str]:
    return {path.name: sha256_of(path) for path in sorted((directory / "frames").iterdir())}


@pytest.mark.slow
def test_the_threads_of_a_cluster_make_the_same_bytes(tmp_path: Path) -> None:
    """Worker threads: kernel settings are per thread in Dr.Jit. Worker processes are tested without dask."""
    plan = load_plan(ROOT / "datasets/quickstart.toml", [*SMALL, "poses.count=4"])
    generate(plan, tmp_path / "alone")
    with LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None, protocol="tcp"
    ) as cluster:
        generate(plan, tmp_path / "cluster", scheduler=cluster.scheduler_address)
    assert digests(tmp_path / "cluster") == digests(tmp_path / "alone")


def test_a_missing_scheduler_is_one_line(tmp_path: Path) -> None:
    plan = load_plan(ROOT / "datasets/quickstart.toml", [*SMALL, "poses.count=1"])
    with pytest.raises(InputError, match=r"^--scheduler nonsense://x: no answer from a scheduler: "):
        generate(plan, tmp_path / "set", scheduler="nonsense://x")
