"""A ROS 2 bag (sqlite3): images, camera_info and imu of each camera, the mounting in /tf_static, true poses.

Source: ROS 2 sensor_msgs (CameraInfo: pixel centres at integers; Image encodings), REP 103 (optical frames: x right, y
down, z forward), REP 145 (IMU: specific force; -1 marks what is not measured). Written by the library `rosbags`.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vlcrender.errors import InputError
from vlcrender.export.conventions import quaternion_xyzw
from vlcrender.export.source import Source
from vlcrender.export.tum import TIMES

FIRST_STAMP_S = 1
"""Added to times: ROS takes the stamp 0 for "latest"."""
WORLD = "world"
NOT_MEASURED = -1.0


def write(source: Source, out: Path) -> Mapping[str, Any]:
    """Write bag/. Raises InputError where `rosbags` is not installed, or ROS cannot express a camera."""
    try:
        from rosbags.rosbag2 import Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError('rosbag2: needs the library rosbags: pip install "vlcrender[export]"') from None
    store = get_typestore(Stores.ROS2_HUMBLE)
    messages = _Messages(source, store.types)
    infos = {name: messages.camera_info(name) for name in source.dataset.cameras}  # refuses before a bag is made
    truths = list(source.truth) if source.has_truth else [None] * len(source.frames)
    with Writer(out / "bag", version=8) as bag:
        connections: dict[str, Any] = {}

        def put(topic: str, stamp_ns: int, message: Any, **options: Any) -> None:
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, name, typestore=store, **options)
            bag.write(connections[topic], stamp_ns, store.serialize_cdr(message, name))

        rows = sorted(zip(source.frames, truths, strict=True), key=lambda pair: source.time_s(pair[0]))
        first_ns = _stamp_ns(source.time_s(rows[0][0])) if rows else 0
        put("/tf_static", first_ns, messages.tf_static(first_ns), offered_qos_profiles=[_latched()])
        for row, truth in rows:
            stamp_ns = _stamp_ns(source.time_s(row))
            put(f"/{row.camera}/image_raw", stamp_ns, messages.image(row, stamp_ns))
            put(f"/{row.camera}/camera_info", stamp_ns, infos[row.camera](stamp_ns))
            if row.accelerometer_m_s2 is not None:
                put(f"/{row.camera}/imu", stamp_ns, messages.imu(row, stamp_ns))
            if truth is not None:
                put(f"/{row.camera}/true_pose", stamp_ns, messages.pose(truth, stamp_ns))
    return {
        "bag": "bag",
        "time": TIMES[source.has_clock],
        "first_stamp_s": FIRST_STAMP_S,
        "truth": source.has_truth,
        "pixel_centres": "integer",
        "pixels_not_read": 0,
    }


def _stamp_ns(time_s: float) -> int:
    return round((time_s + FIRST_STAMP_S) * 1e9)


def _latched() -> Any:
    """Quality of service of /tf_static: late subscribers get the last message."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    forever = QosTime(9223372036, 854775807)
    return Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL,
        forever,
        forever,
        QosLiveliness.AUTOMATIC,
        forever,
        False,
    )


class _Messages:
    """ROS messages of a dataset; stamps in nanoseconds."""

    def __init__(self, source: Source, types: Mapping[str, Any]) -> None:
        self._source = source
        self._types = types

    def _new(self, name: str, *fields: Any) -> Any:
        package, message = name.split("/")
        return self._types[f"{package}/msg/{message}"](*fields)

    def _header(self, stamp_ns: int, frame: str) -> Any:
        seconds, rest = divmod(stamp_ns, 10**9)
        return self._new("std_msgs/Header", self._new("builtin_interfaces/Time", seconds, rest), frame)

    def _quaternion(self, rotation: np.ndarray[Any, np.dtype[np.float64]]) -> Any:
        return self._new("geometry_msgs/Quaternion", *quaternion_xyzw(rotation))

    def camera_info(self, name: str) -> Callable[[int], Any]:
        """Camera as its device is told, for any stamp. Raises InputError for skew and for 90 deg off the axis."""
        to = self._source.to
        camera = self._source.told_camera(name).without_skew(to).within_half_space(to).with_integer_centres()
        k1, k2, k3, p1, p2 = camera.brown
        model = "equidistant" if camera.is_fisheye else "plumb_bob"
        coefficients = np.zeros(4) if camera.is_fisheye else np.array([k1, k2, p1, p2, k3])
        matrix = np.array(camera.matrix)
        region = self._new("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
        projection = np.hstack([matrix, np.zeros((3, 1))]).ravel()
        size = camera.height_px, camera.width_px
        rest = (model, coefficients, matrix.ravel(), np.eye(3).ravel(), projection, 0, 0, region)
        return lambda stamp_ns: self._new("sensor_msgs/CameraInfo", self._header(stamp_ns, _frame(name)), *size, *rest)

    def image(self, row: Any, stamp_ns: int) -> Any:
        """Digital numbers, unscaled; a mosaic by its name."""
        pixels, _ = self._source.image_16bit(row)
        mosaic = self._source.dataset.sensor.mosaic
        encoding = "mono16" if mosaic == "none" else f"bayer_{mosaic}16"
        height, width = pixels.shape
        data = np.frombuffer(pixels.astype("<u2").tobytes(), np.uint8)
        header = self._header(stamp_ns, _frame(row.camera))
        return self._new("sensor_msgs/Image", header, height, width, encoding, 0, 2 * width, data)

    def imu(self, row: Any, stamp_ns: int) -> Any:
        """The accelerometer's reading, and the gyroscope's where there is one, in the axes of the frame's camera."""
        vector = "geometry_msgs/Vector3"
        unknown = np.zeros(9)
        absent = np.array([NOT_MEASURED, *unknown[1:]])
        rates = row.gyro_rad_s or (0.0, 0.0, 0.0)
        return self._new(
            "sensor_msgs/Imu",
            self._header(stamp_ns, _frame(row.camera)),
            self._new("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0),
            absent,
            self._new(vector, *rates),
            absent if row.gyro_rad_s is None else unknown,
            self._new(vector, *row.accelerometer_m_s2),
            unknown,
        )

    def pose(self, truth: Any, stamp_ns: int) -> Any:
        """True pose of a frame's camera in the world."""
        point = self._new("geometry_msgs/Point", *truth.position_m)
        turned = self._quaternion(np.reshape(truth.R_cam_world, (3, 3)).T)
        pose = self._new("geometry_msgs/Pose", point, turned)
        return self._new("geometry_msgs/PoseStamped", self._header(stamp_ns, WORLD), pose)

    def tf_static(self, stamp_ns: int) -> Any:
        """Mounting of the cameras beside the first, as told: axes and origin of the rig are those of the first."""
        first, *others = self._source.dataset.cameras.items()
        transforms = [
            self._new(
                "geometry_msgs/TransformStamped",
                self._header(stamp_ns, _frame(first[0])),
                _frame(name),
                self._new(
                    "geometry_msgs/Transform",
                    self._new("geometry_msgs/Vector3", *entry.offset_m),
                    self._quaternion(np.array(entry.R_cam_rig).T),
                ),
            )
            for name, entry in others
        ]
        return self._new("tf2_msgs/TFMessage", transforms)


def _frame(camera: str) -> str:
    return f"{camera}_optical_frame"
