"""What the bound and the error budget take as uncertain, from a recipe's belief."""

import numpy as np

from vlcrender.camera.rig import Mounted
from vlcrender.dataset.recipe.recipe import Recipe
from vlcrender.rendering.uncertainty import Uncertainty
from vlcrender.scene.as_built import luminaires_of
from vlcrender.scene.loader import Scene

FREE_TILT_RAD = 1.0
"""Sigma of the tilt of an LED's face where the map errs, about either axis: next to no knowledge of it. The shape of an
LED's image would tell the camera's tilt to some 0.01 deg if faces were exactly level and round, as the rendered ones
are; luminaires that hang by a tilt, and real faces, are not."""


def uncertainty_of(recipe: Recipe, scene: Scene, mounted: Mounted) -> Uncertainty:
    """Standard deviations of lens, map and mounting for one frame of a camera: errors of device and shot together.

    scene: with the LEDs as told or as built; `mounted`: as told or true. All are 0 where the recipe has no belief.
    """
    leds = scene.leds
    if recipe.belief is None:
        return Uncertainty.none(len(leds))
    sigmas = recipe.belief.true_sigmas(recipe.cameras, recipe.accelerometer)
    camera = sigmas.cameras[mounted.name]
    luminaires = luminaires_of(scene.settings, leds)
    map_errs = any(a.any() for a in (sigmas.luminaire_m, sigmas.luminaire_rotation_deg, sigmas.led_m))
    of_luminaire = np.concatenate([sigmas.luminaire_m, np.radians(sigmas.luminaire_rotation_deg)])
    return Uncertainty(
        intrinsics=np.hypot(camera.device, camera.shot),
        luminaire_of_led=luminaires.of_led,
        luminaires=np.tile(of_luminaire, (len(luminaires), 1)),
        led_positions_m=np.tile(sigmas.led_m, (len(leds), 1)),
        led_sizes=np.full(len(leds), sigmas.led_size),
        led_gradients=np.full(len(leds), sigmas.led_gradient),
        led_faces_rad=np.full(len(leds), FREE_TILT_RAD * map_errs),
        datum_m=sigmas.datum_m,
        scale=sigmas.datum_scale_ppm * 1e-6,
        mounting_rad=float(np.radians(camera.rotation_deg)),
    )
