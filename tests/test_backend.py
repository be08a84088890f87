"""LLVM is found or refused with what to install; a program's own Mitsuba variant and environment stay as they are."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT, SMALL

from vlcrender.core import backend
from vlcrender.errors import InputError


def test_the_library_in_use_is_new_enough() -> None:
    assert backend.llvm_version(backend.find_llvm()) >= 17
    assert backend.dr.detail.llvm_version()[0] == backend.llvm_version(backend.find_llvm())


def test_names_are_ordered_newest_first(tmp_path: Path) -> None:
    for name in ("libLLVM-14.so.1", "libLLVM-19.so.1", "libLLVM-15.so", "libLLVM.a", "libLLVMSupport.so"):
        (tmp_path / name).write_bytes(b"")
    names = [path.name for path in backend.candidates(tmp_path / "none", (str(tmp_path),))]
    assert names == ["libLLVM-19.so.1", "libLLVM-15.so", "libLLVM-14.so.1"]


def test_a_machine_with_only_llvm_14_and_15_is_told_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("libLLVM-14.so.1", "libLLVM-15.so.1"):
        (tmp_path / name).write_bytes(b"")
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(backend, "candidates", lambda prefix: sorted(tmp_path.iterdir()))
    with pytest.raises(InputError, match=r"libLLVM-14.*libLLVM-15.*karellen-llvm-core.*libllvm19") as refusal:
        backend.find_llvm()
    assert "\n" not in str(refusal.value)


@pytest.mark.slow
def test_a_path_that_is_no_llvm_is_one_line_and_exit_code_2(tmp_path: Path) -> None:
    fake = tmp_path / "libLLVM-19.so"
    fake.write_bytes(b"not a library")
    command = [sys.executable, "-c", "import sys; sys.argv[0] = 'vlcrender'; from vlcrender.cli import main; main()"]
    run = subprocess.run(
        [*command, "show", "scenes/table1.toml", "--out", str(tmp_path / "x.png")],
        env={**os.environ, "DRJIT_LIBLLVM_PATH": str(fake)},
        cwd=Path(__file__).parent.parent,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 2
    assert run.stderr.count("\n") == 1
    assert str(fake) in run.stderr
    assert "17" in run.stderr


CUDA_HERE = backend.dr.has_backend(backend.dr.JitBackend.CUDA)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variant", "message"),
    [
        ("scalar_rgb", "VLCRENDER_VARIANT=scalar_rgb: allowed are llvm_ad_mono, cuda_ad_mono"),
        pytest.param(
            "cuda_ad_mono", "no CUDA device", marks=pytest.mark.skipif(CUDA_HERE, reason="there is a CUDA device")
        ),
    ],
)
def test_a_variant_that_cannot_be_used_is_one_line_and_exit_code_2(tmp_path: Path, variant: str, message: str) -> None:
    command = [sys.executable, "-c", "import sys; sys.argv[0] = 'vlcrender'; from vlcrender.cli import main; main()"]
    run = subprocess.run(
        [*command, "show", "scenes/table1.toml", "--out", str(tmp_path / "x.png")],
        env={**os.environ, "VLCRENDER_VARIANT": variant, "DRJIT_LIBLLVM_PATH": ""},
        cwd=Path(__file__).parent.parent,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 2
    assert run.stderr.count("\n") == 1
    assert message in run.stderr


def test_llvm_is_not_looked_for_where_another_variant_is_chosen(tmp_path: Path) -> None:
    """With an LLVM that cannot be loaded the refusal is CUDA's, or none where there is a CUDA device."""
    code = (
        "from vlcrender.errors import InputError\ntry:\n import vlcrender.core.backend as b; print(b.MITSUBA_VARIANT)\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", code + "except InputError as e:\n print(e)"],
        env={**os.environ, "VLCRENDER_VARIANT": "cuda_ad_mono", "DRJIT_LIBLLVM_PATH": str(tmp_path / "none.so")},
        cwd=Path(__file__).parent.parent,
        capture_output=True,
        text=True,
    )
    assert "LLVM" not in run.stdout
    assert "cuda_ad_mono" in run.stdout


@pytest.mark.skipif(shutil.which("ldconfig") is None, reason="asks ldconfig which LLVMs the system has")
def test_system_libraries_older_than_17_are_never_chosen() -> None:
    listing = subprocess.run(["ldconfig", "-p"], capture_output=True, text=True).stdout
    old = [line.split("=>")[1].strip() for line in listing.splitlines() if "libLLVM-1" in line]
    for path in old:
        if backend.llvm_version(Path(path)) < 17:
            assert Path(path).resolve() != backend.find_llvm().resolve()


BESIDE = """
import hashlib, json, os, sys, threading
from pathlib import Path
before = dict(os.environ)
variant, workers, out = sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])
if variant != "unset":
    import mitsuba
    mitsuba.set_variant(variant)
from vlcrender.dataset.run.generate import generate
from vlcrender.dataset.recipe.plan import load_plan
plan = load_plan(Path("datasets/quickstart.toml"), sys.argv[4:])
seen = []
generate(plan, out, workers, progress=lambda report: seen.append(variant == "unset" or mitsuba.variant()))
import mitsuba
print(json.dumps({
    "variant": mitsuba.variant(),
    "during": sorted({str(one) for one in seen}),
    "environment": dict(os.environ) == before,
    "float": variant == "unset" or mitsuba.Float.__module__,
    "digests": [hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted((out / "frames").iterdir())],
}))
"""


def beside(variant: str, workers: int, out: Path, llvm: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Generate two small frames in a process that has set this variant of Mitsuba itself."""
    environment = {key: value for key, value in os.environ.items() if key != "DRJIT_LIBLLVM_PATH"}
    return subprocess.run(
        [sys.executable, "-c", BESIDE, variant, str(workers), str(out), *SMALL, "poses.count=2"],
        env={**environment, **({} if llvm is None else {"DRJIT_LIBLLVM_PATH": str(llvm)})},
        cwd=ROOT,
        capture_output=True,
        text=True,
    )


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    run = beside("unset", 1, tmp_path_factory.mktemp("alone") / "set")
    assert run.returncode == 0, run.stderr
    found: dict[str, object] = json.loads(run.stdout)
    assert found["variant"] is None
    assert found["environment"]
    return found


@pytest.fixture(scope="module")
def own_llvm() -> int:
    """The LLVM that Dr.Jit chooses where nothing is said, as in a program that imports Mitsuba first."""
    code = "import drjit; drjit.has_backend(drjit.JitBackend.LLVM); print(drjit.detail.llvm_version()[0])"
    environment = {key: value for key, value in os.environ.items() if key != "DRJIT_LIBLLVM_PATH"}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    return int(run.stdout)


@pytest.mark.slow
@pytest.mark.parametrize(("variant", "workers"), [("scalar_rgb", 1), ("scalar_rgb", 2), ("llvm_ad_rgb", 1)])
def test_a_variant_that_the_user_has_set_stays_and_changes_no_bit(
    variant: str, workers: int, tmp_path: Path, alone: dict[str, object]
) -> None:
    """Ours is never set at all: not during a frame, in a worker's process, or after.

    A scalar variant works with whatever LLVM the system has; one that uses LLVM needs a new one itself.
    """
    run = beside(variant, workers, tmp_path / "set", None if variant == "scalar_rgb" else backend.find_llvm())
    assert run.returncode == 0, run.stderr
    there = json.loads(run.stdout)
    assert there["variant"] == variant
    assert there["during"] == [variant]
    assert there["environment"]
    assert there["digests"] == alone["digests"]


@pytest.mark.slow
def test_an_old_llvm_that_a_program_has_used_is_refused_in_one_line(tmp_path: Path, own_llvm: int) -> None:
    if not 0 < own_llvm < 17:
        pytest.skip("Dr.Jit finds no LLVM by itself here, or a new one")
    run = beside("llvm_ad_rgb", 1, tmp_path / "set")
    assert run.returncode == 1
    line = run.stderr.splitlines()[-1]
    assert f"uses LLVM {own_llvm}; 17 or newer is needed: start Python with DRJIT_LIBLLVM_PATH=/" in line


@pytest.mark.slow
def test_a_variant_set_in_one_thread_while_another_renders_changes_no_bit(
    tmp_path: Path, alone: dict[str, object]
) -> None:
    """The setting is one for all threads: threads of a dask worker share it with whatever else runs in the process."""
    code = """
import itertools, threading
import mitsuba
stop = threading.Event()
def switch():
    for variant in itertools.cycle(["scalar_rgb", "llvm_ad_rgb", "scalar_spectral"]):
        if stop.is_set():
            return
        mitsuba.set_variant(variant)
thread = threading.Thread(target=switch)
thread.start()
"""
    ended = "\nstop.set()\nthread.join()\n"
    script = code + BESIDE.replace("import mitsuba\nprint", ended + "print")
    llvm = {"DRJIT_LIBLLVM_PATH": str(backend.find_llvm())}  # two of the variants use it
    run = subprocess.run(
        [sys.executable, "-c", script, "unset", "1", str(tmp_path / "set"), *SMALL, "poses.count=2"],
        env={**os.environ, **llvm},
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout)["digests"] == alone["digests"]


def test_an_unknown_name_of_mitsuba_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="llvm_ad_mono has no nothing_of_this_name"):
        _ = backend.mi.nothing_of_this_name
