"""Files that a scene names: textures, meshes, and what Mitsuba XML reads; their digests belong to a run's identity."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from pathlib import Path

from vlcrender.core.digest import sha256_of
from vlcrender.errors import InputError
from vlcrender.scene.schema import SceneSettings


def scene_sources(settings: SceneSettings, folder: Path) -> dict[str, str]:
    """SHA-256 of each file that a scene reads from its folder, by its path from there, sorted by path.

    Files that are missing are left out: the reader of each reports them.
    """
    room, found = settings.room, {piece.file for piece in settings.furniture}
    textures = (room.texture.floor, room.texture.ceiling, room.texture.walls)
    found |= {entry.file for entry in textures if entry is not None}
    for name in sorted(found):
        if name.lower().endswith(".xml"):
            found |= set(_named_by_xml(folder, name, {name}))
    try:
        return {name: sha256_of(folder / name) for name in sorted(found) if (folder / name).is_file()}
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be read: {error.strerror}") from None


def check_sources(settings: SceneSettings, folder: Path, sources: Mapping[str, str]) -> None:
    """Raise InputError that names the first file of a scene whose content is not that of `sources` any more."""
    now = scene_sources(settings, folder)
    for name in sorted({*now, *sources}):
        if now.get(name) != sources.get(name):
            raise InputError(
                f"{folder / name}: was changed while frames were made of it; restore it and run the same command "
                "again, or choose another --out"
            )


def _named_by_xml(folder: Path, name: str, known: set[str]) -> Iterator[str]:
    """Files that a Mitsuba scene file names in any attribute, and those that included files name in turn.

    Paths start at the folder of the XML file or at one that a `path` element adds. Defaults replace their `$name`.
    """
    base = Path(name).parent
    try:
        elements = list(ElementTree.parse(folder / name).getroot().iter())
    except (ElementTree.ParseError, OSError, ValueError, LookupError):
        return  # Mitsuba reports it
    defaults = {e.get("name", ""): e.get("value", "") for e in elements if e.tag == "default" and e.get("name")}
    places = [base, *(base / _with_defaults(e.get("value", "."), defaults) for e in elements if e.tag == "path")]
    for value in sorted({value for element in elements for value in element.attrib.values()}):
        text = _with_defaults(value, defaults)
        for place in places:
            named = (place / text).as_posix()
            if not text or len(text) > 1000 or "\0" in text or named in known or not (folder / named).is_file():
                continue
            known.add(named)
            yield named
            if named.lower().endswith(".xml"):
                yield from _named_by_xml(folder, named, known)


def _with_defaults(text: str, defaults: Mapping[str, str]) -> str:
    for name in sorted(defaults, key=len, reverse=True):
        text = text.replace(f"${name}", defaults[name])
    return text
