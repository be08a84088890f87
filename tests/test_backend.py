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
from vlcrender.dataset.generate import generate
from vlcrender.dataset.recipe import load_plan
plan = load_plan(Path("datasets/quickstart.toml"), sys.argv[4:])
seen = []
generate(plan, out, workers, progress=lambda done, total: seen.append(variant == "unset" or mitsuba.variant()))
import mitsuba
print(json.dumps({
    "variant": mitsuba.variant(),
    "during": sorted({str(one) for one in seen}),
    "environment": dict(os.environ) == before,
    "float": variant == "unset" or mitsuba.Float.__module__,
    "digests": [hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted((out / "frames").iterdir())],
}))
"""


def beside(variant: str, workers: int, out: Path) -> dict[str, object]:
    """Generate two small frames in a process that has set this variant of Mitsuba itself; what it then finds."""
    sets = [*SMALL, "poses.count=2"]
    llvm = {"DRJIT_LIBLLVM_PATH": str(backend.find_llvm())}  # as where the system's LLVM is new enough
    run = subprocess.run(
        [sys.executable, "-c", BESIDE, variant, str(workers), str(out), *sets],
        env={**os.environ, **llvm},
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    found: dict[str, object] = json.loads(run.stdout)
    return found


@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_rgb"])
def test_a_variant_that_the_user_has_set_stays_and_changes_no_bit(variant: str, tmp_path: Path) -> None:
    """Ours is never set at all: not during a frame, in a worker's process, or after."""
    alone = beside("unset", 1, tmp_path / "alone")
    assert alone["variant"] is None
    assert alone["environment"]
    there = beside(variant, 1, tmp_path / "set")
    assert there["variant"] == variant
    assert there["during"] == [variant]
    assert there["environment"]
    assert there["digests"] == alone["digests"]


def test_a_variant_set_in_one_thread_while_another_renders_changes_no_bit(tmp_path: Path) -> None:
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
    llvm = {"DRJIT_LIBLLVM_PATH": str(backend.find_llvm())}
    run = subprocess.run(
        [sys.executable, "-c", script, "unset", "1", str(tmp_path / "set"), *SMALL, "poses.count=2"],
        env={**os.environ, **llvm},
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout)["digests"] == beside("unset", 1, tmp_path / "alone")["digests"]


def test_an_old_llvm_that_another_import_has_loaded_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"has loaded LLVM 15; 17 or newer is needed.*DRJIT_LIBLLVM_PATH=/") as refusal:
        backend._check_llvm(15)
    assert "\n" not in str(refusal.value)
    backend._check_llvm(17)


def test_an_unknown_name_of_mitsuba_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="llvm_ad_mono has no nothing_of_this_name"):
        _ = backend.mi.nothing_of_this_name
