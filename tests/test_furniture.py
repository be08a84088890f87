"""Furniture: files that are refused, orientation, subdivision and reflectances of meshes."""

import logging
import re
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from test_path_traced import BOX, scene_of

from vlcrender.core.backend import mi
from vlcrender.core.warn_once import warn_once
from vlcrender.errors import InputError
from vlcrender.light.lightmap import bake
from vlcrender.scene.furniture import MAX_TRIANGLES, SHEET_M, furniture_meshes
from vlcrender.scene.mesh import Mesh

LED = {"id": 1, "position_m": [1.5, 1.5, 2.5], "radius_m": 0.02, "luminance_cd_m2": 20000.0}
HEAD = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
FACE = "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n"
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def xml(*shapes: str) -> str:
    return f"<scene version='3.0.0'>{''.join(shapes)}</scene>"


def mesh_xml(kind: str, file: str) -> str:
    return xml(f"<shape type='{kind}' id='chair'><string name='filename' value='{file}'/></shape>")


def serialized(vertices: list[list[float]], faces: list[list[int]]) -> bytes:
    """A file of Mitsuba's binary format, version 4: one mesh in single precision, compressed, and its place."""
    v, f = np.array(vertices, dtype=np.float32), np.array(faces, dtype=np.uint32)
    body = struct.pack("<I", 0x1000) + b"mesh\0" + struct.pack("<QQ", len(v), len(f)) + v.tobytes() + f.tobytes()
    return struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<QI", 0, 1)


TRIANGLE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
REFUSED: dict[str, tuple[str | bytes, str]] = {
    "noise.ply": (b"\x00\x01 not a mesh", "header: is no PLY header"),
    "noise.obj": (b"\xff\xfe v 0 0", "line 1: .* is no line of an OBJ mesh"),
    "empty.obj": ("", "has no triangle"),
    "points.obj": (OBJ, "has no triangle"),
    "flat.obj": ("v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "line 1: 'v 0 0': is no line of an OBJ mesh"),
    "text.xml": (
        b"<scene version='3.0.0'><shape type='cube' id='\xe4'/></scene>",
        "line 1: has the byte 0xe4, which is no UTF-8",
    ),
    "line.obj": ("v 0 0 0\nv 0.5 0 0\nv 1 0 0\nf 1 2 3\n", "has no triangle with an area"),
    "far.obj": ("v 0 0 0\nv 90 0 0\nv 0 90 0\nf 1 2 3\n", r"outside the room of \[3\.0, 3\.0, 2\.5\] m"),
    "nan.obj": ("v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "has vertices that are not finite"),
    "infinite.ply": (HEAD + FACE.replace("1 0 0", "inf 0 0") + "3 0 1 2\n", "has vertices that are not finite"),
    "index.obj": (OBJ + "f 1 2 9999999\n", "have a face index 9999999, out of range for 3 vertices"),
    "zero.obj": (OBJ + "f 1 0/1 2\n", "line 4: has a face index 0"),
    "behind.obj": (OBJ + "f 1 2 -9\n", "line 4: has a face index -9, out of range"),
    "index.ply": (HEAD + FACE + "3 0 1 99999999\n", "has a face index 99999999, out of range for 3 vertices"),
    "negative.ply": (HEAD + FACE + "3 0 1 -1\n", "has a face index -1, out of range for 3 vertices"),
    "ply.xml": (
        mesh_xml("ply", "index.ply"),
        "shape 'chair', line 1: file 'index.ply': face 0: has a face index 99999999",
    ),
    "obj.xml": (mesh_xml("obj", "index.obj"), "shape 'chair', line 1: file .* have a face index 9999999"),
    "serialized.xml": (
        mesh_xml("serialized", "index.serialized"),
        "shape 'chair', line 1: file .* face 0: has a face index 99999999",
    ),
    "lost.xml": (
        mesh_xml("ply", "nowhere.ply"),
        "shape 'chair', line 1: file 'nowhere.ply': no such file in the scene's folder",
    ),
    "broken.xml": ("<scene version='3.0.0'><shape", "line 1: is no XML: unclosed token"),
    "sphere.xml": (
        xml("<shape type='sphere' id='ball'/>"),
        "shape 'ball', line 1: type='sphere' is not supported; allowed are ply, obj, ser",
    ),
    "lamp.xml": (
        xml("<shape type='rectangle' id='lamp'><emitter type='area'/></shape>"),
        "line 1: <emitter type='area'> is not supported",
    ),
    "nothing.xml": (xml(), "holds no shape"),
    "mixed.obj": (BOX.replace("f 1 3 2\n", "f 1 2 3\n"), "is closed, but its triangles face outwards and inwards"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_furniture_that_cannot_be_used_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    for file in {name, "index.ply", "index.obj"}:
        content = REFUSED[file][0]
        (tmp_path / file).write_bytes(content if isinstance(content, bytes) else content.encode())
    (tmp_path / "index.serialized").write_bytes(serialized(TRIANGLE, [[0, 1, 99999999]]))
    scene = scene_of(tmp_path, led=[LED], furniture=[{"file": name, "position_m": [1.5, 1.5, 1.0]}])
    with pytest.raises(InputError, match=REFUSED[name][1]) as refusal:
        furniture_meshes(scene, 0)
    assert str(refusal.value).startswith(f"furniture[0].file = '{name}'")
    assert "\n" not in str(refusal.value)


def mesh_of(folder: Path, name: str, content: str | bytes, texel_m: float = 10.0, **piece: object) -> Mesh:
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    entry = {"file": name, "position_m": [1.5, 1.5, 1.0], **piece}
    (mesh,) = furniture_meshes(scene_of(folder, led=[LED], furniture=[entry], bake={"texel_m": texel_m}), 7)
    assert set(mesh.owners) == {7}
    return mesh


def triangles(mesh: Mesh) -> np.ndarray:
    return mesh.vertices_m[mesh.faces]


def volume_m3(mesh: Mesh) -> float:
    """By Gauss's theorem: positive where triangles run counter-clockwise as seen from outside."""
    a, b, c = np.moveaxis(triangles(mesh) - [1.5, 1.5, 1.0], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


def turned(obj: str) -> str:
    return re.sub(r"f (\d+) (\d+) (\d+)", r"f \1 \3 \2", obj)


def beside(obj: str, dx: float, dz: float) -> str:
    """A second body of eight vertices, moved."""
    vertices = re.findall(r"v (\S+) (\S+) (\S+)", obj)
    faces = re.findall(r"f (\d+) (\d+) (\d+)", obj)
    return "".join(f"v {float(x) + dx} {y} {float(z) + dz}\n" for x, y, z in vertices) + "".join(
        f"f {int(a) + 8} {int(b) + 8} {int(c) + 8}\n" for a, b, c in faces
    )


BODIES = {
    "outside out": (BOX, 0.02, 0),
    "inside out": (turned(BOX), 0.02, 12),
    "inside out, with a collapsed triangle": (turned(BOX) + "f 1 1 2\n", 0.02, 12),
    "one of two inside out": (BOX + beside(turned(BOX), 0.5, 0.0), 0.04, 12),
    "one on the other": (BOX + beside(BOX, 0.0, 0.1), 0.04, 0),
    "one on the other, inside out": (turned(BOX + beside(BOX, 0.0, 0.1)), 0.04, 24),
}


@pytest.fixture
def warnings(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    """Warnings that are logged from here on, those logged before among them."""
    warn_once.cache_clear()
    caplog.set_level(logging.WARNING)
    return caplog


@pytest.mark.parametrize("name", BODIES)
def test_closed_bodies_face_outwards_and_turning_them_is_told_once(
    tmp_path: Path, warnings: pytest.LogCaptureFixture, name: str
) -> None:
    """Boxes of 0.4 x 0.5 x 0.1 m: 0.02 m3 each, and positive."""
    content, volume, faces = BODIES[name]
    for _ in range(2):
        mesh = mesh_of(tmp_path, "boxes.obj", content)
        assert volume_m3(mesh) == pytest.approx(volume, rel=1e-9)
    told = [f"furniture[0].file = 'boxes.obj': is inside out; {faces} of"] if faces else []
    assert len(warnings.records) == len(told)
    assert all(line in warnings.text for line in told)


def test_an_open_mesh_is_a_sheet_with_light_on_both_sides(tmp_path: Path, warnings: pytest.LogCaptureFixture) -> None:
    """A board between lamp and floor: its upper side has the lamp's light, its lower side what the room reflects.

    Direct light of the lamp, 20 000 cd/m2 times 4 pi cm2 at 0.5 m, is 100 lx; the black room reflects nothing.
    """
    (tmp_path / "board.obj").write_text(OBJ + "f 1 3 2\n")
    room = {"size_m": [3.0, 3.0, 2.5], "reflectance": {"floor": 0.0, "ceiling": 0.0, "walls": 0.0}}
    piece = {"file": "board.obj", "position_m": [1.2, 1.2, 2.0], "reflectance": 0.0}
    light = bake(
        scene_of(tmp_path, led=[LED], room=room, furniture=[piece], bake={"texel_m": 2.0, "paths": 8}), tmp_path
    )
    board = light.mesh.faces[-2:].ravel()
    assert light.mesh.normals[board].tolist() == [[0.0, 0.0, -1.0]] * 3 + [[0.0, 0.0, 1.0]] * 3
    assert light.mesh.vertices_m[board, 2] == pytest.approx([2.0] * 3 + [2.0 + SHEET_M] * 3, abs=1e-12)
    assert (light.led_lux[board[:3]] == 0).all()
    nearest = np.linalg.norm(light.mesh.vertices_m[board[3:], :2] - 1.5, axis=1).argmin()
    assert light.led_lux[board[3:]][nearest] == pytest.approx(
        20000 * np.pi * 0.02**2 * 0.5**2 / (0.5**2 + 0.18) ** 2, rel=0.05
    )
    assert not warnings.records


BOTTOM = "f 1 3 2\nf 1 4 3\n"
TOP = "f 5 6 7\nf 5 7 8\n"


@pytest.mark.parametrize("left_out", [BOTTOM, TOP])
def test_an_open_box_is_the_same_whichever_way_its_triangles_run(tmp_path: Path, left_out: str) -> None:
    """Ten triangles facing outwards and ten inwards, SHEET_M apart."""
    box = BOX.replace(left_out, "")
    assert box != BOX
    meshes = [mesh_of(tmp_path, "box.obj", content) for content in (box, turned(box))]
    directions = []
    for mesh in meshes:
        assert len(mesh.faces) == 20
        away = ((mesh.vertices_m - [1.5, 1.5, 1.05]) * mesh.normals).sum(axis=1).reshape(20, 3)
        assert sorted((away > 0).all(axis=1)) == [False] * 10 + [True] * 10
        directions.append(sorted(mesh.normals[::3].round(9).tolist()))
    assert directions[0] == directions[1]


def test_furniture_without_light_is_told_by_name(tmp_path: Path, warnings: pytest.LogCaptureFixture) -> None:
    """A box in a larger black one bakes to 0 lx; the larger one does not."""
    (tmp_path / "box.obj").write_text(BOX)
    pieces = [
        {"file": "box.obj", "position_m": [1.5, 1.5, 1.0], "scale": 2.0, "reflectance": 0.0},
        {"file": "box.obj", "position_m": [1.5, 1.5, 1.05]},
    ]
    bake(scene_of(tmp_path, led=[LED], furniture=pieces, bake={"texel_m": 2.0, "paths": 8}), tmp_path)
    assert "furniture[1].file = 'box.obj': no light falls on" in warnings.text
    assert "furniture[0].file = 'box.obj': no light" not in warnings.text


PLY_BOX = (
    HEAD.replace("vertex 3", "vertex 8")
    + FACE.split("end_header")[0].replace("face 1", "face 12")
    + "end_header\n"
    + "".join(f"{x} {y} {z}\n" for x, y, z in re.findall(r"v (\S+) (\S+) (\S+)", BOX))
    + "".join(f"3 {int(a) - 1} {int(b) - 1} {int(c) - 1}\n" for a, b, c in re.findall(r"f (\d) (\d) (\d)", BOX))
)
UV_BOX = BOX.replace("f ", "vt 0 0\nf ", 1)
UV_BOX = re.sub(r"f (\d) (\d) (\d)", r"f \1/1 \2/1 \3/1", UV_BOX)
CUBE = (
    "<shape type='cube'><transform name='to_world'><scale x='0.2' y='0.25' z='0.05'/><translate z='0.05'/></transform>"
    "<bsdf type='diffuse'><rgb name='reflectance' value='0.25'/></bsdf></shape>"
)


@pytest.mark.parametrize(
    ("name", "content"), [("a.obj", BOX), ("a.obj", UV_BOX), ("a.ply", PLY_BOX), ("a.xml", xml(CUBE))]
)
def test_one_box_is_the_same_mesh_by_every_format(
    tmp_path: Path, warnings: pytest.LogCaptureFixture, name: str, content: str
) -> None:
    """Mitsuba's cube has four vertices of its own on each side; float32 at 1.5 m is 6e-8 m."""
    mesh = mesh_of(tmp_path, name, content, yaw_deg=90.0, reflectance=0.25)
    assert len(mesh.faces) == 12
    assert volume_m3(mesh) == pytest.approx(0.02, rel=1e-6)
    assert np.ptp(mesh.vertices_m, axis=0) == pytest.approx([0.5, 0.4, 0.1], abs=1e-6)
    assert mesh.albedo == pytest.approx(0.25, abs=1e-6)
    assert not warnings.records


def test_a_rectangle_and_a_serialized_mesh_of_mitsuba_are_taken(tmp_path: Path) -> None:
    """Sheets, of two sides each."""
    (tmp_path / "chair.serialized").write_bytes(serialized(TRIANGLE, [[0, 1, 2]]))
    assert mesh_of(tmp_path, "s.xml", mesh_xml("serialized", "chair.serialized")).areas_m2().sum() == pytest.approx(1.0)
    assert mesh_of(tmp_path, "r.xml", xml("<shape type='rectangle'/>")).areas_m2().sum() == pytest.approx(8.0)


def test_no_edge_is_longer_than_a_texel_and_nothing_is_lost(tmp_path: Path) -> None:
    """A wedge with long, thin and small triangles keeps area, volume, normals and the reflectance."""
    wedge = "v 0 0 0\nv 1.2 0 0\nv 0 0.07 0\nv 0 0 1.1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    whole, fine = (mesh_of(tmp_path, "wedge.obj", wedge, texel, reflectance=0.3) for texel in (10.0, 0.1))
    corners = triangles(fine)
    assert np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max() <= 0.1 * (1 + 1e-9)
    assert fine.areas_m2().sum() == pytest.approx(whole.areas_m2().sum(), rel=1e-12)
    assert volume_m3(fine) == pytest.approx(1.2 * 0.07 * 1.1 / 6, rel=1e-9)
    assert len(np.unique(fine.normals.round(9), axis=0)) == 4
    assert set(fine.albedo) == {0.3}
    # one vertex in place of each that triangles have in common: closed if every edge is run once each way
    _, shared = np.unique(fine.vertices_m.round(9), axis=0, return_inverse=True)
    faces = shared.ravel()[fine.faces]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert {tuple(edge) for edge in edges} == {tuple(edge[::-1]) for edge in edges}
    assert len({tuple(edge) for edge in edges}) == len(edges)


def test_reflectances_of_textured_triangles_are_those_in_their_middles(tmp_path: Path) -> None:
    """A checkerboard of 0.4 and 0.2, one square a triangle, is found again after subdivision."""
    board = (
        "<shape type='rectangle'><bsdf type='diffuse'><texture type='checkerboard' name='reflectance'>"
        "<rgb name='color0' value='0.4'/><rgb name='color1' value='0.2'/>"
        "<transform name='to_uv'><scale x='0.5' y='1'/></transform></texture></bsdf></shape>"
    )
    mesh = mesh_of(tmp_path, "board.xml", xml(board), 0.3)
    # the triangles' middles are at (u, v) = (1/3, 1/3) and (2/3, 2/3), the border of the squares at (1, 1/2)
    of_triangle = mesh.albedo[mesh.faces][:, 0].round(6)
    x, y = (triangles(mesh).mean(axis=1) - [1.5, 1.5, 1.0])[:, :2].T
    assert len(of_triangle) > 2
    assert np.array_equal(of_triangle, np.where(x + y < 0, 0.4, 0.2))


def test_a_shape_of_too_many_triangles_is_refused_before_it_is_made(tmp_path: Path) -> None:
    """200 squares of 2.9 m in texels of 1 cm: each triangle has 2^9 parts a side, 2^18, of which there are 400."""
    squares = "".join(
        f"v 0 0 {0.01 * i}\nv 2.9 0 {0.01 * i}\nv 2.9 2.9 {0.01 * i}\nv 0 2.9 {0.01 * i}\n" for i in range(200)
    )
    squares += "".join(f"f {4 * i + 1} {4 * i + 2} {4 * i + 3} {4 * i + 4}\n" for i in range(200))
    with pytest.raises(InputError, match=rf"some 1e\+08 triangles at bake\.texel_m = 0\.01; at most {MAX_TRIANGLES}"):
        mesh_of(tmp_path, "stack.obj", squares, 0.01, position_m=[0.0, 0.0, 0.0])


def test_subdivision_makes_about_as_many_triangles_as_expected(tmp_path: Path) -> None:
    """The estimate is exact where all edges are halved as often."""
    mesh = mesh_of(tmp_path, "one.obj", "v 0 0 0\nv 0.8 0 0\nv 0.4 0.69 0\nf 1 2 3\n", 0.101)
    assert len(mesh.faces) == 2 * 64  # a sheet


def test_meshes_of_a_mitsuba_file_are_looked_up_in_its_folder(tmp_path: Path) -> None:
    """From the XML file's folder, which may be below the scene's; Mitsuba's own search paths stay as they are."""
    (tmp_path / "chairs").mkdir()
    (tmp_path / "chairs/box.ply").write_text(PLY_BOX)
    before = str(mi.file_resolver())
    mesh = mesh_of(tmp_path, "chairs/box.xml", mesh_xml("ply", "box.ply"))
    assert volume_m3(mesh) == pytest.approx(0.02, rel=1e-6)
    assert str(mi.file_resolver()) == before


def test_a_piece_is_scaled_then_turned_counter_clockwise_then_moved(tmp_path: Path) -> None:
    """Seen from above a yaw of 90 deg takes x to y, and y to -x."""
    mesh = mesh_of(tmp_path, "corner.obj", "v 0 0 0\nv 200 0 0\nv 0 100 50\nf 1 2 3\n", yaw_deg=90.0, scale=0.001)
    expected = [[1.5, 1.5, 1.0], [1.5, 1.7, 1.0], [1.4, 1.5, 1.05]]
    assert sorted(mesh.vertices_m[:3].round(9).tolist()) == sorted(expected)


@pytest.mark.parametrize(("axis", "at_m"), [(0, -0.01), (1, -0.01), (2, -0.01), (0, 2.01), (1, 2.01), (2, 2.51)])
def test_a_piece_has_to_be_inside_the_room_on_every_side(tmp_path: Path, axis: int, at_m: float) -> None:
    """A triangle of 1 m in the room of 3 x 3 x 2.5 m, and 1 cm beyond its floor, ceiling or walls."""
    position = np.array([1.0, 1.0, 1.0])
    position[axis] = at_m
    with pytest.raises(InputError, match=r"outside the room of \[3\.0, 3\.0, 2\.5\] m"):
        mesh_of(tmp_path, "board.obj", OBJ + "f 1 2 3\n", position_m=position.tolist())


def test_triangles_keep_their_reflectances_where_others_are_left_out(tmp_path: Path) -> None:
    """The first triangle is collapsed, the second flat; the textures of the others tell left from right."""
    (tmp_path / "two.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0.5 0 0\nvt 0.25 0.25\nvt 0.75 0.25\n"
        "f 1/1 1/1 2/1\nf 1/1 4/1 2/1\nf 1/1 2/1 3/1\nv 0 0 1\nf 1/2 3/2 5/2\n"
    )
    board = (
        "<shape type='obj'><string name='filename' value='two.obj'/><bsdf type='diffuse'>"
        "<texture type='checkerboard' name='reflectance'><rgb name='color0' value='0.4'/>"
        "<rgb name='color1' value='0.2'/><transform name='to_uv'><scale x='1' y='0.5'/></transform>"
        "</texture></bsdf></shape>"
    )
    mesh = mesh_of(tmp_path, "two.xml", xml(board))
    of_triangle = {
        tuple(np.abs(normal).round(6).tolist()): float(albedo)
        for normal, albedo in zip(mesh.normals[mesh.faces[:, 0]], mesh.albedo[mesh.faces[:, 0]].round(6), strict=True)
    }
    assert of_triangle == {(0.0, 0.0, 1.0): 0.4, (1.0, 0.0, 0.0): 0.2}
