"""Files that a scene names: meshes, Mitsuba XML and textures, in the scene's folder."""

from pathlib import Path

from vlcrender.errors import InputError


def file_inside(folder: Path, name: str, where: str, base: Path | None = None) -> Path:
    """The file of a path `name` from `base`, the scene's `folder` where not given.

    Raises InputError that starts with `where` for a file that is missing, or whose real place, symbolic links
    followed, is outside `folder`.
    """
    path = (base or folder) / name
    try:
        inside = path.resolve().is_relative_to(folder.resolve())
        found = inside and path.is_file()
    except (OSError, RuntimeError, ValueError) as error:  # too long, a loop of links, a null character
        reason = (isinstance(error, OSError) and error.strerror) or "a loop of links, or a null character"
        raise InputError(f"{where}: is no path of a file: {reason}") from None
    if not inside:
        raise InputError(f"{where}: is outside the scene's folder; copy the file there, and give its path from there")
    if not found:
        raise InputError(f"{where}: no such file in the scene's folder")
    return path
