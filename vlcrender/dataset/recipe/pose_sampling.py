"""Poses of the frames: ones that see LEDs at random tilts or at those of a grid, listed ones, or a grid of places."""

from functools import lru_cache
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from vlcrender.camera.intrinsics import Camera, Pose
from vlcrender.camera.posed_camera import PosedCamera
from vlcrender.config.toml_model import Settings
from vlcrender.core.random_keys import stream
from vlcrender.errors import InputError
from vlcrender.scene.loader import Scene
from vlcrender.scene.visibility import can_occlude_leds, leds_in_view

Tilt = Annotated[float, Field(ge=-85, le=85)]
Steps = Annotated[int, Field(ge=1, le=10_000)]
MIN_RISE = 0.01
"""Smallest sine of a ray's elevation towards its target."""
TRIES = 10_000
"""Random positions and yaws tried for the tilts of one frame before the recipe is refused."""


class Aim(Settings):
    """Where a camera of given tilts may be so that it sees LEDs."""

    kind: Literal["aimed", "tilt-grid"]
    """How the poses are given."""
    tilt_x_deg: tuple[Tilt, Tilt] | tuple[Tilt, Tilt, Steps]
    """Tilts about the camera's x axis."""
    tilt_y_deg: tuple[Tilt, Tilt] | tuple[Tilt, Tilt, Steps]
    """Tilts about the camera's y axis."""
    height_m: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]]
    """Range of the projection centre's height over the floor, metres: [lowest, highest]."""
    min_leds: Annotated[int, Field(ge=1, le=1000)] = 4
    """Smallest number of LEDs whole in the image. An LED that something hides in part does not count."""
    wall_distance_m: Annotated[float, Field(gt=0, le=100)] = 0.2
    """Smallest distance of the camera from the walls, metres."""
    border_px: Annotated[float, Field(ge=0, le=10000)] = 20.0
    """LEDs nearer than this to the image's border do not count, pixels."""

    @model_validator(mode="after")
    def _ranges_go_up(self) -> Self:
        for name in ("tilt_x_deg", "tilt_y_deg", "height_m"):
            low, high, *count = getattr(self, name)
            if low > high:
                raise ValueError(f"{name} = {[low, high, *count]}: the lower value comes first")
        return self


class AimedPoses(Aim):
    """Random poses that see LEDs. Tilts are stratified over their ranges, so that few frames already span them.

    For each pose a target LED, a height, a yaw and a place in the image are drawn. The camera is placed where it images
    the target there. The pose is kept if the camera is inside the room and enough LEDs are whole in the image, hidden
    in no part by furniture or panels.
    """

    kind: Literal["aimed"]
    """How the poses are given."""
    count: Annotated[int, Field(ge=1, le=10_000_000)]
    """Number of poses."""
    tilt_x_deg: tuple[Tilt, Tilt]
    """Range of tilt_x, degrees: [lowest, highest]."""
    tilt_y_deg: tuple[Tilt, Tilt]
    """Range of tilt_y, degrees: [lowest, highest]."""


class TiltGridPoses(Aim):
    """Poses that see LEDs at each tilt of a grid: those of one tilt one after another, tilt_y faster than tilt_x.

    Target, height, yaw and place in the image are drawn as for `aimed`.
    """

    kind: Literal["tilt-grid"]
    """How the poses are given."""
    tilt_x_deg: tuple[Tilt, Tilt, Steps]
    """Values of tilt_x, degrees: [lowest, highest, count], equally spaced, both included."""
    tilt_y_deg: tuple[Tilt, Tilt, Steps]
    """Values of tilt_y, degrees: [lowest, highest, count], equally spaced, both included."""
    per_cell: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    """Number of poses at each pair of tilts."""

    @model_validator(mode="after")
    def _one_value_is_lowest_and_highest(self) -> Self:
        for name in ("tilt_x_deg", "tilt_y_deg"):
            low, high, count = getattr(self, name)
            if count == 1 and low != high:
                raise ValueError(f"{name} = [{low}, {high}, 1]: a single value is lowest and highest; give it twice")
        return self

    @property
    def count(self) -> int:
        """Number of poses."""
        return self.tilt_x_deg[2] * self.tilt_y_deg[2] * self.per_cell

    def tilts_deg(self, number: int) -> tuple[float, float]:
        """tilt_x and tilt_y of the pose of a number, degrees."""
        places = divmod(number // self.per_cell, self.tilt_y_deg[2])
        x, y = (
            float(np.linspace(*values)[place])
            for values, place in zip((self.tilt_x_deg, self.tilt_y_deg), places, strict=True)
        )
        return x, y


class PoseEntry(Settings):
    """One pose of a list."""

    position_m: tuple[float, float, float]
    """Projection centre, world, metres."""
    tilt_x_deg: Tilt = 0.0
    """Tilt about the camera's x axis, degrees."""
    tilt_y_deg: Tilt = 0.0
    """Tilt about the camera's y axis, degrees."""
    yaw_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    """Rotation about the vertical, degrees."""
    time_s: Annotated[float, Field(ge=-1e12, le=1e12)] | None = None
    """Time stamp, s, on any clock: it stands with each frame of the pose, and no light depends on it."""


class ListedPoses(Settings):
    """Poses in the order of a list."""

    kind: Literal["list"]
    """How the poses are given."""
    pose: Annotated[tuple[PoseEntry, ...], Field(min_length=1)]
    """The poses, in order."""

    @property
    def count(self) -> int:
        """Number of poses."""
        return len(self.pose)


class GridPoses(Settings):
    """Level poses at one height, at the centres of `columns` x `rows` equal cells of the floor.

    Table 1 of Huynh & Yoo 2016 has 350 x 350 at 0 m. A camera must be inside the room: use a small height.
    """

    kind: Literal["grid"]
    """How the poses are given."""
    columns: Annotated[int, Field(ge=1, le=10_000)]
    """Number of poses along x."""
    rows: Annotated[int, Field(ge=1, le=10_000)]
    """Number of poses along y."""
    height_m: Annotated[float, Field(gt=0)]
    """Height of the projection centre over the floor, metres."""
    yaw_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    """Rotation about the vertical, degrees; the same in every pose."""

    @property
    def count(self) -> int:
        """Number of poses."""
        return self.columns * self.rows


AnyPoses = AimedPoses | TiltGridPoses | ListedPoses | GridPoses
Poses = Annotated[AnyPoses, Field(discriminator="kind")]


def pose_of_frame(poses: AnyPoses, frame: int, seed: int, camera: Camera, scene: Scene) -> Pose:
    """The pose with this number; depends on nothing but the arguments. Raises InputError where no pose qualifies."""
    if isinstance(poses, GridPoses):
        row, column = divmod(frame, poses.columns)  # x varies fastest
        x_m, y_m, _ = scene.room_m
        place = (float((column + 0.5) * x_m / poses.columns), float((row + 0.5) * y_m / poses.rows), poses.height_m)
        return Pose(place, yaw_deg=poses.yaw_deg)
    if isinstance(poses, ListedPoses):
        entry = poses.pose[frame]
        return Pose(entry.position_m, entry.tilt_x_deg, entry.tilt_y_deg, entry.yaw_deg)
    tilts = poses.tilts_deg(frame) if isinstance(poses, TiltGridPoses) else _stratified_tilts_deg(poses, frame, seed)
    return _aimed_pose(poses, tilts, frame, seed, camera, scene)


def places_m(poses: AnyPoses, scene: Scene) -> NDArray[np.float64] | None:
    """Places of all poses of a list or a grid, (count, 3); None where a place takes a search."""
    if isinstance(poses, ListedPoses):
        return np.array([entry.position_m for entry in poses.pose])
    if isinstance(poses, GridPoses):
        x_m, y_m, _ = scene.room_m
        x = (np.arange(poses.columns) + 0.5) * x_m / poses.columns
        y = (np.arange(poses.rows) + 0.5) * y_m / poses.rows
        height = np.full(poses.count, poses.height_m)
        return np.column_stack((np.tile(x, poses.rows), np.repeat(y, poses.columns), height))
    return None


def _stratified_tilts_deg(poses: AimedPoses, frame: int, seed: int) -> tuple[float, float]:
    tilts = []
    for axis, (low, high) in (("x", poses.tilt_x_deg), ("y", poses.tilt_y_deg)):
        within = stream(seed, frame, f"tilt-{axis}").uniform()
        tilts.append(low + (high - low) * (_strata(seed, axis, poses.count)[frame] + within) / poses.count)
    tilt_x, tilt_y = map(float, tilts)
    return tilt_x, tilt_y


def _aimed_pose(
    poses: Aim, tilts_deg: tuple[float, float], frame: int, seed: int, camera: Camera, scene: Scene
) -> Pose:
    tilt_x, tilt_y = tilts_deg
    generator = stream(seed, frame, "aim")
    low_corner = np.array([poses.wall_distance_m, poses.wall_distance_m, 0.0])
    high_corner = scene.room_m - [poses.wall_distance_m, poses.wall_distance_m, 0.0]
    image_px = np.array([camera.width_px, camera.height_px], dtype=np.float64)
    border_px = np.minimum(poses.border_px, image_px / 2)
    most = None  # LEDs that any pose inside the room saw
    for _ in range(TRIES):
        target = scene.leds.centers_m[generator.integers(len(scene.leds))]
        yaw = float(generator.uniform(-180, 180))
        height = float(generator.uniform(*poses.height_m))
        place_px = generator.uniform(border_px, image_px - border_px)
        towards = PosedCamera(camera, Pose((0.0, 0.0, 0.0), tilt_x, tilt_y, yaw)).rays_world(place_px)
        towards = towards / np.linalg.norm(towards)
        if not towards[2] > MIN_RISE or height >= target[2]:  # also where the lens images nothing at this place: NaN
            continue
        position = target - towards * (target[2] - height) / towards[2]
        position[2] = height
        if (position <= low_corner).any() or (position >= high_corner).any():
            continue
        pose = Pose((float(position[0]), float(position[1]), height), tilt_x, tilt_y, yaw)
        count = _leds_seen(PosedCamera(camera, pose), scene, poses)
        if count >= poses.min_leds:
            return pose
        most = max(count, most or 0)
    seen = "none is inside the room" if most is None else f"the most that any pose sees is {most}"
    raise InputError(
        f"poses: frame {frame}: no position in {TRIES} tries sees {poses.min_leds} LEDs whole at tilts "
        f"({tilt_x:.1f}, {tilt_y:.1f}) deg: {seen}; lower min_leds or the tilts, or raise height_m"
    )


@lru_cache(maxsize=4)
def _strata(seed: int, axis: str, count: int) -> NDArray[np.int64]:
    """Stratum of each pose's tilt about an axis, (count,): a Latin hypercube, each axis shuffled against the other.

    Kept, since a permutation takes a time in proportion to `count`, and all poses of a set share it.
    """
    return stream(seed, 0, f"tilt-{axis}-strata").permutation(count)


def _leds_seen(posed: PosedCamera, scene: Scene, poses: Aim) -> int:
    """Number of LEDs whole in the image; of those that nothing hides, where the others are enough."""
    found = leds_in_view(posed, scene, poses.border_px)
    if len(found) < poses.min_leds or not can_occlude_leds(scene):
        return len(found)
    from vlcrender.light.line_of_sight import lines_of_sight  # loads Mitsuba

    return len(lines_of_sight(scene).not_hidden(posed, found))
