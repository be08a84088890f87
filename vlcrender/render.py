"""The expected image of a view: electrons a second in every pixel, without noise.

The room is one mesh through which Mitsuba casts a ray for each pixel centre, and a grid of rays for each pixel in which
two surfaces meet. LEDs lie on top, each a window with its exact pixel coverage (`led_image`). An LED's face hides what
is behind it and reflects the surrounding light: that is part of the background; its own light is a patch of its own, so
that image = background + sum over LEDs of gain * patch, for any exposure and modulation.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.backend import dr, exact_math, mi
from vlcrender.camera import Camera, Pose, project
from vlcrender.errors import InputError
from vlcrender.irradiance import led_face_luminance_cd_m2, surface_luminance_cd_m2
from vlcrender.led_image import LedImage, image_of_disc
from vlcrender.photometry import Silicon, electron_rate_per_cd_m2
from vlcrender.scene import Scene, Surface

EDGE_GRID = 8
"""Rays across a pixel where surfaces meet: the error is about 0.3 / 8^1.5 = 1.3 % of the step between them."""

Image = NDArray[np.float32]


@dataclass(frozen=True)
class LedPatch:
    """One LED's own light. `electrons_per_s` (rows, columns) starts at pixel (row, column) of the image."""

    led_id: int
    center_px: tuple[float, float]
    """Image of the LED's centre (u, v); may lie outside the sensor."""
    row: int
    column: int
    electrons_per_s: Image
    visible_fraction: float


@dataclass(frozen=True)
class View:
    """A camera's view of a scene: `background_e_per_s` (height, width) and one patch for each LED it sees."""

    background_e_per_s: Image
    patches: tuple[LedPatch, ...]

    def expected_electrons(self, exposure_s: float, gains: Mapping[int, float] | None = None) -> Image:
        """Mean electrons of an exposure, (height, width). `gains`: by LED id, 1 where not given."""
        image = self.background_e_per_s * np.float32(exposure_s)
        for patch in self.patches:
            gain = 1.0 if gains is None else gains.get(patch.led_id, 1.0)
            rows, columns = patch.electrons_per_s.shape
            window = image[patch.row : patch.row + rows, patch.column : patch.column + columns]
            window += patch.electrons_per_s * np.float32(gain * exposure_s)
        return image


class Renderer:
    """Renders views of one scene. Holds the scene's mesh for Mitsuba."""

    def __init__(self, scene: Scene, silicon: Silicon | None = None) -> None:
        """Prepare a scene. `silicon` is the photodiode that turns light into electrons."""
        self.scene = scene
        self.silicon = silicon or Silicon()
        self._mitsuba_scene = mi.load_dict({"type": "scene", "room": room_mesh(scene.surfaces)}, optimize=False)
        self._luminance = mi.Float(np.append(surface_luminance_cd_m2(scene), 0.0).astype(np.float32))

    def view(self, camera: Camera, pose: Pose) -> View:
        """Render one view. Raises InputError where the camera is not inside the room."""
        check_inside(self.scene, pose)
        ambient = electron_rate_per_cd_m2(camera, self.scene.settings.ambient.spectrum, self.silicon)
        lamp = electron_rate_per_cd_m2(camera, self.scene.settings.led_spectrum, self.silicon)
        background = self.background_cd_m2(camera, pose)
        background *= np.float32(ambient)
        faces_e_per_s = ambient * led_face_luminance_cd_m2(self.scene)
        patches = []
        for i, image in self._led_images(camera, pose):
            cos4 = _cos4(camera, image)
            rows, columns = image.coverage.shape
            window = background[image.row : image.row + rows, image.column : image.column + columns]
            window[...] = window * (1 - image.coverage) + faces_e_per_s[i] * image.coverage * cos4
            light = (lamp * self.scene.leds.luminances_cd_m2[i] * image.coverage * cos4).astype(np.float32)
            patches.append(self._patch(camera, pose, i, image, light))
        return View(background, tuple(patches))

    def background_cd_m2(self, camera: Camera, pose: Pose) -> Image:
        """Luminance of the surfaces times cos^4 of the field angle, averaged over each pixel, (height, width)."""
        with exact_math():
            width, height = camera.width_px, camera.height_px
            index = dr.arange(mi.UInt32, width * height)
            row = index // width
            u, v = mi.Float(index - row * width) + 0.5, mi.Float(row) + 0.5
            value, surface = self._look(camera, pose, u, v)
            dr.eval(value, surface)
            image: Image = value.numpy().reshape(height, width)
            edges = np.flatnonzero(_differs_from_neighbour(surface.numpy().reshape(height, width)))
            if len(edges):
                image.ravel()[edges] = self._supersample(camera, pose, edges)
            return image

    def _look(self, camera: Camera, pose: Pose, u: "mi.Float", v: "mi.Float") -> "tuple[mi.Float, mi.UInt32]":
        """Luminance times cos^4 and surface number that pixels (u, v) see."""
        # Python floats: a NumPy scalar times a Dr.Jit array would become a NumPy array.
        inverse = np.linalg.inv(camera.matrix).tolist()
        x = inverse[0][0] * u + inverse[0][1] * v + inverse[0][2]
        y = inverse[1][1] * v + inverse[1][2]
        to_world = pose.rotation.T.tolist()
        direction = mi.Vector3f(*(row[0] * x + row[1] * y + row[2] for row in to_world))
        ray = mi.Ray3f(mi.Point3f(*pose.position_m), dr.normalize(direction))
        hit = self._mitsuba_scene.ray_intersect_preliminary(ray, coherent=True)
        # Two triangles a surface; what hits nothing gets the black entry at the end.
        surface = dr.select(hit.is_valid(), hit.prim_index // 2, len(self.scene.surfaces))
        cos2 = 1.0 / (1.0 + x * x + y * y)
        return dr.gather(mi.Float, self._luminance, surface) * cos2 * cos2, surface

    def _supersample(self, camera: Camera, pose: Pose, pixels: NDArray[np.int64]) -> Image:
        """Mean over an EDGE_GRID x EDGE_GRID grid in each of the pixels (row * width + column)."""
        grid = EDGE_GRID
        index = dr.arange(mi.UInt32, len(pixels) * grid * grid)
        number = index // (grid * grid)
        sub = index - number * (grid * grid)
        pixel = dr.gather(mi.UInt32, mi.UInt32(pixels.astype(np.uint32)), number)
        row = pixel // camera.width_px
        sub_row = sub // grid
        u = mi.Float(pixel - row * camera.width_px) + (mi.Float(sub - sub_row * grid) + 0.5) / grid
        v = mi.Float(row) + (mi.Float(sub_row) + 0.5) / grid
        value, _ = self._look(camera, pose, u, v)
        mean: Image = value.numpy().reshape(-1, grid * grid).mean(axis=1)
        return mean

    def _led_images(self, camera: Camera, pose: Pose) -> Iterator[tuple[int, LedImage]]:
        """Index and image of each LED that lights a pixel."""
        leds = self.scene.leds
        for i in range(len(leds)):
            image = image_of_disc(camera, pose, leds.centers_m[i], float(leds.radii_m[i]))
            if image is not None:
                yield i, image

    def _patch(self, camera: Camera, pose: Pose, i: int, image: LedImage, light: Image) -> LedPatch:
        center, _ = project(camera, pose, self.scene.leds.centers_m[i])
        return LedPatch(
            led_id=int(self.scene.leds.ids[i]),
            center_px=(float(center[0]), float(center[1])),
            row=image.row,
            column=image.column,
            electrons_per_s=light,
            visible_fraction=image.visible_fraction,
        )


def check_inside(scene: Scene, pose: Pose) -> None:
    """Raise InputError where the camera is not inside the room."""
    if not all(0 < p < limit for p, limit in zip(pose.position_m, scene.room_m, strict=True)):
        raise InputError(
            f"camera position {list(pose.position_m)} m is not inside the room of {scene.room_m.tolist()} m"
        )


def room_mesh(surfaces: tuple[Surface, ...]) -> "mi.Mesh":
    """All surfaces as one Mitsuba mesh, two triangles each, in order: surface = primitive // 2."""
    corners = np.stack(
        [s.corner_m + a * s.edge_u_m + b * s.edge_v_m for s in surfaces for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
    )
    first = 4 * np.arange(len(surfaces), dtype=np.uint32)[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]], axis=1)
    mesh = mi.Mesh("room", len(corners), 2 * len(surfaces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = corners.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh


def _differs_from_neighbour(labels: NDArray[np.uint32]) -> NDArray[np.bool_]:
    """Pixels of which one of the 8 neighbours shows another surface."""
    differs = np.zeros(labels.shape, dtype=bool)
    for here, there in (
        (np.s_[:, 1:], np.s_[:, :-1]),
        (np.s_[1:, :], np.s_[:-1, :]),
        (np.s_[1:, 1:], np.s_[:-1, :-1]),
        (np.s_[1:, :-1], np.s_[:-1, 1:]),
    ):
        change = labels[here] != labels[there]
        differs[here] |= change
        differs[there] |= change
    return differs


def _cos4(camera: Camera, image: LedImage) -> NDArray[np.float64]:
    """cos^4 of the field angle at the pixel centres of an LED's window."""
    rows, columns = image.coverage.shape
    inverse = np.linalg.inv(camera.matrix)
    v = (image.row + 0.5 + np.arange(rows))[:, None]
    u = (image.column + 0.5 + np.arange(columns))[None, :]
    x = inverse[0, 0] * u + inverse[0, 1] * v + inverse[0, 2]
    y = inverse[1, 1] * v + inverse[1, 2]
    cos4: NDArray[np.float64] = (1.0 + x * x + y * y) ** -2
    return cos4
