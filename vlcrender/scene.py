"""The room: surfaces, panels and LEDs. TOML in, checked geometry in world coordinates out.

World: metres, right-handed, z up, origin at a floor corner.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vlcrender.errors import InputError
from vlcrender.scene_settings import PanelGrid, PanelLeds, Room, SceneSettings, TextureEntry
from vlcrender.settings import check, read_toml
from vlcrender.streams import stream
from vlcrender.texture import Texture, read_reflectances

TOUCH_M = 1e-9
"""Rounding allowance where an LED or panel touches a wall or another LED."""


@dataclass(frozen=True)
class Surface:
    """A diffuse rectangle: corner + a * edge_u + b * edge_v with a, b in [0, 1]; seen from edge_u x edge_v."""

    name: str
    corner_m: NDArray[np.float64]
    edge_u_m: NDArray[np.float64]
    edge_v_m: NDArray[np.float64]
    reflectance: float
    """The mean, where there is a texture."""
    holes: tuple[tuple[float, float, float, float], ...] = ()
    """(a0, b0, a1, b1) of what is cut out: panels on a ceiling, windows in a wall."""
    texture: Texture | None = None


@dataclass(frozen=True)
class Pane:
    """A window pane: the rectangle corner + a * edge_u + b * edge_v, seen from edge_u x edge_v."""

    name: str
    corner_m: NDArray[np.float64]
    edge_u_m: NDArray[np.float64]
    edge_v_m: NDArray[np.float64]
    luminance_cd_m2: float
    refractive_index: float

    @property
    def corners_m(self) -> NDArray[np.float64]:
        """The four corners in order around, shape (4, 3)."""
        shares = ((0, 0), (1, 0), (1, 1), (0, 1))
        return np.stack([self.corner_m + a * self.edge_u_m + b * self.edge_v_m for a, b in shares])

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit vector into the room."""
        normal: NDArray[np.float64] = np.cross(self.edge_u_m, self.edge_v_m)
        return normal / float(np.linalg.norm(normal))

    def mirrored(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mirror images (..., 3) of points (..., 3) in the pane's plane."""
        height = ((points_m - self.corner_m) * self.normal).sum(axis=-1, keepdims=True)
        images: NDArray[np.float64] = points_m - 2 * height * self.normal
        return images

    def holds(self, points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether points (..., 3) of its plane are within the pane, (...,)."""
        from_corner = points_m - self.corner_m
        inside = np.ones(points_m.shape[:-1], dtype=bool)
        for edge in (self.edge_u_m, self.edge_v_m):
            share = (from_corner * edge).sum(axis=-1) / float(edge @ edge)
            inside &= (share >= 0) & (share <= 1)
        return inside


@dataclass(frozen=True)
class Leds:
    """All LEDs of a scene, sorted by id: discs or squares that face down (normal 0, 0, -1)."""

    ids: NDArray[np.int64]
    centers_m: NDArray[np.float64]
    radii_m: NDArray[np.float64]
    luminances_cd_m2: NDArray[np.float64]
    orders: NDArray[np.float64]
    """Lambertian order m: luminance at an angle theta from the normal is luminance * cos^(m-1)(theta)."""

    squares: NDArray[np.bool_]
    """Where True the LED is a square of half side `radii_m`, sides along x and y."""

    def __len__(self) -> int:
        """Count the LEDs."""
        return len(self.ids)

    @property
    def areas_m2(self) -> NDArray[np.float64]:
        """Area of each face."""
        return np.where(self.squares, 4.0, np.pi) * self.radii_m**2

    @property
    def reaches_m(self) -> NDArray[np.float64]:
        """From each centre to the face's farthest point: a square's corner, a disc's rim."""
        return np.where(self.squares, np.sqrt(2.0), 1.0) * self.radii_m


@dataclass(frozen=True)
class Scene:
    """A room ready to be rendered. `settings` is what it was made from."""

    settings: SceneSettings
    surfaces: tuple[Surface, ...]
    panes: tuple[Pane, ...]
    leds: Leds
    folder: Path
    """Where furniture and textures are looked up."""

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
    return build_scene(check(read_toml(path), SceneSettings, str(path)), str(path), path.parent)


def build_scene(settings: SceneSettings, source: str, folder: Path = Path()) -> Scene:
    """Lay out surfaces and LEDs; files of furniture and textures are below `folder`.

    Raises InputError, which starts with `source`, where something is outside the room, overlaps, is missing or, of a
    texture, cannot be used.
    """
    leds = _leds(settings, source)
    panes = _panes(settings, source)
    surfaces = _room_surfaces(settings.room, settings.panels, panes, folder, source)
    for index, grid in enumerate(settings.panels):
        surfaces += _panel_surfaces(grid, np.array(settings.room.size_m), f"{source}: panels[{index}]")
    for index, piece in enumerate(settings.furniture):
        if not (folder / piece.file).is_file():
            raise InputError(
                f"{source}: furniture[{index}].file = {piece.file!r}: no such file from the scene's folder"
            )
    return Scene(settings, tuple(surfaces), panes, leds, folder)


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
    half_powers: list[float] = []
    shapes: list[str] = []
    origins: list[str] = []
    for index, entry in enumerate(settings.led):
        ids.append(entry.id)
        centers.append(np.array(entry.position_m))
        radii.append(entry.radius_m)
        luminances.append(entry.luminance_cd_m2)
        half_powers.append(entry.half_power_deg)
        shapes.append(entry.shape)
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
        half_powers += [array.half_power_deg] * len(positions)
        shapes += [array.shape] * len(positions)
        origins += [f"panels[{index}].leds"] * len(positions)
    if not ids:
        raise InputError(f"{source}: has no LED; add [[led]] or [[panels]]")
    order = np.argsort(ids, kind="stable")
    leds = Leds(
        np.array(ids, dtype=np.int64)[order],
        np.array(centers)[order],
        np.array(radii)[order],
        np.array(luminances)[order],
        -np.log(2) / np.log(np.cos(np.radians(half_powers)))[order],
        np.array([shape == "square" for shape in shapes])[order],
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
        between = leds.centers_m[i + 1 :] - leds.centers_m[i]
        both_square = leds.squares[i + 1 :] & leds.squares[i]
        apart = np.where(both_square, np.abs(between).max(axis=1), np.linalg.norm(between, axis=1))
        close = np.flatnonzero(apart < leds.radii_m[i + 1 :] + leds.radii_m[i] - TOUCH_M)
        if len(close):
            other = i + 1 + close[0]
            raise InputError(
                f"{source}: {origins[other]}: LEDs {leds.ids[i]} and {leds.ids[other]} overlap: centres "
                f"{apart[close[0]]:.4g} m apart, radii {leds.radii_m[i]} and {leds.radii_m[other]} m"
            )


def _room_surfaces(
    room: Room, panels: tuple[PanelGrid, ...], panes: tuple[Pane, ...], folder: Path, source: str
) -> list[Surface]:
    o = np.zeros(3)
    x, y, z = (np.diag(room.size_m)[i] for i in range(3))
    skins = {name: _skin(room, name, folder, source) for name in ("floor", "ceiling", "walls")}
    floor, ceiling = (_hung(skins[name], corner, x, y) for name, corner in (("floor", o), ("ceiling", z)))
    surfaces = [
        Surface("floor", o, x, y, skins["floor"].reflectance, texture=floor),
        Surface("ceiling", z, y, x, skins["ceiling"].reflectance, _panels_on_ceiling(room, panels), ceiling),
    ]
    for name, (corner, edge_u, edge_v) in _walls(room).items():
        holes = tuple(_hole(pane, corner, edge_u, edge_v) for pane in panes if pane.name.startswith(f"window {name} "))
        along = y if name.startswith("x") else x
        texture = _hung(skins["walls"], corner + z, along, -z)
        surfaces.append(Surface(f"wall {name}", corner, edge_u, edge_v, skins["walls"].reflectance, holes, texture))
    return surfaces


@dataclass(frozen=True)
class _Skin:
    """What a surface looks like: its (mean) reflectance, and an image with the size of its tile where it has one."""

    reflectance: float
    image: NDArray[np.float64] | None = None
    tile_m: tuple[float, float] = (1.0, 1.0)


def _skin(room: Room, name: str, folder: Path, source: str) -> _Skin:
    reflectance: float | None = getattr(room.reflectance, name)
    entry: TextureEntry | None = getattr(room.texture, name)
    if entry is None:
        if reflectance is None:
            raise InputError(f"{source}: key room.reflectance.{name} is missing, and there is no room.texture.{name}")
        return _Skin(reflectance)
    if reflectance is not None:
        raise InputError(
            f"{source}: room.reflectance.{name} = {reflectance}: room.texture.{name} says it already; leave one out"
        )
    image = read_reflectances(folder / entry.file, f"{source}: room.texture.{name}.file = {entry.file!r}")
    return _Skin(float(image.mean()), image, entry.tile_m)


def _hung(
    skin: _Skin, corner: NDArray[np.float64], across: NDArray[np.float64], down: NDArray[np.float64]
) -> Texture | None:
    """The skin's image with its first pixel in a corner and its sides along two edges."""
    if skin.image is None:
        return None
    width, height = (side * edge / np.linalg.norm(edge) for side, edge in zip(skin.tile_m, (across, down), strict=True))
    return Texture(skin.image, corner, width, height)


def _walls(room: Room) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
    """Corner and edges of each wall; edge_u x edge_v points into the room."""
    o = np.zeros(3)
    x, y, z = (np.diag(room.size_m)[i] for i in range(3))
    return {"x=0": (o, y, z), "x=max": (x, z, y), "y=0": (o, z, x), "y=max": (y, x, z)}


def _panels_on_ceiling(room: Room, panels: tuple[PanelGrid, ...]) -> tuple[tuple[float, float, float, float], ...]:
    """Parts of the ceiling that panels touch, in its (a, b) = (y, x) shares."""
    width, depth, height = room.size_m
    holes = []
    for grid in panels:
        if abs(grid.first_center_m[2] + grid.size_m[2] - height) > TOUCH_M:
            continue
        half_x, half_y = grid.size_m[0] / 2, grid.size_m[1] / 2
        for x, y, _ in panel_centers_m(grid).tolist():
            holes.append(((y - half_y) / depth, (x - half_x) / width, (y + half_y) / depth, (x + half_x) / width))
    return tuple(holes)


def _hole(
    pane: Pane, corner: NDArray[np.float64], edge_u: NDArray[np.float64], edge_v: NDArray[np.float64]
) -> tuple[float, float, float, float]:
    low = pane.corner_m - corner
    high = low + pane.edge_u_m + pane.edge_v_m
    along = [(float(p @ edge_u / (edge_u @ edge_u)), float(p @ edge_v / (edge_v @ edge_v))) for p in (low, high)]
    (a0, b0), (a1, b1) = along
    return a0, b0, a1, b1


def _panes(settings: SceneSettings, source: str) -> tuple[Pane, ...]:
    panes: list[Pane] = []
    taken: list[tuple[str, tuple[NDArray[np.float64], NDArray[np.float64]]]] = []
    for index, window in enumerate(settings.window):
        where = f"{source}: window[{index}]"
        corner, edge_u, edge_v = _walls(settings.room)[window.wall]
        along = 1 if window.wall.startswith("x") else 0
        low = corner.copy()
        low[along] = window.corner_m[0]
        low[2] = window.corner_m[1]
        high = low.copy()
        high[along] += window.size_m[0]
        high[2] += window.size_m[1]
        if (high > np.array(settings.room.size_m) + TOUCH_M).any():
            raise InputError(
                f"{where}: from {low.round(4).tolist()} to {high.round(4).tolist()} m does not fit "
                f"into the room of {list(settings.room.size_m)} m"
            )
        if any(wall == window.wall and _overlap(low, high, *extent, along) for wall, extent in taken):
            raise InputError(f"{where}: overlaps another window in wall {window.wall}")
        taken.append((window.wall, (low, high)))
        span = high - low
        panes.append(
            Pane(
                name=f"window {window.wall} {index}",
                corner_m=low,
                edge_u_m=np.where(edge_u != 0, span, 0.0),
                edge_v_m=np.where(edge_v != 0, span, 0.0),
                luminance_cd_m2=window.luminance_cd_m2,
                refractive_index=window.refractive_index,
            )
        )
    return tuple(panes)


def _overlap(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    other_low: NDArray[np.float64],
    other_high: NDArray[np.float64],
    along: int,
) -> bool:
    axes = [along, 2]
    return bool((low[axes] < other_high[axes] - TOUCH_M).all() and (high[axes] > other_low[axes] + TOUCH_M).all())


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
