"""CSV: the tables of a set, one number a column, in our units and conventions; a number reads back as the same double.

frames.csv, spots.csv, truth.csv, truth_leds.csv, led_map.csv (told), true_leds.csv and cameras.csv. An empty cell is
null.
"""

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from vlcrender.export.source import Source

AXES = "xyz"


def write(source: Source, out: Path) -> Mapping[str, Any]:
    """Write the tables."""
    frames = [row.model_dump() for row in source.frames]
    truth = [row.model_dump() for row in source.truth]
    dataset = source.dataset.model_dump(mode="json")
    _write(out / "frames.csv", (_flat(row, {"spots"}) for row in frames))
    _write(out / "spots.csv", (_flat({"frame": row["frame"], **spot}) for row in frames for spot in row["spots"]))
    _write(out / "truth.csv", (_flat(row, {"leds"}) for row in truth))
    _write(out / "truth_leds.csv", (_flat({"frame": row["frame"], **led}) for row in truth for led in row["leds"]))
    _write(out / "led_map.csv", map(_flat, dataset["led_map"] or ()))
    true_leds = (
        {"map": number, "led": led.led, "position_m": led.position_m.tolist(), "shape": led.shape, "size_m": led.size_m}
        for number, leds in source.maps.items()
        for led in leds.values()
    )
    _write(out / "true_leds.csv", map(_flat, true_leds))
    keep = ("width_px", "height_px", "K", "projection", "distortion", "R_cam_rig", "offset_m", "f_number")
    cameras = ({"camera": name, **{key: entry[key] for key in keep}} for name, entry in dataset["cameras"].items())
    _write(out / "cameras.csv", map(_flat, cameras))
    return {"pixel_centres": "+0.5"}


def _flat(row: Mapping[str, Any], without: set[str] | None = None) -> dict[str, Any]:
    """A row with one cell a number: position_m_x, K_00 to K_22, distortion_k1."""
    cells: dict[str, Any] = {}
    for key, value in row.items():
        if without and key in without:
            continue
        if isinstance(value, Mapping):
            cells |= {f"{key}_{name}": item for name, item in value.items()}
        elif isinstance(value, list | tuple):
            cells |= {f"{key}_{name}": item for name, item in _named(value)}
        else:
            cells[key] = value
    return cells


def _named(value: Sequence[Any]) -> list[tuple[str, Any]]:
    flat = [item for line in value for item in line] if value and isinstance(value[0], list | tuple) else list(value)
    if len(flat) == 9:
        return [(f"{i // 3}{i % 3}", item) for i, item in enumerate(flat)]
    names = {3: AXES, 5: ("k1", "k2", "k3", "p1", "p2")}.get(len(flat)) or range(len(flat))
    return [(str(name), item) for name, item in zip(names, flat, strict=True)]


def _write(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """A table with the columns of all rows, in the order of their first use."""
    lines = list(rows)
    columns = list(dict.fromkeys(key for line in lines for key in line))
    # A null vector has no components: its key is a column only where no row has any.
    empty = {key for key in columns if any(other.startswith(f"{key}_") for other in columns)}
    empty = {key for key in empty if all(line.get(key) is None for line in lines)}
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, [key for key in columns if key not in empty], extrasaction="ignore")
        table.writeheader()
        table.writerows(lines)
