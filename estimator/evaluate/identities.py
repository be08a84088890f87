"""Scores of a receiver: its identities against the truth, by the lines of an LED image, distance and tilt."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from estimator.camera.pose import Pose
from estimator.camera.projection import project
from estimator.io.camera import Camera
from estimator.io.dataset import Dataset, FrameRecord
from estimator.io.device import Identity
from estimator.io.estimates import EstimateRow
from estimator.io.records import Row, Size
from estimator.io.truth import WHOLE, TrueLed, TrueMapLed, TruthRow
from estimator.receiver.bits import NOT_SEEN

Floats = NDArray[np.float64]
Places = Mapping[int, tuple[Floats, float]]
"""Centre, world metres, and radius or half the side of LEDs, by id."""

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


def score_identities(
    estimates: Sequence[EstimateRow], truth: Sequence[TruthRow], dataset: Dataset, true_map: Sequence[TrueMapLed]
) -> IdentityScore | None:
    """Score of the identities of one variant's rows; None where identities are given, or no row has any.

    `true_map` is needed where the dataset has no map.
    """
    tally = IdentityTally(dataset, true_map)
    for row, true, record in zip(estimates, truth, dataset.frames, strict=True):
        tally.add(row, true, record)
    return tally.score()


class IdentityTally:
    """Counts of one variant's identities, frame by frame; as `score_identities`."""

    def __init__(self, dataset: Dataset, true_map: Sequence[TrueMapLed]) -> None:
        """Count nothing yet; `true_map` is needed where the dataset has no map."""
        self._dataset = dataset
        received = dataset.downlink is not None and dataset.downlink.demodulation == "pixels"
        self._downlink = dataset.downlink if received else None
        self._of_map: dict[int, dict[int, tuple[Floats, float]]] = {}
        for led in true_map:
            self._of_map.setdefault(led.map, {})[led.led] = (np.array(led.position_m), led.size_m)
        self._told: Places = {led.id: (np.array(led.position_m), led.half_width_m) for led in dataset.leds.values()}
        self._received = False
        self._elsewhere = self._bit_errors = self._bits = 0
        self._verdicts = Counter[str]()
        self._by_rows, self._by_distance, self._by_tilt = _Classes(ROWS), _Classes(DISTANCES_M), _Classes(TILTS_DEG)

    def add(self, row: EstimateRow, true: TruthRow, record: FrameRecord) -> None:
        """Count the identities of a frame."""
        if self._downlink is None:
            return
        identities = row.identities or ()
        self._received |= row.identities is not None
        known: Places = self._of_map.get(true.map, self._told)
        names = _names(identities, known, bool(self._dataset.leds))
        frame = _Frame(true, self._dataset.cameras[record.camera], known)
        of_led, stray = frame.assigned(identities)
        self._elsewhere += sum(names[number] is not None for number in stray)
        for led in true.leds:
            found = of_led.get(led.led, [])
            said = {names[number] for number in found} - {None}
            tells = led.led in self._downlink.leds or led.bits is not None
            if led.visible_fraction < WHOLE or not tells:
                self._elsewhere += bool(said - ({led.led} if tells else set()))
                continue
            verdict = "missed" if not found else "rejected" if not said else "right" if said == {led.led} else "wrong"
            self._verdicts[verdict] += 1
            for classes, value in zip(
                (self._by_rows, self._by_distance, self._by_tilt), frame.geometry(led), strict=True
            ):
                classes.add(value, verdict)
            if verdict == "right" and led.bits is not None:
                for number in found:
                    read = identities[number].bits or ""
                    pairs = [(a, b) for a, b in zip(read, led.bits, strict=False) if a != NOT_SEEN]
                    self._bits += len(pairs)
                    self._bit_errors += sum(a != b for a, b in pairs)

    def score(self) -> IdentityScore | None:
        """Score of the frames so far; None where identities are given, or no frame has any."""
        if not self._received:
            return None
        return IdentityScore(
            **_counts(self._verdicts),
            wrong_elsewhere=self._elsewhere,
            bit_errors=self._bit_errors,
            bits=self._bits,
            by_rows=self._by_rows.counted(),
            by_distance=self._by_distance.counted(),
            by_tilt=self._by_tilt.counted(),
        )


def _names(identities: Sequence[Identity], known: Places, mapped: bool) -> list[int | None]:
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
    known: Places

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


def _counts(verdicts: Counter[str]) -> dict[str, int]:
    return {"leds": verdicts.total()} | {name: verdicts[name] for name in ("right", "wrong", "rejected", "missed")}


class _Classes:
    """Verdicts on LED images by the class of a value; `lower` are the lower ends, the last class has no upper end."""

    def __init__(self, lower: Sequence[float]) -> None:
        self._ends = tuple(zip(lower, [*lower[1:], None], strict=True))
        self._verdicts = [Counter[str]() for _ in lower]

    def add(self, value: float, verdict: str) -> None:
        """Count a verdict on an image of this value."""
        for (low, high), verdicts in zip(self._ends, self._verdicts, strict=True):
            verdicts[verdict] += low <= value and (high is None or value < high)

    def counted(self) -> tuple[IdentityClass, ...]:
        """The classes so far."""
        return tuple(
            IdentityClass(low=low, high=high, **_counts(verdicts))
            for (low, high), verdicts in zip(self._ends, self._verdicts, strict=True)
        )
