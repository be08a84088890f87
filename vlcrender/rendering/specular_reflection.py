"""False images: LEDs seen by way of a window pane, each the image that the camera's mirror image has of it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose, ray_world
from vlcrender.camera.lens import blur, relative_illumination
from vlcrender.camera.roi import Roi
from vlcrender.rendering.expected_image import SpecularReflection
from vlcrender.rendering.led_blur import radius_px
from vlcrender.rendering.led_coverage import coverage_of_led, leds_that_may_be_seen
from vlcrender.rendering.led_radiance import face_of_led, luminance_pattern
from vlcrender.rendering.occlusion import Occlusion
from vlcrender.scene.fresnel import glazing_reflectance
from vlcrender.scene.loader import Scene
from vlcrender.scene.surfaces import Glazing

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MirroredPose(Pose):
    """The camera's mirror image in a pane: what it sees directly is what the camera sees by way of the pane."""

    mirror: tuple[tuple[float, ...], ...] = ()

    @property
    def rotation(self) -> Array:
        """R_cam_world after the mirror: it takes the mirrored world to the camera."""
        product: Array = super().rotation @ np.array(self.mirror)
        return product


def mirrored_pose(pose: Pose, glazing: Glazing) -> MirroredPose:
    """A camera's mirror image in a pane."""
    mirror = np.eye(3) - 2 * np.outer(glazing.normal, glazing.normal)
    behind = glazing.mirrored(np.array(pose.position_m))
    return MirroredPose(
        (float(behind[0]), float(behind[1]), float(behind[2])),
        pose.tilt_x_deg,
        pose.tilt_y_deg,
        pose.yaw_deg,
        tuple(map(tuple, mirror.tolist())),
    )


def specular_reflections(
    scene: Scene,
    occlusion: Occlusion,
    camera: Camera,
    pose: Pose,
    number: int,
    frames: Sequence[Roi],
    e_per_s_per_cd_m2: float,
) -> list[SpecularReflection]:
    """LEDs in the pane of this number, as far as it reaches and nothing stands in the way to it or from it.

    `e_per_s_per_cd_m2`: what 1 cd/m2 of an LED is worth on the axis. In parts, one for each frame that a false image
    reaches into; not blurred.
    """
    leds, glazing = scene.leds, scene.glazings[number]
    mirrored = mirrored_pose(pose, glazing)
    found = []
    for i in leds_that_may_be_seen(camera, mirrored, leds.centers_m, leds.reaches_m).tolist():
        image = coverage_of_led(camera, mirrored, *face_of_led(leds, i))
        if image is None:
            continue
        roi = Roi(image.row, image.column, *image.coverage.shape)
        if not any(frame.overlaps(roi) for frame in frames):
            continue
        lit = image.coverage > 0
        (clear,) = occlusion.clear_shares(camera, pose, [(float(leds.centers_m[i, 2]), roi, lit)], (number, mirrored))
        u, v = roi.centers_px()
        x, y, z = ray_world(camera, mirrored, u, v)
        east, north, up = glazing.normal.tolist()
        cosine = np.abs(x * east + y * north + z * up) / np.sqrt(x * x + y * y + z * z)
        weight = relative_illumination(camera, u, v) * glazing_reflectance(cosine, glazing.refractive_index, np.sqrt)
        pattern = luminance_pattern(leds, i, camera, mirrored, roi)
        light = e_per_s_per_cd_m2 * leds.luminances_cd_m2[i] * image.coverage * clear * weight * pattern
        for frame in frames:
            if frame.overlaps(roi):
                both = frame.intersection(roi)
                part = light[roi.slices(both)]
                if part.any():
                    found.append(SpecularReflection(int(leds.ids[i]), both.row, both.column, part.astype(np.float32)))
    return found


def blurred(
    images: Iterable[SpecularReflection], kernel: Array | None, frames: Sequence[Roi], sensor: Roi
) -> list[SpecularReflection]:
    """False images after the lens's blur, in parts, one for each frame that they reach into."""
    parts = []
    for image in images:
        roi = image.roi.padded(radius_px(kernel))
        if sensor.overlaps(roi):
            light = blur(image.electrons_per_s, kernel)
            for frame in frames:
                both = sensor.intersection(roi)
                if frame.overlaps(both):
                    both = frame.intersection(both)
                    parts.append(SpecularReflection(image.led_id, both.row, both.column, light[roi.slices(both)]))
    return parts
