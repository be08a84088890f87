"""What a set is made of: files of the scene and the program; nothing is mixed, and a difference is named."""

import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, small_plan
from PIL import Image

import vlcrender as vr
from vlcrender.core.program import program_sha256
from vlcrender.dataset.run.frame_job import Job, make_frames
from vlcrender.dataset.run.unfinished import _line, _record_of
from vlcrender.dataset.world.withheld import Seal
from vlcrender.scene.scene_files import scene_sources

CUBE = "v 3 3 0\nv 4 3 0\nv 4 4 0\nv 3 4 0\nv 3 3 {h}\nv 4 3 {h}\nv 4 4 {h}\nv 3 4 {h}\n" + "".join(
    f"f {face}\n" for face in ("1 4 3 2", "5 6 7 8", "1 2 6 5", "2 3 7 6", "3 4 8 7", "4 1 5 8")
)
XML = """<scene version="3.0.0"><default name="meshes" value="parts"/><include filename="shared.xml"/>
<shape type="obj"><string name="filename" value="$meshes/cube.obj"/></shape></scene>"""


def write_texture(path: Path, grey: int) -> None:
    Image.fromarray(np.full((4, 4), grey, dtype=np.uint8)).save(path)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A recipe with a scene of a textured floor and a cube."""
    text = (ROOT / "scenes/table1.toml").read_text().replace("{ floor = 0.2, ceiling", "{ ceiling", 1)
    texture = '[room.texture.floor]\nfile = "floor.png"\ntile_m = [1.0, 1.0]\n'
    furniture = '[[furniture]]\nfile = "cube.obj"\nreflectance = 0.5\n'
    bake = "[bake]\ntexel_m = 1.0\npaths = 16\n"
    (tmp_path / "room.toml").write_text("\n".join([text.split("[bake]")[0], texture, furniture, bake]))
    write_texture(tmp_path / "floor.png", 120)
    (tmp_path / "cube.obj").write_text(CUBE.format(h=0.5))
    return tmp_path


def plan(folder: Path) -> vr.Plan:
    here = ", ".join(f"{{ position_m = [1.0, 1.0, 0.05], yaw_deg = {yaw} }}" for yaw in (0, 30, 60))
    return small_plan(f"scene={json.dumps(str(folder / 'room.toml'))}", f"poses={{ kind = 'list', pose = [{here}] }}")


class Crash(Exception):
    pass


def interrupt(progress: vr.Progress) -> None:
    if progress.stage == "frames" and progress.done == 1:
        raise Crash


CHANGES: dict[str, Callable[[Path], object]] = {
    "floor.png": lambda folder: write_texture(folder / "floor.png", 121),
    "cube.obj": lambda folder: (folder / "cube.obj").write_text(CUBE.format(h=0.6)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CHANGES)
def test_a_file_edited_between_two_runs_is_refused_by_name(folder: Path, name: str) -> None:
    """Half made, and finished: the same command neither goes on nor calls the set complete."""
    out = folder / "set"
    with pytest.raises(Crash):
        vr.generate(plan(folder), out, progress=interrupt)
    before = (folder / name).read_bytes()
    CHANGES[name](folder)
    with pytest.raises(vr.InputError, match=rf"they differ in the file {name}, which was changed"):
        vr.generate(plan(folder), out)
    (folder / name).write_bytes(before)
    assert vr.generate(plan(folder), out)
    assert set(json.loads((out / "dataset.json").read_text())["provenance"]["sources"]) == {"cube.obj", "floor.png"}
    assert vr.generate(plan(folder), out) is False
    CHANGES[name](folder)
    with pytest.raises(vr.InputError, match=rf"another recipe, scene or version.* the file {name}, which was changed"):
        vr.generate(plan(folder), out)
    if name == "floor.png":
        return
    (out / "frames/000001.exr").write_bytes(b"x")
    with pytest.raises(vr.InputError, match="give the scene's folder with --scene-folder"):
        vr.repair(out)
    with pytest.raises(vr.InputError, match=r"cube.obj: is not the file that"):
        vr.repair(out, scene_folder=folder)
    (folder / name).write_bytes(before)
    assert vr.repair(out, scene_folder=folder) == ["frames/000001.exr: made again"]
    assert vr.verify(out) == []


@pytest.mark.slow
def test_a_file_edited_after_the_plan_is_refused_by_name(folder: Path) -> None:
    """The texture was read by the plan, the mesh is read later: both have to be those that the plan stated."""
    made = plan(folder)
    job = Job.of(made, folder / "set")
    CHANGES["cube.obj"](folder)
    with pytest.raises(vr.InputError, match=r"cube.obj: was changed while frames were made of it"):
        make_frames([(job, 0)])  # as a worker does
    with pytest.raises(vr.InputError, match=r"cube.obj: was changed while frames were made of it"):
        vr.generate(made, folder / "set")
    assert not list((folder / "set").glob("frames/*"))


def test_one_process_keeps_no_room_of_an_edited_file(folder: Path) -> None:
    """Keys of kept views and renderers hold the digests."""
    first = Job.of(plan(folder), folder / "a")
    write_texture(folder / "floor.png", 200)
    second = Job.of(plan(folder), folder / "a")
    assert first.scene_key != second.scene_key
    assert (first.scene_json, first.scene_folder) == (second.scene_json, second.scene_folder)


def test_the_files_of_a_mitsuba_scene_are_sources_with_those_that_they_include(folder: Path) -> None:
    (folder / "xml/parts").mkdir(parents=True)
    (folder / "xml/parts/cube.obj").write_text("v")
    (folder / "xml/shared.xml").write_text(
        '<scene version="3.0.0"><bsdf><string name="filename" value="a.png"/></bsdf></scene>'
    )
    (folder / "xml/a.png").write_bytes(b"a")
    (folder / "xml/unused.obj").write_bytes(b"b")
    (folder / "xml/desk.xml").write_text(XML)
    settings = plan(folder).scene.settings
    piece = settings.furniture[0].model_copy(update={"file": "xml/desk.xml"})
    found = scene_sources(settings.model_copy(update={"furniture": (piece,)}), folder)
    assert list(found) == ["floor.png", "xml/a.png", "xml/desk.xml", "xml/parts/cube.obj", "xml/shared.xml"]
    assert all(len(digest) == 64 for digest in found.values())


def test_another_program_does_not_go_on_but_takes_a_finished_set_for_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(Crash):
        vr.generate(small_plan(), tmp_path / "set", progress=interrupt)
    with monkeypatch.context() as changed:
        changed.setattr("vlcrender.dataset.run.unfinished.program_sha256", lambda: "0" * 64)
        with pytest.raises(vr.InputError, match="they differ in the program: the source of vlcrender was changed"):
            vr.generate(small_plan(), tmp_path / "set")
    assert vr.generate(small_plan(), tmp_path / "set")
    monkeypatch.setattr("vlcrender.dataset.run.unfinished.program_sha256", lambda: "0" * 64)
    assert vr.generate(small_plan(), tmp_path / "set") is False


def test_a_worker_with_another_program_makes_no_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = Job.of(small_plan(), tmp_path)
    assert job.program == program_sha256()
    monkeypatch.setattr("vlcrender.dataset.run.frame_job.program_sha256", lambda: "0" * 64)
    with pytest.raises(vr.InputError, match="a worker runs another program"):
        make_frames([(job, 0)])


def test_a_changed_setting_is_named_with_both_values(tmp_path: Path) -> None:
    with pytest.raises(Crash):
        vr.generate(small_plan(), tmp_path / "set", progress=interrupt)
    with pytest.raises(vr.InputError, match=r"they differ in recipe.camera.f_number: 2.2 there, 2.8 here"):
        vr.generate(small_plan("camera.f_number=2.8"), tmp_path / "set")


@pytest.fixture(scope="module")
def half(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two of three frames."""
    folder = tmp_path_factory.mktemp("half") / "set"

    def stop(progress: vr.Progress) -> None:
        if progress.stage == "frames" and progress.done == 2:
            raise Crash

    with pytest.raises(Crash):
        vr.generate(small_plan("expected=true"), folder, progress=stop)
    return folder


DAMAGES: dict[str, Callable[[Path], object]] = {
    "a byte 0xff in the journal": lambda d: _change(d / "journal.jsonl", 500, b"\xff"),
    "a digit in the journal": lambda d: _change_digit(d / "journal.jsonl"),
    "an expected image cut": lambda d: (d / "expected/000000.exr").write_bytes(b"\x76\x2f\x31\x01"),
    "another preview": lambda d: (d / "previews/000000.png").write_bytes((d / "previews/000001.png").read_bytes()),
}


def _change(path: Path, place: int, value: bytes) -> None:
    data = path.read_bytes()
    path.write_bytes(data[:place] + value + data[place + 1 :])


def _change_digit(path: Path) -> None:
    """A digit of the first frame's position: JSON as before."""
    data = path.read_bytes()
    place = data.index(b'"position_m":[') + 16
    _change(path, place, b"3" if data[place : place + 1] != b"3" else b"4")


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_unfinished_set_is_finished_as_if_nothing_had_happened(
    half: Path, rendered_set: Path, tmp_path: Path, damage: str
) -> None:
    """The frame of a damaged line or by-product is made again, the other is kept."""
    folder = tmp_path / "set"
    for path in half.rglob("*"):
        target = folder / path.relative_to(half)
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.is_file():
            target.write_bytes(path.read_bytes())
    DAMAGES[damage](folder)
    done: list[float] = []
    assert vr.generate(small_plan("expected=true"), folder, progress=lambda p: done.append(p.done))
    assert done[-3:] == [1, 2, 3]
    assert vr.verify(folder) == []
    for path in rendered_set.rglob("*"):
        if path.is_file() and path.name != "dataset.json":
            assert (folder / path.relative_to(rendered_set)).read_bytes() == path.read_bytes(), path


def test_each_changed_byte_of_a_line_is_noticed(half: Path) -> None:
    line = (half / "journal.jsonl").read_bytes().splitlines(keepends=True)[0]
    record = _record_of(line, None)
    assert record is not None
    for seal in (None, Seal(bytes(32))):
        line = _line(record, seal)
        assert _record_of(line, seal) == record
        for place in range(0, len(line), 7):
            assert _record_of(line[:place] + bytes([line[place] ^ 4]) + line[place + 1 :], seal) is None
        assert _record_of(line[:-9], seal) is None


def test_files_are_on_the_disk_before_their_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a power cut every frame of the journal has its files: file, folder, line, in this order."""
    events: list[str] = []
    sync = os.fsync

    def watched(descriptor: int) -> None:
        name = os.readlink(f"/proc/self/fd/{descriptor}").removeprefix(str(tmp_path))
        events.append(re.sub(r"\.[0-9a-f]{12}\.partial$", ".partial", name))
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    with pytest.raises(Crash):
        vr.generate(small_plan("expected=true"), tmp_path / "set", progress=interrupt)
    of_frame = events[events.index("/set/frames/000000.partial") :]
    assert of_frame[:7] == [
        *("/set/frames/000000.partial", "/set/frames"),
        *("/set/expected/000000.partial", "/set/expected"),
        *("/set/previews/000000.partial", "/set/previews"),
        "/set/journal.jsonl",
    ]
