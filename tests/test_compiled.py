"""Compiled loops: what they may call, and that they run wherever the package is installed."""

import ast
import builtins
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
import pytest

from estimator.compiled import compiled, compiled_sums

PACKAGE = Path(__file__).parent.parent / "estimator"
DECORATORS = {"compiled", "compiled_sums"}


def compiled_functions() -> Iterator[tuple[Path, ast.Module, ast.FunctionDef]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        module = ast.parse(path.read_text())
        for node in ast.walk(module):
            if isinstance(node, ast.FunctionDef):
                names = {one.id for one in node.decorator_list if isinstance(one, ast.Name)}
                if names & DECORATORS:
                    yield path, module, node


def test_compiled_functions_call_functions_of_their_own_module_alone() -> None:
    """Their machine code is kept on disk until their own file changes: functions of another would stay as they were.

    NumPy's and `math`'s are Numba's own.
    """
    found = list(compiled_functions())
    assert len(found) > 20
    for path, module, function in found:
        own = {
            node.name
            for node in module.body
            if isinstance(node, ast.FunctionDef)
            and DECORATORS & {one.id for one in node.decorator_list if isinstance(one, ast.Name)}
        }
        for call in (node for node in ast.walk(function) if isinstance(node, ast.Call)):
            if isinstance(call.func, ast.Name):
                assert call.func.id in own or hasattr(builtins, call.func.id), (path.name, function.name, call.func.id)


def test_compiled_functions_use_no_constant_of_another_module() -> None:
    """It would be compiled in, and stay as it was when the other file changes."""
    for path, module, function in compiled_functions():
        imported = {
            name.asname or name.name
            for node in module.body
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("estimator")
            for name in node.names
        }
        body = ast.Module(function.body, [])
        used = {node.id for node in ast.walk(body) if isinstance(node, ast.Name)}
        assert not used & imported, (path.name, function.name, used & imported)


def test_loops_run_where_nothing_can_be_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numba refuses to keep code where no folder can be written: it is compiled in each process then."""
    asked = []
    njit = numba.njit

    def without_folder(*function: object, **options: object) -> object:
        if function:
            return njit(*function, **options)
        asked.append(options.get("cache", False))
        if options.get("cache"):
            raise RuntimeError("cannot cache function: no locator available for file")
        return njit(**options)

    monkeypatch.setattr(numba, "njit", without_folder)

    def total(values: np.ndarray) -> float:
        result = 0.0
        for value in values:
            result += value
        return result

    assert compiled(total)(np.arange(4.0)) == 6.0
    assert asked == [True, False]


def test_loops_divide_as_numpy_does() -> None:
    def over(a: float, b: float) -> float:
        return a / b

    for decorator in (compiled, compiled_sums):
        assert decorator(over)(1.0, 0.0) == np.inf
        assert np.isnan(decorator(over)(0.0, 0.0))
