"""Make the pictures of docs/effects.md: python docs/make_pictures.py"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from vlcrender.camera.glare import Glare
from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import mounted_cameras
from vlcrender.config.toml_model import check, read_toml
from vlcrender.dataset.recipe.motion import Motion, poses_during
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene, build_scene, load_scene
from vlcrender.scene.schema import SceneSettings
from vlcrender.sensor.sensor import Sensor
from vlcrender.sensor.signal_chain import expose

ROOT = Path(__file__).parent.parent
OUT = ROOT / "docs/pictures"
TILTED = Pose((3.0, 3.3, 1.0), tilt_x_deg=-18.0, tilt_y_deg=14.0, yaw_deg=25.0)
NARROW = {"width_px": 800, "height_px": 600, "pixel_pitch_um": 6.0}
WIDE = {**NARROW, "focal_length_mm": 3.0}
FISH_EYE = {**NARROW, "focal_length_mm": 1.6, "projection": "equidistant"}

WHITES = {"diffusers": 50.0}
"""White level of some pictures, over the picture's median; 12 for all others."""

BOARD_OBJ = """\
v -0.4 -0.25 0
v 0.4 -0.25 0
v 0.4 0.25 0
v -0.4 0.25 0
v -0.4 -0.25 0.02
v 0.4 -0.25 0.02
v 0.4 0.25 0.02
v -0.4 0.25 0.02
f 1 3 2
f 1 4 3
f 5 6 7
f 5 7 8
f 1 2 6
f 1 6 5
f 2 3 7
f 2 7 6
f 3 4 8
f 3 8 7
f 4 1 5
f 4 5 8
"""


def office(folder: Path = ROOT / "scenes", **changes: object) -> Scene:
    """The office with some of its tables replaced."""
    tree = {**read_toml(ROOT / "scenes/office.toml"), **changes}
    return build_scene(check(tree, SceneSettings, "picture"), "picture", folder)


def fine_effects() -> None:
    """Write the picture of effects that are small: crops around LEDs, each beside the same view without the effect."""
    panels = read_toml(ROOT / "scenes/office.toml")["panels"]
    profile = {"face_gradient": [0.3, 0.0], "face_falloff": 0.5}
    plain = Renderer(office())
    uneven = Renderer(office(panels=[{**panels[0], "leds": {**panels[0]["leds"], **profile}}]))
    camera = {"width_px": 1600, "height_px": 1200, "pixel_pitch_um": 3.0}
    corner = np.s_[900:1200, 1200:1600]
    blurred, fringed = {"off_axis_sigma_um": 15.0}, {"lateral_colour_um": (24.0, -24.0)}
    glaring = {"glare": Glare(share=0.05)}
    coarse = {"width_px": 240, "height_px": 180, "pixel_pitch_um": 20.0}
    mixing = Renderer(plain.scene, crosstalk=0.2)

    def view(renderer: Renderer, camera: Camera) -> np.ndarray:
        return renderer.expected_image(PosedCamera(camera, TILTED)).expected_electrons(1.0)

    sharp = view(plain, Camera(**camera))
    middle = _busiest(sharp)
    small = view(plain, Camera(**coarse))
    small_middle = _busiest(small, 36, 48)
    colours = np.stack([view(plain, Camera(**camera, **fringed).for_colour(c))[corner] for c in range(3)], axis=-1)
    sensor = Sensor(noise="full", read_noise_e=2.0, hot_pixel_share=0.0, hot_pixel_e_s=2e4)
    dark = np.full((60, 80), 10.0, dtype=np.float32)
    hot = sensor.model_copy(update={"hot_pixel_share": 5e-3})
    pairs = {
        "face: gradient 0.3, fall-off 0.5": (sharp[middle], view(uneven, Camera(**camera))[middle], 1.4),
        "veiling glare, 5 %; white at 1.5 % of the LEDs": (sharp, view(plain, Camera(**camera, **glaring)), 0.015),
        "off-axis blur, 15 um at the corner": (sharp[corner], view(plain, Camera(**camera, **blurred))[corner], 1.0),
        "lateral colour, +-24 um at the corner": (np.stack([sharp[corner]] * 3, axis=-1), colours, 1.0),
        "crosstalk, 20 %": (small[small_middle], view(mixing, Camera(**coarse))[small_middle], 1.0),
        "0.5 % hot pixels, 20 ms": (
            expose(sensor, dark, "picture", exposure_s=0.02),
            expose(hot, dark, "picture", exposure_s=0.02),
            1.0,
        ),
    }
    figure = Figure(figsize=(15, 7.4), layout="constrained")
    for row, (title, (without, with_it, share)) in enumerate(pairs.items()):
        for column, image in enumerate((without, with_it)):
            axes = figure.add_subplot(3, 4, 2 * row + column + 1)
            white = 100.0 if "hot" in title else share * float(without.max())
            axes.imshow(np.clip(image / white, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
            axes.set_title(title if column else "without", fontsize=10)
            axes.set_axis_off()
    figure.savefig(OUT / "fine_effects.png", dpi=90)


def _busiest(image: np.ndarray, rows: int = 150, columns: int = 200) -> tuple[slice, slice]:
    """A crop of this size with the most light."""
    sums = image[: image.shape[0] // rows * rows, : image.shape[1] // columns * columns]
    sums = sums.reshape(image.shape[0] // rows, rows, -1, columns).sum(axis=(1, 3))
    row, column = np.unravel_index(sums.argmax(), sums.shape)
    return np.s_[row * rows : (row + 1) * rows, column * columns : (column + 1) * columns]


def main() -> None:
    """Render all pictures and write them as one file."""
    plain = Renderer(office())
    glazing = {"wall": "x=0", "corner_m": [1.0, 0.9], "size_m": [5.0, 2.2], "luminance_cd_m2": 40.0}
    glazed = Renderer(office(glazing=[glazing]))
    panels = read_toml(ROOT / "scenes/office.toml")["panels"]
    leds = {key: value for key, value in panels[0]["leds"].items() if key != "radius_m"}
    leds |= {"shape": "square", "side_m": 2 * panels[0]["leds"]["radius_m"], "half_power_deg": 30.0}
    squares = [{**panels[0], "leds": leds}]
    OUT.mkdir(exist_ok=True)
    mesh = OUT / "board.obj"
    mesh.write_text(BOARD_OBJ)
    ray = PosedCamera(Camera(**NARROW), TILTED).rays_world(np.array([600.0, 330.0]))
    place = np.array(TILTED.position_m) + ray * 1.6 / ray[2]
    board = {"file": "board.obj", "position_m": place.tolist(), "yaw_deg": 30.0, "scale": 0.2, "reflectance": 0.2}
    furnished = Renderer(office(OUT, furniture=[board]))
    mesh.unlink()
    meeting = Renderer(load_scene(ROOT / "scenes/meeting_room.toml"))
    six_mm = Camera(**{**NARROW, "focal_length_mm": 6.0})
    main_camera = Camera(**NARROW)
    (mounted,) = mounted_cameras(main_camera, ())
    moving = Motion(angular_velocity_deg_s=(0.0, 400.0, 150.0))
    shots = {
        "pinhole": (plain, main_camera, TILTED, None),
        "focused at infinity, f/2.2": (plain, Camera(**NARROW, focus_distance_m="infinity"), TILTED, None),
        "turning at 400 deg/s, 4 ms": (
            plain,
            main_camera,
            TILTED,
            poses_during(moving, mounted, TILTED, 4e-3, plain.scene),
        ),
        "square LEDs of 30 deg half power": (Renderer(office(panels=squares)), main_camera, TILTED, None),
        "a board occludes LEDs": (furnished, main_camera, TILTED, None),
        "3 mm lens: walls, reflected light": (plain, Camera(**WIDE), TILTED, None),
        "barrel distortion, k1 = -0.12": (plain, Camera(**WIDE, distortion={"k1": -0.12}), TILTED, None),
        "equidistant fish-eye": (
            plain,
            Camera(**{**WIDE, "focal_length_mm": 1.6}, projection="equidistant"),
            TILTED,
            None,
        ),
        "vignetting, pupil hidden at 50 deg": (plain, Camera(**WIDE, vignetting_deg=50.0), TILTED, None),
        "specular reflections in a glazing": (glazed, Camera(**WIDE), Pose((2.5, 3.5, 1.2), tilt_y_deg=-60.0), None),
        "tiled ceiling, a frame occludes LEDs": (
            meeting,
            six_mm,
            Pose((1.6, 0.4, 2.2), tilt_x_deg=-70.0, yaw_deg=10.0),
            None,
        ),
        "diffusers": (meeting, six_mm, Pose((2.1, 1.2, 1.4), tilt_x_deg=10.0, yaw_deg=10.0), None),
    }
    figure = Figure(figsize=(15, 7.4), layout="constrained")
    for axes, (title, (renderer, camera, pose, during)) in zip(
        figure.subplots(3, 4).ravel(), shots.items(), strict=True
    ):
        image = renderer.expected_image(PosedCamera(camera, pose), during=during).expected_electrons(1.0)
        image = image / np.quantile(image, 0.5) / WHITES.get(title, 12.0)
        axes.imshow(np.clip(image, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
    figure.savefig(OUT / "effects.png", dpi=90)


if __name__ == "__main__":
    main()
    fine_effects()
