"""Scores of a receiver: its identities against the truth, by the lines of an LED image, distance and tilt."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from estimator.camera.pose import Pose
from estimator.camera.projection import project
from estimator.io.camera import Camera
from estimator.io.dataset import Dataset
from estimator.io.device import Identity
from estimator.io.estimates import EstimateRow
from estimator.io.records import Row, Size
from estimator.io.truth import WHOLE, TrueLed, TrueMapLed, TruthRow
from estimator.receiver.bits import NOT_SEEN

Floats = NDArray[np.float64]

ROWS = (0.0, 30.0, 40.0, 50.0, 60.0, 80.0)
DISTANCES_M = (0.0, 2.0, 2.5, 3.0, 3.5, 4.5)
TILTS_DEG = (0.0, 15.0, 30.0, 45.0, 60.0)
"""Lower ends of the classes; the last one has no upper end."""
RIM = np.array([[np.cos(angle), np.sin(angle), 0.0] for angle in np.linspace(0, 2 * np.pi, 24, endpoint=False)])
NEAR_PX = 2.0
"""An identity belongs to an LED if its pixel is within the LED image, and this much beside it."""


class IdentityClass(Row):
    """Whole LED images from `low` to `high` (null: no limit) in lines, metres or degrees, by what the receiver said."""

    low: Size
    high: Size | None
    leds: int = Field(ge=0)
    right: int = Field(ge=0)
    wrong: int = Field(ge=0)
    rejected: int = Field(ge=0)
    missed: int = Field(ge=0)


class IdentityScore(Row):
    """What a receiver made of the LED images that are whole on the sensor and whose light tells which LED it is.

    Of `leds` images in all frames, `right` were identified, `wrong` as another LED, `rejected` were found and left
    without identity, and `missed` were not found. `wrong_elsewhere` counts identities of cut LED images, of lamps that
    identify nothing and of no LED at all, where they are wrong. `bit_errors` of `bits` chips differ from those sent,
    where an LED was identified, decided without the redundancy of code or packet.
    """

    leds: int = Field(ge=0)
    right: int = Field(ge=0)
    wrong: int = Field(ge=0)
    rejected: int = Field(ge=0)
    missed: int = Field(ge=0)
    wrong_elsewhere: int = Field(ge=0)
    bit_errors: int = Field(ge=0)
    bits: int = Field(ge=0)
    by_rows: tuple[IdentityClass, ...]
    by_distance: tuple[IdentityClass, ...]
    by_tilt: tuple[IdentityClass, ...]


@dataclass(frozen=True)
class _Judged:
    """An LED image that is whole: its lines, distance, tilt of the camera, and what became of it."""

    lines: float
    distance_m: float
    tilt_deg: float
    verdict: str


def score_identities(
    estimates: Sequence[EstimateRow], truth: Sequence[TruthRow], dataset: Dataset, true_map: Sequence[TrueMapLed]
) -> IdentityScore | None:
    """Score of the identities of one variant's rows; None where identities are given, or no row has any.

    `true_map` is needed where the dataset has no map.
    """
    if dataset.downlink is None or all(row.identities is None for row in estimates):
        return None
    judged: list[_Judged] = []
    elsewhere = errors = bits = 0
    places = {(led.map, led.led): (np.array(led.position_m), led.size_m) for led in true_map}
    for row, true, record in zip(estimates, truth, dataset.frames, strict=True):
        known = {led: place for (number, led), place in places.items() if number == true.map}
        if not known:
            known = {led.id: (np.array(led.position_m), led.half_width_m) for led in dataset.leds.values()}
        names = _names(row.identities or (), known, bool(dataset.leds))
        frame = _Frame(true, dataset.cameras[record.camera], known)
        of_led, stray = frame.assigned(row.identities or ())
        elsewhere += sum(names[number] is not None for number in stray)
        for led in true.leds:
            found = of_led.get(led.led, [])
            said = {names[number] for number in found} - {None}
            tells = led.led in dataset.downlink.leds or led.bits is not None
            if led.visible_fraction < WHOLE or not tells:
                elsewhere += bool(said - ({led.led} if tells else set()))
                continue
            verdict = "missed" if not found else "rejected" if not said else "right" if said == {led.led} else "wrong"
            judged.append(_Judged(*frame.geometry(led), verdict))
            if verdict == "right" and led.bits is not None:
                for number in found:
                    read = (row.identities or ())[number].bits or ""
                    pairs = [(a, b) for a, b in zip(read, led.bits, strict=False) if a != NOT_SEEN]
                    bits += len(pairs)
                    errors += sum(a != b for a, b in pairs)
    return IdentityScore(
        **_counts(judged),
        wrong_elsewhere=elsewhere,
        bit_errors=errors,
        bits=bits,
        by_rows=_classes(judged, ROWS, lambda one: one.lines),
        by_distance=_classes(judged, DISTANCES_M, lambda one: one.distance_m),
        by_tilt=_classes(judged, TILTS_DEG, lambda one: one.tilt_deg),
    )


def _names(identities: Sequence[Identity], known: Mapping[int, tuple[Floats, float]], mapped: bool) -> list[int | None]:
    """LED of the truth that each identity names: by its id, or by its position where the dataset has no map."""
    if mapped:
        return [one.led for one in identities]
    leds, positions = list(known), np.array([place for place, _ in known.values()]).reshape(-1, 3)
    names: list[int | None] = []
    for one in identities:
        if one.led is None or one.position_m is None or not leds:
            names.append(None)
        else:
            names.append(leds[int(np.argmin(np.linalg.norm(positions - one.position_m, axis=1)))])
    return names


@dataclass(frozen=True)
class _Frame:
    """A frame's truth: where its LED images are."""

    truth: TruthRow
    camera: Camera
    known: Mapping[int, tuple[Floats, float]]

    def _rim_px(self, led: int) -> Floats:
        """Pixels (24, 2) around the image of an LED, by the camera as it is told and the pose at mid-readout."""
        centre_m, half_width_m = self.known[led]
        pose = Pose(np.array(self.truth.position_m), np.reshape(self.truth.R_cam_world, (3, 3)))
        return project(centre_m + half_width_m * RIM, pose, self.camera).pixels

    def geometry(self, led: TrueLed) -> tuple[float, float, float]:
        """Lines that an LED image spans, distance of the LED, metres, and angle of the axis off the zenith, degrees."""
        rim_px = self._rim_px(led.led)
        lines = float(np.ptp(self.camera.line_of(rim_px[:, 0], rim_px[:, 1])))
        distance_m = float(np.linalg.norm(self.known[led.led][0] - self.truth.position_m))
        return lines, distance_m, float(np.degrees(np.arccos(np.clip(self.truth.R_cam_world[8], -1, 1))))

    def assigned(self, identities: Sequence[Identity]) -> tuple[dict[int, list[int]], list[int]]:
        """Numbers of the identities at each LED's image, by LED, and of those at none."""
        leds = [led for led in self.truth.leds if led.led in self.known]
        centres_px = np.array([(led.u_px, led.v_px) for led in leds]).reshape(-1, 2)
        of_led: dict[int, list[int]] = {}
        stray = []
        for number, one in enumerate(identities):
            away = np.linalg.norm(centres_px - (one.u_px, one.v_px), axis=1)
            nearest = int(np.argmin(away)) if len(away) else -1
            if nearest < 0 or away[nearest] > NEAR_PX + np.ptp(self._rim_px(leds[nearest].led), axis=0).max() / 2:
                stray.append(number)
            else:
                of_led.setdefault(leds[nearest].led, []).append(number)
        return of_led, stray


def _counts(judged: Iterable[_Judged]) -> dict[str, int]:
    verdicts = [one.verdict for one in judged]
    return {"leds": len(verdicts)} | {name: verdicts.count(name) for name in ("right", "wrong", "rejected", "missed")}


def _classes(
    judged: Sequence[_Judged], lower: Sequence[float], value: Callable[[_Judged], float]
) -> tuple[IdentityClass, ...]:
    found = []
    for low, high in zip(lower, [*lower[1:], None], strict=True):
        some = [one for one in judged if low <= value(one) and (high is None or value(one) < high)]
        found.append(IdentityClass(low=low, high=high, **_counts(some)))
    return tuple(found)
