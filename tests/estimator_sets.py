"""Datasets without images, and sweeps of them, whose estimates have chosen errors: for tables and plots."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from estimator_synthetic import FRAMES_SCHEMA, TRUTH_SCHEMA, View, description, grid

from estimator.io.estimates import EstimateRow, write_estimates

LEDS = grid(2, 1, 0.4, (3.0, 3.0, 3.5))
Errors = Sequence[float | None]
"""3D error of each frame, metres; None for a failed one."""


def write_set(
    folder: Path,
    errors_m: Mapping[str, Errors],
    swept: Mapping[str, float | str] | None = None,
    views: Sequence[View] = (),
    poses: Sequence[int] = (),
    devices: Sequence[int] = (),
    cameras: Sequence[str] = (),
) -> Path:
    """A dataset whose variants have these errors along x; frames are level, at x = 3, 4, ... m, unless told otherwise.

    Two LEDs, 10 and 11, stand at x = 2.8 and 3.2 m; frame 0 sees both of them and all others the first alone.
    """
    count = len(next(iter(errors_m.values())))
    seen = list(views) or [View(400, 300, 1500.0, (3.0 + frame, 3.0, 0.5)) for frame in range(count)]
    number, of_device = list(poses) or list(range(count)), list(devices) or [0] * count
    folder.mkdir(parents=True, exist_ok=True)
    frames = [
        {
            **{"frame": frame, "shot": frame, "burst": frame, "pose": number[frame], "device": of_device[frame]},
            **{"file": f"frames/{frame:06d}.exr", "sha256": "0" * 64, "exposure_s": 1e-3, "capturable": frame != 1},
            **{"camera": cameras[frame] if cameras else "main", "start_s": 0.0, "spots": []},
            "accelerometer_m_s2": view.gravity_m_s2.tolist(),
        }
        for frame, view in enumerate(seen)
    ]
    leds = [{"led": led, "u_px": 0.0, "v_px": 0.0, "visible_fraction": 1.0} for led in (10, 11)]
    truth = [
        {
            **{"frame": frame, "shot": frame, "map": 0, "position_m": list(view.position_m)},
            **{"R_cam_world": view.R_cam_world.ravel().tolist(), "K": view.K.ravel().tolist()},
            **{"tilt_x_deg": view.tilt_x_deg, "tilt_y_deg": view.tilt_y_deg, "yaw_deg": view.yaw_deg},
            "leds": leds if frame == 0 else leds[:1],
            **{f"sweep_{name}": value for name, value in (swept or {}).items()},
        }
        for frame, view in enumerate(seen)
    ]
    columns = [
        (f"sweep_{name}", pa.string() if isinstance(value, str) else pa.float64())
        for name, value in (swept or {}).items()
    ]
    pq.write_table(pa.Table.from_pylist(frames, FRAMES_SCHEMA), folder / "frames.parquet")
    schema = pa.schema([*TRUTH_SCHEMA, *columns])
    pq.write_table(pa.Table.from_pylist(truth, schema), folder / "truth.parquet")
    content = description(View(400, 300, 1500.0, (3.0, 3.0, 0.5)), count, LEDS, 0.01)
    content["cameras"] = {name: content["cameras"]["main"] for name in {"main", *cameras}}  # type: ignore[index]
    (folder / "dataset.json").write_text(json.dumps(content))
    for variant, of_variant in errors_m.items():
        write_estimates(folder, variant, [_row(i, e, seen[i]) for i, e in enumerate(of_variant)])
    return folder


def _row(frame: int, error_m: float | None, view: View) -> EstimateRow:
    x, y, z = view.position_m
    if error_m is None:
        return EstimateRow(frame=frame, status="failed", reason="detect: no spot", position_m=None, ranges=(), time_s=0)
    return EstimateRow(frame=frame, status="ok", reason="", position_m=(x + error_m, y, z), ranges=(), time_s=0.1)


def write_sweep(folder: Path, cells: Sequence[tuple[Mapping[str, float | str], Mapping[str, Errors]]]) -> Path:
    """A sweep whose cells have these values and errors, by FORMAT.md."""
    entries = []
    for number, (values, errors_m) in enumerate(cells):
        name = f"cells/{number:06d}"
        write_set(folder / name, errors_m, values)
        entries.append({"folder": name, "pose": None, "values": dict(values)})
    swept = [{"name": name, "key": f"camera.{name}", "kind": "values"} for name in cells[0][0]]
    content = {"format": "vlcrender-sweep", "version": 1, "name": "swept", "sweep": swept, "cells": entries}
    (folder / "sweep.json").write_text(json.dumps(content | {"provenance": {}}))
    return folder


def normal_errors(count: int, seed: int = 1) -> list[float]:
    """Sizes of errors about 10 mm."""
    return np.abs(np.random.default_rng(seed).normal(0.01, 0.002, count)).tolist()
