"""Make the pictures of docs/effects.md: python docs/make_pictures.py"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.rig import mounted_cameras
from vlcrender.config.toml_model import check, read_toml
from vlcrender.dataset.motion import Motion, poses_during
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.loader import Scene, build_scene, load_scene
from vlcrender.scene.schema import SceneSettings

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
