"""Frames of one or more sets as columns: what was swept, the truth, and every variant's scores, a row each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.errors import InputError
from estimator.evaluate.frame_score import Position, mean_distance_m, score_frame, tilt_deg
from estimator.evaluate.known import KnownEstimates, estimate_paths
from estimator.io.dataset import Dataset, read_dataset
from estimator.io.estimates import frames_sha256
from estimator.io.sweep import dataset_folders
from estimator.io.truth import SWEPT, TruthRow, read_true_scalars, read_truth

Column = NDArray[np.float64] | NDArray[np.object_]
Values = list[float | str | None]
Integers = NDArray[np.int64]

OF_RECORD = ("shot", "burst", "pose", "device", "camera", "exposure_s", "start_s", "capturable")
"""Columns of frames.parquet that are columns here."""
OF_SCORE = (
    *("frame", "map", "good_leds", "status", "reason", "error_3d_m", "horizontal_error_m", "vertical_error_m"),
    *("bound_m", "bound_exact_m", "nees", "ambiguous", "time_s", "spots_found", "snr"),
)
"""Keys of a frame in scores.json that are columns here."""


@dataclass(frozen=True, eq=False)
class FrameColumns:
    """A row for each frame and variant of some sets, as columns (n,) by name.

    Numbers are float64, NaN where missing; texts are objects, None where missing. Truth values are 1 and 0. Columns:
    `set`, `variant`; those of frames.parquet, of truth.parquet and of scores.json that hold one number or text a frame;
    each swept name by itself; and `x_m`, `y_m`, `z_m` of the true position, `tilt_deg` (angle of the optical axis off
    the zenith), `leds` (LEDs that light a pixel) and `distance_m` (mean distance to these, by the told map).
    """

    columns: dict[str, Column]
    samples: tuple[Integers, ...]
    """Groupings of the rows by errors that they share, (n,) each; see `_samples`."""

    def column(self, name: str, what: str) -> Column:
        """A column by its name; raises InputError, which starts with `what`, if there is none."""
        if name not in self.columns:
            raise InputError(f"{what} {name}: no such column; there are: {', '.join(self.columns)}")
        return self.columns[name]


def read_frame_columns(directories: Sequence[str | Path], variants: Sequence[str] | None = None) -> FrameColumns:
    """Columns of the frames of datasets and sweeps that have estimates and a truth.

    Parameters
    ----------
    directories
        Folders of datasets or sweeps; `set` is the name of the folder, or its whole path where names repeat.
    variants
        Names of the variants to read; all if None.

    Raises
    ------
    InputError
        A set has no estimates, or none of a variant; a file is missing or damaged.
    """
    paths = [Path(directory) for directory in directories]
    if len(set(paths)) < len(paths):
        raise InputError(f"{', '.join(map(str, paths))}: a folder is given twice")
    names = [path.resolve().name for path in paths]
    labels = [name if names.count(name) == 1 else str(path) for name, path in zip(names, paths, strict=True)]
    columns: dict[str, Values] = {}
    rows = 0
    for label, path in zip(labels, paths, strict=True):
        for folder in dataset_folders(path):
            found = _of_dataset(folder, label, variants)
            count = len(found["frame"])
            for name in {**columns, **found}:
                column = columns.setdefault(name, [None] * rows)
                column += found.get(name) or [None] * count
            rows += count
    return FrameColumns({name: _array(values) for name, values in columns.items() if name[0] != "_"}, _samples(columns))


def _of_dataset(folder: Path, label: str, variants: Sequence[str] | None) -> dict[str, Values]:
    """Columns of one dataset, and `_first`, the true position of the first frame of a frame's pose, as text."""
    dataset = read_dataset(folder)
    estimates = {path.stem: path for path in estimate_paths(folder)}
    if not estimates:
        raise InputError(f"{folder / 'estimates'}: no estimates; make them with `estimator run {folder}`")
    for name in variants or ():
        if name not in estimates:
            raise InputError(f"{folder / 'estimates'}: none of variant {name}; there are: {', '.join(estimates)}")
    truth_path, digest = dataset.folder / "truth.parquet", frames_sha256(dataset.folder)
    truth = read_truth(truth_path, len(dataset.frames))
    scalars = read_true_scalars(truth_path, len(dataset.frames))
    columns: dict[str, Values] = {}
    for name in variants or estimates:
        known = KnownEstimates.of(estimates[name], dataset, len(dataset.frames), digest)
        leds_m = known.leds_m
        scores = [
            score_frame(row, true, leds_m, record.device)
            for row, true, record in zip(known.rows(), truth, dataset.frames, strict=True)
        ]
        found: dict[str, Values] = {"set": [label] * len(scores), "variant": [name] * len(scores)}
        found |= {key.removeprefix(SWEPT): column for key, column in scalars.items() if key.startswith(SWEPT)}
        # A swept name goes before another column of its name.
        found = scalars | _of_truth(truth, leds_m) | found
        found = {key: [getattr(record, key) for record in dataset.frames] for key in OF_RECORD} | found
        found = {key: [getattr(one, key) for one in scores] for key in OF_SCORE} | found
        found["_first"] = _first_positions(dataset, truth)
        for key, column in found.items():
            if not key.startswith(SWEPT):
                columns.setdefault(key, []).extend(column)
    return columns


def _of_truth(truth: Sequence[TruthRow], leds_m: dict[int, Position]) -> dict[str, Values]:
    positions_m = np.array([row.position_m for row in truth]).reshape(-1, 3)
    return {
        **dict(zip(("x_m", "y_m", "z_m"), positions_m.T.tolist(), strict=True)),
        "tilt_deg": [tilt_deg(row) for row in truth],
        "leds": [float(sum(led.visible_fraction > 0 for led in row.leds)) for row in truth],
        "distance_m": [mean_distance_m(row, leds_m) for row in truth],
    }


def _first_positions(dataset: Dataset, truth: Sequence[TruthRow]) -> Values:
    first: dict[int, str] = {}
    return [first.setdefault(r.pose, repr(true.position_m)) for r, true in zip(dataset.frames, truth, strict=True)]


def _array(values: Values) -> Column:
    if any(isinstance(value, str) for value in values):
        return np.array(values, dtype=object)
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _samples(columns: Mapping[str, Values]) -> tuple[Integers, ...]:
    """Groupings of the rows by errors that they share, integers (n,) each.

    Frames of a pose are taken from one place, in repeats, bursts, by several cameras and in several cells of a sweep,
    whose poses and noise are the same: they are one sample. In a set of several devices, the frames of a device are
    one. In one of several maps, the frames of a map are a sample of a second grouping.
    """
    keys = ("set", "device", "map", "pose", "_first")
    rows = list(zip(*(columns.get(key, ()) for key in keys), strict=True))
    devices: dict[object, set[object]] = {}
    maps: dict[object, set[object]] = {}
    for set_, device, map_, *_ in rows:
        devices.setdefault(set_, set()).add(device)
        maps.setdefault(set_, set()).add(map_)
    first = [(s, d, m) if len(devices[s]) > 1 else (s, *place) for s, d, m, *place in rows]
    second = [(row[0], row[2]) if len(maps[row[0]]) > 1 else sample for row, sample in zip(rows, first, strict=True)]
    return tuple(map(_numbered, [first, second] if any(len(found) > 1 for found in maps.values()) else [first]))


def _numbered(samples: Sequence[tuple[object, ...]]) -> Integers:
    numbers: dict[tuple[object, ...], int] = {}
    return np.array([numbers.setdefault(sample, len(numbers)) for sample in samples], dtype=np.int64)
