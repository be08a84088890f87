"""The wheel holds the scenes, the recipes, the templates and the types, and works from an empty folder."""

import os
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest
from conftest import ROOT
from hatchling.builders.wheel import WheelBuilder

from vlcrender.config.packaged import packaged_folder
from vlcrender.core.backend import find_llvm

PACKAGED = "vlcrender/config/packaged_files"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("wheel")
    return Path(next(WheelBuilder(str(ROOT)).build(directory=str(directory), versions=["standard"])))


def test_the_wheel_holds_scenes_recipes_format_templates_and_types(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        for folder, kinds in {"scenes": (".toml", ".png"), "datasets": (".toml", ".md")}.items():
            files = [path for path in (ROOT / folder).iterdir() if path.is_file()]
            assert {path.suffix for path in files} == set(kinds)  # a file of another kind: has it to be in the wheel?
            for path in files:
                assert archive.read(f"{PACKAGED}/{folder}/{path.name}") == path.read_bytes()
    templates = ("estimator/report/report", "vlcrender/emva1288/page", "vlcrender/report/page")
    assert {f"{name}.{kind}" for name in templates for kind in ("html", "css")} <= names
    assert {"vlcrender/py.typed", "estimator/py.typed", "vlcrender/api.py"} <= names
    assert {name.split("/")[0].split("-")[0] for name in names} == {"vlcrender", "estimator"}


def test_an_editable_install_holds_no_copies(tmp_path: Path) -> None:
    """Scenes and recipes of a checkout are those of its top folders."""
    editable = next(WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["editable"]))
    with zipfile.ZipFile(editable) as archive:
        (path_file,) = (name for name in archive.namelist() if ".dist-info/" not in name)
        assert Path(archive.read(path_file).decode().strip()).resolve() == ROOT
    assert packaged_folder("scene") == ROOT / "scenes"


def test_the_wheel_and_the_citation_name_the_same_authors_and_version(wheel: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    with zipfile.ZipFile(wheel) as archive:
        metadata = archive.read(f"vlcrender-{project['version']}.dist-info/METADATA").decode()
    assert "Author: the vlcrender developers\n" in metadata
    assert "Project-URL" not in metadata
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"version: {project['version']}\n" in citation
    assert "- name: the vlcrender developers\n" in citation
    assert f"license: {project['license']}\n" in citation
    assert "://" not in citation


@pytest.mark.slow
def test_an_installed_wheel_works_from_an_empty_folder(wheel: Path, tmp_path: Path) -> None:
    """In an environment of its own, whose dependencies alone, LLVM among them, are those of the running one."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)
    programs = tmp_path / "venv/bin"
    pip = [sys.executable, "-m", "pip", "--python", programs / "python", "--disable-pip-version-check", "--quiet"]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    subprocess.run([*pip, "install", "--no-index", "--no-deps", wheel], check=True, env=environment)
    # After the installation, or pip would take vlcrender for installed. A path in a .pth file brings the packages below
    # it, and not what its own .pth files bring: an editable vlcrender is not among them.
    (here,) = (tmp_path / "venv").glob("lib/python*/site-packages")
    (here / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    empty = tmp_path / "empty"
    empty.mkdir()
    environment["DRJIT_LIBLLVM_PATH"] = str(find_llvm())

    def run(*command: str) -> str:
        done = subprocess.run(
            [programs / command[0], *command[1:]], cwd=empty, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    place = run("python", "-c", "import vlcrender, estimator; print(vlcrender.__file__, estimator.__file__)")
    assert place.split() == [str(here / name / "__init__.py") for name in ("vlcrender", "estimator")]
    run("vlcrender", "generate", "quickstart", "--out", "q", "--set", "poses.count=1")
    assert "1 frames, all there" in run("vlcrender", "verify", "q")
    run("vlcrender", "show", "meeting_room", "--out", "room.png")  # its ceiling has a picture, packaged beside it
    run("estimator", "run", "q", "--variant", "pnp")
    run("estimator", "score", "q")
    assert sorted(path.name for path in empty.iterdir()) == ["q", "room.png"]
