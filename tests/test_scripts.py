"""Scripts and lists that no other test runs (benchmarks, figures, damage, mutants) fit the packages as they are."""

import ast
import tomllib
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


MUTATION = ROOT / "tests/mutation"


@pytest.mark.parametrize("path", sorted(MUTATION.glob("chosen_*.toml")), ids=lambda path: path.stem)
def test_each_kept_mutant_is_one_change_of_its_file_as_it_is(path: Path) -> None:
    for entry in tomllib.loads(path.read_text(encoding="utf-8"))["mutant"]:
        source = (ROOT / entry["file"]).read_text(encoding="utf-8")
        assert source.count(entry["old"]) == 1, entry["name"]
        ast.parse(source.replace(entry["old"], entry["new"]))


@pytest.mark.parametrize("path", sorted(MUTATION.glob("equivalent_*.toml")), ids=lambda path: path.stem)
def test_each_change_without_effect_is_of_a_line_that_is_there(path: Path) -> None:
    for entry in tomllib.loads(path.read_text(encoding="utf-8"))["mutant"]:
        assert entry.get("line", "") in (ROOT / entry["file"]).read_text(encoding="utf-8"), entry
