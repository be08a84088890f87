"""LEDs as a camera sees them during a frame, before their light is computed, and the regions that are read out."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import LedRegions, Roi, led_regions
from vlcrender.rendering.led_blur import LedBlur
from vlcrender.rendering.led_radiance import LedImage
from vlcrender.rendering.readout import Knot, RollingPoses

Array = NDArray[np.float64]
LedImages = Mapping[int, LedImage]
"""Images of the LEDs at one pose, by the LED's index."""
During = Sequence[Pose] | RollingPoses
"""Poses of a moving camera: spread evenly over the exposure of all lines, or of each line."""


@dataclass(frozen=True)
class LedBand:
    """The LEDs as a camera sees them at one or more poses, in lines of the sensor."""

    poses: tuple[PosedCamera, ...]
    images: tuple[LedImages, ...]
    knot: Knot | None = None
    """The lines, and the share of these poses in each; None for all lines."""

    def share(self, roi: Roi) -> tuple[Roi, Array | float] | None:
        """The lines in a region, and the share of these poses in them; None where there are none."""
        if self.knot is None:
            return roi, 1.0
        if not self.knot.lines.overlaps(roi):
            return None
        inside = self.knot.lines.intersection(roi)
        return inside, self.knot.weights_in(inside)


@dataclass(frozen=True)
class LedView:
    """The LEDs as a camera sees them at one or more poses, and the pixels that each lights, by its index."""

    posed: PosedCamera
    bands: tuple[LedBand, ...]
    blurs: LedBlur
    patch_rois: Mapping[int, Roi]
    rolling: RollingPoses | None = None
    """Poses of the lines of a moving camera with a rolling shutter."""


def read_out(views: Sequence[LedView], regions: LedRegions | None, reach_px: int = 0) -> tuple[Roi, ...]:
    """The regions that are read out of a sensor: all of it, or regions around the LEDs of one or more views.

    reach_px: pixels around its image that an LED lights by crosstalk.
    """
    camera = views[0].posed.camera
    if regions is None:
        return (Roi.of_sensor(camera),)
    rois = dict(views[0].patch_rois)
    for view in views[1:]:
        for i, roi in view.patch_rois.items():
            rois[i] = rois[i].union(roi) if i in rois else roi
    if reach_px:
        sensor = Roi.of_sensor(camera)
        lit = {i: roi.padded(reach_px) for i, roi in rois.items()}
        rois = {i: lit[i].intersection(sensor) if sensor.contains(roi) else lit[i] for i, roi in rois.items()}
    return led_regions(rois.values(), camera, regions)


def union_of(images: Iterable[LedImage]) -> Roi:
    """The region that contains several images of an LED."""
    return reduce(Roi.union, (image.roi for image in images))


def cut(light: Array, of: Roi, roi: Roi) -> Array:
    """Light in the region `of`, in another region that it may not fill."""
    if of.contains(roi):
        return light[of.slices(roi)]
    filled = np.zeros((roi.rows, roi.columns))
    if of.overlaps(roi):
        both = of.intersection(roi)
        filled[roi.slices(both)] = light[of.slices(both)]
    return filled


def patch_rois(camera: Camera, bands: Sequence[LedBand], blurs: LedBlur, regions: LedRegions | None) -> dict[int, Roi]:
    """By the LED's index, the pixels that it lights, blur included; on the sensor only, unless with overscan."""
    sensor = Roi.of_sensor(camera)
    rois: dict[int, Roi] = {}
    for band in bands:
        for i in sorted({i for of_pose in band.images for i in of_pose}):
            roi = union_of(of_pose[i] for of_pose in band.images if i in of_pose).padded(blurs.kernel(i).radius_px)
            if regions is None or not regions.overscan:
                if not sensor.overlaps(roi):
                    continue
                roi = roi.intersection(sensor)
            shared = band.share(roi)
            if shared is not None:
                rois[i] = rois[i].union(shared[0]) if i in rois else shared[0]
    return dict(sorted(rois.items()))
