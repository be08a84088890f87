"""The truth of a recipe with [belief]: cameras, LEDs, accelerometers and sensors, drawn about what devices are told.

Each error is a standard normal number times its standard deviation. Each number has a key of its own, (seed, "device",
device, name), (seed, "shot", frame, name) or (seed, "map", map, name, id): a change of one standard deviation moves
nothing else.
Without [belief] told and true are the same, and no number is drawn.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vlcrender.camera.distortion import Distortion
from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.rig import MAIN, Mounted
from vlcrender.config.toml_model import check
from vlcrender.core.face_profile import lowest_share
from vlcrender.core.random_keys import key_number, stream
from vlcrender.dataset.format.rows import DeviceTruthRow, MapTruthRow, five, flat9
from vlcrender.dataset.recipe.belief import CAMERA_PARAMETERS, Sigmas
from vlcrender.dataset.recipe.recipe import Recipe
from vlcrender.errors import InputError
from vlcrender.scene.as_built import BuildingErrors, as_built, luminaires_of
from vlcrender.scene.leds import Leds
from vlcrender.scene.loader import Scene
from vlcrender.sensor.accelerometer import Imu, TiltError
from vlcrender.sensor.gyroscope import Gyroscope
from vlcrender.sensor.sensor import Sensor

Array = NDArray[np.float64]

SERIAL_BITS = 64
"""A serial number is the upper 63 bits of a hash: the most that a recipe allows."""


def device_of_pose(recipe: Recipe, pose_number: int) -> int:
    """The device that takes a pose; 0 without [belief]."""
    return 0 if recipe.belief is None else recipe.belief.device_of_pose(pose_number)


def map_of_device(recipe: Recipe, device: int) -> int:
    """The map that a device works in; 0 without [belief]."""
    return 0 if recipe.belief is None else recipe.belief.map_of_device(device)


def shots_differ(recipe: Recipe) -> bool:
    """Whether a camera's errors are new in each frame, so that frames of one pose differ in more than noise."""
    sigmas = _true_sigmas(recipe)
    return sigmas is not None and any(of_camera.shot.any() for of_camera in sigmas.cameras.values())


def true_camera(recipe: Recipe, which: int, device: int, frame: int | None = None) -> Mounted:
    """Camera number `which` of a device as it is: in a frame, or without the errors of a shot where None.

    Raises InputError where the errors make an impossible camera, such as one whose distortion folds the image.
    """
    told, sigmas = recipe.cameras[which], _true_sigmas(recipe)
    if sigmas is None:
        return told
    of_camera = sigmas.cameras[told.name]
    errors = of_camera.device * _normals(recipe, "device", device, told.name, CAMERA_PARAMETERS)
    if frame is not None:
        errors += of_camera.shot * _normals(recipe, "shot", frame, told.name, CAMERA_PARAMETERS)
    camera = _with_errors(told.camera, errors, f"[belief]: camera {told.name!r} of device {device}")
    if told.name == MAIN:
        return replace(told, camera=camera)
    axes = "xyz"
    moved = of_camera.offset_m * _normals(recipe, "device", device, told.name, [f"offset {a}" for a in axes])
    turned = of_camera.rotation_deg * _normals(recipe, "device", device, told.name, [f"rotation {a}" for a in axes])
    rotation = Rotation.from_rotvec(turned, degrees=True).as_matrix()
    # not `@`: the last bits of a matrix product may depend on threads and processor
    product = (rotation[:, :, None] * told.rotation[None, :, :]).sum(axis=1)
    return replace(told, camera=camera, rotation=product, offset_m=told.offset_m + moved)


def _with_errors(camera: Camera, errors: Array, source: str) -> Camera:
    """A camera with errors in the order of CAMERA_PARAMETERS. Raises InputError that starts with `source`."""
    if not errors.any():
        return camera
    focal, aspect, u, v, k1, p1, p2 = errors.tolist()
    center_u, center_v = camera.center_px
    told = camera.distortion or Distortion()
    distortion = Distortion(k1=told.k1 + k1, k2=told.k2, k3=told.k3, p1=told.p1 + p1, p2=told.p2 + p2)
    image_distance_mm = camera.image_distance_mm * (1 + focal) * _mean_factor(camera.aspect_ratio, aspect)
    focal_length_mm = image_distance_mm
    if isinstance(camera.focus_distance_m, float):  # 1/f = 1/s + 1/f_i
        focus_mm = camera.focus_distance_m * 1000
        focal_length_mm = image_distance_mm * focus_mm / (image_distance_mm + focus_mm)
    changes = {
        "focal_length_mm": focal_length_mm,
        "aspect_ratio": camera.aspect_ratio * (1 + aspect / 2) / (1 - aspect / 2),
        "principal_point_px": (center_u + u, center_v + v),
        "distortion": distortion.model_dump() if distortion != Distortion() else None,
    }
    return check({**camera.model_dump(mode="json"), **changes}, Camera, source)


def _mean_factor(ratio: float, aspect: float) -> float:
    """Change of the mean of fx = f 2a / (1 + a) and fy = f 2 / (1 + a) by the factors 1 +- aspect / 2, a = `ratio`."""
    return (ratio * (1 + aspect / 2) + (1 - aspect / 2)) / (ratio + 1)


def built_leds(recipe: Recipe, scene: Scene, map_number: int) -> Leds:
    """The LEDs of a map as built; the scene's without [belief].

    Raises InputError where an LED's gradient is steeper than its luminance allows.
    """
    sigmas, leds = _true_sigmas(recipe), scene.leds
    if sigmas is None:
        return leds
    luminaires = luminaires_of(scene.settings, leds)

    def normals(name: str, identity: int, count: int) -> Array:
        return stream(recipe.seed, "map", map_number, name, identity).standard_normal(count)

    def of_luminaires(name: str) -> Array:
        return np.stack([normals(f"luminaire {name}", number, 3) for number in range(len(luminaires))])

    def of_leds(name: str, count: int) -> Array:
        return np.stack([normals(f"led {name}", int(led), count) for led in leds.ids])

    errors = BuildingErrors(
        luminaire_m=sigmas.luminaire_m * of_luminaires("position"),
        luminaire_rotation_deg=sigmas.luminaire_rotation_deg * of_luminaires("rotation"),
        led_m=sigmas.led_m * of_leds("position", 3),
        led_size=sigmas.led_size * of_leds("size", 1)[:, 0],
        led_gradient=sigmas.led_gradient * of_leds("gradient", 2),
        datum_m=sigmas.datum_m * normals("datum position", 0, 3),
        datum_scale=sigmas.datum_scale_ppm * 1e-6 * float(normals("datum scale", 0, 1)[0]),
    )
    built = as_built(leds, luminaires, errors)
    for i, (gx, gy) in enumerate(built.face_gradients.tolist()):
        if lowest_share((gx, gy), float(built.face_falloffs[i]), bool(built.squares[i])) < 0:
            raise InputError(
                f"[belief.leds]: LED {built.ids[i]} of map {map_number} has the gradient [{gx:.3g}, {gy:.3g}], which "
                "makes its rim darker than 0; lower belief.leds.gradient_percent"
            )
    return built


def tilt_errors_deg(recipe: Recipe, device: int) -> tuple[float, float]:
    """Constant errors of a device's accelerometer on tilt_x and tilt_y, degrees; 0 without [belief] and for an IMU."""
    sigmas = _true_sigmas(recipe)
    if sigmas is None or isinstance(recipe.accelerometer, Imu):
        return 0.0, 0.0
    x, y = sigmas.accelerometer_device_deg * stream(recipe.seed, "device", device, "tilt error").standard_normal(2)
    return float(x), float(y)


def reading_m_s2(recipe: Recipe, device: int, shot: int, main: Pose) -> Array:
    """Reading of a device's accelerometer in a shot, (3,), axes of the camera `main` at the pose `main`."""
    generator = stream(recipe.seed, shot, "accelerometer")
    accelerometer, sigmas = recipe.accelerometer, _true_sigmas(recipe)
    if sigmas is None:
        return accelerometer.reading_m_s2(main, generator)
    if isinstance(accelerometer, Imu):
        serial = _serial(recipe, device, "imu")
        return accelerometer.model_copy(update={"serial": serial}).reading_m_s2(main, generator)
    error_x, error_y = tilt_errors_deg(recipe, device)
    read = replace(main, tilt_x_deg=main.tilt_x_deg + error_x, tilt_y_deg=main.tilt_y_deg + error_y)
    return TiltError(error_deg=sigmas.accelerometer_shot_deg).reading_m_s2(read, generator)


def gyro_rad_s(recipe: Recipe, gyroscope: Gyroscope, device: int, shot: int) -> Array:
    """Reading of a device's gyroscope in a shot, (3,), rad/s, axes of the camera `main`."""
    velocity = np.zeros(3) if recipe.motion is None else recipe.motion.angular_velocity_rad_s
    bias = stream(recipe.seed, "device", device, "gyroscope bias")
    return gyroscope.reading_rad_s(velocity, bias, stream(recipe.seed, shot, "gyroscope"))


def tilt_sigmas_deg(recipe: Recipe, main: Pose) -> tuple[float, float]:
    """True standard deviations of a frame's accelerometer on tilt_x and tilt_y in a pose, degrees."""
    accelerometer, sigmas = recipe.accelerometer, _true_sigmas(recipe)
    if sigmas is None or isinstance(accelerometer, Imu):
        return accelerometer.tilt_errors_deg(main)
    both = float(np.hypot(sigmas.accelerometer_device_deg, sigmas.accelerometer_shot_deg))
    return both, both


def device_sensor(recipe: Recipe, device: int) -> Sensor:
    """The sensor of a device: with [belief] its fixed patterns are its own."""
    if recipe.belief is None:
        return recipe.sensor
    return recipe.sensor.model_copy(update={"serial": _serial(recipe, device, "sensor")})


def device_rows(recipe: Recipe) -> list[DeviceTruthRow]:
    """The rows of truth_devices.parquet."""
    assert recipe.belief is not None
    rows = []
    for device in range(recipe.belief.devices):
        tilts = None if isinstance(recipe.accelerometer, Imu) else tilt_errors_deg(recipe, device)
        for which in range(len(recipe.cameras)):
            mounted = true_camera(recipe, which, device)
            x, y, z = mounted.offset_m.tolist()
            rows.append(
                DeviceTruthRow(
                    device=device,
                    map=map_of_device(recipe, device),
                    camera=mounted.name,
                    K=flat9(mounted.camera.matrix),
                    distortion=five(mounted.camera.distortion),
                    R_cam_rig=flat9(mounted.rotation),
                    offset_m=(x, y, z),
                    tilt_error_deg=tilts,
                )
            )
    return rows


def map_rows(recipe: Recipe, scene: Scene) -> list[MapTruthRow]:
    """The rows of truth_map.parquet."""
    rows = []
    for map_number in range(1 if recipe.belief is None else recipe.belief.maps):
        leds = built_leds(recipe, scene, map_number)
        sizes = leds.half_widths_m * np.where(leds.squares, 2.0, 1.0)
        for i, (x, y, z) in enumerate(leds.centers_m.tolist()):
            gx, gy = leds.face_gradients[i].tolist()
            rows.append(
                MapTruthRow(
                    map=map_number,
                    led=int(leds.ids[i]),
                    position_m=(x, y, z),
                    size_m=float(sizes[i]),
                    gradient=(gx, gy),
                )
            )
    return rows


def _true_sigmas(recipe: Recipe) -> Sigmas | None:
    return None if recipe.belief is None else recipe.belief.true_sigmas(recipe.cameras, recipe.accelerometer)


def _normals(recipe: Recipe, owner: str, number: int, camera: str, names: "tuple[str, ...] | list[str]") -> Array:
    """A standard normal number for each name of a camera's errors, of one device or frame, (n,)."""
    return np.array([stream(recipe.seed, owner, number, f"{camera} {name}").standard_normal() for name in names])


def _serial(recipe: Recipe, device: int, part: str) -> int:
    return key_number(SERIAL_BITS, recipe.seed, "device", device, f"{part} serial") >> 1
