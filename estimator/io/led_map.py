"""The map of LEDs as devices know it: discs, squares, luminaires, the datum (datasets/FORMAT.md)."""

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, Strict, model_validator

from estimator.io.records import (
    INT64_MAX,
    Entry,
    LedId,
    NotNegative,
    NotNegativeTriple,
)

Floats = NDArray[np.float64]
DeviceNumber = Annotated[int, Field(ge=0, le=INT64_MAX)]
# Within 1000 km of the origin: any range to an LED, even a wrong one, can then be written.
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
LedSize = Annotated[float, Field(ge=1e-6, le=1e3)]
"""Radius or side, metres."""


class Luminaire(Entry):
    """Luminaire of the map: LEDs whose errors of position are common; keys as in dataset.json.

    Its LEDs are shifted together by an error of standard deviation `sigma_m` along x, y, z, and turned together about
    `position_m`, the mean of their positions, by one of `sigma_rotation_deg` about x, y, z.
    """

    id: LedId
    position_m: Annotated[tuple[Coordinate, Coordinate, Coordinate], Strict(False)]
    sigma_m: NotNegativeTriple
    sigma_rotation_deg: NotNegativeTriple

    def sigmas(self) -> Floats:
        """Standard deviations (6,) of the shift along x, y, z, metres, and of the rotation about them, radians."""
        return np.array([*self.sigma_m, *np.radians(self.sigma_rotation_deg)])


class MapDatum(Entry):
    """Standard deviations of the map's origin, along x, y, z, and of its scale about the origin, parts per million."""

    sigma_m: NotNegativeTriple
    scale_sigma_ppm: NotNegative

    def sigmas(self) -> Floats:
        """Standard deviations (4,) of the shift along x, y, z, metres, and of the relative scale."""
        return np.array([*self.sigma_m, 1e-6 * self.scale_sigma_ppm])


class Led(Entry):
    """LED of the map: identity, and centre of its horizontal face, world metres. See `DiscLed`, `SquareLed`.

    `luminaire` is the id of its luminaire, None for none. Standard deviations are None where the device does not state
    them: `sigma_m` of the position within the luminaire along x, y, z; `gradient_sigma` of gx and of gy, where the
    luminance is L (1 + gx x / r + gy y / r) over a face of half width r.
    """

    id: LedId
    position_m: Annotated[tuple[Coordinate, Coordinate, Coordinate], Strict(False)]
    shape: str
    luminaire: LedId | None = None
    sigma_m: NotNegativeTriple | None = None
    gradient_sigma: NotNegative | None = None

    @property
    def has_size(self) -> bool:
        """Whether the map says how large the LED is."""
        return True

    @property
    @abstractmethod
    def half_width_m(self) -> float:
        """Radius of a disc, half the side of a square, metres; NaN where the map does not say it."""

    @property
    @abstractmethod
    def size_sigma_m(self) -> float | None:
        """Standard deviation of the half width, metres; None where the device does not state it."""

    @property
    @abstractmethod
    def mean_square_extent_m2(self) -> float:
        """Mean of x^2 over the face, x measured from the centre along any direction of the face, m^2.

        0, that of a point, where the map does not say the size.
        """

    @property
    def states_errors(self) -> bool:
        """Whether the device states a standard deviation of the position, the size or the gradient."""
        return not (self.sigma_m is None and self.size_sigma_m is None and self.gradient_sigma is None)

    @property
    def shift_by_gradient_m(self) -> float:
        """Shift s^2 / r of the centre of the light by a gradient of 1, with the mean square extent s^2, metres."""
        return self.mean_square_extent_m2 / self.half_width_m if self.has_size else 0.0

    def sigmas(self) -> Floats:
        """Standard deviations (6,) of the position along x, y, z and of the half width, metres, and of gx and gy.

        What the device does not state counts as exact: 0.
        """
        gradient = self.gradient_sigma or 0.0
        return np.array([*(self.sigma_m or (0.0, 0.0, 0.0)), self.size_sigma_m or 0.0, gradient, gradient])

    def light_sigmas_m(self) -> Floats:
        """Standard deviations (3,) of the centre of the light within the luminaire along x, y, z, metres.

        They hold those of the position and of the shift by a gradient.
        """
        sigmas = self.sigmas()
        return np.hypot(sigmas[:3], [*(sigmas[4:] * self.shift_by_gradient_m), 0.0])


class DiscLed(Led):
    """Disc of radius `radius_m`, of standard deviation `radius_sigma_m`; None where the map does not say the radius."""

    shape: Literal["disc"] = "disc"
    radius_m: LedSize | None
    radius_sigma_m: NotNegative | None = None

    @model_validator(mode="before")
    @classmethod
    def _has_no_side(cls, entry: Any) -> Any:
        return _without_key(entry, "side_m", "a disc has radius_m, not side_m")

    @property
    def size_sigma_m(self) -> float | None:
        """Standard deviation of the half width, metres."""
        return self.radius_sigma_m

    @property
    def has_size(self) -> bool:
        """Whether the radius is known."""
        return self.radius_m is not None

    @property
    def half_width_m(self) -> float:
        """The radius, metres; NaN where it is not known."""
        return np.nan if self.radius_m is None else self.radius_m

    @property
    def mean_square_extent_m2(self) -> float:
        """A quarter of the radius squared, m^2; 0 where it is not known."""
        return 0.0 if self.radius_m is None else self.radius_m**2 / 4


class SquareLed(Led):
    """Square of side `side_m`, of standard deviation `side_sigma_m`; its sides are along x and y of the world."""

    shape: Literal["square"] = "square"
    side_m: LedSize
    side_sigma_m: NotNegative | None = None

    @model_validator(mode="before")
    @classmethod
    def _has_no_radius(cls, entry: Any) -> Any:
        return _without_key(entry, "radius_m", "a square has side_m (the whole side), not radius_m")

    @property
    def size_sigma_m(self) -> float | None:
        """Standard deviation of the half width, metres."""
        return None if self.side_sigma_m is None else self.side_sigma_m / 2

    @property
    def half_width_m(self) -> float:
        """Half the side, metres."""
        return self.side_m / 2

    @property
    def mean_square_extent_m2(self) -> float:
        """A twelfth of the side squared, m^2."""
        return self.side_m**2 / 12


def _without_key(entry: Any, key: str, message: str) -> Any:
    if isinstance(entry, Mapping) and key in entry:
        raise ValueError(message)
    return entry


AnyLed = Annotated[DiscLed | SquareLed, Field(discriminator="shape")]
"""An entry of `led_map`, told apart by `shape`."""


@dataclass(frozen=True, eq=False)
class LedArrays:
    """What the n LEDs of a map are, in its order.

    `positions_m` (n, 3), world metres; `half_widths_m` (n,), NaN where the map does not say the size; `sigmas` (n, 6)
    as `Led.sigmas` has them; `luminaires` (n,) ids, -1 for none. `have_sizes` says whether all have one. `numbers` are
    those of the LEDs in the arrays, by id.
    """

    positions_m: Floats
    half_widths_m: Floats
    sigmas: Floats
    luminaires: NDArray[np.int64]
    have_sizes: bool
    numbers: Mapping[int, int]


class LedMap(dict[int, AnyLed]):
    """LEDs by id, not changed once `arrays` is read."""

    @cached_property
    def arrays(self) -> LedArrays:
        """All LEDs as arrays."""
        return _arrays(tuple(self.values()))


def led_arrays(leds: Mapping[int, Led]) -> LedArrays:
    """LEDs of a map as arrays, in its order; made once for a `LedMap`."""
    return leds.arrays if isinstance(leds, LedMap) else _arrays(tuple(leds.values()))


def _arrays(leds: Sequence[Led]) -> LedArrays:
    return LedArrays(
        positions_m=np.array([led.position_m for led in leds]).reshape(-1, 3),
        half_widths_m=np.array([led.half_width_m for led in leds]),
        sigmas=np.array([led.sigmas() for led in leds]).reshape(-1, 6),
        luminaires=np.array([-1 if led.luminaire is None else led.luminaire for led in leds], dtype=np.int64),
        have_sizes=all(led.has_size for led in leds),
        numbers={led.id: k for k, led in enumerate(leds)},
    )


def leds_by_id(leds: Iterable[AnyLed]) -> LedMap:
    """LEDs by id; raises ValueError for an id that occurs twice."""
    entries = list(leds)
    mapped = LedMap((led.id, led) for led in entries)
    if len(mapped) != len(entries):
        raise ValueError("LED ids have to be unique")
    return mapped


def luminaires_by_id(luminaires: Iterable[Luminaire], leds: Iterable[Led]) -> dict[int, Luminaire]:
    """Luminaires by id; raises ValueError for an id that occurs twice, and for one that an LED names and is missing.

    Without any luminaires, which states nothing of them, LEDs may still say which of them belong together.
    """
    entries = list(luminaires)
    mapped = {luminaire.id: luminaire for luminaire in entries}
    if len(mapped) != len(entries):
        raise ValueError("luminaire ids have to be unique")
    for led in leds:
        if mapped and led.luminaire is not None and led.luminaire not in mapped:
            raise ValueError(f"LED {led.id} names luminaire {led.luminaire}, which is not in luminaires")
    return mapped
