"""Shared fixtures: two scenes, a camera with a hundredth of the pixels, small datasets that are made once a session."""

import hashlib
import io
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from estimator_synthetic import small_dataset
from hypothesis import settings

import vlcrender as vr
from estimator.cli import main as estimator_main
from vlcrender.cli import main as vlcrender_main
from vlcrender.dataset.format.manifest import seal_dataset

os.environ.setdefault("VLCRENDER_CACHE", tempfile.mkdtemp(prefix="vlcrender-tests-"))
# No bake of an earlier run is taken, and processes that tests start share this one's.

settings.register_profile("alike", deadline=None, derandomize=True)
settings.register_profile("random", deadline=None)
settings.load_profile("alike")
# The same examples in every run, however slow; others by --hypothesis-profile=random.

ROOT = Path(__file__).parent.parent
SMALL = (
    *("camera.width_px=400", "camera.height_px=300", "camera.pixel_pitch_um=12.0"),
    *("exposure_s=1.6e-6", "poses.border_px=4.0"),
)
"""The quickstart camera with a hundredth of the pixels and the same electrons in each."""


@dataclass(frozen=True)
class Finished:
    """Result of a command line, in the words of subprocess.CompletedProcess."""

    returncode: int
    stdout: str
    stderr: str


def run(program: str, *arguments: str, cwd: Path = ROOT) -> Finished:
    """Call the command line `vlcrender` or `estimator` in this process, as its console script does."""
    out, err = io.StringIO(), io.StringIO()
    main = {"vlcrender": vlcrender_main, "estimator": estimator_main}[program]
    with chdir(cwd), redirect_stdout(out), redirect_stderr(err):
        try:
            code: object = main(arguments)
        except SystemExit as exit_:
            code = exit_.code
    assert code is None or isinstance(code, int), code
    return Finished(code or 0, out.getvalue(), err.getvalue())


def started(program: str, *arguments: str, environment: Mapping[str, str] | None = None) -> subprocess.Popen[str]:
    """Start a command line in a session of its own, as a terminal does, with stdout and stderr in one pipe.

    Background jobs of a shell ignore SIGINT and hand that down; the default is restored here, so that an interrupt is
    one however the tests were started.
    """
    code = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        f"from {program}.cli import main; sys.exit(main())"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        cwd=ROOT,
        env=environment,
    )


HANG_S = 600.0
"""Ends a test whose event never happens; no test waits for it on any machine that works."""


def wait_until(happened: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    """Wait for an event; fail where the process ends first."""
    end = time.monotonic() + HANG_S
    while not happened():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < end, "the event never happened"
        time.sleep(0.01)


def small_plan(*assignments: str) -> vr.Plan:
    """Three small frames of the quickstart recipe."""
    return vr.load_recipe(ROOT / "datasets/quickstart.toml", [*SMALL, "poses.count=3", *assignments])


def sealed(dataset: Path) -> Path:
    """A dataset with a new manifest and seal, after its files were changed on purpose."""
    seal_dataset(dataset)
    return dataset


def copy_of(dataset: Path, to: Path) -> Path:
    """A copy of a shared dataset that a test may change; `to` may exist."""
    return Path(shutil.copytree(dataset, to, dirs_exist_ok=True))


@contextmanager
def unchanged(folder: Path) -> Iterator[Path]:
    """Fail at the end of the session if a test has changed a shared dataset."""

    def content() -> dict[Path, str]:
        return {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.rglob("*") if path.is_file()}

    before = content()
    yield folder
    assert content() == before, f"a test has changed the shared {folder}: it needs a copy"


@pytest.fixture(scope="session")
def rendered_set(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The dataset of `small_plan`, with expected images."""
    folder = tmp_path_factory.mktemp("rendered") / "set"
    assert vr.generate(small_plan("expected=true"), folder)
    with unchanged(folder):
        yield folder


@pytest.fixture(scope="session")
def rig_set(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Two shots of LED regions: `main` without distortion, and `left`, mounted beside it, with one."""
    distortion = "{ k1 = -0.05, k2 = 0.01, p1 = 1e-5, p2 = -2e-4 }"
    camera = f"{{ width_px = 320, height_px = 240, pixel_pitch_um = 12.0, distortion = {distortion} }}"
    left = f'[{{ name = "left", offset_m = [0.1, 0.02, 0.01], tilt_x_deg = 3.0, yaw_deg = 7.0, camera = {camera} }}]'
    folder = tmp_path_factory.mktemp("rig") / "set"
    plan = small_plan("poses.count=2", 'regions={ kind = "leds", margin_px = 2 }', f"rig={left}")
    assert vr.generate(plan, folder)
    with unchanged(folder):
        yield folder


@pytest.fixture(scope="session")
def synthetic_set(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Three frames with shot noise that the renderer has no part in."""
    with unchanged(small_dataset(tmp_path_factory.mktemp("synthetic") / "set")) as folder:
        yield folder


@pytest.fixture(scope="session")
def exact_synthetic_set(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The same three frames without noise."""
    with unchanged(small_dataset(tmp_path_factory.mktemp("exact") / "set", noise=False)) as folder:
        yield folder


@pytest.fixture(scope="session")
def scored_set(synthetic_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The synthetic frames with estimates of all variants, and scores."""
    folder = copy_of(synthetic_set, tmp_path_factory.mktemp("scored") / "set")
    for command in ("run", "score"):
        finished = run("estimator", command, str(folder))
        assert finished.returncode == 0, finished.stderr
    with unchanged(folder):
        yield folder


@pytest.fixture(scope="session")
def table1() -> vr.Scene:
    return vr.load_scene(ROOT / "scenes/table1.toml")


@pytest.fixture(scope="session")
def office() -> vr.Scene:
    return vr.load_scene(ROOT / "scenes/office.toml")


@pytest.fixture(scope="session")
def small_camera() -> vr.Camera:
    return vr.Camera(width_px=400, height_px=300, pixel_pitch_um=12.0)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.Generator(np.random.Philox(20161118))
