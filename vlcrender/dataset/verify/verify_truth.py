"""Verification of a dataset's truth: poses, LEDs and waves against the map and the told or true cameras."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vlcrender.camera.distortion import Distortion
from vlcrender.camera.intrinsics import Camera, rotation_cam_world, transform
from vlcrender.config.toml_model import check
from vlcrender.dataset.format.camera_entries import CameraEntry
from vlcrender.dataset.format.rows import DeviceTruthRow, FrameRow, MapTruthRow, TruthRow, five, flat9
from vlcrender.dataset.format.schema import DatasetFile
from vlcrender.dataset.format.value_checks import truth_problem
from vlcrender.errors import InputError
from vlcrender.modulation.transmission import Transmitter, led_waves
from vlcrender.modulation.wave import Wave
from vlcrender.scene.leds import transmitters_of
from vlcrender.scene.schema import SceneSettings

Array = NDArray[np.float64]
Positions = Mapping[int, Array]
"""Centre (3,) of each LED, by id."""
MAX_PHASE_ERROR = 1e-6
"""Rounding of phases, periods: waves of 10 kHz after 10^5 s."""
MAX_ROTATION_ERROR = 1e-9
"""Rounding of tilts in degrees and of a rotation's entries: some 1e-15 each."""
LINE_ROUNDS = 200
"""Largest number of steps to an image at its own line's time; each divides the error by 2 at least."""


def camera_of(entry: CameraEntry, source: str) -> Camera:
    """A camera that images points as the entry says. `source` names it in the InputError for an impossible one."""
    (fx, skew, u), (_, fy, v), _ = entry.K
    shared = entry.model_dump(
        include={"width_px", "height_px", "pixel_pitch_um", "projection", "distortion", "shutter"}
    )
    # A lens focused at infinity has its image distance as focal length, and a projection uses nothing else.
    lens = {"focal_length_mm": entry.image_distance_mm, "principal_point_px": (u, v), "skew_px": skew}
    lens |= {"aspect_ratio": fx / fy if fy > 0 else 1.0}
    camera = check({**shared, **lens}, Camera, source)
    if not np.allclose(camera.matrix, entry.K, rtol=1e-12, atol=0):
        raise InputError(
            f"{source}: K is not [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with the mean of fx and fy "
            "image_distance_mm / pitch"
        )
    return camera


def is_told(row: TruthRow, entry: CameraEntry) -> bool:
    """Whether a frame's true camera is the told one."""
    return (row.K, row.distortion) == (flat9(np.array(entry.K)), five(entry.distortion))


def true_camera_of(entry: CameraEntry, row: TruthRow) -> Camera:
    """The true camera of a frame. Raises InputError for an impossible one."""
    fx, _, _, _, fy, *_ = row.K
    changes: dict[str, object] = {
        "K": (row.K[:3], row.K[3:6], row.K[6:]),
        "image_distance_mm": (fx + fy) / 2 * entry.pixel_pitch_um / 1000,
        "distortion": None,
    }
    if row.distortion is not None:
        k1, k2, k3, p1, p2 = row.distortion
        changes["distortion"] = Distortion.model_construct(k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)
    return camera_of(entry.model_copy(update=changes), f"truth.parquet: frame {row.frame}")


def sealed_problems(
    devices: Sequence[DeviceTruthRow] | None, built: Sequence[MapTruthRow], dataset: DatasetFile
) -> list[str]:
    """Rows of the sealed tables that are missing, repeated or out of order. A table without rows has a line already."""
    belief = (dataset.provenance.get("recipe") or {}).get("belief") or {"devices": 0, "maps": 1}
    problems = []
    expected = [(device, camera) for device in range(belief["devices"]) for camera in dataset.cameras]
    if devices and [(row.device, row.camera) for row in devices] != expected:
        problems.append("truth_devices.parquet: has not one row for each device and camera, in order")
    ids = sorted(led for transmitter in _transmitters_of(dataset) for led in transmitter.led_ids)
    leds = [(number, led) for number in range(belief["maps"]) for led in ids]
    if built and [(row.map, row.led) for row in built] != leds:
        problems.append("truth_map.parquet: has not one row for each map and LED, in order")
    return problems


def device_problems(
    frame: FrameRow,
    truth: TruthRow,
    entry: CameraEntry,
    dataset: DatasetFile,
    devices: Sequence[DeviceTruthRow] | None,
) -> list[str]:
    """Contradictions between a frame's device, map and camera and the told camera or, with [belief], `devices`."""
    where = f"truth.parquet: frame {frame.frame}"
    if devices is None:
        if (frame.device, truth.map) != (0, 0):
            return [f"{where}: device {frame.device} and map {truth.map}: both are 0 without [belief]"]
        if not is_told(truth, entry):
            return [f"{where}: K or distortion differs from dataset.json's, but there is no [belief]"]
        return []
    if not devices:
        return []
    own = [row for row in devices if (row.device, row.camera) == (frame.device, frame.camera)]
    if not own:
        return [f"{where}: device {frame.device} with camera {frame.camera!r} is not in truth_devices.parquet"]
    if truth.map != own[0].map:
        return [f"{where}: map {truth.map}: device {frame.device} works in map {own[0].map}"]
    shot = dataset.provenance["recipe"]["belief"]["shot"]
    same = (truth.K, truth.distortion) == (own[0].K, own[0].distortion)
    if not same and not (shot["focal_percent"] or shot["principal_point_um"]):
        return [f"{where}: K or distortion differs from its device's, but shots have no errors of their own"]
    return []


def waves_of(dataset: DatasetFile, map_number: int) -> dict[int, Wave]:
    """The waves of a map's LEDs, from the scene and the seed; none where the provenance states no recipe."""
    transmitters, recipe = _transmitters_of(dataset), dataset.provenance.get("recipe")
    return led_waves(transmitters, int(recipe["seed"]), map_number) if transmitters and recipe else {}


def _transmitters_of(dataset: DatasetFile) -> tuple[Transmitter, ...]:
    """What LEDs transmit by the scene of the provenance; nothing where there is none."""
    scene = dataset.provenance.get("scene")
    return () if scene is None else transmitters_of(check(scene, SceneSettings, "dataset.json: provenance.scene"))


def wave_problems(row: TruthRow, start_s: float, waves: Mapping[int, Wave]) -> list[str]:
    """LEDs whose clock error, bits or phase at the start of the frame are not those of their wave."""
    problems = []
    for led in row.leds:
        where = f"truth.parquet: frame {row.frame}: LED {led.led}"
        wave = waves.get(led.led)
        if wave is None:
            if (led.clock_error, led.phase, led.bits) != (None, None, None):
                problems.append(f"{where}: is steady, but clock_error, phase and bits are not null")
        elif led.clock_error is None or led.phase is None:
            problems.append(f"{where}: is modulated, but clock_error or phase is null")
        else:
            off = abs(led.phase - float(wave.phase(start_s)))
            if not min(off, 1 - off) <= MAX_PHASE_ERROR or (led.clock_error, led.bits) != (wave.clock_error, wave.bits):
                problems.append(f"{where}: clock_error, phase or bits are not those of its wave")
    return problems


def offset_in_camera(frame: FrameRow, entry: CameraEntry, devices: Sequence[DeviceTruthRow] | None) -> Array:
    """From the projection centre of `main` to that of a frame's camera, (3,), in the camera's axes."""
    rotation, offset_m = np.array(entry.R_cam_rig), np.array(entry.offset_m)
    for row in devices or ():
        if (row.device, row.camera) == (frame.device, frame.camera):
            rotation, offset_m = np.array(row.R_cam_rig).reshape(3, 3), np.array(row.offset_m)
    return transform(rotation, offset_m)


def _image_at_own_line(row: TruthRow, camera: Camera, offset_m: Array, point_m: Array) -> Array:
    """Pixel (2,) of a world point at the time of its own line; `offset_m` of `_offset_in_camera`.

    The camera `main` moves along a line, and the rig turns about it.
    """
    rotation, position_m = np.array(row.R_cam_world).reshape(3, 3), np.array(row.position_m)
    turning, moving = (np.array(v or (0.0, 0.0, 0.0)) for v in (row.angular_velocity_rad_s, row.linear_velocity_m_s))
    of_main = moving - transform(rotation.T, np.cross(turning, offset_m))

    def image(time_s: float) -> Array:
        turned = transform(Rotation.from_rotvec(-turning * time_s).as_matrix(), rotation.T).T
        swing = transform(turned.T, offset_m) - transform(rotation.T, offset_m)
        return camera.image_of_points(transform(turned, point_m - (position_m + of_main * time_s + swing)))

    pixel = image(0.0)
    if row.angular_velocity_rad_s is not None:
        for _ in range(LINE_ROUNDS):
            before, pixel = pixel, image(float(camera.times_s(*pixel)))
            if not np.abs(pixel - before).max() > 1e-9:
                break
    return pixel


def truth_problems(row: TruthRow, camera: Camera | None, maps: Mapping[int, Positions], offset_m: Array) -> list[str]:
    """What contradicts itself in a row of the truth; `camera` is the true one, `offset_m` of `offset_in_camera`."""
    where = f"truth.parquet: frame {row.frame}"
    if (problem := truth_problem(row)) is not None:
        return [problem]
    rotation = np.array(row.R_cam_world).reshape(3, 3)
    turned = rotation_cam_world(row.tilt_x_deg, row.tilt_y_deg, row.yaw_deg)
    if not np.abs(turned - rotation).max() <= MAX_ROTATION_ERROR:
        return [f"{where}: R_cam_world is not that of tilt_x_deg, tilt_y_deg and yaw_deg"]
    if camera is None or row.map not in maps:
        return []
    positions = maps[row.map]
    for led in row.leds:
        if led.led not in positions:
            return [f"{where}: LED {led.led} is not in the LED map"]
        u, v = _image_at_own_line(row, camera, offset_m, positions[led.led])
        # Not `>`: a point that the lens does not image has NaN pixels, which compare false.
        if not np.hypot(u - led.u_px, v - led.v_px) <= 1e-6:
            return [f"{where}: LED {led.led} is not where the pose puts it"]
    return []
