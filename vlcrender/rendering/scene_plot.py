"""Picture of a scene: a floor plan, and the image of a camera on the floor."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import RegionImage, Roi
from vlcrender.camera.vignetting import relative_illumination
from vlcrender.light.lightmap import Lightmap
from vlcrender.rendering.renderer import Renderer
from vlcrender.scene.leds import Leds
from vlcrender.scene.loader import Scene
from vlcrender.scene.visibility import leds_in_view
from vlcrender.sensor.radiometry import Silicon, electron_rate_per_cd_m2

EXPOSURE_S = 160e-6
"""Exposure time of the image."""
REFERENCE_SCALE = 8
"""Size of the reference's pixels, in pixels of the camera."""
REFERENCE_SAMPLES = 128
"""Samples per pixel of the reference."""
WHITE_E = 4000.0
"""Electrons that are drawn white."""
DISC_CORNERS = 16
"""Corners of a disc's outline on the plan."""
LABEL_ROOM = 0.05
"""Share of the image at each edge in which the identity of an LED is written on the side that has room."""
DRAWN_PX = 1000
"""Width to which an image is reduced, about."""


def show_pose(scene: Scene, camera: Camera) -> PosedCamera:
    """A level pose on the floor that sees as many LEDs as can be, of those under the middle of LEDs near each other."""
    best, most = None, -1
    centers = scene.leds.centers_m
    middle = scene.room_m[:2] / 2
    order = np.argsort(np.linalg.norm(centers[:, :2] - middle, axis=1), kind="stable")[:50]
    for yaw in (0.0, 90.0):
        for center in centers[order]:
            near = centers[np.linalg.norm(centers - center, axis=1) < 0.5]
            x, y = near[:, :2].mean(axis=0)
            posed = PosedCamera(camera, Pose((float(x), float(y), 0.05), yaw_deg=yaw))
            count = len(leds_in_view(posed, scene))
            if count > most:
                best, most = posed, count
    assert best is not None  # a scene has at least one LED
    return best


def footprint_m(posed: PosedCamera, z_m: float) -> NDArray[np.float64]:
    """What a camera sees of the plane at height z_m: x and y of the four corners of its image, (4, 2) metres."""
    size = np.array([posed.camera.width_px, posed.camera.height_px])
    rays = posed.rays_world(size * np.array([[0, 0], [1, 0], [1, 1], [0, 1]]))
    reach = (z_m - posed.position_m[2]) / rays[:, 2]
    return np.asarray(posed.position_m[:2] + rays[:, :2] * reach[:, None])


def draw(scene: Scene, camera: Camera, path: Path, reference: bool = False, light: Lightmap | None = None) -> None:
    """Write a PNG with the floor plan and the image from `show_pose`.

    reference: let Mitsuba path-trace the image, slowly and in pixels REFERENCE_SCALE times as large. light: of the
    scene, baked here where it is None.
    """
    posed = show_pose(scene, camera)
    electrons: NDArray[Any]
    if reference:
        electrons = _reference_electrons(scene, posed)
    else:
        electrons = Renderer(scene, light).expected_image(posed).expected_electrons(EXPOSURE_S)
    x, y, z = posed.position_m
    title = (
        f"level camera at ({x:.2f}, {y:.2f}, {z:.2f}) m, yaw {posed.pose.yaw_deg:g} deg, "
        f"{EXPOSURE_S * 1e6:g} us at f/{camera.f_number:g}; gamma 2.2"
    )
    places = {
        int(scene.leds.ids[i]): tuple(map(float, posed.project(scene.leds.centers_m[i])))
        for i in leds_in_view(posed, scene)
    }
    sensor = Roi.of_sensor(camera)
    draw_view(scene, posed, [RegionImage(sensor, electrons / WHITE_E)], places, title, path)


def draw_view(
    scene: Scene,
    posed: PosedCamera,
    regions: Sequence[RegionImage],
    places_px: Mapping[int, tuple[float, ...]],
    title: str,
    path: Path,
    positions_m: NDArray[np.float64] | None = None,
) -> None:
    """Write a PNG with the floor plan and an image.

    regions: the image, 1 is white; pixels outside of them are drawn blue. places_px: image (u, v) of LEDs by id, which
    are named there. positions_m: places of further poses, (n, 3), world, as points of the plan.
    """
    figure = Figure(figsize=(14, 6.2), layout="constrained")
    plan, image = figure.subplots(1, 2, width_ratios=[1, 1.25])
    faces = _draw_plan(plan, scene, posed, positions_m)
    if np.ptp(scene.leds.luminances_cd_m2) > 0:
        figure.colorbar(faces, ax=plan, label="LED luminance, cd/m$^2$", shrink=0.8)
    _draw_image(image, posed.camera, regions, places_px)
    image.set_title(title)
    figure.savefig(path, dpi=110)


def _draw_plan(axes: Axes, scene: Scene, posed: PosedCamera, positions_m: NDArray[np.float64] | None) -> PolyCollection:
    x_m, y_m, z_m = scene.room_m
    undersides = [s for s in scene.surfaces if s.name.endswith("underside")]
    axes.add_patch(Rectangle((0, 0), x_m, y_m, fill=False, lw=1.5))
    axes.add_collection(
        PolyCollection(
            [
                [(s.corner_m + a * s.edge_u_m + b * s.edge_v_m)[:2] for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
                for s in undersides
            ],
            facecolors="0.92",
            edgecolors="0.6",
            linewidths=0.5,
        )
    )
    leds = scene.leds
    faces = PolyCollection(outlines_m(leds, 0.004 * max(x_m, y_m)), cmap="plasma", linewidths=0)
    faces.set_array(leds.luminances_cd_m2)
    axes.add_collection(faces)
    footprint = footprint_m(posed, float(leds.centers_m[:, 2].mean()))
    axes.add_collection(PolyCollection([footprint], facecolors="none", edgecolors="tab:blue", linewidths=1.5))
    if positions_m is not None:
        axes.plot(positions_m[:, 0], positions_m[:, 1], ".", color="tab:green", ms=3, alpha=0.6)
    axes.plot(*posed.pose.position_m[:2], "+", color="tab:blue", ms=10)
    axes.set(
        xlim=(-0.02 * x_m, 1.02 * x_m),
        ylim=(1.02 * y_m, -0.02 * y_m),
        xlabel="x, m",
        ylabel="y, m (down, as in the image)",
    )
    axes.set_aspect("equal")
    others = "" if positions_m is None else f"; green: {len(positions_m)} poses"
    count = f"{len(leds)} LED{'s' * (len(leds) != 1)}"
    if np.ptp(leds.luminances_cd_m2) == 0:
        count += f" of {leds.luminances_cd_m2[0]:g} cd/m$^2$"
    title = f"{scene.name}: {x_m:g} x {y_m:g} x {z_m:g} m,\n{count} seen from below; blue: the image{others}"
    axes.set_title(title)
    return faces


def outlines_m(leds: Leds, least_m: float) -> list[NDArray[np.float64]]:
    """Outlines (n, 2) of the LEDs' faces from below, x and y; those narrower than `least_m` are drawn as wide."""
    round_angles = np.linspace(0, 2 * np.pi, DISC_CORNERS, endpoint=False)
    disc = np.stack([np.cos(round_angles), np.sin(round_angles)], axis=1)
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return [
        center[:2] + max(half_m, least_m / 2) * (square if leds.squares[i] else disc)
        for i, (center, half_m) in enumerate(zip(leds.centers_m, leds.half_widths_m.tolist(), strict=True))
    ]


def _reference_electrons(scene: Scene, posed: PosedCamera) -> NDArray[np.float64]:
    from vlcrender.rendering.path_traced import reference_cd_m2  # loads trimesh

    camera = posed.camera
    coarse = camera.model_copy(
        update={
            "width_px": camera.width_px // REFERENCE_SCALE,
            "height_px": camera.height_px // REFERENCE_SCALE,
            "pixel_pitch_um": camera.pixel_pitch_um * REFERENCE_SCALE,
        }
    )
    cd_m2, _ = reference_cd_m2(scene, PosedCamera(coarse, posed.pose), REFERENCE_SAMPLES)
    u, v = np.meshgrid(np.arange(coarse.width_px) + 0.5, np.arange(coarse.height_px) + 0.5)
    # electrons of a pixel of the real size; both spectra as the LEDs'
    rate = electron_rate_per_cd_m2(camera, scene.settings.led_spectrum, Silicon())
    electrons: NDArray[np.float64] = EXPOSURE_S * rate * cd_m2 * relative_illumination(coarse, u, v)
    return electrons


def _draw_image(
    axes: Axes, camera: Camera, regions: Sequence[RegionImage], places_px: Mapping[int, tuple[float, ...]]
) -> None:
    block = max(1, camera.width_px // DRAWN_PX)
    axes.set_facecolor("#26324a")
    for roi, light in regions:
        small = light
        if min(light.shape) >= 2 * block:
            rows, columns = (n // block * block for n in light.shape)
            blocks = light[:rows, :columns].reshape(rows // block, block, columns // block, block)
            small = blocks.mean(axis=(1, 3))
        axes.imshow(
            np.clip(small, 0, 1) ** (1 / 2.2),
            cmap="gray",
            vmin=0,
            vmax=1,
            extent=(roi.column, roi.column + roi.columns, roi.row + roi.rows, roi.row),
            interpolation="nearest",
        )
    axes.set(xlim=(0, camera.width_px), ylim=(camera.height_px, 0), xlabel="u, px", ylabel="v, px")
    axes.set_aspect("equal")
    beside = LABEL_ROOM * camera.width_px
    for led_id, (u, v) in places_px.items():
        below = v < LABEL_ROOM * camera.height_px
        axes.annotate(
            str(led_id),
            (u, v),
            xytext=(0, -9 if below else 9),
            textcoords="offset points",
            color="orange",
            ha="left" if u < beside else "right" if u > camera.width_px - beside else "center",
            va="top" if below else "bottom",
            fontsize=7,
            annotation_clip=True,
        )
