"""The LEDs of a scene as built: displaced from the scene's by errors of the map, of luminaires and of single LEDs."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vlcrender.scene.leds import Leds
from vlcrender.scene.schema import SceneSettings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Luminaires:
    """The m luminaires of a scene: single LEDs in the order of the scene file, then panels grid by grid."""

    of_led: NDArray[np.int64]
    """Number of the luminaire of each LED, in the order of `Leds`, (n,)."""
    centers_m: Array
    """Mean of the centres of its LEDs, (m, 3), world."""

    def __len__(self) -> int:
        """Number of luminaires."""
        return len(self.centers_m)


@dataclass(frozen=True)
class BuildingErrors:
    """Errors of the n LEDs and m luminaires of one map."""

    luminaire_m: Array
    """Displacements of the luminaires, (m, 3)."""
    luminaire_rotation_deg: Array
    """Rotation vectors of the luminaires about their centres, world axes, (m, 3)."""
    led_m: Array
    """Displacements of the LEDs within their luminaires, (n, 3)."""
    led_size: Array
    """Relative errors of radii and sides, (n,)."""
    led_gradient: Array
    """Errors of the luminance gradients over the faces, (n, 2)."""
    datum_m: Array
    """Displacement of the whole map, (3,)."""
    datum_scale: float
    """Relative error of all lengths from the world's origin."""


def luminaires_of(settings: SceneSettings, leds: Leds) -> Luminaires:
    """The luminaires of a scene; `leds` are its LEDs."""
    luminaire: dict[int, int] = {entry.id: number for number, entry in enumerate(settings.led)}
    first = len(luminaire)
    for grid in settings.panels:
        panels, per_panel = grid.columns * grid.rows, grid.leds.columns * grid.leds.rows
        for i in range(panels * per_panel):
            luminaire[grid.leds.first_id + i] = first + i // per_panel
        first += panels
    of_led = np.array([luminaire[int(i)] for i in leds.ids], dtype=np.int64)
    centers = np.stack([leds.centers_m[of_led == number].mean(axis=0) for number in range(first)])
    return Luminaires(of_led, centers)


def as_built(leds: Leds, luminaires: Luminaires, errors: BuildingErrors) -> Leds:
    """The LEDs with the errors of a map, as "Told and true" in datasets/FORMAT.md has them.

    Faces stay horizontal, and the sides of squares along x and y. The lit part of a diffuser moves with its LED.
    """
    of_led = luminaires.of_led
    turns = Rotation.from_rotvec(errors.luminaire_rotation_deg, degrees=True).as_matrix() - np.eye(3)
    from_center = leds.centers_m - luminaires.centers_m[of_led]
    # not `@`: the last bits of a matrix product may depend on threads and processor
    turned = (turns[of_led] * from_center[:, None, :]).sum(axis=2)
    shifts = errors.luminaire_m[of_led] + turned + errors.led_m
    # As a sum of small shifts: an error of 0 leaves every bit.
    shifts = shifts + errors.datum_scale * (leds.centers_m + shifts) + errors.datum_m
    sizes = 1 + errors.led_size
    diffusers = tuple(
        diffuser and diffuser.as_built(x, y, size)
        for diffuser, (x, y, _), size in zip(leds.diffusers, shifts.tolist(), sizes.tolist(), strict=True)
    )
    return replace(
        leds,
        centers_m=leds.centers_m + shifts,
        half_widths_m=leds.half_widths_m * sizes,
        diffusers=diffusers,
        face_gradients=leds.face_gradients + errors.led_gradient,
    )
