"""Scenes: a TOML file into checked geometry in world coordinates.

World frame: metres, right-handed, z up, origin at a floor corner.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vlcrender.config.toml_model import check, override, read_toml
from vlcrender.errors import InputError
from vlcrender.scene.led_map_file import of_led_map, with_led_map
from vlcrender.scene.leds import Leds, leds_of
from vlcrender.scene.paths import file_inside
from vlcrender.scene.scene_files import scene_sources
from vlcrender.scene.schema import SceneSettings
from vlcrender.scene.surfaces import Glazing, Surface, check_absorptance, glazings_of, panel_surfaces, room_surfaces


@dataclass(frozen=True, eq=False)
class Scene:
    """A room ready to be rendered. Two scenes are equal if they are one object: results are kept by scene."""

    settings: SceneSettings
    """The checked scene file."""
    surfaces: tuple[Surface, ...]
    """Diffuse surfaces of the room and its panels: floor, ceiling, four walls, panels. Furniture is not among them."""
    glazings: tuple[Glazing, ...]
    """Glazing in the walls."""
    leds: Leds
    """All LEDs."""
    folder: Path
    """The folder of furniture and textures."""
    sources: Mapping[str, str]
    """SHA-256 of each file of the folder that the scene is made of, before it was read, by its path from the folder."""

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self.settings.name

    @property
    def room_m(self) -> NDArray[np.float64]:
        """Extent of the room along x, y and z, (3,)."""
        return np.array(self.settings.room.size_m)


def load_scene(
    path: Path, assignments: Iterable[str] = (), source: str | None = None, how: str = "--set scene."
) -> Scene:
    """The scene of a TOML file with `key=value` assignments applied. Raises InputError that names file, key and value.

    source: start of the messages, the path where not given. how: as in `toml_model.override`.
    """
    source, (of_map, others) = source or str(path), of_led_map(assignments)
    tree, lines = with_led_map(override(read_toml(path), of_map, how), path.parent, source)
    try:
        return build_scene(check(override(tree, others, how), SceneSettings, source), source, path.parent)
    except InputError as error:
        raise InputError(lines.named(str(error))) from None


def build_scene(settings: SceneSettings, source: str, folder: Path = Path()) -> Scene:
    """The scene of checked settings. Files of furniture and textures are looked up in `folder`.

    Raises InputError that starts with `source` for geometry outside the room, for overlaps, for files that are missing
    or outside `folder`, for textures that cannot be read and for surfaces that absorb no light. Furniture is read, and
    checked, by a bake.
    """
    sources = scene_sources(settings, folder)  # before the files are read: a change while they are is found later
    leds = leds_of(settings, source)
    glazings = glazings_of(settings, source)
    surfaces = room_surfaces(settings.room, settings.panels, glazings, folder, source)
    for index, grid in enumerate(settings.panels):
        surfaces += panel_surfaces(grid, np.array(settings.room.size_m), f"{source}: panels[{index}]")
    for index, piece in enumerate(settings.furniture):
        file_inside(folder, piece.file, f"{source}: furniture[{index}].file = {piece.file!r}")
    if not settings.furniture:
        glazing_m2 = sum(glazing.area_m2 for glazing in glazings)
        absorbing_m2 = sum((1 - surface.reflectance) * surface.area_m2 for surface in surfaces) + glazing_m2
        check_absorptance(absorbing_m2, sum(surface.area_m2 for surface in surfaces) + glazing_m2, source)
    return Scene(settings, tuple(surfaces), glazings, leds, folder, sources)
