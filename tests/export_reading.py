"""What tests of exports compare with: the truth of a set as arrays, and the export of a set."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

import vlcrender as vr
from vlcrender.dataset.format.files import read_dataset_file

MAX_ERROR_PX = 1e-6
"""Tests ask for 1e-6 px; doubles of 10 m and 2000 px leave some 1e-12 px."""


@dataclass(frozen=True)
class TrueFrame:
    """A frame of truth.parquet with the LEDs that light it."""

    frame: int
    map: int
    camera: str
    R_cam_world: NDArray[np.float64]
    position_m: NDArray[np.float64]
    led: list[int]
    world_m: NDArray[np.float64]
    """Centres (n, 3) of these LEDs, in the map that the frame shows."""
    pixels: NDArray[np.float64]
    """Our own projection (n, 2) of these centres, pixel centres at +0.5."""


def true_frames(folder: Path) -> list[TrueFrame]:
    """All frames of a set; each has LEDs."""
    dataset = read_dataset_file(folder)
    maps = {(0, led.id): led.position_m for led in dataset.led_map or ()}
    if (folder / "truth_map.parquet").is_file():
        rows = pq.read_table(folder / "truth_map.parquet").to_pylist()
        maps = {(row["map"], row["led"]): row["position_m"] for row in rows}
    cameras = pq.read_table(folder / "frames.parquet", columns=["camera"]).column("camera").to_pylist()
    found = []
    for row, camera in zip(pq.read_table(folder / "truth.parquet").to_pylist(), cameras, strict=True):
        leds = row["leds"]
        assert leds
        found.append(
            TrueFrame(
                row["frame"],
                row["map"],
                camera,
                np.reshape(row["R_cam_world"], (3, 3)),
                np.array(row["position_m"]),
                [led["led"] for led in leds],
                np.array([maps[row["map"], led["led"]] for led in leds]),
                np.array([[led["u_px"], led["v_px"]] for led in leds]),
            )
        )
    return found


def exported(folder: Path, to: str, tmp_path: Path, name: str = "out") -> Path:
    """The export of a set."""
    out = tmp_path / name
    assert vr.export_dataset(folder, to, out) == read_dataset_file(folder).frame_count
    return out
