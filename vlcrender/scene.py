"""The room: surfaces, panels and LEDs. TOML in, checked geometry in world coordinates out.

World: metres, right-handed, z up, origin at a floor corner.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vlcrender.errors import InputError
from vlcrender.settings import Settings, check, read_toml
from vlcrender.streams import stream

Length = Annotated[float, Field(gt=0, le=1000)]
Reflectance = Annotated[float, Field(ge=0, le=1)]
Luminance = Annotated[float, Field(gt=0, le=1e9)]
Illuminance = Annotated[float, Field(ge=0, le=1e6)]
Count = Annotated[int, Field(ge=1, le=1000)]
Identity = Annotated[int, Field(ge=0, lt=2**31)]
Point = tuple[float, float, float]
Spectrum = Literal["LED-B1", "LED-B2", "LED-B3", "LED-B4", "LED-B5", "LED-BH1", "LED-V1", "LED-V2"]

TOUCH_M = 1e-9
"""Rounding allowance where an LED or panel touches a wall or another LED."""


class RoomReflectances(Settings):
    """Diffuse reflectance (albedo) of the room's surfaces, 0 to 1."""

    floor: Reflectance
    ceiling: Reflectance
    walls: Reflectance


class Room(Settings):
    """A box with one corner at the origin."""

    size_m: tuple[Length, Length, Length]
    reflectance: RoomReflectances


class Ambient(Settings):
    """Surrounding light: all that reaches a surface and does not come straight from an LED."""

    illuminance_lux: Illuminance
    spectrum: Spectrum


class LedEntry(Settings):
    """One LED: a disc that faces down."""

    id: Identity
    position_m: Point
    radius_m: Length
    luminance_cd_m2: Luminance


class PanelLeds(Settings):
    """The two-dimensional array of LEDs on the underside of a panel, centred on it."""

    columns: Count
    rows: Count
    pitch_m: tuple[Length, Length]
    radius_m: Length
    luminance_cd_m2: tuple[Luminance, Luminance]
    """Each LED's luminance is drawn evenly between the two, once and for all, by `luminance_seed`."""
    luminance_seed: Identity = 0
    first_id: Identity
    """LED (row, column) of panel (row, column): ids go up along columns first, then rows, then panels likewise."""


class PanelGrid(Settings):
    """Equal panels on a rectangular grid; each is a box whose underside carries LEDs."""

    columns: Count
    rows: Count
    first_center_m: Point
    """Centre of the underside of the panel nearest the origin."""
    pitch_m: tuple[Length, Length]
    size_m: tuple[Length, Length, Length]
    """Along x, along y, and upwards from the underside."""
    reflectance: Reflectance
    leds: PanelLeds


class SceneSettings(Settings):
    """A scene file."""

    format: Literal["vlcrender-scene"]
    version: Literal[1]
    name: Annotated[str, Field(min_length=1, max_length=100)]
    description: str = ""
    led_spectrum: Spectrum
    led_reflectance: Reflectance
    """Of an LED's own face, under the surrounding light."""
    room: Room
    ambient: Ambient
    led: tuple[LedEntry, ...] = ()
    panels: tuple[PanelGrid, ...] = ()


@dataclass(frozen=True)
class Surface:
    """A diffuse parallelogram: corner + a * edge_u + b * edge_v with a, b in [0, 1]; seen from edge_u x edge_v."""

    name: str
    corner_m: NDArray[np.float64]
    edge_u_m: NDArray[np.float64]
    edge_v_m: NDArray[np.float64]
    reflectance: float


@dataclass(frozen=True)
class Leds:
    """All LEDs of a scene, sorted by id: discs that face down (normal 0, 0, -1)."""

    ids: NDArray[np.int64]
    centers_m: NDArray[np.float64]
    radii_m: NDArray[np.float64]
    luminances_cd_m2: NDArray[np.float64]

    def __len__(self) -> int:
        """Count the LEDs."""
        return len(self.ids)


@dataclass(frozen=True)
class Scene:
    """A room ready to be rendered. `settings` is what it was made from."""

    settings: SceneSettings
    surfaces: tuple[Surface, ...]
    leds: Leds

    @property
    def name(self) -> str:
        """The scene's name."""
        return self.settings.name

    @property
    def room_m(self) -> NDArray[np.float64]:
        """Extent of the room along x, y, z."""
        return np.array(self.settings.room.size_m)


def load_scene(path: Path) -> Scene:
    """Read and check a scene file. Raises InputError naming file, key and value."""
    return build_scene(check(read_toml(path), SceneSettings, str(path)), str(path))


def build_scene(settings: SceneSettings, source: str) -> Scene:
    """Lay out surfaces and LEDs. Raises InputError where something is outside the room or overlaps."""
    leds = _leds(settings, source)
    surfaces = _room_surfaces(settings.room)
    for index, grid in enumerate(settings.panels):
        surfaces += _panel_surfaces(grid, np.array(settings.room.size_m), f"{source}: panels[{index}]")
    return Scene(settings, tuple(surfaces), leds)


def panel_centers_m(grid: PanelGrid) -> NDArray[np.float64]:
    """Centres of the undersides, shape (rows * columns, 3), columns (x) fastest."""
    x = grid.first_center_m[0] + grid.pitch_m[0] * np.arange(grid.columns)
    y = grid.first_center_m[1] + grid.pitch_m[1] * np.arange(grid.rows)
    yy, xx = np.meshgrid(y, x, indexing="ij")
    return np.stack([xx.ravel(), yy.ravel(), np.full(xx.size, grid.first_center_m[2])], axis=1)


def _leds(settings: SceneSettings, source: str) -> Leds:
    ids: list[int] = []
    centers: list[NDArray[np.float64]] = []
    radii: list[float] = []
    luminances: list[float] = []
    origins: list[str] = []
    for index, entry in enumerate(settings.led):
        ids.append(entry.id)
        centers.append(np.array(entry.position_m))
        radii.append(entry.radius_m)
        luminances.append(entry.luminance_cd_m2)
        origins.append(f"led[{index}]")
    for index, grid in enumerate(settings.panels):
        array = grid.leds
        _check_led_array(array, grid, f"{source}: panels[{index}]")
        x = array.pitch_m[0] * (np.arange(array.columns) - (array.columns - 1) / 2)
        y = array.pitch_m[1] * (np.arange(array.rows) - (array.rows - 1) / 2)
        yy, xx = np.meshgrid(y, x, indexing="ij")
        offsets = np.stack([xx.ravel(), yy.ravel(), np.zeros(xx.size)], axis=1)
        positions = (panel_centers_m(grid)[:, None, :] + offsets[None, :, :]).reshape(-1, 3)
        low, high = array.luminance_cd_m2
        ids += range(array.first_id, array.first_id + len(positions))
        centers += list(positions)
        radii += [array.radius_m] * len(positions)
        luminances += list(stream(array.luminance_seed, 0, "led-luminance").uniform(low, high, len(positions)))
        origins += [f"panels[{index}].leds"] * len(positions)
    if not ids:
        raise InputError(f"{source}: has no LED; add [[led]] or [[panels]]")
    order = np.argsort(ids, kind="stable")
    leds = Leds(
        np.array(ids, dtype=np.int64)[order],
        np.array(centers)[order],
        np.array(radii)[order],
        np.array(luminances)[order],
    )
    _check_leds(leds, [origins[i] for i in order], np.array(settings.room.size_m), source)
    return leds


def _check_led_array(array: PanelLeds, grid: PanelGrid, where: str) -> None:
    for axis, name, count in ((0, "columns", array.columns), (1, "rows", array.rows)):
        extent = (count - 1) * array.pitch_m[axis] + 2 * array.radius_m
        if extent > grid.size_m[axis] + TOUCH_M:
            raise InputError(
                f"{where}.leds: {count} {name} at {array.pitch_m[axis]} m and radius {array.radius_m} m span "
                f"{extent:.4g} m; the panel is {grid.size_m[axis]} m"
            )
    if array.luminance_cd_m2[0] > array.luminance_cd_m2[1]:
        raise InputError(f"{where}.leds.luminance_cd_m2 = {list(array.luminance_cd_m2)}: the lower value comes first")


def _check_leds(leds: Leds, origins: list[str], room_m: NDArray[np.float64], source: str) -> None:
    repeated = np.flatnonzero(np.diff(leds.ids) == 0)
    if len(repeated):
        raise InputError(f"{source}: {origins[repeated[0] + 1]}: LED id {leds.ids[repeated[0]]} is used twice")
    reach = np.stack([leds.radii_m, leds.radii_m, np.zeros(len(leds))], axis=1)
    outside = ((leds.centers_m - reach < -TOUCH_M) | (leds.centers_m + reach > room_m + TOUCH_M)).any(axis=1)
    if outside.any():
        i = int(np.flatnonzero(outside)[0])
        center = [round(float(v), 4) for v in leds.centers_m[i]]
        raise InputError(
            f"{source}: {origins[i]}: LED {leds.ids[i]} at {center} m with radius {leds.radii_m[i]} m "
            f"is not inside the room of {room_m.tolist()} m"
        )
    for i in range(len(leds) - 1):
        apart = np.linalg.norm(leds.centers_m[i + 1 :] - leds.centers_m[i], axis=1)
        close = np.flatnonzero(apart < leds.radii_m[i + 1 :] + leds.radii_m[i] - TOUCH_M)
        if len(close):
            other = i + 1 + close[0]
            raise InputError(
                f"{source}: {origins[other]}: LEDs {leds.ids[i]} and {leds.ids[other]} overlap: centres "
                f"{apart[close[0]]:.4g} m apart, radii {leds.radii_m[i]} and {leds.radii_m[other]} m"
            )


def _room_surfaces(room: Room) -> list[Surface]:
    x, y, z = (np.diag(room.size_m)[i] for i in range(3))
    o = np.zeros(3)
    r = room.reflectance
    return [
        Surface("floor", o, x, y, r.floor),
        Surface("ceiling", z, y, x, r.ceiling),
        Surface("wall x=0", o, y, z, r.walls),
        Surface("wall x=max", x, z, y, r.walls),
        Surface("wall y=0", o, z, x, r.walls),
        Surface("wall y=max", y, x, z, r.walls),
    ]


def _panel_surfaces(grid: PanelGrid, room_m: NDArray[np.float64], where: str) -> list[Surface]:
    size = np.array(grid.size_m)
    for axis, name, count in ((0, "columns", grid.columns), (1, "rows", grid.rows)):
        if count > 1 and grid.pitch_m[axis] < size[axis] - TOUCH_M:
            raise InputError(
                f"{where}.pitch_m: {name} {grid.pitch_m[axis]} m apart overlap; panels are {size[axis]} m wide"
            )
    surfaces: list[Surface] = []
    for number, center in enumerate(panel_centers_m(grid)):
        low = center - [size[0] / 2, size[1] / 2, 0.0]
        high = center + [size[0] / 2, size[1] / 2, size[2]]
        if (low < -TOUCH_M).any() or (high > room_m + TOUCH_M).any():
            raise InputError(
                f"{where}: panel {number} from {low.round(4).tolist()} to {high.round(4).tolist()} m "
                f"is not inside the room of {room_m.tolist()} m"
            )
        x, y, z = (np.diag(size)[i] for i in range(3))
        name = f"panel {number}"
        surfaces += [
            Surface(f"{name} underside", low, y, x, grid.reflectance),
            Surface(f"{name} side x-", low, z, y, grid.reflectance),
            Surface(f"{name} side x+", low + x, y, z, grid.reflectance),
            Surface(f"{name} side y-", low, x, z, grid.reflectance),
            Surface(f"{name} side y+", low + y, z, x, grid.reflectance),
        ]
    return surfaces
