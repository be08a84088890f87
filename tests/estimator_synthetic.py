"""A tiny dataset writer for the estimator's tests: discs seen through a pinhole, after datasets/FORMAT.md alone."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenEXR
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

Array = NDArray[np.float64]
GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True)
class View:
    """A camera: its image, its place and its tilt."""

    width_px: int
    height_px: int
    focal_px: float
    position_m: tuple[float, float, float]
    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0
    yaw_deg: float = 0.0

    @property
    def K(self) -> Array:
        return np.array([[self.focal_px, 0, self.width_px / 2], [0, self.focal_px, self.height_px / 2], [0, 0, 1]])

    @property
    def R_cam_world(self) -> Array:
        (cx, sx), (cy, sy), (cz, sz) = (
            (np.cos(np.radians(a)), np.sin(np.radians(a))) for a in (self.tilt_x_deg, self.tilt_y_deg, self.yaw_deg)
        )
        rx = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
        ry = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
        rz = np.array([[cz, sz, 0], [-sz, cz, 0], [0, 0, 1]])
        return rx @ ry @ rz

    @property
    def gravity_m_s2(self) -> Array:
        return self.R_cam_world @ [0, 0, GRAVITY_M_S2]

    def project(self, points_m: Array) -> Array:
        """World points (n, 3) to pixels (n, 2)."""
        seen = (np.asarray(points_m) - self.position_m) @ self.R_cam_world.T @ self.K.T
        return seen[:, :2] / seen[:, 2:]


def view_of(
    target_m: Sequence[float],
    height_m: float,
    tilt_x_deg: float = 0.0,
    tilt_y_deg: float = 0.0,
    yaw_deg: float = 0.0,
    size: tuple[int, int, float] = (400, 300, 1500.0),
) -> View:
    """A camera `height_m` below a point of the ceiling that has the point in the middle of its image."""
    view = View(*size, (0.0, 0.0, 0.0), tilt_x_deg, tilt_y_deg, yaw_deg)
    axis = view.R_cam_world[2]
    x, y, z = np.asarray(target_m) - axis * height_m / axis[2]
    return View(*size, (float(x), float(y), float(z)), tilt_x_deg, tilt_y_deg, yaw_deg)


def grid(columns: int, rows: int, pitch_m: float, centre_m: Sequence[float]) -> Array:
    """LEDs in a grid on the ceiling, (columns * rows, 3)."""
    x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    return np.column_stack([x.ravel() * pitch_m, y.ravel() * pitch_m, np.zeros(x.size)]) + centre_m


def render(
    view: View,
    leds_m: Array,
    radius_m: float = 0.01,
    led_e: float | Sequence[float] = 4000.0,
    background_e: float = 40.0,
    samples: int = 16,
) -> Array:
    """Expected electrons, (height, width): horizontal discs of the given electrons a pixel, edges supersampled."""
    image = np.full((view.height_px, view.width_px), float(background_e))
    to_plane = view.R_cam_world.T @ np.linalg.inv(view.K)
    around = np.linspace(0, 2 * np.pi, 64)
    for led, peak_e in zip(leds_m, np.broadcast_to(led_e, len(leds_m)), strict=True):
        rim = view.project(led + radius_m * np.column_stack([np.cos(around), np.sin(around), 0 * around]))
        left, top = np.maximum(np.floor(rim.min(axis=0)) - 2, 0).astype(int)
        right, bottom = np.minimum(np.ceil(rim.max(axis=0)) + 2, (view.width_px, view.height_px)).astype(int)
        if left >= right or top >= bottom:
            continue

        def inside(u: Array, v: Array, led: Array = led) -> NDArray[np.bool_]:
            x, y, z = np.tensordot(to_plane, np.stack([u, v, np.ones_like(u)]), axes=1)
            distance = (led[2] - view.position_m[2]) / z
            return np.asarray(
                (x * distance + view.position_m[0] - led[0]) ** 2 + (y * distance + view.position_m[1] - led[1]) ** 2
                <= radius_m**2
            )

        v, u = np.meshgrid(np.arange(top, bottom) + 0.5, np.arange(left, right) + 0.5, indexing="ij")
        cover = inside(u, v).astype(float)
        edge = np.zeros(cover.shape, bool)
        for du in (-1, 0, 1):
            for dv in (-1, 0, 1):
                edge |= inside(u + du, v + dv) != (cover > 0)
        # Also small ellipses that slip between the pixel centres.
        edge |= np.hypot(u - rim[:, 0].mean(), v - rim[:, 1].mean()) < 3
        sub = (np.arange(samples) + 0.5) / samples - 0.5
        sv, su = np.meshgrid(sub, sub, indexing="ij")
        cover[edge] = inside(u[edge][:, None] + su.ravel(), v[edge][:, None] + sv.ravel()).mean(axis=1)
        image[top:bottom, left:right] += (peak_e - background_e) * cover
    return image


def poisson(expected_e: Array, seed: int) -> NDArray[np.uint32]:
    """Shot noise; digital numbers of gain 1."""
    return np.random.default_rng(seed).poisson(expected_e).astype(np.uint32)


def write_exr(path: Path, image_dn: NDArray[np.uint32]) -> str:
    """One channel Y, PIZ; returns the file's sha256."""
    path.parent.mkdir(exist_ok=True)
    with OpenEXR.File({"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}, {"Y": image_dn}) as file:
        file.write(str(path))
    return hashlib.sha256(path.read_bytes()).hexdigest()


SPOT = pa.struct([("led", pa.int64()), ("u_px", pa.float64()), ("v_px", pa.float64())])
TRUTH_LED = pa.struct([*SPOT, pa.field("visible_fraction", pa.float64()), pa.field("bits", pa.string())])
FRAMES_SCHEMA = pa.schema(
    [
        ("frame", pa.int64()),
        ("shot", pa.int64()),
        ("pose", pa.int64()),
        ("file", pa.string()),
        ("sha256", pa.string()),
        ("camera", pa.string()),
        ("exposure_s", pa.float64()),
        ("capturable", pa.bool_()),
        ("accelerometer_m_s2", pa.list_(pa.float64(), 3)),
        ("spots", pa.list_(SPOT)),
        ("device", pa.int64()),
        ("burst", pa.int64()),
        ("start_s", pa.float64()),
        ("gyro_rad_s", pa.list_(pa.float64(), 3)),
    ]
)
TRUTH_SCHEMA = pa.schema(
    [
        ("frame", pa.int64()),
        ("shot", pa.int64()),
        ("position_m", pa.list_(pa.float64(), 3)),
        ("R_cam_world", pa.list_(pa.float64(), 9)),
        ("tilt_x_deg", pa.float64()),
        ("tilt_y_deg", pa.float64()),
        ("yaw_deg", pa.float64()),
        ("leds", pa.list_(TRUTH_LED)),
        ("bound_m2", pa.list_(pa.float64(), 9)),
        ("bound_exact_m2", pa.list_(pa.float64(), 9)),
        ("map", pa.int64()),
        ("K", pa.list_(pa.float64(), 9)),
        ("distortion", pa.list_(pa.float64(), 5)),
    ]
)


def write_dataset(
    folder: Path,
    views: Sequence[View],
    leds_m: Array,
    radius_m: float = 0.01,
    led_e: float = 4000.0,
    background_e: float = 40.0,
    noise: bool = True,
    seed: int = 1,
    rough_px: float = 3.0,
) -> Path:
    """A complete dataset of one camera; LED ids are 10, 11, ... so that they are no indices by chance."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([seed, 0])
    frames, truth = [], []
    for index, view in enumerate(views):
        expected = render(view, leds_m, radius_m, led_e, background_e)
        image = poisson(expected, seed + index) if noise else np.rint(expected).astype(np.uint32)
        pixels = view.project(leds_m)
        seen = [k for k, (u, v) in enumerate(pixels) if 0 < u < view.width_px and 0 < v < view.height_px]
        rough = pixels + rng.normal(0, rough_px, pixels.shape)
        file = f"frames/{index:06d}.exr"
        frames.append(
            {
                "frame": index,
                "shot": index,
                "pose": index,
                "file": file,
                "sha256": write_exr(folder / file, image),
                "camera": "main",
                "exposure_s": 1e-3,
                "capturable": True,
                "accelerometer_m_s2": view.gravity_m_s2.tolist(),
                "spots": [{"led": 10 + k, "u_px": rough[k, 0], "v_px": rough[k, 1]} for k in seen],
                "device": 0,
                "burst": index,
                "start_s": 0.0,
            }
        )
        truth.append(
            {
                "frame": index,
                "shot": index,
                "position_m": list(view.position_m),
                "R_cam_world": view.R_cam_world.ravel().tolist(),
                "tilt_x_deg": view.tilt_x_deg,
                "tilt_y_deg": view.tilt_y_deg,
                "yaw_deg": view.yaw_deg,
                "map": 0,
                "K": view.K.ravel().tolist(),
                "leds": [
                    {"led": 10 + k, "u_px": pixels[k, 0], "v_px": pixels[k, 1], "visible_fraction": 1.0} for k in seen
                ],
            }
        )
    pq.write_table(pa.Table.from_pylist(frames, FRAMES_SCHEMA), folder / "frames.parquet")
    pq.write_table(pa.Table.from_pylist(truth, TRUTH_SCHEMA), folder / "truth.parquet")
    (folder / "dataset.json").write_text(json.dumps(description(views[0], len(views), leds_m, radius_m)))
    return folder


def description(view: View, frame_count: int, leds_m: Array, radius_m: float) -> dict[str, object]:
    """The contents of dataset.json."""
    pitch_um = 18000 / view.focal_px
    return {
        "format": "vlcrender-dataset",
        "version": 4,
        "name": "synthetic <&>",
        "frame_count": frame_count,
        "cameras": {
            "main": {
                "width_px": view.width_px,
                "height_px": view.height_px,
                "K": view.K.tolist(),
                "pixel_pitch_um": pitch_um,
                "focal_length_mm": 18.0,
                "image_distance_mm": 18.0,
                "f_number": 2.0,
                "projection": "perspective",
                "distortion": None,
                "focus_distance_m": None,
                "psf": "none",
                "psf_wavelength_nm": 550.0,
                "psf_kernel": None,
                "R_cam_rig": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
                "offset_m": [0.0, 0.0, 0.0],
                "uncertainty": None,
                "shutter": {"kind": "global"},
            }
        },
        "sensor": {
            **{"bits": 16, "gain_e_per_dn": 1.0, "full_well_e": 60000, "black_level_dn": 0, "noise": "shot"},
            **{"prnu": 0.0, "dark_current_e_s": 0.0, "dsnu_e": 0.0, "read_noise_e": 0.0, "adc_noise_dn": 0.0},
            **{"row_offset_e": 0.0, "column_offset_e": 0.0, "mosaic": "none"},
            **{"crosstalk": 0.0, "hot_pixel_share": 0.0, "hot_pixel_e_s": 0.0},
        },
        "accelerometer": {"kind": "tilt-error", "error_deg": 0.0, "device_error_deg": None, "shot_error_deg": None},
        "luminaires": [],
        "map_datum": None,
        "gyroscope": None,
        "downlink": None,
        "led_map": [
            {
                **{"id": 10 + k, "position_m": led.tolist(), "radius_m": radius_m, "shape": "disc"},
                **{"luminaire": None, "sigma_m": None, "radius_sigma_m": None, "gradient_sigma": None},
            }
            for k, led in enumerate(np.asarray(leds_m))
        ],
        "room_m": [7.0, 7.0, 3.5],
        "provenance": {"seed": "12345678901234567890", "recipe": {"nothing": None}},
    }


def small_dataset(folder: Path, noise: bool = True) -> Path:
    """Three frames of 20 LEDs: level, tilted, and tilted the other way and turned."""
    tilts = [(0.0, 0.0, 0.0), (30.0, -20.0, 0.0), (-15.0, 25.0, 70.0)]
    views = [view_of((3.5, 3.6, 3.5), 3.0, *tilt) for tilt in tilts]
    return write_dataset(folder, views, grid(5, 4, 0.14, (3.5, 3.6, 3.5)), noise=noise)
