"""Diffuse surfaces of a room and its panels, and glazing in its walls.

World frame: metres, right-handed, z up, origin at a floor corner.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vlcrender.errors import InputError
from vlcrender.scene.paths import file_inside
from vlcrender.scene.schema import PanelFrame, PanelGrid, Room, SceneSettings, TextureEntry
from vlcrender.scene.texture import Texture, read_reflectances

TOUCH_M = 1e-9
"""Rounding allowance for solids that touch."""
MIN_ABSORPTANCE = 1e-3
"""Smallest mean absorptance of a room. Its light paths have 1 / absorptance bounces on average."""


@dataclass(frozen=True)
class Surface:
    """A diffuse rectangle: corner + a * edge_u + b * edge_v with a, b in [0, 1].

    Its normal edge_u x edge_v points to the side that is lit.
    """

    name: str
    corner_m: NDArray[np.float64]
    edge_u_m: NDArray[np.float64]
    edge_v_m: NDArray[np.float64]
    reflectance: float
    """Diffuse reflectance; the mean over its texture, where it has one."""
    holes: tuple[tuple[float, float, float, float], ...] = ()
    """(a0, b0, a1, b1) of rectangles that are cut out: panels on a ceiling, glazing in a wall."""
    texture: Texture | None = None
    enclosed: bool = False
    """Whether other surfaces stand at all four sides, as walls do around a floor."""
    solids: tuple[tuple[float, float, float, float], ...] = ()
    """(a0, b0, a1, b1) of rectangles on which solids stand: panels on a ceiling."""

    @property
    def area_m2(self) -> float:
        """Area without the holes."""
        share = 1.0 - sum((a1 - a0) * (b1 - b0) for a0, b0, a1, b1 in self.holes)
        return share * float(np.linalg.norm(np.cross(self.edge_u_m, self.edge_v_m)))


@dataclass(frozen=True)
class Glazing:
    """Glazing in a wall: the rectangle corner + a * edge_u + b * edge_v; edge_u x edge_v points into the room."""

    name: str
    corner_m: NDArray[np.float64]
    edge_u_m: NDArray[np.float64]
    edge_v_m: NDArray[np.float64]
    luminance_cd_m2: float
    refractive_index: float

    @property
    def corners_m(self) -> NDArray[np.float64]:
        """The four corners in order around the rectangle, (4, 3)."""
        shares = ((0, 0), (1, 0), (1, 1), (0, 1))
        return np.stack([self.corner_m + a * self.edge_u_m + b * self.edge_v_m for a, b in shares])

    @property
    def area_m2(self) -> float:
        """Area."""
        return float(np.linalg.norm(np.cross(self.edge_u_m, self.edge_v_m)))

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit vector into the room."""
        normal: NDArray[np.float64] = np.cross(self.edge_u_m, self.edge_v_m)
        return normal / float(np.linalg.norm(normal))

    def mirrored(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mirror images (..., 3) of points (..., 3) in the plane of the glazing."""
        height = ((points_m - self.corner_m) * self.normal).sum(axis=-1, keepdims=True)
        images: NDArray[np.float64] = points_m - 2 * height * self.normal
        return images

    def contains(self, points_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether points (..., 3) of its plane are within the glazing, (...,)."""
        from_corner = points_m - self.corner_m
        inside = np.ones(points_m.shape[:-1], dtype=bool)
        for edge in (self.edge_u_m, self.edge_v_m):
            share = (from_corner * edge).sum(axis=-1) / float(edge @ edge)
            inside &= (share >= 0) & (share <= 1)
        return inside


def check_absorptance(absorbing_m2: float, total_m2: float, source: str) -> None:
    """Refuse a room in which light is reflected for ever, or nearly so.

    absorbing_m2: sum of area * (1 - reflectance) of all surfaces; glazing counts as absorbing. total_m2: their area.
    Raises InputError that starts with `source` where the mean absorptance is below MIN_ABSORPTANCE.
    """
    absorptance = absorbing_m2 / total_m2
    if absorptance < MIN_ABSORPTANCE:
        raise InputError(
            f"{source}: reflectance: all surfaces together absorb {max(absorptance, 0.0):.3%} of the light on them; at "
            f"least {MIN_ABSORPTANCE:.1%} is needed: lower a reflectance, or add glazing"
        )


def panel_centers_m(grid: PanelGrid) -> NDArray[np.float64]:
    """Centres of the undersides of a grid's panels, (rows * columns, 3), columns (x) fastest."""
    x = grid.first_center_m[0] + grid.pitch_m[0] * np.arange(grid.columns)
    y = grid.first_center_m[1] + grid.pitch_m[1] * np.arange(grid.rows)
    yy, xx = np.meshgrid(y, x, indexing="ij")
    return np.stack([xx.ravel(), yy.ravel(), np.full(xx.size, grid.first_center_m[2])], axis=1)


def panel_opening_m(grid: PanelGrid, x: float, y: float) -> tuple[float, float, float, float]:
    """(x0, y0, x1, y1) of the opening in the frame of the panel centred at (x, y); without a frame, the underside."""
    rim = 0.0 if grid.frame is None else grid.frame.width_m
    half_x, half_y = grid.size_m[0] / 2 - rim, grid.size_m[1] / 2 - rim
    return x - half_x, y - half_y, x + half_x, y + half_y


def room_surfaces(
    room: Room, panels: tuple[PanelGrid, ...], glazings: tuple[Glazing, ...], folder: Path, source: str
) -> list[Surface]:
    """Floor, ceiling and walls, with holes for panels and glazing. Textures are read from `folder`.

    Raises InputError that starts with `source` for a surface with neither or both of reflectance and texture, and for a
    texture that cannot be read or is outside `folder`.
    """
    o = np.zeros(3)
    x, y, z = (np.diag(room.size_m)[i] for i in range(3))
    finishes = {name: _finish(room, name, folder, source) for name in ("floor", "ceiling", "walls")}
    floor, ceiling = (_texture(finishes[name], corner, x, y) for name, corner in (("floor", o), ("ceiling", z)))
    on_ceiling = _panels_on_ceiling(room, panels)
    surfaces = [
        Surface("floor", o, x, y, finishes["floor"].reflectance, texture=floor, enclosed=True),
        Surface("ceiling", z, y, x, finishes["ceiling"].reflectance, on_ceiling, ceiling, True, on_ceiling),
    ]
    for name, (corner, edge_u, edge_v) in _walls(room).items():
        holes = tuple(
            _hole(glazing, corner, edge_u, edge_v)
            for glazing in glazings
            if glazing.name.startswith(f"glazing {name} ")
        )
        along = y if name.startswith("x") else x
        texture = _texture(finishes["walls"], corner + z, along, -z)
        reflectance = finishes["walls"].reflectance
        surfaces.append(Surface(f"wall {name}", corner, edge_u, edge_v, reflectance, holes, texture, enclosed=True))
    return surfaces


@dataclass(frozen=True)
class _Finish:
    """Mean reflectance of a surface, and the image of its texture with the size of a tile, where it has one."""

    reflectance: float
    image: NDArray[np.float64] | None = None
    tile_m: tuple[float, float] = (1.0, 1.0)


def _finish(room: Room, name: str, folder: Path, source: str) -> _Finish:
    reflectance: float | None = getattr(room.reflectance, name)
    entry: TextureEntry | None = getattr(room.texture, name)
    if entry is None:
        if reflectance is None:
            raise InputError(f"{source}: key room.reflectance.{name} is missing; give it or room.texture.{name}")
        return _Finish(reflectance)
    if reflectance is not None:
        raise InputError(
            f"{source}: room.reflectance.{name} = {reflectance}: there is a room.texture.{name} too; remove one of them"
        )
    where = f"{source}: room.texture.{name}.file = {entry.file!r}"
    image = read_reflectances(file_inside(folder, entry.file, where), where)
    return _Finish(float(image.mean()), image, entry.tile_m)


def _texture(
    finish: _Finish, corner: NDArray[np.float64], across: NDArray[np.float64], down: NDArray[np.float64]
) -> Texture | None:
    """The image of a finish with its first pixel at a corner and its sides along two edges; None without an image."""
    if finish.image is None:
        return None
    width, height = (
        side * edge / np.linalg.norm(edge) for side, edge in zip(finish.tile_m, (across, down), strict=True)
    )
    return Texture(finish.image, corner, width, height)


def _walls(room: Room) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
    """Corner and edges of each wall; edge_u x edge_v points into the room."""
    o = np.zeros(3)
    x, y, z = (np.diag(room.size_m)[i] for i in range(3))
    return {"x=0": (o, y, z), "x=max": (x, z, y), "y=0": (o, z, x), "y=max": (y, x, z)}


def _panels_on_ceiling(room: Room, panels: tuple[PanelGrid, ...]) -> tuple[tuple[float, float, float, float], ...]:
    """Holes of the ceiling for panels that touch it, in the ceiling's (a, b), which run along y and x."""
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
    glazing: Glazing, corner: NDArray[np.float64], edge_u: NDArray[np.float64], edge_v: NDArray[np.float64]
) -> tuple[float, float, float, float]:
    low = glazing.corner_m - corner
    high = low + glazing.edge_u_m + glazing.edge_v_m
    along = [(float(p @ edge_u / (edge_u @ edge_u)), float(p @ edge_v / (edge_v @ edge_v))) for p in (low, high)]
    (a0, b0), (a1, b1) = along
    return a0, b0, a1, b1


def glazings_of(settings: SceneSettings, source: str) -> tuple[Glazing, ...]:
    """A scene's glazing. Raises InputError for glazing that does not fit into its wall or overlaps another one."""
    glazings: list[Glazing] = []
    taken: list[tuple[str, tuple[NDArray[np.float64], NDArray[np.float64]]]] = []
    for index, glazing in enumerate(settings.glazing):
        where = f"{source}: glazing[{index}]"
        corner, edge_u, edge_v = _walls(settings.room)[glazing.wall]
        along = 1 if glazing.wall.startswith("x") else 0
        low = corner.copy()
        low[along] = glazing.corner_m[0]
        low[2] = glazing.corner_m[1]
        high = low.copy()
        high[along] += glazing.size_m[0]
        high[2] += glazing.size_m[1]
        if (high > np.array(settings.room.size_m) + TOUCH_M).any():
            raise InputError(
                f"{where}: from {low.round(4).tolist()} to {high.round(4).tolist()} m does not fit "
                f"into the room of {list(settings.room.size_m)} m"
            )
        if any(wall == glazing.wall and _overlap(low, high, *extent, along) for wall, extent in taken):
            raise InputError(f"{where}: overlaps another glazing in wall {glazing.wall}")
        taken.append((glazing.wall, (low, high)))
        span = high - low
        glazings.append(
            Glazing(
                name=f"glazing {glazing.wall} {index}",
                corner_m=low,
                edge_u_m=np.where(edge_u != 0, span, 0.0),
                edge_v_m=np.where(edge_v != 0, span, 0.0),
                luminance_cd_m2=glazing.luminance_cd_m2,
                refractive_index=glazing.refractive_index,
            )
        )
    return tuple(glazings)


def _overlap(
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    other_low: NDArray[np.float64],
    other_high: NDArray[np.float64],
    along: int,
) -> bool:
    axes = [along, 2]
    return bool((low[axes] < other_high[axes] - TOUCH_M).all() and (high[axes] > other_low[axes] + TOUCH_M).all())


def panel_surfaces(grid: PanelGrid, room_m: NDArray[np.float64], where: str) -> list[Surface]:
    """Underside, sides and frame of each panel. Raises InputError for panels that overlap or are outside the room."""
    size = np.array(grid.size_m)
    for axis, name, count in ((0, "columns", grid.columns), (1, "rows", grid.rows)):
        if count > 1 and grid.pitch_m[axis] < size[axis] - TOUCH_M:
            raise InputError(
                f"{where}.pitch_m: {name} {grid.pitch_m[axis]} m apart overlap; panels are {size[axis]} m wide"
            )
    drop = 0.0 if grid.frame is None else grid.frame.depth_m
    surfaces: list[Surface] = []
    for number, center in enumerate(panel_centers_m(grid)):
        low = center - [size[0] / 2, size[1] / 2, 0.0]
        high = center + [size[0] / 2, size[1] / 2, size[2]]
        if (low - [0, 0, drop] < -TOUCH_M).any() or (high > room_m + TOUCH_M).any():
            raise InputError(
                f"{where}: panel {number} from {(low - [0, 0, drop]).round(4).tolist()} to {high.round(4).tolist()} m "
                f"is not inside the room of {room_m.tolist()} m"
            )
        name = f"panel {number}"
        x0, y0, x1, y1 = panel_opening_m(grid, float(center[0]), float(center[1]))
        under, across, along = np.array([x0, y0, low[2]]), np.array([x1 - x0, 0, 0]), np.array([0, y1 - y0, 0])
        framed = grid.frame is not None
        surfaces.append(Surface(f"{name} underside", under, along, across, grid.reflectance, enclosed=framed))
        surfaces += _sides(f"{name} side", low, size, grid.reflectance)
        if grid.frame is not None:
            surfaces += _frame_surfaces(f"{name} frame", low, size, grid.frame)
    return surfaces


def _sides(
    name: str, low: NDArray[np.float64], size: NDArray[np.float64], reflectance: float, inwards: bool = False
) -> list[Surface]:
    """The four vertical sides of a box with its lowest corner at `low`, facing outwards or `inwards`."""
    x, y, z = (np.diag(size)[i] for i in range(3))
    outside = (("x-", low, z, y), ("x+", low + x, y, z), ("y-", low, x, z), ("y+", low + y, z, x))
    return [
        Surface(f"{name} {side}", corner, *((v, u) if inwards else (u, v)), reflectance)
        for side, corner, u, v in outside
    ]


def _frame_surfaces(name: str, low: NDArray[np.float64], size: NDArray[np.float64], frame: PanelFrame) -> list[Surface]:
    """The rim below a panel with its lowest corner at `low`: outer sides, inner sides and the face down."""
    bottom = low - [0, 0, frame.depth_m]
    rim = np.array([frame.width_m, frame.width_m, 0])
    outer, inner = (np.array([*(size[:2] - 2 * width), frame.depth_m]) for width in (0.0, frame.width_m))
    x, y, _ = np.diag(size)
    hole = (rim[1] / size[1], rim[0] / size[0], 1 - rim[1] / size[1], 1 - rim[0] / size[0])
    return [
        *_sides(f"{name} outside", bottom, outer, frame.reflectance),
        *_sides(f"{name} inside", bottom + rim, inner, frame.reflectance, inwards=True),
        Surface(f"{name} rim", bottom, y, x, frame.reflectance, (hole,)),
    ]
