"""Specular reflections of LEDs in glazings: each is the LED's image in the camera's mirror image."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.psf import blur, kernel_radius_px
from vlcrender.camera.roi import Roi
from vlcrender.camera.vignetting import relative_illumination
from vlcrender.rendering.expected_image import SpecularReflection
from vlcrender.rendering.led_coverage import coverage_of_led
from vlcrender.rendering.led_radiance import face_of_led, luminance_pattern
from vlcrender.rendering.occlusion import LitRegion, Mirror, Occlusion
from vlcrender.scene.fresnel import glazing_reflectance
from vlcrender.scene.loader import Scene
from vlcrender.scene.surfaces import Glazing

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MirroredPose(Pose):
    """A camera's mirror image in a glazing: it sees directly what the camera sees by way of the glazing."""

    mirror: tuple[tuple[float, ...], ...] = ()
    """The reflection, rows of a (3, 3) matrix."""

    @property
    def rotation(self) -> Array:
        """R_cam_world after the reflection: takes the mirrored world to camera axes."""
        product: Array = super().rotation @ np.array(self.mirror)
        return product


def mirrored_pose(pose: Pose, glazing: Glazing) -> MirroredPose:
    """The mirror image of a pose in a glazing."""
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
    scene: Scene, occlusion: Occlusion, posed: PosedCamera, number: int, rois: Sequence[Roi], led_rate: float
) -> list[SpecularReflection]:
    """Reflections of all LEDs in the glazing of this number, less what is occluded on either side of it; not blurred.

    led_rate: electrons a second of 1 cd/m2 of an LED on the axis (`ElectronRates.led`). A reflection that extends into
    several regions is given in parts, one for each.
    """
    leds, glazing, camera = scene.leds, scene.glazings[number], posed.camera
    mirrored = posed.at(mirrored_pose(posed.pose, glazing))
    found = []
    for i in leds.spheres.candidates(mirrored).tolist():
        image = coverage_of_led(mirrored, face_of_led(leds, i))
        if image is None:
            continue
        roi = image.roi
        if not any(region.overlaps(roi) for region in rois):
            continue
        lit = LitRegion(float(occlusion.heights_m[i]), roi, image.coverage > 0)
        (clear,) = occlusion.clear_shares(posed, [lit], Mirror(number, mirrored.pose))
        u, v = roi.centers_px()
        x, y, z = mirrored.ray_world(u, v)
        normal_x, normal_y, normal_z = glazing.normal.tolist()
        cosine = np.abs(x * normal_x + y * normal_y + z * normal_z) / np.sqrt(x * x + y * y + z * z)
        weight = relative_illumination(camera, u, v) * glazing_reflectance(cosine, glazing.refractive_index, np.sqrt)
        pattern = luminance_pattern(leds, i, mirrored, roi) * image.profile
        light = led_rate * leds.luminances_cd_m2[i] * image.coverage * clear * weight * pattern
        for region in rois:
            if region.overlaps(roi):
                both = region.intersection(roi)
                part = light[roi.slices(both)]
                if part.any():
                    found.append(SpecularReflection(int(leds.ids[i]), both.row, both.column, part.astype(np.float32)))
    return found


def blurred(
    reflections: Iterable[SpecularReflection], kernel: Array | None, rois: Sequence[Roi], sensor: Roi
) -> list[SpecularReflection]:
    """Reflections after the lens's blur, in parts, one for each region that they extend into."""
    parts = []
    for reflection in reflections:
        roi = reflection.roi.padded(kernel_radius_px(kernel))
        if sensor.overlaps(roi):
            light = blur(reflection.electrons_per_s, kernel)
            on_sensor = sensor.intersection(roi)
            for region in rois:
                if region.overlaps(on_sensor):
                    both = region.intersection(on_sensor)
                    part = light[roi.slices(both)]
                    parts.append(SpecularReflection(reflection.led_id, both.row, both.column, part))
    return parts
