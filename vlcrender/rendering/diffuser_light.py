"""Light of a diffuser in pixels that its lit part fills, by one kernel: a diffuser may fill the sensor, for many LEDs.

The numbers of camera, pose and diffuser are data, so that one kernel serves all LEDs. Positions on the diffuser, which
are metres from the camera's and compared with centimetres, are in double precision, luminance in that of the result.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.camera.roi import Roi
from vlcrender.camera.vignetting import relative_illumination
from vlcrender.core.backend import dr, exact_math, mi
from vlcrender.rendering.camera_data import CameraData
from vlcrender.scene.diffuser import Diffuser

MIN_RISE = 1e-9
"""Least upward component of a ray, against division by zero; such rays meet no diffuser."""


def light_of_diffuser(
    posed: PosedCamera,
    diffuser: Diffuser,
    height_m: float,
    nodes: Sequence[tuple[float, float]],
    unit: float,
    precision: type[np.floating],
    roi: Roi,
) -> Any:
    """Luminance of a diffuser at a height, over the LED's, times relative illumination times `unit`, row by row.

    nodes: positions in a pixel, from its centre, whose mean is taken. Returns a Dr.Jit array that is not yet evaluated.
    """

    number = mi.Float if precision is np.float32 else mi.Float64

    def data(value: float, of: Any = mi.Float64) -> Any:
        return dr.opaque(of, value)

    with exact_math():
        rotation, position_m = posed.rotation.T.tolist(), posed.pose.position_m
        to_x, to_y, to_z = ([data(value) for value in row] for row in rotation)
        foot_x, foot_y = (data(at - foot) for at, foot in zip(position_m, diffuser.foot_m, strict=False))
        rise = data(height_m - position_m[2])
        numbers = {name: data(getattr(diffuser, name), number) for name in ("distance_m", "transmittance", "area_m2")}
        about_foot = replace(diffuser, foot_m=(0.0, 0.0), **numbers)
        columns, row, column = (data(value % 2**32, mi.UInt32) for value in (roi.columns, roi.row, roi.column))
        index = dr.arange(mi.UInt32, roi.pixels)
        # Vectors have no division of integers. The quotient of two of 32 bits is never rounded up to a whole number.
        down = mi.UInt32(mi.Float64(index) / mi.Float64(columns))
        u, v = (mi.Float64(mi.Int32(place)) + 0.5 for place in (column + index - down * columns, row + down))
        camera, total = CameraData.of(posed.camera, mi.Float64), number(0.0)
        for du, dv in nodes:
            x, y, z = camera.unproject(u + du, v + dv, dr)
            distance = rise / dr.maximum(x * to_z[0] + y * to_z[1] + z * to_z[2], MIN_RISE)
            total += about_foot.at(
                number(foot_x + (x * to_x[0] + y * to_x[1] + z * to_x[2]) * distance),
                number(foot_y + (x * to_y[0] + y * to_y[1] + z * to_y[2]) * distance),
            )
        light = total * (data(unit, number) / len(nodes))
        return relative_illumination(CameraData.of(posed.camera, number), number(u), number(v), dr, light)
