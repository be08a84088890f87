"""Measurements of docs/paper.md beside the tables of errors: theory, coverage, LED images and noise."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from measure import length, predictions
from numpy.typing import NDArray
from paper_sets import Measured, key_text

import estimator as est
import vlcrender as vr
from estimator.evaluate.table import Key, Statistic, Table, TableRow
from estimator.io.estimates import estimates_path, read_estimates
from estimator.io.sweep import dataset_folders
from estimator.report.plot import plot
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.scene.visibility import leds_in_view, level_visibility

Floats = NDArray[np.float64]
Grid = dict[str, Any]
Found = tuple[list[Grid], dict[str, float]]
TILT_POSITIONS = 20
NEIGHBOURS = 11


def tilt_theory(sets: Mapping[str, Measured]) -> Found:
    """Root mean square of `huynh2016` at each accelerometer error, and the same to first order in the angle."""
    predicted: dict[tuple[str, float], list[float]] = {}
    measured: dict[tuple[str, float], list[float]] = {}
    for cell in dataset_folders(sets["table2"].folder):
        true = pq.read_table(cell / "truth.parquet").to_pylist()
        at = (true[0]["sweep_tilt"], true[0]["sweep_error_deg"])
        rows = read_estimates(estimates_path(cell, "huynh2016"), len(true))
        answered = [row for row in rows if row.position_m is not None]
        if len(answered) < len(rows):
            raise ValueError(f"{cell}: huynh2016 failed in {len(rows) - len(answered)} frames")
        for row, (position_m, error_m) in zip(rows, predictions(cell, rows), strict=True):
            predicted.setdefault(at, []).append(float(np.sum(error_m**2)))
            measured.setdefault(at, []).append(float(np.sum(np.subtract(row.position_m, position_m) ** 2)))
    rows, worst = [], 0.0
    for (tilt, error_deg), squares in sorted(predicted.items()):
        if error_deg == 0:
            continue
        theory, real = (float(np.sqrt(np.mean(one))) for one in (squares, measured[tilt, error_deg]))
        worst = max(worst, abs(real / theory - 1))
        rows.append(
            [key_text(tilt), f"{error_deg:g}", str(len(squares)), length(theory), length(real), f"{real / theory:.4f}"]
        )
    head = [
        "tilt on both axes, deg",
        "error, deg",
        "frames",
        "first order, RMS",
        "measured, RMS",
        "measured / first order",
    ]
    return [{"title": "First order beside measurement, `huynh2016`", "head": head, "rows": rows}], {
        "theory_worst": worst
    }


def coverage(_: Mapping[str, Measured]) -> Found:
    """Shares of Table 1's poses with four LED centres in view."""
    camera, found, rows = vr.Camera(), {}, []
    for scene, name in (("table1", "seen"), ("office", "office")):
        for yaw_deg, side in ((0.0, "x"), (90.0, "y")):
            one = level_visibility(camera, vr.load_scene(scene), 0.0, yaw_deg)
            found[f"{name}_{side}"] = one.share
            rows.append([scene, side, str(one.poses), str(one.seen), f"{100 * one.share:.3f} %"])
    found["office"] = min(found["office_x"], found["office_y"])
    head = ["scene", "long side along", "poses", "with four LEDs in view", "share"]
    return [{"title": "Coverage of the 350 x 350 level poses on the floor", "head": head, "rows": rows}], found


def tilt_coverage(_: Mapping[str, Measured]) -> Found:
    """Shares of positions with four whole LEDs in view by tilt, not aimed, yaw 0, on the floor."""
    camera, rows, found = vr.Camera(), [], {}
    places = (np.arange(TILT_POSITIONS) + 0.5) * 7.0 / TILT_POSITIONS
    tilts = (0.0, 20.0, 40.0, 60.0)
    for scene_name in ("table1", "office"):
        scene = vr.load_scene(scene_name)
        for tilt_x in tilts:
            shares = []
            for tilt_y in tilts:
                poses = (vr.Pose((x, y, 0.1), tilt_x_deg=tilt_x, tilt_y_deg=tilt_y) for x in places for y in places)
                seen = [len(leds_in_view(PosedCamera(camera, pose), scene)) >= 4 for pose in poses]
                shares.append(float(np.mean(seen)))
            rows.append([scene_name, f"{tilt_x:g}", *(f"{100 * share:.1f} %" for share in shares)])
            if scene_name == "office" and tilt_x == 60:
                found["share_60"] = shares[-1]
    head = ["scene", "tilt_x, deg", *(f"tilt_y = {tilt:g} deg" for tilt in tilts)]
    title = (
        f"Coverage: {TILT_POSITIONS} x {TILT_POSITIONS} positions, share with four whole LEDs in view, yaw 0, not aimed"
    )
    return [{"title": title, "head": head, "rows": rows}], found


def curves(metric: str, x: str, groups: Mapping[str, tuple[Floats, Floats]]) -> str:
    """A plot of curves, SVG, by the plot of tables."""
    rows = tuple(
        TableRow((Key(float(at)),), (group,), 1, 1, (Statistic(float(value), np.nan, np.nan),), {})
        for group, (places, values) in groups.items()
        for at, value in zip(places, values, strict=True)
    )
    return plot(Table(metric, (x,), ("variant",), ("mean",), rows), ())


def _images(folder: Path) -> list[tuple[Any, dict[str, Any]]]:
    """Frames of a set and their truth."""
    found = []
    for cell in dataset_folders(folder):
        dataset = est.read_dataset(cell)
        true = pq.read_table(cell / "truth.parquet").to_pylist()
        found += [(est.read_frame(dataset, record), row) for record, row in zip(dataset.frames, true, strict=True)]
    return found


def _around(frame: Any, u_px: float, v_px: float, half: int) -> Floats:
    """Electrons of the pixels within `half` of a place."""
    for part in frame.parts:
        row, column = int(v_px) - part.row, int(u_px) - part.column
        image = frame.electrons(part)
        if half <= row < image.shape[0] - half and half <= column < image.shape[1] - half:
            return image[row - half : row + half + 1, column - half : column + half + 1].astype(np.float64)
    raise ValueError(f"no region holds {2 * half + 1} pixels about ({u_px:.0f}, {v_px:.0f})")


def profile(sets: Mapping[str, Measured]) -> Found:
    """Rows through the centres of LED images without noise, and how flat they are."""
    frame, true = _images(sets["fig5"].folder)[0]
    groups, flats, rows = {}, [], []
    for led in true["leds"]:
        if led["led"] not in (1, 2):
            continue
        image = _around(frame, led["u_px"], led["v_px"], 45)
        peak, line = image.max(), image[image.shape[0] // 2]
        groups[f"LED {led['led']}"] = (np.arange(len(line)) - len(line) // 2, line)
        flats.append(float((image >= 0.95 * peak).sum() / (image >= 0.5 * peak).sum()))
        rows.append(
            [f"LED {led['led']}", f"{peak:.0f}", str(int((image >= 0.5 * peak).sum())), f"{100 * flats[-1]:.1f} %"]
        )
    head = ["LED", "largest, electrons", "pixels above half", "of them within 5 % of the largest"]
    bell = np.log(1 / 0.95) / np.log(2)
    grid = {"title": "Rows through the centres of two LED images, no noise", "head": head, "rows": rows}
    grid |= {"plot": "fig5-profile.svg", "svg": curves("electrons", "pixel", groups)}
    return [grid], {"flat": min(flats), "bell": float(bell)}


def noise_histogram(sets: Mapping[str, Measured]) -> Found:
    """The 120 differences at an LED's centre, its edge and the ceiling: their variance over that of Skellam's law."""
    half = NEIGHBOURS // 2
    found: dict[str, list[Floats]] = {"centre": [], "edge": [], "ceiling": []}
    means: dict[str, list[float]] = {name: [] for name in found}
    frames = _images(sets["fig8"].folder)
    for frame, true in frames:
        led = next(one for one in true["leds"] if one["led"] == 2)
        radius_px = frame.camera.matrix()[0, 0] * 0.01 / (3.5 - true["position_m"][2])
        for name, away_px in (("centre", 0.0), ("edge", radius_px), ("ceiling", radius_px + 25)):
            area = _around(frame, led["u_px"] + away_px, led["v_px"], half)
            others = np.delete(area.ravel(), area.size // 2)
            found[name].append(area[half, half] - others)
            means[name].append(float(area.mean()))
    rows, figures, groups = [], {}, {}
    for name, of_name in found.items():
        within = float(np.mean([np.var(one) for one in of_name]))
        skellam = 2 * float(np.mean(means[name]))
        figures[name] = within / skellam
        rows.append(
            [
                name,
                str(len(of_name)),
                f"{skellam / 2:.1f}",
                f"{np.sqrt(skellam):.1f}",
                f"{np.sqrt(within):.1f}",
                f"{within / skellam:.3f}",
            ]
        )
        scaled = np.concatenate(of_name) / np.sqrt(skellam)
        counts, edges = np.histogram(scaled, bins=np.linspace(-4, 4, 33), density=True)
        groups[name] = ((edges[:-1] + edges[1:]) / 2, counts)
    head = [
        "place",
        "frames",
        "mean, electrons",
        "Skellam's sigma",
        "sigma of the 120 differences",
        "variance over Skellam's",
    ]
    grid = {"title": "120 differences in an area of 11 x 11 pixels", "head": head, "rows": rows}
    grid |= {"plot": "fig8-histogram.svg", "svg": curves("density", "difference over Skellam's sigma", groups)}
    return [grid], figures
