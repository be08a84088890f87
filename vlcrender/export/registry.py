"""The formats that a dataset can be exported to, and the export itself."""

import json
import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, cast

from vlcrender.core.digest import sha256_of
from vlcrender.errors import InputError
from vlcrender.export.source import Source

EXPORT_FILE = "export.json"


@dataclass(frozen=True)
class Format:
    """A format: its name on the command line, its module below `vlcrender.export`, and what it needs."""

    name: str
    module: str
    summary: str
    needs_truth: bool = False
    is_file: bool = False
    """Whether `--out` is a file; else a folder."""


FORMATS = {
    format_.name: format_
    for format_ in (
        Format("png16", "png16", "16-bit grey PNG of whole sensors, digital numbers unscaled"),
        Format("csv", "csv_tables", "all tables as CSV", needs_truth=True),
        Format("tum", "tum", "trajectories: time, position, quaternion", needs_truth=True),
        Format("opencv-yaml", "opencv_yaml", "calibrations for cv::FileStorage"),
        Format("kalibr", "kalibr", "camchain.yaml of the rig"),
        Format("colmap", "colmap", "images and a sparse text model, LEDs as 3D points", needs_truth=True),
        Format("nerfstudio", "nerfstudio", "images and transforms.json", needs_truth=True),
        Format("bop", "bop", "6D object poses: LEDs as objects", needs_truth=True),
        Format("webdataset", "webdataset", "tar shards of arrays and JSON"),
        Format("rosbag2", "rosbag2", "a ROS 2 bag: images, camera_info, imu, ground truth"),
        Format("croissant", "croissant", "Croissant metadata (JSON-LD) of the set as it is", is_file=True),
        Format("card", "card", "a dataset card: README.md for Hugging Face", is_file=True),
    )
}


class _Writer(Protocol):
    def write(self, source: Source, out: Path) -> Mapping[str, Any]:
        """Write the format to a folder or file; returns what export.json states of it."""


def export_dataset(directory: Path, to: str, out: Path) -> int:
    """Export a dataset to the folder or file `out`, which appears whole or not at all; returns the number of frames.

    Raises InputError for an unknown format, an `out` that exists, a damaged dataset, a truth that is withheld, and for
    anything that the format cannot express.
    """
    if to not in FORMATS:
        raise InputError(f"--to {to}: has to be one of {', '.join(FORMATS)}")
    format_ = FORMATS[to]
    if out.exists() and (format_.is_file or not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out {out}: exists; nothing was changed; choose another --out")
    if not out.absolute().parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.parent}")
    if format_.is_file and out.suffix != (suffix := ".json" if to == "croissant" else ".md"):
        raise InputError(f"--out {out}: has to be a file that ends in {suffix}")
    if not format_.is_file and directory.resolve() in out.resolve().parents:
        raise InputError(f"--out {out}: lies in the dataset {directory}; choose a folder outside it")
    source = Source.open(directory, to, format_.needs_truth)
    writer = cast(_Writer, import_module(f"vlcrender.export.{format_.module}"))
    if format_.is_file:
        writer.write(source, out)
        return len(source.frames)
    partial = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.absolute().parent))
    try:
        stated = {
            "format": to,
            "dataset": source.dataset.name,
            "frames": len(source.frames),
            "frames_sha256": sha256_of(directory / "frames.parquet"),
            "licence": source.dataset.licence,
            **writer.write(source, partial),
        }
        (partial / EXPORT_FILE).write_text(json.dumps(stated, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        partial.chmod(0o777 & ~_umask())  # mkdtemp's folder is private
        os.replace(partial, out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return len(source.frames)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
