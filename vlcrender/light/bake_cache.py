"""Cache of baked illuminance: one file per bake in the user's cache folder, or this process's memory if that fails."""

import logging
import os
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile
from zlib import error as ZlibError

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_dir

from vlcrender.core.warn_once import warn_once

Array = NDArray[np.float64]
logger = logging.getLogger(__name__)

DAMAGES = (OSError, ValueError, KeyError, EOFError, BadZipFile, ZlibError, NotImplementedError, RuntimeError)
"""What NumPy, zipfile and zlib raise for files that are cut short or have wrong bytes."""


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
    """$VLCRENDER_CACHE, else the user's cache folder of this platform; None for a user without a home folder."""
    chosen = os.environ.get("VLCRENDER_CACHE")
    if chosen:
        return Path(chosen)
    try:
        return Path(user_cache_dir("vlcrender", appauthor=False))
    except RuntimeError:  # platformdirs finds no home folder
        return None


def load(key: str, count: int, folder: Path | None) -> BakedIlluminance | None:
    """The bake kept under `key`, with arrays of `count` values; None if there is none or its file is damaged."""
    if key in _in_memory:
        return _in_memory[key]
    if folder is None:
        return None
    try:
        with np.load(_file(folder, key)) as stored:
            baked = BakedIlluminance(stored["led_lux"], stored["daylight_lux"], stored["sigma_lux"])
    except DAMAGES:
        return None  # missing, or damaged by a crash or a disk
    return baked if baked.led_lux.shape == (count,) else None


def store(key: str, baked: BakedIlluminance, folder: Path | None) -> None:
    """Keep a bake under `key`. If the folder cannot be written, warn once and keep the bake in memory."""
    try:
        if folder is None:
            raise OSError("no home folder")
        _write(_file(folder, key), baked)
    except OSError as error:
        _in_memory[key] = baked
        place = "the user's cache folder" if folder is None else str(folder)
        reason = error.strerror or error
        warn_once(
            logger,
            f"{place}: cannot keep bakes ({reason}); each process bakes anew; set VLCRENDER_CACHE to a writable folder",
        )


def _file(folder: Path, key: str) -> Path:
    return folder / f"{key}.npz"


def _write(file: Path, baked: BakedIlluminance) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_suffix(f".{os.getpid()}.partial")
    try:
        with partial.open("wb") as out:
            np.savez_compressed(out, led_lux=baked.led_lux, daylight_lux=baked.daylight_lux, sigma_lux=baked.sigma_lux)
        os.replace(partial, file)
    except OSError:
        partial.unlink(missing_ok=True)  # a full disk keeps no half file
        raise
