"""Readers of meshes and of Mitsuba XML: every encoding, damaged files, what is refused by name."""

import random
import re
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from PIL import Image
from test_furniture import CUBE, FACE, HEAD, OBJ, TRIANGLE, UV_BOX, mesh_xml, serialized, xml

from vlcrender.errors import InputError
from vlcrender.scene.mesh_file import Triangles, read_mesh
from vlcrender.scene.mitsuba_xml import read_xml

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.5, 1.5, 0.25]])


def read(folder: Path, name: str, content: str | bytes, number: int = 0) -> Triangles:
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_mesh(folder / name, "mesh", number)


def ply(order: str, vertex: str = "f", uv: bool = False, index: str = "i") -> bytes:
    """A quadrilateral and a triangle, `order` < or > for binary of either byte order, empty for text."""
    names = {"f": "float", "d": "float64", "i": "int", "H": "uint16", "B": "uchar"}
    head = [
        "ply",
        f"format {'ascii' if not order else 'binary_little_endian' if order == '<' else 'binary_big_endian'} 1.0",
    ]
    head += ["comment made by a modeller", "element vertex 5", *(f"property {names[vertex]} {axis}" for axis in "xyz")]
    head += ["property float u", "property float v"] if uv else []
    head += ["element face 2", f"property list uchar {names[index]} vertex_index", "property uchar flags"]
    head += ["element edge 1", "property int vertex1", "end_header", ""]
    rows: list[tuple[str, tuple[float, ...]]] = []
    for x, y, z in SQUARE.tolist():
        rows.append((vertex * 3 + "ff" * uv, (x, y, z, *((x, 1 - y) if uv else ()))))
    rows += [("B" + 4 * index + "B", (4, 0, 1, 2, 3, 7)), ("B" + 3 * index + "B", (3, 3, 2, 4, 7)), ("i", (0,))]
    if order:
        body = b"".join(struct.pack(order + kinds, *numbers) for kinds, numbers in rows)
    else:
        body = "".join(" ".join(f"{number:g}" for number in numbers) + "\n" for _, numbers in rows).encode()
    return "\n".join(head).encode() + body


@pytest.mark.parametrize("order", ["", "<", ">"])
@pytest.mark.parametrize("vertex", ["f", "d"])
@pytest.mark.parametrize("index", ["i", "H", "B"])
def test_every_encoding_of_a_ply_is_the_same_mesh(tmp_path: Path, order: str, vertex: str, index: str) -> None:
    mesh = read(tmp_path, "a.ply", ply(order, vertex, index=index))
    assert np.array_equal(mesh.vertices, SQUARE)
    assert mesh.faces.tolist() == [[3, 2, 4], [0, 1, 2], [2, 3, 0]]
    assert mesh.uv is None


@pytest.mark.parametrize("order", ["", "<"])
def test_texture_coordinates_are_those_of_the_triangles_vertices(tmp_path: Path, order: str) -> None:
    square = read(tmp_path, "a.ply", ply(order, uv=True))
    assert square.uv is not None
    assert np.array_equal(square.uv, np.stack([SQUARE[:, 0], 1 - SQUARE[:, 1]], axis=1)[square.faces])
    obj = OBJ + "vt 0 0\nvt 0.5 0.25\nf 1/2 2/1 3/-1\n"
    found = read(tmp_path, "a.obj", obj).uv
    assert found is not None
    assert found.tolist() == [[[0.5, 0.25], [0.0, 0.0], [0.5, 0.25]]]
    assert read(tmp_path, "b.obj", obj + "f 1 2 3\n").uv is None


def test_an_obj_may_count_back_continue_lines_and_have_text_of_any_encoding(tmp_path: Path) -> None:
    """And a polygon is cut into a fan."""
    vertices = "".join(f"v {x} {y} {z} 0.1 0.2 0.3\r\n" for x, y, z in SQUARE.tolist())
    content = b"# B\xe4nke\no \xff\n" + (vertices + "vn 0 0 1\nf -5//1 -4//1 -3//1 \\\r\n-1//1 4//1 # end\n").encode()
    mesh = read(tmp_path, "a.obj", content)
    assert np.array_equal(mesh.vertices, SQUARE)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 4], [0, 4, 3]]
    assert read(tmp_path, "a.ply", ply("").replace(b"a modeller", b"\xe4\xff")).faces.shape == (3, 3)


def test_serialized_meshes_are_told_apart_by_their_number(tmp_path: Path) -> None:
    first, second = serialized(TRIANGLE, [[0, 1, 2]]), serialized(SQUARE.tolist(), [[0, 1, 2], [0, 2, 3]])
    bodies = first[:-12] + second[:-12]
    two = bodies + struct.pack("<QQI", 0, len(first) - 12, 2)
    assert len(read(tmp_path, "a.serialized", two, 0).faces) == 1
    assert np.array_equal(read(tmp_path, "a.serialized", two, 1).vertices, SQUARE)
    with pytest.raises(InputError, match="shape_index: is 2; the file states 2 meshes"):
        read(tmp_path, "a.serialized", two, 2)


TEXT_PLY = HEAD + FACE + "3 0 1 2\n"
HUGE = serialized(TRIANGLE, [[0, 1, 2]])
REFUSED: dict[str, tuple[str, str | bytes, str]] = {
    "vertices missing": ("a.ply", TEXT_PLY.replace("vertex 3", "vertex 5"), "has 4 lines; the header states 6"),
    "faces missing": ("a.ply", TEXT_PLY.replace("face 1", "face 2"), "has 4 lines; the header states 5"),
    "lines too many": ("a.ply", TEXT_PLY + "3 0 1 2\n", "has 5 lines; the header states 4"),
    "huge count": ("a.ply", TEXT_PLY.replace("face 1", "face 4000000000"), "the header states 4000000003"),
    "count below 0": ("a.ply", TEXT_PLY.replace("face 1", "face -1"), "line 7: .* is no line of a PLY header"),
    "face of a fraction": ("a.ply", HEAD + FACE + "3 0 1 1.5\n", "face 0: '3 0 1 1.5' does not fit"),
    "face of two": ("a.ply", HEAD + FACE + "2 0 1\n", "face 0: has 2 vertices; at least 3"),
    "face longer than its line": ("a.ply", HEAD + FACE + "9 0 1 2\n", "face 0: '9 0 1 2' does not fit"),
    "high byte": ("a.ply", (HEAD + FACE).encode() + b"3 0 1 \xe4\n", r"data line 4: has the byte b'\\xe4'"),
    "no faces": ("a.ply", HEAD + "end_header\n0 0 0\n1 0 0\n0 1 0\n", "has no element face"),
    "no format": ("a.ply", TEXT_PLY.replace("format ascii 1.0\n", ""), "has no line format"),
    "unknown format": ("a.ply", TEXT_PLY.replace("ascii", "text"), "line 2: .* is no line of a PLY header"),
    "list of floats": ("a.ply", TEXT_PLY.replace("uchar int", "uchar float"), "vertex_indices are no integers"),
    "element twice": ("a.ply", TEXT_PLY.replace("element face 1", "element vertex 1"), "line 7: .* is no line"),
    "index of 64 bits": ("a.ply", HEAD + FACE + f"3 0 1 {2**63}\n", "face 0: '3 0 1 9223372036854775808' does not fit"),
    "binary cut short": ("a.ply", ply("<")[:-9], "is cut short"),
    "binary too long": ("a.ply", ply("<") + b"\0", "has 1 bytes more than the header states"),
    "binary huge count": ("a.ply", ply("<").replace(b"face 2", b"face 999999999999"), "element face: is cut short"),
    "binary huge list": (
        "a.ply",
        ply("<").replace(b"list uchar", b"list uint"),
        "is cut short, or has a list longer than the file",
    ),
    "obj garbage": ("a.obj", OBJ + "hello\nf 1 2 3\n", "line 4: 'hello': is no line of an OBJ mesh"),
    "obj face of two": ("a.obj", OBJ + "f 1 2\n", "line 4: 'f 1 2': is no line"),
    "obj curve": ("a.obj", OBJ + "curv 0 1 1 2\n", "line 4: 'curv 0 1 1 2': is no line"),
    "obj texture index": ("a.obj", OBJ + "vt 0 0\nf 1/1 2/2 3/1\n", "have a texture index 2; there are 1 vt"),
    "obj huge index": ("a.obj", OBJ + f"f 1 2 {10**30}\n", "line 4: has a face index 1000"),
    "serialized cut short": ("a.serialized", HUGE[:-6], "is no serialized mesh|is 0; the file states|has no"),
    "serialized of other bytes": ("a.serialized", b"x" * 40, "is no serialized mesh of version 3 or 4"),
    "serialized empty": ("a.serialized", b"", "is no serialized mesh that can be read"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_file_whose_numbers_do_not_fit_is_refused_with_the_place(tmp_path: Path, name: str) -> None:
    file, content, message = REFUSED[name]
    with pytest.raises(InputError, match=message) as refusal:
        read(tmp_path, file, content)
    assert str(refusal.value).startswith("mesh: ")
    assert "\n" not in str(refusal.value)


def test_a_serialized_mesh_cannot_ask_for_more_than_its_bytes(tmp_path: Path) -> None:
    """2^60 vertices stated for 36 bytes of them."""
    body = zlib.decompress(HUGE[4:-12])
    body = body[:9] + struct.pack("<QQ", 1 << 60, 1) + body[25:]
    with pytest.raises(InputError, match="mesh 0: has 48 bytes for 1152921504606846976 vertices"):
        read(tmp_path, "a.serialized", HUGE[:4] + zlib.compress(body) + HUGE[-12:])


FILES: dict[str, bytes] = {
    "text.ply": ply(""),
    "binary.ply": ply("<", uv=True),
    "box.obj": UV_BOX.encode(),
    "a.serialized": HUGE,
    "shapes.xml": xml(
        "<default name='r' value='0.4'/><bsdf type='twosided' id='wood'><bsdf type='diffuse'>"
        "<rgb name='reflectance' value='$r, 0.5, 0.3'/></bsdf></bsdf>\n"
        "<shape type='obj'><string name='filename' value='whole.obj'/><ref id='wood'/>"
        "<transform name='to_world'><rotate z='1' angle='30'/><scale value='0.5'/></transform></shape>\n"
        "<shape type='rectangle'><bsdf type='diffuse'><texture type='bitmap' name='reflectance'>"
        "<string name='filename' value='grey.png'/><boolean name='raw' value='true'/></texture></bsdf></shape>\n",
        CUBE,
    ).encode(),
}
PIECES = (b"-1", b"nan", b"1e999", b"4294967295", b"9" * 20, b"\xe4", b"\0", b" ", b"\n", b"5", b"../", b"conductor")
VALUE = re.compile(rb"'[^']*'|[^\s'<>=]+")


def mutated(content: bytes, chance: random.Random) -> bytes:
    """One to three changes: a bit, a word or value replaced, bytes left out or doubled, the end cut off."""
    for _ in range(chance.choice([1, 1, 2, 3])):
        at = chance.randrange(len(content) + 1)
        end = min(len(content), at + chance.randrange(1, 12))
        change = chance.randrange(5)
        words = list(VALUE.finditer(content)) if change == 0 else []
        if words:
            word = chance.choice(words)
            quote = b"'" if word.group().startswith(b"'") else b""
            content = content[: word.start()] + quote + chance.choice(PIECES) + quote + content[word.end() :]
        elif change == 1 and at < len(content):
            content = content[:at] + bytes([content[at] ^ 1 << chance.randrange(8)]) + content[at + 1 :]
        elif change == 2:
            content = content[:at] + content[end:]
        elif change == 3:
            content = content[:at] + content[at:end] + content[at:]
        elif change == 4 and chance.random() < 0.3:
            content = content[:at]
    return content


@pytest.mark.parametrize("name", FILES)
def test_a_damaged_file_gives_valid_triangles_or_one_line(tmp_path: Path, name: str) -> None:
    """300 seeded mutations of each file. Reflectances that remain are 0 to 1."""
    Image.fromarray(np.arange(64, dtype=np.uint8).reshape(8, 8) * 4).save(tmp_path / "grey.png")
    (tmp_path / "whole.obj").write_text(UV_BOX)
    chance = random.Random(20161118)
    refused: list[str] = []
    for _ in range(300):
        (tmp_path / name).write_bytes(mutated(FILES[name], chance))
        try:
            if name.endswith(".xml"):
                shapes = read_xml(tmp_path / name, tmp_path, "mesh")
                assert all(((shape.albedo >= 0) & (shape.albedo <= 1)).all() for shape in shapes)
                meshes = [shape.mesh for shape in shapes]
            else:
                meshes = [read_mesh(tmp_path / name, "mesh")]
        except InputError as refusal:
            refused.append(str(refusal))
            continue
        for mesh in meshes:
            assert ((mesh.faces >= 0) & (mesh.faces < len(mesh.vertices))).all()
    assert 0 < len(refused) < 300
    assert all(line.startswith("mesh: ") and "\n" not in line for line in refused)


def shape(inner: str) -> str:
    return f"<shape type='cube' id='chair'>{inner}</shape>"


def diffuse(value: str, tag: str = "float") -> str:
    return shape(f"<bsdf type='diffuse'><{tag} name='reflectance' value='{value}'/></bsdf>")


def bitmap(file: str, more: str = "") -> str:
    name = f"<string name='filename' value='{file}'/>"
    return shape(f"<bsdf type='diffuse'><texture type='bitmap' name='reflectance'>{name}{more}</texture></bsdf>")


OUTSIDE = "is outside the scene's folder"
XML_REFUSED = {
    "nan": (diffuse("nan"), "bsdf, line 1: reflectance = nan: 0 to 1 is allowed"),
    "5": (diffuse("5"), "reflectance = 5: 0 to 1"),
    "-1": (diffuse("-1"), "reflectance = -1: 0 to 1"),
    "a colour beyond 1": (diffuse("0.1, 0.2, 1.5", "rgb"), "reflectance = 0.1, 0.2, 1.5: 0 to 1"),
    "a spectrum": (diffuse("400:0.1,700:0.2", "spectrum"), "reflectance: give one number, an rgb, or a texture"),
    "checkerboard": (
        shape(
            "<bsdf type='diffuse'><texture type='checkerboard' name='reflectance'>"
            "<float name='color0' value='2'/></texture></bsdf>"
        ),
        "color0 = 2: 0 to 1",
    ),
    "conductor": (
        shape("<bsdf type='conductor'/>"),
        "type='conductor' is not supported; allowed are diffuse, twosided",
    ),
    "conductor within": (shape("<bsdf type='twosided'><bsdf type='conductor'/></bsdf>"), "'conductor' is not supp"),
    "unused plastic": (
        "<bsdf type='plastic' id='p'/>" + shape(""),
        "bsdf 'p', line 1: type='plastic' is not supported",
    ),
    "emitter": ("<emitter type='constant'/>" + shape(""), "<emitter type='constant'> is not supported"),
    "attribute texture": (
        shape("<bsdf type='diffuse'><texture type='mesh_attribute' name='reflectance'/></bsdf>"),
        "type='mesh_attribute' is not supported; allowed are bitmap, checkerboard",
    ),
    "include": ("<include filename='/etc/hosts'/>", "line 1: <include> is not supported"),
    "path": ("<path value='/etc'/>" + shape(""), "line 1: <path> is not supported"),
    "spectrum file": (
        shape("<bsdf type='diffuse'><spectrum name='reflectance' filename='/etc/hosts'/></bsdf>"),
        "<spectrum filename=...> is not supported; give value",
    ),
    "two BSDFs": (
        shape("<bsdf type='diffuse'/><bsdf type='diffuse'/>"),
        "shape 'chair', line 1: has 2 BSDFs; give one",
    ),
    "shape in a shape": (shape(shape("").replace("chair", "b")), "a nested shape is not supported in cube"),
    "unknown property": (shape("<float name='foo' value='1'/>"), "foo is not supported in cube"),
    "no reference": (shape("<ref id='nowhere'/>"), "Mitsuba cannot parse it: .*nowhere"),
    "transform": (
        shape("<transform name='to_world'><scale value='nan'/></transform>"),
        "to_world is no affine transformation of finite numbers",
    ),
    "absolute": (
        mesh_xml("ply", "/etc/hosts").removeprefix("<scene version='3.0.0'>").removesuffix("</scene>"),
        OUTSIDE,
    ),
    "above": (bitmap("../grey.png"), OUTSIDE),
    "a link": (bitmap("link.png"), OUTSIDE),
    "no image": (bitmap("text.png"), "file 'text.png': is no PNG or JPEG that can be read"),
    "alpha": (bitmap("alpha.png"), "file 'alpha.png': is no grey or RGB image of 8 or 16 bits without transparency"),
    "huge": (bitmap("huge.png"), "file 'huge.png': has 2001 x 2000 pixels; at most 4000000"),
    "filter": (bitmap("grey.png", "<string name='filter_type' value='cubic'/>"), "Invalid filter type"),
    "nesting": ("<shape type='cube'>" * 40 + "</shape>" * 40, "elements are nested deeper than 16"),
}


@pytest.mark.parametrize("name", XML_REFUSED)
def test_what_furniture_has_no_use_for_is_refused_by_name(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "scene"
    folder.mkdir()
    grey = Image.fromarray(np.arange(64, dtype=np.uint8).reshape(8, 8))
    for place in (tmp_path, folder):
        grey.save(place / "grey.png")
    (folder / "link.png").symlink_to(tmp_path / "grey.png")
    (folder / "text.png").write_text("no image")
    Image.new("LA", (2, 2)).save(folder / "alpha.png")
    Image.new("L", (2001, 2000)).save(folder / "huge.png")
    content, message = XML_REFUSED[name]
    (folder / "a.xml").write_text(xml(content))
    with pytest.raises(InputError, match=message) as refusal:
        read_xml(folder / "a.xml", folder, "mesh")
    assert str(refusal.value).startswith("mesh: ")
    assert "\n" not in str(refusal.value)


def test_entities_are_refused_before_they_grow(tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text("<!DOCTYPE a [<!ENTITY b 'cc'>]>" + xml(shape("")))
    with pytest.raises(InputError, match="line 1: <!DOCTYPE> is not supported"):
        read_xml(tmp_path / "a.xml", tmp_path, "mesh")


def test_numbers_colours_and_images_are_reflectances(tmp_path: Path) -> None:
    """Luminance of linear sRGB: 0.2126 R + 0.7152 G + 0.0722 B (IEC 61966-2-1). A raw grey value of 51 is 0.2."""
    Image.new("L", (4, 4), 51).save(tmp_path / "grey.png")
    Image.fromarray(np.full((4, 4), 13107, dtype=np.uint16)).save(tmp_path / "fine.png")
    raw = "<boolean name='raw' value='true'/>"
    colour = 0.2126 * 0.1 + 0.7152 * 0.5 + 0.0722 * 0.7
    srgb = ((0.2 + 0.055) / 1.055) ** 2.4
    expected = {
        diffuse("0.3"): 0.3,
        diffuse("0.3", "spectrum"): 0.3,
        diffuse("0.1, 0.5, 0.7", "rgb"): colour,
        bitmap("grey.png", raw): 0.2,
        bitmap("fine.png", raw): 0.2,
        bitmap("grey.png"): srgb,
        bitmap("fine.png"): srgb,
    }
    for content, albedo in expected.items():
        (tmp_path / "a.xml").write_text(xml(content))
        (found,) = read_xml(tmp_path / "a.xml", tmp_path, "mesh")
        assert found.albedo == pytest.approx(albedo, rel=2e-3), content  # Mitsuba's weights have four digits


@pytest.mark.slow
def test_a_face_index_out_of_range_ends_the_command_with_2_and_one_line(tmp_path: Path) -> None:
    """In a process of its own: Mitsuba once followed the index, and the process ended by a signal."""
    (tmp_path / "bad.ply").write_text(HEAD + FACE + "3 0 1 99999999\n")
    (tmp_path / "bad.xml").write_text(mesh_xml("ply", "bad.ply"))
    scene = (ROOT / "scenes/table1.toml").read_text()
    (tmp_path / "room.toml").write_text(scene + '\n[[furniture]]\nfile = "bad.xml"\nposition_m = [3.0, 3.0, 0.0]\n')
    recipe = re.sub(
        r'scene = "[^"]*"', f'scene = "{tmp_path / "room.toml"}"', (ROOT / "datasets/quickstart.toml").read_text()
    )
    (tmp_path / "recipe.toml").write_text(recipe)
    code = "import sys; from vlcrender.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "generate", str(tmp_path / "recipe.toml"), "--out", str(tmp_path / "set")]
    finished = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert finished.returncode == 2, finished.stderr
    assert "furniture[0].file = 'bad.xml': shape 'chair', line 1:" in finished.stderr
    assert "99999999, out of range for 3 vertices" in finished.stderr
