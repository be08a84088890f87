"""Panels: which LED images are of one panel, and the ways to lay them over it.

Gravity levels the image: LEDs of a panel are then seen as they stand, but for a rotation, a shift and a scale. The
known size of an LED gives the scale. Images that are neighbours in a panel are of one group; the images of a burst's
frames are matched by their places.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.camera.leveling import MIN_ELEVATION_SINE, tilt_from_gravity
from estimator.camera.pose import rotation
from estimator.camera.undistort import has_pinhole_image, pinhole_image
from estimator.io.device import DeviceFrame
from estimator.io.downlink import DiscFace, Packets
from estimator.receiver.signal import Floats, Ints, LedImage

LINK = 1.6
"""LED images nearer than this many times the distance of neighbouring LEDs are of one panel: more than the diagonal."""
MATCH = 0.45
"""An image of another frame is the same LED within this share of the distance of neighbouring LEDs."""
PLACE = 0.3
"""An image is at an LED's place in the panel within this share of the distance of neighbouring LEDs."""
PAIR = 0.25
"""Two images may be two LEDs if their distances differ by at most this share of the larger one."""
FOLLOWED = 4.0
"""Diameters that an LED image moves at most from one frame of a burst to the next. Ours."""
MAX_OUTSIDE = 0.2
"""Share of a group's images that may be at no LED's place, such as a lamp of another kind among them."""


@dataclass(frozen=True, eq=False)
class Member:
    """LED image of a group: its number in each frame that shows it, -1 in the others."""

    numbers: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Group:
    """LED images that may be of one panel, and the ways to lay them over it.

    `hypotheses` hold the index of each member in the panel; -1 for one at no LED's place.
    """

    members: tuple[Member, ...]
    hypotheses: tuple[Ints, ...]

    def alike(self) -> list[list[Ints]]:
        """Hypotheses in lists that lay the same members, more frequent ones first."""
        found: dict[tuple[bool, ...], list[Ints]] = {}
        for one in self.hypotheses:
            found.setdefault(tuple((one >= 0).tolist()), []).append(one)
        return sorted(found.values(), key=lambda some: -len(some))


@dataclass(frozen=True, eq=False)
class _Level:
    """A frame's LED images in a level view: places (n, 2), metres, and `seen` (n,), the numbers of the images."""

    places_m: Floats
    seen: Ints


def find_groups(
    frames: Sequence[DeviceFrame], images: Sequence[Sequence[LedImage]], packets: Packets
) -> tuple[Group, ...]:
    """Groups of LED images over the frames of a burst; `images` are those of each frame."""
    offsets = np.array(packets.offsets_m)
    pitch_m = _pitch_m(offsets)
    readings = [frame.accelerometer_m_s2 for frame in frames if frame.accelerometer_m_s2 is not None]
    if not readings:
        return ()
    gravity = np.mean(readings, axis=0)
    R_cam_world = rotation(*tilt_from_gravity((float(gravity[0]), float(gravity[1]), float(gravity[2]))))
    levels = [_level(frame, some, packets, R_cam_world) for frame, some in zip(frames, images, strict=True)]
    places, numbers = _matched(levels, pitch_m)
    groups = []
    for some in _linked(places, LINK * pitch_m):
        hypotheses = _hypotheses(places[some], offsets, pitch_m)
        if hypotheses:
            groups.append(Group(tuple(Member(tuple(numbers[one].tolist())) for one in some), hypotheses))
    return tuple(groups)


def same_images(images: Sequence[Sequence[LedImage]]) -> tuple[tuple[tuple[int, int], ...], ...]:
    """LED images of a burst that are of one LED, as (frame, number of the image), in the order of time.

    An image follows the one in the frame before that is nearest, where each is the other's nearest and the distance is
    less than MATCH of that to the next LED image, and than FOLLOWED diameters.
    """
    tracks: list[list[tuple[int, int]]] = [[(0, number)] for number in range(len(images[0]))] if images else []
    for which in range(1, len(images)):
        now = _pixels(images[which])
        latest = [track for track in tracks if track[-1][0] == which - 1]
        before = _pixels([images[which - 1][track[-1][1]] for track in latest])
        followed: set[int] = set()
        if len(now) and len(before):
            away = np.linalg.norm(before[:, None] - now, axis=2)
            gap = np.linalg.norm(now[:, None] - now, axis=2) + np.diag(np.full(len(now), np.inf))
            for old, number in enumerate(away.argmin(axis=1).tolist()):
                size_px = 4 * np.linalg.det(images[which][number].moments_px2) ** 0.25
                limit_px = min(MATCH * gap[number].min(), FOLLOWED * size_px)
                if away[:, number].argmin() == old and away[old, number] < limit_px:
                    latest[old].append((which, number))
                    followed.add(number)
        tracks += [[(which, number)] for number in range(len(now)) if number not in followed]
    return tuple(map(tuple, tracks))


def _pixels(images: Sequence[LedImage]) -> Floats:
    return np.array([(one.u_px, one.v_px) for one in images], dtype=np.float64).reshape(-1, 2)


def _pitch_m(offsets: Floats) -> float:
    """Largest distance of an LED of a panel from the nearest other, metres; 0 for a single LED."""
    if len(offsets) < 2:
        return 0.0
    distance = np.linalg.norm(offsets[:, None] - offsets, axis=2)
    np.fill_diagonal(distance, np.inf)
    return float(distance.min(axis=1).max())


def _level(frame: DeviceFrame, images: Sequence[LedImage], packets: Packets, R_cam_world: Floats) -> _Level:
    """Level places of a frame's LED images, those at or below the horizon left out."""
    pixels = _pixels(images)
    # Each image and a pixel beside it along u and along v.
    around = (pixels[:, None] + [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]).reshape(-1, 2)
    seen = np.flatnonzero(has_pinhole_image(around, frame.camera).reshape(-1, 3).all(axis=1))
    plane = pinhole_image(around.reshape(-1, 3, 2)[seen].reshape(-1, 2), frame.camera)
    rays = np.column_stack([plane, np.ones(len(plane))]) @ R_cam_world
    above = (rays[:, 2] > MIN_ELEVATION_SINE * np.linalg.norm(rays, axis=1)).reshape(-1, 3).all(axis=1)
    seen, rays = seen[above], rays.reshape(-1, 3, 3)[above]
    if not len(seen):
        return _Level(np.zeros((0, 2)), seen)
    level = rays[..., :2] / rays[..., 2:]
    slopes = np.stack([level[:, 1] - level[:, 0], level[:, 2] - level[:, 0]], axis=2)
    moments = slopes @ np.array([images[one].moments_px2 for one in seen]) @ slopes.transpose(0, 2, 1)
    spread = np.maximum(np.linalg.det(moments), 0.0) ** 0.25
    # The root of the mean square extent along any direction: half the radius, or the side over sqrt(12).
    face_m = packets.led.radius_m / 2 if isinstance(packets.led, DiscFace) else packets.led.side_m / np.sqrt(12)
    scale_m = float(np.median(face_m / np.maximum(spread, 1e-12)))
    return _Level(level[:, 0] * scale_m, seen)


def _matched(levels: Sequence[_Level], pitch_m: float) -> tuple[Floats, Ints]:
    """Places (n, 2) of the LEDs that any frame shows, and the number of each in each frame, (n, frames), or -1."""
    places = np.zeros((0, 2))
    numbers = np.zeros((0, len(levels)), dtype=np.int64)
    for which, level in enumerate(levels):
        of_frame = level.places_m
        if len(places) and len(of_frame):
            of_frame = of_frame + _shift(of_frame, places, pitch_m)
        new = []
        for place, number in zip(of_frame, level.seen, strict=True):
            distance = np.linalg.norm(places - place, axis=1) if len(places) else np.zeros(0)
            nearest = int(np.argmin(distance)) if len(distance) else -1
            limit_m = MATCH * pitch_m if pitch_m else np.inf
            if nearest >= 0 and distance[nearest] < limit_m and numbers[nearest, which] < 0:
                numbers[nearest, which] = number
            else:
                new.append((place, number))
        if new:
            added = np.full((len(new), len(levels)), -1, dtype=np.int64)
            added[:, which] = [number for _, number in new]
            places = np.vstack([places, [place for place, _ in new]])
            numbers = np.vstack([numbers, added])
    return places, numbers


def _shift(of_frame: Floats, places: Floats, pitch_m: float) -> Floats:
    """Shift (2,) that lays the places of a frame over those of earlier ones: the most frequent one of least length."""
    shifts = (places[None] - of_frame[:, None]).reshape(-1, 2)
    near = shifts[np.linalg.norm(shifts, axis=1) < (MATCH * pitch_m if pitch_m else np.inf)]
    return np.median(near, axis=0) if len(near) else np.zeros(2)


def _linked(places: Floats, limit_m: float) -> list[list[int]]:
    """Numbers of places in groups, in which each place is within `limit_m` of another one."""
    near = np.linalg.norm(places[:, None] - places, axis=2) <= limit_m
    left, groups = set(range(len(places))), []
    while left:
        group, new = set[int](), {min(left)}
        while new:
            group |= new
            new = {int(one) for some in new for one in np.flatnonzero(near[some])} - group
        left -= group
        groups.append(sorted(group))
    return groups


def _hypotheses(places: Floats, offsets: Floats, pitch_m: float) -> tuple[Ints, ...]:
    """Ways to lay places (n, 2) over LEDs at offsets (k, 2) by a rotation and a shift: the index of each place."""
    if len(places) == 1:
        return tuple(np.array([index]) for index in range(len(offsets)))
    distance = np.linalg.norm(places[:, None] - places, axis=2) + np.diag(np.full(len(places), np.inf))
    # The pair of neighbours nearest to the middle.
    first = int(np.argmin(np.linalg.norm(places - places.mean(axis=0), axis=1)))
    second = int(np.argmin(distance[first]))
    apart = np.linalg.norm(offsets[:, None] - offsets, axis=2)
    own = distance[first, second]
    found: dict[tuple[int, ...], Ints] = {}
    for one, other in np.argwhere(np.abs(apart - own) <= PAIR * np.maximum(apart, own)):
        indices = _laid(places, offsets, (first, second), (int(one), int(other)), PLACE * pitch_m)
        if indices is not None:
            found.setdefault(tuple(indices.tolist()), indices)
    most = max(((one >= 0).sum() for one in found.values()), default=0)
    if most < (1 - MAX_OUTSIDE) * len(places):
        return ()
    return tuple(one for one in found.values() if (one >= 0).sum() == most)


def _laid(places: Floats, offsets: Floats, pair: tuple[int, int], onto: tuple[int, int], limit_m: float) -> Ints | None:
    """Index of each place where two of them are known; -1 beyond `limit_m` from any. None if two have the same.

    The nearest places are laid first, each over the LED nearest to where those before it put it.
    """
    z, target = places @ [1, 1j], offsets @ [1, 1j]
    indices = np.full(len(places), -1, dtype=np.int64)
    indices[list(pair)] = onto
    for number in np.argsort(np.abs(z - z[pair[0]])):
        if indices[number] >= 0:
            continue
        known = np.flatnonzero(indices >= 0)
        at = target[indices[known]]
        middle, middle_at = z[known].mean(), at.mean()
        # Similarity by least squares, with the plane as complex numbers.
        turn = np.vdot(z[known] - middle, at - middle_at) / np.vdot(z[known] - middle, z[known] - middle)
        away = np.abs(target - (middle_at + turn * (z[number] - middle)))
        if away.min() <= limit_m:
            indices[number] = int(np.argmin(away))
    used = indices[indices >= 0]
    return indices if len(set(used.tolist())) == len(used) else None
