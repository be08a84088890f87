"""Scripts that no other test runs (benchmarks, figures of the documents, damage) import what the packages have."""

import ast
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
from conftest import ROOT

SCRIPTS = [path for folder in ("benchmarks", "docs", "tests/damage") for path in sorted((ROOT / folder).glob("*.py"))]


def is_there(module: str, name: str) -> bool:
    """Whether a module has a name, or a package a module of that name."""
    found = import_module(module)
    return hasattr(found, name) or (hasattr(found, "__path__") and find_spec(f"{module}.{name}") is not None)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_what_a_script_imports_of_the_packages_is_there(path: Path) -> None:
    imported = [
        (node.module, one.name)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module
        for one in node.names
    ]
    of_packages = [one for one in imported if one[0].partition(".")[0] in ("vlcrender", "estimator")]
    assert [one for one in of_packages if not is_there(*one)] == []
