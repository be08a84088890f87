"""Positions by a rolling shutter in motion, for docs/measure_downlink.py: projected points, and rendered frames."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from measure import Measurement, heading, row
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import estimator as est
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.io.led_map import DiscLed
from estimator.io.shutter import GLOBAL, Gyroscope
from estimator.methods.gravity_fit import fit_correspondences
from estimator.spots.detect import Spot
from estimator.spots.identify import Correspondence

Floats = NDArray[np.float64]
HEADINGS = ("lens", "deg/s", "LEDs", "motion", "median", "95 %", "failed", "NEES (expected 3)")
WIDTH_PX, HEIGHT_PX = 4000, 3000
LENSES = {"18 mm": 15000.0, "phone": 3500.0}
RATES_DEG_S = (1.0, 5.0, 20.0)
ROW_TIME_US = 10.0
SPEED_M_S = 0.05
CENTROID_SIGMA_PX = 0.02
TILT_SIGMA_DEG = 0.5
GYRO_SIGMA_RAD_S = float(np.radians(0.3))
HANDLINGS = ("ignored", "gyroscope", "estimated")
MAX_LEDS = 60
FEW_LEDS = (3, 4)
MIN_LEDS = 8
BORDER_PX = 60
POSES = 100
SUBSTITUTIONS = 10
POINT_M = 1e-6
"""49 panels of 5 x 5 LEDs at a height of 3.45 m, as in scenes/office.toml."""
_STEPS_M = (np.arange(5) - 2) * 0.13
_CENTRES_M = 0.5 + np.arange(7)
_ALONG_M = (_CENTRES_M[:, None] + _STEPS_M).ravel()
LEDS_M = np.array([(x, y, 3.45) for x in _ALONG_M for y in _ALONG_M])
RENDERED_FRAMES = 24
RENDERED_VELOCITY = {
    "motion.angular_velocity_deg_s": [3.0, -3.2, 2.4],
    "motion.linear_velocity_m_s": [0.03, -0.04, 0.02],
}
RENDERED_VARIANTS = ("gravity-fit", "up2p", "ml", "pnp")


@dataclass(frozen=True)
class _View:
    """A camera in motion: pose at mid-readout, and its velocities, rad/s in its own axes and m/s in the world's."""

    focal_px: float
    position_m: Floats
    R_cam_world: Floats
    rate_rad_s: Floats
    speed_m_s: Floats

    def pixels(self, points_m: Floats, times_s: Floats) -> Floats:
        """Pixels (n, 2) of points (n, 3), each at its time (n,)."""
        offset = points_m - self.position_m - times_s[:, None] * self.speed_m_s
        turned = Rotation.from_rotvec(times_s[:, None] * self.rate_rad_s).inv()
        x, y, z = turned.apply(offset @ self.R_cam_world.T).T
        return np.column_stack([x, y]) / np.where(z > 0, z, np.nan)[:, None] * self.focal_px + [
            WIDTH_PX / 2,
            HEIGHT_PX / 2,
        ]

    def rolling_pixels(self, points_m: Floats) -> Floats:
        """The same when the line of each is exposed, rows downwards."""
        times_s = np.zeros(len(points_m))
        for _ in range(SUBSTITUTIONS):
            times_s = (self.pixels(points_m, times_s)[:, 1] - HEIGHT_PX / 2) * ROW_TIME_US * 1e-6
        return self.pixels(points_m, times_s)


def _drawn_view(rng: np.random.Generator, focal_px: float, rate_deg_s: float) -> tuple[_View, NDArray[np.intp]]:
    """A view with MIN_LEDS LEDs or more on the sensor, and these."""
    while True:
        tilt_x, tilt_y, yaw = *rng.uniform(-25, 25, 2), rng.uniform(0, 360)
        R = Rotation.from_euler("XYZ", [-tilt_x, -tilt_y, -yaw], degrees=True).as_matrix()
        position_m = np.array([*rng.uniform(2, 5, 2), rng.uniform(0.3, 1.5)])
        axis = rng.normal(size=3)
        rate = np.radians(rate_deg_s) * axis / np.linalg.norm(axis)
        view = _View(focal_px, position_m, R, rate, SPEED_M_S * rng.normal(size=3))
        pixels = view.pixels(LEDS_M, np.zeros(len(LEDS_M)))
        size_px = np.array([WIDTH_PX, HEIGHT_PX])
        seen = np.flatnonzero(((pixels > BORDER_PX) & (pixels < size_px - BORDER_PX)).all(axis=1))
        if len(seen) >= MIN_LEDS:
            return view, seen


def _frame(view: _View, handling: str, rng: np.random.Generator) -> DeviceFrame:
    """What the device knows; its accelerometer has an error of TILT_SIGMA_DEG on each tilt."""
    shutter: dict[str, object] = {"kind": "rolling", "row_time_us": ROW_TIME_US, "direction": "down"}
    off = np.radians(TILT_SIGMA_DEG) * rng.normal(size=2)
    gravity = Rotation.from_rotvec([*off, 0.0]).apply(view.R_cam_world @ [0.0, 0.0, 9.80665])
    nothing = {"parameters": [], "device_sigma": [], "shot_sigma": [], "offset_sigma_m": 0.0, "rotation_sigma_deg": 0.0}
    camera = {
        **{"width_px": WIDTH_PX, "height_px": HEIGHT_PX, "projection": "perspective", "distortion": None},
        "K": [[view.focal_px, 0.0, WIDTH_PX / 2], [0.0, view.focal_px, HEIGHT_PX / 2], [0.0, 0.0, 1.0]],
        **{
            "pixel_pitch_um": 1.2,
            "focal_length_mm": view.focal_px * 1.2e-3,
            "image_distance_mm": view.focal_px * 1.2e-3,
        },
        **{"f_number": 2.2, "focus_distance_m": None, "psf": "none", "psf_wavelength_nm": 550.0, "psf_kernel": None},
        **{"R_cam_rig": np.eye(3), "offset_m": [0.0, 0.0, 0.0], "uncertainty": nothing, "shutter": shutter},
    }
    sensor = {
        **{"bits": 16, "gain_e_per_dn": 1.0, "full_well_e": 60000, "black_level_dn": 0, "noise": "shot", "prnu": 0.0},
        **{"dark_current_e_s": 0.0, "dsnu_e": 0.0, "read_noise_e": 0.0, "adc_noise_dn": 0.0, "row_offset_e": 0.0},
        **{"column_offset_e": 0.0, "mosaic": "none"},
    }
    frame = est.frame(
        {
            **{"camera": camera, "sensor": sensor, "led_map": [], "spots": [], "exposure_s": 40e-6},
            "accelerometer": {"kind": "imu", "error_deg": TILT_SIGMA_DEG},
            "accelerometer_m_s2": gravity,
            "parts": [{"row": 0, "column": 0, "image_dn": np.zeros((1, 1), dtype=np.uint32)}],
        }
    )
    if handling == "ignored":
        return replace(frame, camera=frame.camera.model_copy(update={"shutter": GLOBAL}))
    if handling == "gyroscope":
        x, y, z = (view.rate_rad_s + GYRO_SIGMA_RAD_S * rng.normal(size=3)).tolist()
        gyroscope = Gyroscope(noise_rad_s=GYRO_SIGMA_RAD_S, bias_rad_s=0.0)
        return replace(frame, gyro_rad_s=(x, y, z), gyroscope=gyroscope)
    return frame


def _trial(
    rng: np.random.Generator, focal_px: float, rate_deg_s: float, leds: int, handling: str
) -> tuple[float, float]:
    """Distance from the truth, metres, and the normalised squared error; raises EstimationFailure."""
    view, seen = _drawn_view(rng, focal_px, rate_deg_s)
    chosen = rng.permutation(seen)[:leds]
    pixels = view.rolling_pixels(LEDS_M[chosen]) + CENTROID_SIGMA_PX * rng.normal(size=(len(chosen), 2))
    covariance_px2 = CENTROID_SIGMA_PX**2 * np.eye(2)
    spots = [
        Correspondence(
            DiscLed(id=k, position_m=(x, y, z), radius_m=POINT_M),
            Spot(u, v, covariance_px2, u, v, 50, 1000.0, touches_border=False, saturated=False),
        )
        for k, ((x, y, z), (u, v)) in enumerate(zip(LEDS_M[chosen].tolist(), pixels.tolist(), strict=True))
    ]
    found = fit_correspondences(_frame(view, handling, rng), spots)
    error = found.position_m - view.position_m
    return float(np.linalg.norm(error)), float(error @ np.linalg.solve(np.asarray(found.covariance_m2), error))


def projected(poses: int = POSES) -> None:
    """Print the rows of projected points by `gravity-fit`."""
    heading(*HEADINGS)
    for lens, focal_px in LENSES.items():
        for rate in RATES_DEG_S:
            for leds in (MAX_LEDS, *FEW_LEDS) if rate == RATES_DEG_S[1] else (MAX_LEDS,):
                for handling in HANDLINGS:
                    if handling == "ignored" and leds != MAX_LEDS:
                        continue
                    rng = np.random.default_rng([int(rate), int(focal_px), leds])
                    found = []
                    for _ in range(poses):
                        try:
                            found.append(_trial(rng, focal_px, rate, leds, handling))
                        except EstimationFailure:
                            found.append((np.inf, np.nan))
                    _print_row((lens, f"{rate:g}", f"<= {leds}", handling), np.array(found))


def _print_row(first: Sequence[str], found: Floats) -> None:
    """Median and 95th percentile of all, a failed one being infinite, and the mean NEES of the others."""
    median, most = np.quantile(found[:, 0], [0.5, 0.95], method="lower")
    failed = int(np.isinf(found[:, 0]).sum())
    row(*first, f"{1e3 * median:.1f} mm", f"{1e3 * most:.0f} mm", failed, f"{np.nanmean(found[:, 1]):.2f}")


def rendered(measurement: Measurement, frames: int = RENDERED_FRAMES) -> None:
    """Print the rows of rendered frames at 5 deg/s: LEDs steady and identities given, 18 mm lens, by variant."""
    of_recipe = {
        **{"poses.count": frames, "bound": False, "exposure_s": 40e-6, "regions.kind": "leds"},
        **{"camera.shutter.kind": "rolling", "camera.shutter.row_time_us": ROW_TIME_US},
        **{"accelerometer.error_deg": TILT_SIGMA_DEG, **RENDERED_VELOCITY},
    }
    gyroscope = {"gyroscope.noise_deg_s": 0.3, "gyroscope.bias_deg_s": 0.0}
    estimated = measurement.dataset(f"motion-{frames}", "office200", of_recipe)
    read = measurement.dataset(f"motion-gyro-{frames}", "office200", {**of_recipe, **gyroscope})
    ignored = _said_to_be_global(estimated)
    heading("variant", "motion", "median", "95 %", "failed", "NEES (expected 3)")
    for handling, folder in zip(HANDLINGS, (ignored, read, estimated), strict=True):
        est.run(folder, RENDERED_VARIANTS, measurement.workers)
        for of_variant in est.score(folder).variants:
            errors = of_variant.error_3d
            if errors is None:
                row(f"`{of_variant.variant}`", handling, "", "", of_variant.failed, "")
                continue
            nees = "" if of_variant.nees is None else f"{of_variant.nees.mean:.2f}"
            own = [f"{1e3 * errors.median_m:.1f} mm", f"{1e3 * errors.p95_m:.0f} mm", of_variant.failed, nees]
            row(f"`{of_variant.variant}`", handling, *own)


def _said_to_be_global(folder: Path) -> Path:
    """A copy of a set whose device is told that the shutter is global."""
    copy = folder.with_name(f"{folder.name}-ignored")
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    path = copy / "dataset.json"
    told = json.loads(path.read_text())
    for camera in told["cameras"].values():
        camera["shutter"] = {"kind": "global"}
    path.write_text(json.dumps(told))
    return copy
