"""The architecture, read off the imports: who may import whom, and where each heavy library is used."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("vlcrender", "estimator")
MODULES = [path for package in PACKAGES for path in sorted((ROOT / package).glob("*.py"))]

LIBRARY_ROOMS = {
    "mitsuba": {"vlcrender/backend.py"},
    "drjit": {"vlcrender/backend.py"},
    "OpenEXR": {"vlcrender/dataset.py", "estimator/dataset.py"},
    "cv2": {"estimator"},
    "colour": {"vlcrender/photometry.py"},
    "colour_demosaicing": {"vlcrender/tone.py"},
    "PIL": {"vlcrender/texture.py", "vlcrender/tone.py"},
}
BACKEND_ROOMS = {
    *("backend", "background", "exposure", "furniture", "irradiance", "mitsuba_room"),
    *("obstacles", "philox", "poisson", "raycast", "reference", "render"),
}
"""Modules of vlcrender that may use Mitsuba, through `backend`."""


def imports_of(path: Path) -> set[str]:
    """Full names of the modules a file imports, also inside functions."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide who imports whom"
            names.add(node.module or "")
    return names


def local_imports(path: Path) -> set[str]:
    package = path.parent.name
    return {n.split(".")[1] for n in imports_of(path) if n.startswith(package + ".")}


@pytest.mark.parametrize("path", MODULES, ids=lambda p: f"{p.parent.name}/{p.name}")
def test_the_two_packages_do_not_import_each_other(path: Path) -> None:
    (other,) = set(PACKAGES) - {path.parent.name}
    assert not [name for name in imports_of(path) if name.split(".")[0] == other]


@pytest.mark.parametrize("path", MODULES, ids=lambda p: f"{p.parent.name}/{p.name}")
def test_heavy_libraries_stay_in_their_rooms(path: Path) -> None:
    place = f"{path.parent.name}/{path.name}"
    for name in imports_of(path):
        rooms = LIBRARY_ROOMS.get(name.split(".")[0])
        assert rooms is None or place in rooms or path.parent.name in rooms, f"{place} imports {name}"


def test_mitsuba_reaches_only_the_modules_that_render() -> None:
    users = {path.stem for path in MODULES if path.parent.name == "vlcrender" and "backend" in local_imports(path)}
    assert users <= BACKEND_ROOMS


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_run_one_way(package: str) -> None:
    graph = {path.stem: local_imports(path) for path in MODULES if path.parent.name == package}
    done: set[str] = set()
    while graph:
        free = [name for name, needs in graph.items() if not needs & graph.keys() - {name}]
        assert free, f"{package}: import cycle among {sorted(graph)}"
        for name in free:
            done.add(name)
            del graph[name]


@pytest.mark.parametrize("package", PACKAGES)
def test_the_design_document_shows_every_import(package: str) -> None:
    """docs/design.md says who imports whom; each line `module <- a, b` has to be what the code does."""
    written: dict[str, set[str]] = {}
    section = (ROOT / "docs/design.md").read_text().split(f"### {package}\n")[1].split("```")[1]
    for line in section.strip().splitlines():
        name, _, rest = line.partition("<-")
        written[name.split()[0]] = {item.strip() for item in rest.split(",") if item.strip()}
    actual = {
        path.stem: local_imports(path) - {"errors"}
        for path in MODULES
        if path.parent.name == package and path.stem not in ("__init__", "errors")
    }
    assert written == actual
