"""Photographs made apart from vlcrender: lamps with square waves under a rolling shutter, tone curve, JPEG."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from striped_images import gains

Array = NDArray[np.float64]

SIZE_PX = (2000, 1500)
FOCAL_PX = 1400.0
LINE_RATE_HZ = 40_000.0
EXPOSURE_S = 60e-6
HEIGHT_CM = 240.0
LAMPS_CM: dict[int, tuple[float, float]] = {
    2000: (-60.0, 40.0),
    2500: (60.0, 42.0),
    3000: (58.0, -40.0),
    3500: (-62.0, -41.0),
    4000: (5.0, 3.0),
}
"""LEDs by their frequency, in right-handed axes."""
POSITION_CM = (4.0, -7.0, 10.0)


def pixels_of(places_cm: Array, tilt_deg: float, position_cm: Sequence[float] = POSITION_CM) -> Array:
    """Pixels (n, 2) of points on the ceiling (n, 2), of a camera that looks up, turned about its x axis."""
    offset = np.column_stack([places_cm, np.full(len(places_cm), HEIGHT_CM)]) - position_cm
    c, s = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    x, y, z = (offset @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]]).T).T
    return np.asarray(np.column_stack([x, y]) / z[:, None] * FOCAL_PX + np.array(SIZE_PX) / 2)


def photograph(
    lamps_cm: Mapping[int, tuple[float, float]] = LAMPS_CM,
    tilt_deg: float = 0.5,
    frequencies_hz: Sequence[float] | None = None,
    along: str = "rows",
    radius_px: float = 34.0,
    bell: bool = True,
    steady: bool = False,
    seed: int = 1,
    position_cm: Sequence[float] = POSITION_CM,
) -> NDArray[np.uint8]:
    """Codes (rows, columns) of a picture with sRGB's curve; lamps saturate, and `bell` ones fade to their rim."""
    rng = np.random.default_rng(seed)
    width, height = SIZE_PX
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    count = height if along == "rows" else width
    starts_us = 1e6 * np.arange(count) / LINE_RATE_HZ
    light = np.zeros((height, width))
    tones = list(lamps_cm) if frequencies_hz is None else frequencies_hz
    for tone, (u, v) in zip(tones, pixels_of(np.array(list(lamps_cm.values())), tilt_deg, position_cm), strict=True):
        wave = gains(np.array([1.0, 0.0]), 0.5e6 / tone, starts_us + 1e3 * rng.random(), 1e6 * EXPOSURE_S)
        wave = np.full(count, 0.5) if steady else wave
        distance2 = ((x - u) ** 2 + (y - v) ** 2) / radius_px**2
        face = 1.6 * np.exp(-3 * distance2) if bell else 0.8 * np.clip(radius_px * (1 - np.sqrt(distance2)) + 0.5, 0, 1)
        light += face * (wave[:, None] if along == "rows" else wave[None, :])
    light = np.clip(light + 0.002 + 0.002 * rng.standard_normal(light.shape), 0, 1)
    coded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * coded).astype(np.uint8)


def write_picture(path: Path, codes: NDArray[np.uint8]) -> Path:
    cv2.imwrite(str(path), codes)
    return path


def write_map(path: Path, lamps_cm: Mapping[int, tuple[float, float]] = LAMPS_CM, left_handed: bool = False) -> Path:
    sign = -1 if left_handed else 1
    rows = [f"{hz},{sign * x},{y},{HEIGHT_CM},{hz}" for hz, (x, y) in lamps_cm.items()]
    path.write_text("\n".join(["id,x,y,z,frequency_hz", *rows]) + "\n")
    return path
