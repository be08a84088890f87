"""Cache of baked illuminance: one file per bake in the user's cache folder, or this process's memory if that fails."""

import logging
import os
from dataclasses import astuple, dataclass
from pathlib import Path
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_dir

from vlcrender.core.warn_once import warn_once

Array = NDArray[np.float64]
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class BakedIlluminance:
    """Results of a bake, (n,) each: at the vertices of a room's mesh, then on the faces of its LEDs."""

    led_lux: Array
    """Illuminance by light of LEDs, direct and reflected."""
    daylight_lux: Array
    """Illuminance by light from outside that the glazing transmits, direct and reflected."""
    sigma_lux: Array
    """Monte Carlo standard error of the sum of both."""


_in_memory: dict[str, BakedIlluminance] = {}
"""Bakes of this process that could not be written, by key."""


def cache_folder() -> Path | None:
    """$VLCRENDER_CACHE, else the user's cache folder of this platform; None for a user without a home folder.

    A relative $XDG_CACHE_HOME is ignored, as its specification has it.
    """
    chosen = os.environ.get("VLCRENDER_CACHE")
    if chosen:
        return Path(chosen)
    try:
        folder = Path(user_cache_dir("vlcrender", appauthor=False))
        if not folder.is_absolute():
            folder = Path.home() / ".cache/vlcrender"
    except RuntimeError:  # no home folder is found
        return None
    return folder if folder.is_absolute() else None


def load(key: str, count: int, folder: Path | None) -> BakedIlluminance | None:
    """The bake kept under `key`, with arrays of `count` values; None, with a warning, if its file is damaged.

    None without a warning if there is no such file.
    """
    if key in _in_memory:
        return _in_memory[key]
    if folder is None:
        return None
    file = _file(folder, key)
    try:
        with np.load(file) as stored:
            baked = BakedIlluminance(stored["led_lux"], stored["daylight_lux"], stored["sigma_lux"])
        if not all(_sound(values, count) for values in astuple(baked)):
            raise ValueError("values that no bake has")
    except (FileNotFoundError, NotADirectoryError):
        return None
    except Exception as error:  # whatever its readers trip over, the file is no bake
        reason = (isinstance(error, OSError) and error.strerror) or "damaged by a crash or a disk"
        warn_once(logger, f"{file}: cannot be read ({reason}); the light is baked again")
        return None
    return baked


def _sound(values: Array, count: int) -> bool:
    return values.shape == (count,) and values.dtype == np.float64 and bool((np.isfinite(values) & (values >= 0)).all())


def store(key: str, baked: BakedIlluminance, folder: Path | None) -> None:
    """Keep a bake under `key`. If the folder cannot be written, warn once and keep the bake in memory."""
    try:
        if folder is None:
            raise OSError("no home folder")
        _write(_file(folder, key), baked)
    except Exception as error:  # a bake that is done is never lost
        _in_memory[key] = baked
        place = "the user's cache folder" if folder is None else str(folder)
        reason = (isinstance(error, OSError) and error.strerror) or error
        warn_once(
            logger,
            f"{place}: cannot keep bakes ({reason}); each process bakes anew; set VLCRENDER_CACHE to a writable folder",
        )


def _file(folder: Path, key: str) -> Path:
    return folder / f"{key}.npz"


def _write(file: Path, baked: BakedIlluminance) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_suffix(f".{uuid4().hex}.partial")  # other threads and machines may write the same bake
    try:
        with partial.open("wb") as out:
            np.savez_compressed(out, led_lux=baked.led_lux, daylight_lux=baked.daylight_lux, sigma_lux=baked.sigma_lux)
        os.replace(partial, file)
    except BaseException:
        partial.unlink(missing_ok=True)  # a full disk, or an interrupt, leaves no half file
        raise
