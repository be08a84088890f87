"""Mitsuba and Dr.Jit in one variant, with an LLVM library that Dr.Jit 1.5 can use (17 or newer).

Every other module imports `mi` and `dr` from here. `mi` is Mitsuba's namespace in the variant of this package. It
does not depend on `mitsuba.set_variant`, which is one setting for the whole process: this module neither reads nor
changes it, so a program may use Mitsuba in a variant of its own beside this package, in any thread.

With an LLVM older than 17 trivial kernels pass and real ones end the process. So this module finds a library that is
new enough before Dr.Jit is imported, and checks which one Dr.Jit has loaded. If a program has imported Dr.Jit before,
with an older one, Dr.Jit is restarted, or refused if it has been used. The environment variable DRJIT_LIBLLVM_PATH is
set only while Dr.Jit loads LLVM.

The environment variable VLCRENDER_VARIANT may choose CUDA. CUDA kernels round in other places and OptiX casts the
rays, not Embree: results differ from LLVM's in the last bits, so a dataset is the same bit for bit only if one
variant made all of it. On one NVIDIA H200, 70 of 24.8 million digital numbers of five frames (three of office200, one
each of quickstart and fisheye) differ from LLVM's; expected images of two views differ by 2e-4 of the shot noise's
standard deviation (RMS), by 0.14 in the worst pixel. All other figures in this project were measured with LLVM.
"""

import ctypes
import importlib.util
import os
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vlcrender.errors import InputError

MITSUBA_VARIANTS = ("llvm_ad_mono", "cuda_ad_mono")
"""The default comes first. Monochromatic variants pass numbers unchanged, so that a film holds cd/m2."""
MIN_LLVM = 17
SYSTEM_FOLDERS = ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/opt/homebrew/opt/llvm/lib", "/usr/local/opt/llvm/lib")


def llvm_version(library: Path) -> int:
    """Major version that a libLLVM reports; 0 if it cannot be loaded, or has no such function (older than 16)."""
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
    """The LLVM library to use. Raises InputError with what to install if there is none."""
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
        # A library whose name has an old version is not loaded at all: loading it may crash.
        if (_number_in(path.name) or MIN_LLVM) >= MIN_LLVM and llvm_version(path) >= MIN_LLVM:
            return path
    found = f"found only {', '.join(sorted(set(seen)))}" if seen else "none was found"
    raise InputError(
        f"LLVM {MIN_LLVM} or newer is needed ({found}): install karellen-llvm-core with pip (x86-64 Linux) "
        f"or libllvm19 with apt, or point DRJIT_LIBLLVM_PATH at libLLVM"
    )


def chosen_variant() -> str:
    """The value of VLCRENDER_VARIANT, by default the first of MITSUBA_VARIANTS. Raises InputError for any other."""
    variant = os.environ.get("VLCRENDER_VARIANT") or MITSUBA_VARIANTS[0]
    if variant not in MITSUBA_VARIANTS:
        raise InputError(f"VLCRENDER_VARIANT={variant}: allowed are {', '.join(MITSUBA_VARIANTS)}")
    return variant


@contextmanager
def _environment(name: str, value: str) -> Iterator[None]:
    """Set an environment variable and put its former value back."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


def _import_drjit(variant: str) -> Any:
    """Dr.Jit with what the variant needs: an LLVM that is new enough, or CUDA. Raises InputError without it."""
    if not variant.startswith("llvm"):
        import drjit

        if not drjit.has_backend(drjit.JitBackend.CUDA):
            raise InputError(
                f"VLCRENDER_VARIANT={variant}: Dr.Jit finds no CUDA device and driver; unset it to render on the "
                f"processor"
            )
        return drjit
    if "drjit" in sys.modules:
        import drjit

        if _llvm_in_use(drjit) < MIN_LLVM and not _restarted(drjit, find_llvm()):
            _refuse_llvm(_llvm_in_use(drjit))
        return drjit
    with _environment("DRJIT_LIBLLVM_PATH", str(find_llvm())):
        import drjit  # loads LLVM, once a process, in a thread of its own

        found = _llvm_in_use(drjit)
    if found < MIN_LLVM:
        _refuse_llvm(found)
    return drjit


def _llvm_in_use(drjit: Any) -> int:
    """Major version of the LLVM that Dr.Jit has loaded, negative without one."""
    drjit.has_backend(drjit.JitBackend.LLVM)  # waits for Dr.Jit's search for LLVM; the next call does not
    return int(drjit.detail.llvm_version()[0])


def _restarted(drjit: Any, library: Path) -> bool:
    """Restart Dr.Jit with another LLVM if nothing in this process has used Dr.Jit yet; whether that was possible.

    A program that has imported Mitsuba for a scalar variant has loaded any LLVM that the system has, and not used it.
    """
    if any(name.startswith(("mitsuba.llvm_", "mitsuba.cuda_")) for name in sys.modules):
        return False
    try:
        core = ctypes.CDLL(str(Path(drjit.__file__).parent / "libdrjit-core.so"))
        whos, shutdown, init = core._Z12jit_var_whosv, core._Z12jit_shutdowni, core._Z8jit_initj
    except (OSError, AttributeError):
        return False  # another platform or version, whose names differ
    whos.restype = ctypes.c_char_p
    if b"Variables created : 0 " not in whos():
        return False
    shutdown(0)
    with _environment("DRJIT_LIBLLVM_PATH", str(library)):
        init(sum(1 << backend.value for backend in (drjit.JitBackend.CUDA, drjit.JitBackend.LLVM)))
    return _llvm_in_use(drjit) >= MIN_LLVM


def _refuse_llvm(loaded: int) -> None:
    """Raise InputError: another import of Dr.Jit or Mitsuba has chosen an LLVM that is too old."""
    found = f"LLVM {loaded}" if loaded > 0 else "no LLVM"
    raise InputError(
        f"Dr.Jit was imported before vlcrender and uses {found}; {MIN_LLVM} or newer is needed: start Python with "
        f"DRJIT_LIBLLVM_PATH={find_llvm()}, or render once before importing mitsuba"
    )


class _Mitsuba:
    """Mitsuba's namespace in one variant, whatever `mitsuba.set_variant` says.

    `mitsuba.NAME` is looked up in the module of the current variant, in the compiled module that all variants share,
    or in Mitsuba's Python files, which refer to the current variant themselves. Here the first is the module of
    `variant`, and the Python functions are those of a copy of `mitsuba.python.util` that refers to this object.
    """

    def __init__(self, variant: str) -> None:
        """Load the variant. The current variant is neither read nor changed."""
        import mitsuba
        from mitsuba import mitsuba_ext, parser

        self._variant = variant
        self._parser = parser
        self._modules = (getattr(mitsuba, variant), mitsuba_ext)
        spec = importlib.util.find_spec("mitsuba.python.util")
        assert spec is not None
        assert spec.loader is not None
        functions = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(functions)
        vars(functions)["mi"] = self  # its global name for Mitsuba
        self.traverse = functions.traverse
        self.render = functions.render
        self.SceneParameters = functions.SceneParameters

    def __getattr__(self, name: str) -> Any:
        """A name of the variant, or one that all variants share."""
        for module in self._modules:
            if hasattr(module, name):
                value = getattr(module, name)
                setattr(self, name, value)
                return value
        raise AttributeError(f"mitsuba in variant {self._variant} has no {name}")

    def variant(self) -> str:
        """The variant's name."""
        return self._variant

    def load_dict(self, tree: Mapping[str, Any], parallel: bool = True, optimize: bool = True) -> Any:
        """`mitsuba.load_dict` in this variant."""
        config = self._parser.ParserConfig(self._variant)
        config.parallel, config.merge_equivalent, config.merge_meshes = parallel, optimize, optimize
        state = self._parser.parse_dict(config, dict(tree))
        self._parser.transform_all(config, state)
        return self._parser.instantiate(config, state)


MITSUBA_VARIANT = chosen_variant()
if TYPE_CHECKING:
    import drjit as dr
    import mitsuba as mi
else:
    dr = _import_drjit(MITSUBA_VARIANT)
    mi = _Mitsuba(MITSUBA_VARIANT)


def exact_math() -> AbstractContextManager[None]:
    """Scope in which kernels give the same bits on every SIMD width. Dr.Jit's flags hold for one thread only."""
    scope: AbstractContextManager[None] = dr.scoped_set_flag(dr.JitFlag.FastMath, False)
    return scope


def empty_image(shape: tuple[int, int]) -> NDArray[np.float32]:
    """An image (rows, columns) of any numbers, in memory that Dr.Jit keeps and lends again.

    New pages of the system, which it clears, would cost several times what arithmetic on the image does.
    """
    if not MITSUBA_VARIANT.startswith("llvm"):  # memory of a GPU
        return np.empty(shape, dtype=np.float32)
    image: NDArray[np.float32] = dr.empty(mi.Float, shape[0] * shape[1]).numpy().reshape(shape)
    return image


__all__ = ["dr", "empty_image", "exact_math", "find_llvm", "llvm_version", "mi"]
