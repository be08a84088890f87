"""Factors from luminance to the electrons that images hold, for light of the LEDs and for ambient light."""

from dataclasses import dataclass

from vlcrender.camera.intrinsics import Camera
from vlcrender.scene.loader import Scene
from vlcrender.sensor.radiometry import Detector, electron_rate_per_cd_m2


@dataclass(frozen=True)
class ElectronRates:
    """Electrons a second in an on-axis pixel that sees 1 cd/m2, by the light's spectrum."""

    led: float
    """Of light that left an LED, reflected or not."""
    ambient: float
    """Of all other light."""

    @classmethod
    def of(cls, scene: Scene, camera: Camera, detector: Detector) -> "ElectronRates":
        """Rates of a scene's two spectra on the detector of a camera, of the light that glare does not scatter."""
        settings = scene.settings
        sharp = 1.0 if camera.glare is None else 1.0 - camera.glare.share
        return cls(
            led=electron_rate_per_cd_m2(camera, settings.led_spectrum, detector) * sharp,
            ambient=electron_rate_per_cd_m2(camera, settings.ambient.spectrum, detector) * sharp,
        )


DARK = ElectronRates(0.0, 0.0)
"""For rays whose light is not needed."""
