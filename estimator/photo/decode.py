"""Lamps of a picture and their tones: where they are, what they send, and which axis the sensor is read along."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.photo.pictures import Picture
from estimator.receiver.signal import Signal
from estimator.receiver.tones import ToneFit, ToneMatch, band_hz, envelope_of, fit_tone, match_tone
from estimator.spots.led_light import Readout
from estimator.spots.striped import Lamp, find_lamps
from estimator.spots.striped_blobs import Along

Floats = NDArray[np.float64]

# Noise of a coded picture, squared codes of 255: compression and quantisation.
FLOOR = 2.0
# Lines whose envelope is below this share of the highest are left out: glow around a lamp.
MIN_ENVELOPE = 0.06
# Errors of a line's level, as a share of its envelope and of the highest: luminance, tone curve, compression. Ours.
LEVEL_SHARE = 0.1
FLOOR_SHARE = 0.01
# Standard deviation of a frequency measured in a photograph beside the fit's: envelope and saturation. Ours.
ADDED_SIGMA_HZ = 25.0
# Bright shares of a period that are tried: the tone curve and saturation widen the bright half.
DUTIES = (0.5, 0.55, 0.6)
# The band of trial frequencies reaches this much beyond the map's.
BAND_BEYOND = 1.6
# A lamp in the middle of a picture has as much gradient along both axes: stripes have several times as much along one.
MIN_AXIS_RATIO = 1.5
# Pixels above this share of the brightest belong to lamps, for the readout axis.
LAMP_SHARE = 0.3
LAMP_RADIUS_PX = 12


@dataclass(frozen=True, eq=False)
class FoundLamp:
    """A lamp of a picture, the tone that fits its stripes, and the LEDs of the map with that tone."""

    lamp: Lamp
    tone: ToneFit | None
    match: ToneMatch | None

    @property
    def candidates(self) -> tuple[int, ...]:
        """Ids of the LEDs that it may be."""
        return () if self.match is None else self.match.leds

    def why_not(self) -> str:
        """Why the lamp is no LED of the map; empty if it may be one."""
        if self.match is not None:
            return ""
        if self.tone is None:
            return "no stripes"
        if self.tone.at_border:
            return f"{self.tone.frequency_hz:.0f} Hz is at the border of the band"
        if not self.tone.clear:
            share = max(100 * self.tone.share, 0.0)
            return f"{self.tone.frequency_hz:.0f} Hz explains {share:.0f} % of the stripes' energy"
        return f"{self.tone.frequency_hz:.0f} Hz is no LED's tone"


def readout_ratio(picture: Picture) -> tuple[Along, float]:
    """What lines are, by the gradients of the bright parts, and by how many times they exceed the other axis'."""
    coded = picture.coded
    bright = (coded > LAMP_SHARE * coded.max()).view(np.uint8)
    near = cv2.dilate(bright, np.ones((2 * LAMP_RADIUS_PX + 1, 2 * LAMP_RADIUS_PX + 1), np.uint8)).view(np.bool_)
    down, right = np.diff(coded, axis=0) ** 2, np.diff(coded, axis=1) ** 2
    by_rows = float(down[near[1:] & near[:-1]].sum(dtype=np.float64))
    by_columns = float(right[near[:, 1:] & near[:, :-1]].sum(dtype=np.float64))
    axis: Literal["rows", "columns"] = "rows" if by_rows >= by_columns else "columns"
    return axis, max(by_rows, by_columns) / max(min(by_rows, by_columns), 1e-12)


def find(
    picture: Picture,
    along: Along,
    line_time_s: float,
    exposure_s: float,
    frequencies_hz: dict[int, float],
    any_square: bool = False,
) -> list[FoundLamp]:
    """Lamps of a picture with the tones of the map's LEDs; larger ones first.

    `along` says what lines are, `line_time_s` is the time between two of them. `frequencies_hz` are those of the LEDs,
    by id. Stripes are looked at in the coded picture, where dim and bright parts of a lamp weigh alike.
    """
    coded = picture.coded
    readout = Readout(0, 0, coded, coded, picture.clipped, FLOOR)
    longest_s = 0.5 / min(frequencies_hz.values()) + exposure_s
    lamps = find_lamps([readout], along, longest_s / line_time_s, coded.size, any_square)
    lowest_hz, highest_hz = min(frequencies_hz.values()), max(frequencies_hz.values())
    found = []
    for lamp in lamps:
        tone = _tone(lamp, line_time_s, exposure_s, lowest_hz, highest_hz)
        match = None if tone is None else match_tone(tone, frequencies_hz, added_sigma_hz=ADDED_SIGMA_HZ)
        found.append(FoundLamp(lamp, tone, match))
    return found


def _tone(lamp: Lamp, line_time_s: float, exposure_s: float, lowest_hz: float, highest_hz: float) -> ToneFit | None:
    """The tone of a lamp's profile, of frequencies about those of the map; None without stripes."""
    profile = lamp.profile
    if not lamp.striped or len(profile.lines) < 2:
        return None
    starts_s = np.asarray(profile.lines * line_time_s, dtype=np.float64)
    whole = Signal(starts_s, exposure_s, profile.level_e, profile.weight)
    envelope = envelope_of(whole, int(np.ceil(1 / lowest_hz / line_time_s)))
    highest = float(envelope.max())
    used = envelope >= MIN_ENVELOPE * highest
    variance = (LEVEL_SHARE * envelope) ** 2 + (FLOOR_SHARE * highest) ** 2 + 1 / profile.weight
    weight = np.asarray(1 / variance[used], dtype=np.float64)
    level = np.asarray(whole.level[used], dtype=np.float64)
    signal = Signal(np.asarray(whole.start_s[used], dtype=np.float64), exposure_s, level, weight)
    low, high = band_hz(line_time_s, exposure_s, int(used.sum()))
    band = max(low, lowest_hz / BAND_BEYOND), min(high, highest_hz * BAND_BEYOND)
    fits = [fit for duty in DUTIES if (fit := fit_tone(signal, band, duty, envelope[used])) is not None]
    return max(fits, key=lambda fit: fit.share, default=None)
