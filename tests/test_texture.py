"""Textures: means over pixels against brute force, orientation, energy balance, error messages."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_path_traced import ROOM, SMALL_VIEW, blocks, both_ways, scene_of

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi
from vlcrender.camera.vignetting import relative_illumination
from vlcrender.core.backend import mi
from vlcrender.errors import InputError
from vlcrender.light.lightmap import Lightmap, bake, room_mesh
from vlcrender.light.raycast import Textures
from vlcrender.rendering.background import Background
from vlcrender.rendering.electron_rates import ElectronRates
from vlcrender.scene.loader import Scene
from vlcrender.scene.mesh import mesh_of_surfaces
from vlcrender.scene.surfaces import Surface
from vlcrender.scene.texture import Texture, read_reflectances

PLAIN = {"floor": 0.3, "ceiling": 0.8, "walls": 0.5}
LAMP = {"id": 1, "position_m": [1.5, 1.5, 2.5], "radius_m": 0.02, "luminance_cd_m2": 20000.0}


def textured(
    folder: Path, image: np.ndarray, tile_m: tuple[float, float], name: str = "ceiling", **changes: object
) -> Scene:
    """The test room with an image of reflectances, written in 16 bits, on one of its surfaces."""
    Image.fromarray((image * 65535).round().astype(np.uint16)).save(folder / "image.png")
    room = {
        "size_m": [3.0, 3.0, 2.5],
        "reflectance": {key: value for key, value in PLAIN.items() if key != name},
        "texture": {name: {"file": "image.png", "tile_m": list(tile_m)}},
    }
    return scene_of(folder, **{"led": [LAMP], "room": room, **changes})


def speckled() -> np.ndarray:
    """A ceiling tile: light, with dark fissures one to three pixels wide and a dark joint around it."""
    generator = np.random.Generator(np.random.Philox(7))
    image = np.full((128, 128), 0.8)
    for row, column in generator.integers(0, 126, (80, 2)):
        image[row : row + 2, column : column + 3] = 0.35
    image[:2] = image[:, :2] = 0.2
    return image


def evenly_lit(scene: Scene, lux: float) -> Background:
    mesh = room_mesh(scene)
    count = len(mesh.vertices_m)
    albedo = np.append(mesh.albedo, 0.5)
    return Background(scene, Lightmap(mesh, albedo, np.zeros(count + 1), np.full(count + 1, lux), np.zeros(count + 1)))


def brute_force(texture: Texture, camera: Camera, pose: Pose, grid: int) -> np.ndarray:
    """Mean reflectance of the ceiling in each pixel: grid x grid rays per pixel, linear between texture pixels."""
    rows, columns = texture.reflectances.shape
    total = np.zeros((camera.height_px, camera.width_px))
    within = (np.arange(grid) + 0.5) / grid
    for a in within:
        for b in within:
            u, v = np.meshgrid(np.arange(camera.width_px) + a, np.arange(camera.height_px) + b)
            ray = PosedCamera(camera, pose).rays_world(np.stack([u, v], axis=-1))
            point = np.array(pose.position_m) + ray * ((2.5 - pose.position_m[2]) / ray[..., 2:])
            at = texture.at_px(point) - 0.5
            whole = np.floor(at).astype(int)
            x, y = np.moveaxis(at - whole, -1, 0)
            corner = [
                [texture.reflectances[(whole[..., 1] + j) % rows, (whole[..., 0] + i) % columns] for i in (0, 1)]
                for j in (0, 1)
            ]
            total += (corner[0][0] * (1 - x) + corner[0][1] * x) * (1 - y)
            total += (corner[1][0] * (1 - x) + corner[1][1] * x) * y
    return total / grid**2


@pytest.mark.slow
@pytest.mark.parametrize(
    "pose", [Pose((1.4, 1.5, 0.3)), Pose((1.4, 1.6, 0.3), yaw_deg=45.0), Pose((1.2, 1.3, 1.6), 40.0, 0.0, 70.0)]
)
@pytest.mark.parametrize("pitch_um", [1.2, 36.0, 120.0, 400.0], ids=["magnified", "alike", "3 to 1", "10 to 1"])
def test_the_error_of_a_texture_is_below_a_hundredth_of_the_shot_noise(
    tmp_path: Path, pitch_um: float, pose: Pose
) -> None:
    """Tiles of 0.6 m in 128 pixels of 4.7 mm, seen from 2.2 m in pixels of 0.15 to 50 mm.

    The brightest LED of 16 000 cd/m2 holds 4 000 electrons, so the ceiling under 440 lux some 28 at a reflectance of
    0.8. The error's variance is its mean square over the image, and the shot noise's is the mean number of electrons.
    """
    scene = textured(tmp_path, speckled(), (0.6, 0.6))
    camera = Camera(width_px=80, height_px=60, pixel_pitch_um=pitch_um)
    rates = ElectronRates(led=0.0, ambient=4000 / 16000)
    (region,) = evenly_lit(scene, 440.0).regions(PosedCamera(camera, pose), (Roi.of_sensor(camera),), rates)
    texture = scene.surfaces[1].texture
    assert texture is not None
    # brute force itself errs by 0.3 / 24^1.5 = 0.25 % of a step in a pixel with an edge: 1e-4 of the shot noise
    u, v = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
    expected = brute_force(texture, camera, pose, 24) * 440 / np.pi * 4000 / 16000 * relative_illumination(camera, u, v)
    seen = region.surfaces == 1
    seen[1:-1, 1:-1] &= seen[2:, 1:-1] & seen[:-2, 1:-1] & seen[1:-1, 2:] & seen[1:-1, :-2]  # no wall in the pixel
    assert seen.sum() > 500
    error = (region.image - expected)[seen]
    assert (error**2).mean() < 0.01 * expected[seen].mean()
    if pose.yaw_deg == 0 and pitch_um == 1.2:
        # sides along the image's, and finer: linear interpolation itself, to float32's 2.5 m * 6e-8 / 4.7 mm
        assert np.abs(error / expected[seen]).max() < 2e-3


@pytest.mark.parametrize(
    ("name", "place", "pose"),
    [
        ("ceiling", [0.4, 0.15, 2.5], Pose((0.5, 0.4, 0.5))),
        ("floor", [0.4, 0.15, 0.0], Pose((0.5, 0.4, 2.0), 180.0)),
        ("walls", [0.0, 0.4, 2.35], Pose((2.0, 0.4, 2.3), 0.0, -90.0)),
        ("walls", [3.0, 0.4, 2.35], Pose((1.0, 0.4, 2.3), 0.0, 90.0)),
        ("walls", [0.4, 3.0, 2.35], Pose((0.4, 1.0, 2.3), -90.0)),
    ],
)
def test_a_texture_has_the_documented_origin_and_axes(
    tmp_path: Path, name: str, place: list[float], pose: Pose
) -> None:
    """A white spot at column 4 of 6 and row 1 of 3 of a tile 0.6 m across and 0.3 m down, in black."""
    image = np.zeros((6, 12))
    image[3, 8] = 1.0  # centre at 0.425 m across and 0.175 m down
    at = np.array(place) + (np.array([0.025, 0.025, 0]) if name != "walls" else [0, 0, -0.025])
    if name == "walls":
        at[1 if place[0] in (0.0, 3.0) and place[1] == 0.4 else 0] += 0.025
    scene = textured(tmp_path, image, (0.6, 0.3), name)
    camera = Camera(width_px=400, height_px=300, pixel_pitch_um=20.0)
    rates = ElectronRates(led=0.0, ambient=1.0)
    (region,) = evenly_lit(scene, 100.0).regions(PosedCamera(camera, pose), (Roi.of_sensor(camera),), rates)
    pixel = PosedCamera(camera, pose).project(at)
    u, v = np.meshgrid(np.arange(400) + 0.5, np.arange(300) + 0.5)
    near = np.hypot(u - pixel[0], v - pixel[1]) < 25
    light = region.image * near
    assert light.sum() > 0.1 * 100 / np.pi
    found = np.array([(light * u).sum(), (light * v).sum()]) / light.sum()
    # the spot is 22 px wide: half a pixel is far less than any wrong turn, which moves it by tiles
    assert np.abs(found - pixel).max() < 0.5


@pytest.mark.slow
def test_a_texture_agrees_with_the_reference(tmp_path: Path) -> None:
    """An image without symmetry on the ceiling, a panel cut into it, seen slanted and lit by an LED."""
    image = np.linspace(0.1, 0.9, 12).reshape(3, 4)[:, [2, 0, 3, 1]]
    leds = {
        "columns": 1,
        "rows": 1,
        "pitch_m": [0.1, 0.1],
        "radius_m": 0.03,
        "luminance_cd_m2": [2e4, 2e4],
        "first_id": 2,
    }
    panel = {
        "columns": 1,
        "rows": 1,
        "first_center_m": [1.4, 1.6, 2.45],
        "pitch_m": [1.0, 1.0],
        "size_m": [0.3, 0.3, 0.05],
        "reflectance": 0.7,
        "leds": leds,
    }
    scene = textured(tmp_path, image, (0.8, 0.6), led=[], panels=[panel])
    camera = Camera(**SMALL_VIEW)
    ours, reference, variance, lit = both_ways(scene, camera, Pose((1.2, 2.0, 0.5), 20.0, 2.0, 25.0), 128)
    assert lit.any()
    kept = blocks(lit.astype(float))[0] == 0
    mine, theirs, spread = (b[kept] for b in blocks(ours, reference, variance))
    # as for furniture: Student's t with 7 degrees of freedom, and 0.5 % for the bake and its interpolation
    z = (mine - theirs) / np.sqrt(spread / 100 + (0.005 * theirs) ** 2)
    assert np.abs(z).max() < 7.9
    assert np.ptp(theirs) > 0.5 * theirs.mean()


@pytest.mark.slow
def test_a_textured_room_absorbs_the_flux_of_the_leds(tmp_path: Path) -> None:
    """Energy balance with a texture on the floor with pixels as large as texels, at other positions."""
    image = np.array([[0.1, 0.9], [0.8, 0.2]])
    scene = textured(tmp_path, image, (0.34, 0.5), "floor", bake={"texel_m": 0.1, "paths": 512})
    light = bake(scene, tmp_path)
    count = len(light.mesh.vertices_m)
    absorbed = ((1 - light.mesh.albedo) * light.led_lux[:count] * light.mesh.areas_m2()).sum()
    flux = np.pi * 20000 * np.pi * 0.02**2
    # as in a plain room: 1 % for the quadrature and Monte Carlo
    assert absorbed == pytest.approx(flux, rel=0.01)
    floor = mesh_of_surfaces(scene.surfaces[:1], 0.1)
    texture = scene.surfaces[0].texture
    assert texture is not None
    # 3 m are not whole tiles: the mean over the floor, which the vertices' areas weigh exactly but at the ends
    whole = texture.means(np.zeros((1, 3)), np.array([[3.0, 3.0, 0.0]]))[0]
    assert (floor.albedo * floor.areas_m2()).sum() / 9 == pytest.approx(whole, abs=1e-3)


def test_rows_and_columns_of_an_image_are_alike(rng: np.random.Generator) -> None:
    """An image along (x, y) and its transpose along (y, x) are one texture. Footprints of some 10 pixels of 5 mm, in
    any direction; in float32, so that edges of up to 600 px round by 4e-5 px, of rectangles of 1 px at least:
    2e-4 for their four edges.
    """
    image = rng.random((64, 64))
    origin, across, down = np.zeros(3), np.array([0.32, 0.0, 0.0]), np.array([0.0, 0.32, 0.0])
    n = 200
    points, sides = rng.uniform(0, 3, (3, n)), rng.uniform(-0.05, 0.05, (2, 3, n))
    points[2], directions, found = 0.0, np.array([[0.6], [0.0], [-0.8]]) + np.zeros((3, n)), []
    for texture in (Texture(image, origin, across, down), Texture(image.T.copy(), origin, down, across)):
        made = Textures((Surface("floor", origin, 9 * across, 9 * down, 0.5, texture=texture),), 1)
        spread = mi.Vector3f(sides[0]), mi.Vector3f(sides[1])
        of = made.reflectance(mi.UInt32(0), mi.Vector3f(points), mi.Vector3f(directions), mi.Float(1.0), spread)
        found.append(of.numpy())
    assert found[0].std() > 0.01
    np.testing.assert_allclose(*found, rtol=0, atol=2e-4)


def test_means_are_those_of_counted_pixels(rng: np.random.Generator) -> None:
    """Rectangles of any size about a repeated image of 5 x 7, against pixels split into 20 x 20."""
    image = rng.random((5, 7))
    texture = Texture(image, np.array([0.3, 0.1, 0.0]), np.array([0.7, 0.0, 0.0]), np.array([0.0, 0.5, 0.0]))
    fine = np.kron(np.tile(image, (9, 9)), np.ones((20, 20)))
    for _ in range(50):
        row, column = rng.integers(0, 400, 2)
        height, width = rng.integers(1, 450, 2)
        counted = fine[row : row + height, column : column + width].mean()
        low = np.array([[0.3 - 2 * 0.7 + column / 200, 0.1 - 3 * 0.5 + row / 200, 0.0]])
        high = low + [width / 200, height / 200, 0.0]
        assert texture.means(low, high)[0] == pytest.approx(counted, rel=1e-9)
        assert texture.means(high, low)[0] == pytest.approx(counted, rel=1e-9)


def test_grey_values_are_read_linearly(tmp_path: Path) -> None:
    Image.fromarray(np.array([[0, 51, 255]], dtype=np.uint8)).save(tmp_path / "8.png")
    Image.fromarray(np.array([[0, 13107, 65535]], dtype=np.uint16)).save(tmp_path / "16.png")
    for name in ("8.png", "16.png"):
        assert read_reflectances(tmp_path / name, "test").tolist() == [[0.0, 0.2, 1.0]]


@pytest.mark.slow
def test_another_texture_gives_another_bake(tmp_path: Path) -> None:
    """Two images whose means over texels are the same are still two."""
    image = np.kron([[0.2, 0.8], [0.8, 0.2]], np.ones((4, 4)))
    coarse = {"texel_m": 1.0, "paths": 8}
    for pixels in (image, image[::-1], image):
        bake(textured(tmp_path, pixels, (0.1, 0.1), "floor", bake=coarse), tmp_path)
    assert len(list(tmp_path.glob("*.npz"))) == 2


def _colour(path: Path) -> None:
    Image.new("RGB", (4, 4)).save(path)


def _transparent(path: Path) -> None:
    Image.new("L", (4, 4)).save(path, transparency=0)


def _alpha(path: Path) -> None:
    Image.new("LA", (4, 4)).save(path)


def _link(path: Path) -> None:
    path.symlink_to(Path(__file__).parent.parent / "docs/pictures/nowhere.png")


def _large(path: Path) -> None:
    Image.new("L", (2001, 2000)).save(path)


def _cut(path: Path) -> None:
    Image.fromarray(np.random.default_rng(1).integers(0, 255, (64, 64), dtype=np.uint8)).save(path)
    path.write_bytes(path.read_bytes()[:500])


BAD_FILES = {
    "no such file": lambda path: None,
    "no PNG that can be read": lambda path: path.write_bytes(b"P5 1 1 255 x"),
    "no grey image": _colour,
    "no grey image of 8 or 16 bits without transparency": _transparent,
    "is no grey image of 8 or 16 bits without": _alpha,
    "is outside the scene's folder; copy the file there": _link,
    "2001 x 2000 pixels; at most 4000000": _large,
    "is no PNG that can be read: ": _cut,
}


@pytest.mark.parametrize("message", BAD_FILES)
def test_an_unusable_texture_is_refused_in_one_line(tmp_path: Path, message: str) -> None:
    BAD_FILES[message](tmp_path / "x.png")
    room = {**dict(ROOM["room"]), "reflectance": {"ceiling": 0.8, "walls": 0.5}}  # type: ignore[call-overload]
    room["texture"] = {"floor": {"file": "x.png", "tile_m": [1.0, 1.0]}}
    with pytest.raises(InputError, match=message) as refusal:
        scene_of(tmp_path, led=[LAMP], room=room)
    assert "room.texture.floor.file = 'x.png'" in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_surface_has_a_reflectance_or_a_texture_and_not_both(tmp_path: Path) -> None:
    size = [3.0, 3.0, 2.5]
    with pytest.raises(InputError, match=r"room\.reflectance\.walls is missing"):
        scene_of(led=[LAMP], room={"size_m": size, "reflectance": {"floor": 0.3, "ceiling": 0.8}})
    texture = {"walls": {"file": "x.png", "tile_m": [1.0, 1.0]}}
    with pytest.raises(InputError, match=r"room\.reflectance\.walls = 0\.5"):
        scene_of(led=[LAMP], room={"size_m": size, "reflectance": PLAIN, "texture": texture})
