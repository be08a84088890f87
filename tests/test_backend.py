"""LLVM: the right one is found, and a machine that has only 14 and 15 is told what to install."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from vlcrender.core import backend
from vlcrender.errors import InputError


def test_the_library_in_use_is_new_enough() -> None:
    assert backend.llvm_version(Path(os.environ["DRJIT_LIBLLVM_PATH"])) >= 17
    assert backend.dr.detail.llvm_version()[0] >= 17


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
    code = "from vlcrender.errors import InputError\ntry:\n import vlcrender.core.backend as b; print(b.VARIANT)\n"
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
            assert Path(path).resolve() != Path(os.environ["DRJIT_LIBLLVM_PATH"]).resolve()
