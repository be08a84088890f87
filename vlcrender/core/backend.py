"""Mitsuba and Dr.Jit with one variant, chosen once, and a usable LLVM found before the first kernel.

Dr.Jit 1.5 needs LLVM 17 or newer. With an older one trivial kernels pass and real ones end the process, so the version
is checked here. Everything else imports `mi` and `dr` from this module.

The environment variable VLCRENDER_VARIANT may choose CUDA. Its kernels round in other places and its rays are cast by
OptiX, not Embree: results differ from LLVM's in the last bits, so a dataset is the same bit for bit only where one
variant made all of it. No figure in this project was measured on a GPU.
"""

import ctypes
import os
import re
import sys
from contextlib import AbstractContextManager
from pathlib import Path

from vlcrender.errors import InputError

MITSUBA_VARIANTS = ("llvm_ad_mono", "cuda_ad_mono")
"""The first is taken where nothing is said. Monochromatic: numbers pass unchanged, so that a film holds cd/m2."""
MIN_LLVM = 17
SYSTEM_FOLDERS = ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/opt/homebrew/opt/llvm/lib", "/usr/local/opt/llvm/lib")


def llvm_version(library: Path) -> int:
    """Major version a libLLVM reports of itself; 0 where it cannot be loaded or is too old (< 16) to say."""
    try:
        loaded = ctypes.CDLL(str(library))
        numbers = [ctypes.c_uint() for _ in range(3)]
        loaded.LLVMGetVersion(*(ctypes.byref(number) for number in numbers))
    except (OSError, AttributeError):
        return 0
    return numbers[0].value


def candidates(prefix: Path, folders: tuple[str, ...] = SYSTEM_FOLDERS) -> list[Path]:
    """Shared LLVM libraries: the Python environment's own first, then the system's, newest name first."""
    own = sorted((prefix / "lib").glob("libLLVM[-.]*"))
    system: set[Path] = set()
    for folder in map(Path, folders):
        for pattern in ("libLLVM[-.]*", "*-linux-gnu/libLLVM[-.]*", "llvm-*/lib/libLLVM[-.]*"):
            system.update(folder.glob(pattern))
    newest = sorted(system, key=lambda path: (_number_in(path.name), path.name), reverse=True)
    return [path for path in own + newest if re.search(r"\.(so|dylib)(\.|$)", path.name)]


def _number_in(name: str) -> int:
    found = re.search(r"\d+", name)
    return int(found.group()) if found else 0


def find_llvm() -> Path:
    """The LLVM library to use. Raises InputError saying what to install where there is none."""
    chosen = os.environ.get("DRJIT_LIBLLVM_PATH")
    if chosen:
        version = llvm_version(Path(chosen))
        if version < MIN_LLVM:
            raise InputError(
                f"DRJIT_LIBLLVM_PATH={chosen}: is not a loadable LLVM {MIN_LLVM} or newer; "
                f"unset it, or install karellen-llvm-core (pip) or libllvm19 (Debian)"
            )
        return Path(chosen)
    seen = []
    for path in candidates(Path(sys.prefix)):
        seen.append(path.name)
        # Names lie less often than they crash: a library whose name says 14 is not loaded at all.
        if (_number_in(path.name) or MIN_LLVM) >= MIN_LLVM and llvm_version(path) >= MIN_LLVM:
            return path
    found = f"found only {', '.join(sorted(set(seen)))}" if seen else "none was found"
    raise InputError(
        f"LLVM {MIN_LLVM} or newer is needed ({found}): install karellen-llvm-core with pip (x86-64 Linux) "
        f"or libllvm19 with apt, or point DRJIT_LIBLLVM_PATH at libLLVM"
    )


def chosen_variant() -> str:
    """What VLCRENDER_VARIANT says, or the first of VARIANTS. Raises InputError for any other."""
    variant = os.environ.get("VLCRENDER_VARIANT") or MITSUBA_VARIANTS[0]
    if variant not in MITSUBA_VARIANTS:
        raise InputError(f"VLCRENDER_VARIANT={variant}: allowed are {', '.join(MITSUBA_VARIANTS)}")
    return variant


MITSUBA_VARIANT = chosen_variant()
if MITSUBA_VARIANT.startswith("llvm"):
    os.environ["DRJIT_LIBLLVM_PATH"] = str(find_llvm())

import drjit as dr  # noqa: E402  the path has to be set first
import mitsuba as mi  # noqa: E402

if MITSUBA_VARIANT.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
    raise InputError(
        f"VLCRENDER_VARIANT={MITSUBA_VARIANT}: no CUDA device and driver that Dr.Jit can use are found; "
        f"unset it to render on the processor"
    )
mi.set_variant(MITSUBA_VARIANT)


def exact_math() -> AbstractContextManager[None]:
    """Within it kernels give the same bits on every SIMD width. Dr.Jit's flags hold for one thread only."""
    scope: AbstractContextManager[None] = dr.scoped_set_flag(dr.JitFlag.FastMath, False)
    return scope


__all__ = ["dr", "exact_math", "find_llvm", "llvm_version", "mi"]
