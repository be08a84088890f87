"""The command `vlcrender report`; it loads what it needs when it runs."""

from pathlib import Path

from vlcrender.errors import InputError


def report(directory: Path, /, *, out: Path | None = None) -> None:
    """Write one self-contained HTML page of a dataset alone: room, poses, exposure, what is told and true, previews.

    Parameters
    ----------
    directory
        Folder of the dataset, or of a cell of a sweep.
    out
        The page to write; by default the folder's name with -dataset.html in the current folder.
    """
    from vlcrender.dataset.format.files import whole_file
    from vlcrender.report.page import page

    path = out or Path(f"{directory.resolve().name}-dataset.html")
    if path.is_dir():
        raise InputError(f"--out {path}: is a folder; give the name of a file")
    html = page(directory)
    with whole_file(path) as partial:
        partial.write_text(html, encoding="utf-8")
    print(f"{path}: written")
