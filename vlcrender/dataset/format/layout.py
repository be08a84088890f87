"""Layout of a dataset: the folders and files that a recipe makes."""

from collections.abc import Callable, Iterable

from vlcrender.dataset.format.files import EXPECTED, PREVIEWS, PROCESSED
from vlcrender.dataset.recipe.file_settings import FileSettings


def extra_folders(expected: bool, processed: bool, files: FileSettings) -> list[str]:
    """Folders that hold one file a frame beside `frames`."""
    wanted = ((PREVIEWS, files.has_preview(0)), (EXPECTED, expected), (PROCESSED, processed))
    return [folder for folder, is_wanted in wanted if is_wanted]


def missing_files(
    stems: Callable[[str], set[str]], folders: Iterable[str], frames: Iterable[int], files: FileSettings
) -> dict[int, str]:
    """Frames without a file in one of the folders -> the first file that is missing (path without suffix).

    stems: names without suffix of the files of a folder.
    """
    missing: dict[int, str] = {}
    numbers = list(frames)
    for folder in folders:
        present = stems(folder)
        for frame in numbers:
            if f"{frame:06d}" not in present and (folder != PREVIEWS or files.has_preview(frame)):
                missing.setdefault(frame, f"{folder}/{frame:06d}")
    return missing
