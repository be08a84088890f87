"""A dataset of photographs, by datasets/FORMAT.md: null for what a photograph does not say."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from estimator.errors import InputError
from estimator.io.atomic import write_atomically
from estimator.io.dataset import FORMAT_VERSION, FRAME_COLUMNS, write_image
from estimator.io.device import DeviceFrame
from estimator.io.sensor import Sensor
from estimator.photo.pictures import Picture

BITS = 16


def photograph_sensor() -> Sensor:
    """Sensor of a photograph: BITS of linear light, neither gain nor full well known."""
    return Sensor(
        bits=BITS,
        gain_e_per_dn=None,
        full_well_e=None,
        black_level_dn=0.0,
        noise="shot",
        crosstalk=0.0,
        prnu=0.0,
        dark_current_e_s=0.0,
        dsnu_e=0.0,
        read_noise_e=0.0,
        adc_noise_dn=0.0,
        row_offset_e=0.0,
        column_offset_e=0.0,
        mosaic="none",
    )


def digital_numbers(picture: Picture) -> NDArray[np.uint32]:
    """Linear light of a picture as digital numbers of BITS; saturated pixels have the largest."""
    largest = 2**BITS - 1
    image = np.rint(np.clip(picture.linear, 0, 1) * (largest - 1)).astype(np.uint32)
    image[picture.clipped] = largest
    return np.asarray(image, dtype=np.uint32)


def save(folder: Path, name: str, frames: Sequence[DeviceFrame], provenance: dict[str, Any]) -> None:
    """Write a dataset of the frames of one camera; raises InputError if the folder has one, or the cameras differ."""
    if (folder / "dataset.json").exists():
        raise InputError(f"--save {folder}: is there already; give the name of a new folder")
    first = frames[0]
    if any(frame.camera != first.camera for frame in frames):
        raise InputError(f"--save {folder}: the pictures are of different sizes; a dataset has one camera")
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    rows = []
    for number, frame in enumerate(frames):
        file = f"frames/{number:06d}.exr"
        (part,) = frame.parts
        sha256 = write_image(folder / file, part.image_dn, frame.exposure_s)
        rows.append(
            {
                "frame": number,
                "shot": number,
                "pose": number,
                "file": file,
                "sha256": sha256,
                "camera": "main",
                "exposure_s": frame.exposure_s,
                "capturable": True,
                "accelerometer_m_s2": frame.accelerometer_m_s2,
                "spots": [asdict(spot) for spot in frame.spots],
                "device": 0,
                "burst": number,
                "start_s": 0.0,
                "gyro_rad_s": None,
            }
        )
    schema = pa.schema(list(FRAME_COLUMNS.items()))
    pq.write_table(pa.Table.from_pylist(rows, schema), folder / "frames.parquet")
    write_atomically(folder / "dataset.json", json.dumps(_description(name, frames, provenance), indent=1).encode())


def _description(name: str, frames: Sequence[DeviceFrame], provenance: dict[str, Any]) -> dict[str, Any]:
    first = frames[0]
    camera = first.camera.model_dump()
    if not first.camera.shutter.rolls:
        camera["shutter"] = {"kind": "global"}
    return {
        "format": "vlcrender-dataset",
        "version": FORMAT_VERSION,
        "name": name,
        "frame_count": len(frames),
        "cameras": {"main": camera},
        "sensor": first.sensor.model_dump(),
        "accelerometer": None if first.accelerometer is None else first.accelerometer.model_dump(),
        "led_map": [led.model_dump() for led in first.leds.values()],
        "luminaires": [],
        "map_datum": None,
        "names": dict.fromkeys(("camera", "sensor", "accelerometer", "belief")),
        "room_m": None,
        "gyroscope": None,
        "downlink": None if first.downlink is None else first.downlink.model_dump(),
        "provenance": provenance,
    }
