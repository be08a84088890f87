"""Relative illumination: the fall-off of light from the optical axis, natural and by mechanical vignetting."""

from typing import Any

import numpy as np

from vlcrender.camera.intrinsics import Camera


def relative_illumination(camera: Camera, u: Any, v: Any, xp: Any = np, luminance: Any = 1.0) -> Any:
    """Illuminance at pixel positions (u, v) over the illuminance on the axis, for one luminance; elementwise.

    cos(theta) (the pupil seen at an angle) times the pixel's solid angle over a pixel's on the axis, times the share of
    the pupil that the second stop leaves: cos^4 for a perspective lens, over the distortion's Jacobian determinant;
    cos(theta) sin(theta) / theta for an equidistant one, 0 beyond 90 deg. Arrays as in `Camera.unproject`. `luminance`,
    of the same shape or a number, is multiplied by one factor after the other, since rounding depends on the order.
    """
    x, y = camera.sensor_position(u, v)
    light, tangent = camera.lens_projection.illumination(x, y, xp, luminance)
    if camera.vignetting_deg is not None:
        light = light * _pupil_share(tangent / float(np.tan(np.radians(camera.vignetting_deg))), xp)
    return light


def _pupil_share(shift: Any, xp: Any) -> Any:
    """Area that two equal circles with centres `shift` diameters apart share, over the area of one."""
    s = xp.minimum(shift, 1.0)
    share = (xp.acos(s) - s * xp.sqrt(1.0 - s * s)) * (2 / np.pi)
    return xp.maximum(share, 0.0)  # rounding: light is never negative
