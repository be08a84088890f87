"""The light that falls on the room's surfaces, in lux.

Today the surrounding light is flat: every surface gets the scene's ambient illuminance, which is defined to hold all
that does not come straight from an LED into the camera. Inter-reflection takes this module's place in the flow.
"""

import numpy as np
from numpy.typing import NDArray

from vlcrender.scene import Scene


def surface_luminance_cd_m2(scene: Scene) -> NDArray[np.float64]:
    """Luminance of each of `scene.surfaces`, reflectance * illuminance / pi, shape (surfaces,)."""
    reflectances = np.array([surface.reflectance for surface in scene.surfaces])
    return lambertian_luminance_cd_m2(reflectances, scene.settings.ambient.illuminance_lux)


def led_face_luminance_cd_m2(scene: Scene) -> NDArray[np.float64]:
    """Luminance that the faces of `scene.leds` have from the light they reflect alone, shape (LEDs,)."""
    reflectances = np.full(len(scene.leds), scene.settings.led_reflectance)
    return lambertian_luminance_cd_m2(reflectances, scene.settings.ambient.illuminance_lux)


def lambertian_luminance_cd_m2(reflectances: NDArray[np.float64], illuminance_lux: float) -> NDArray[np.float64]:
    """Luminance of diffuse surfaces under an illuminance: rho E / pi."""
    luminance: NDArray[np.float64] = reflectances * illuminance_lux / np.pi
    return luminance
