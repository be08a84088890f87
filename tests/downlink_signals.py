"""LED images of modulated LEDs for tests of the receiver: elliptical discs with gains by lines, and noise of a sensor.

The waves are computed here, by sums over fine steps of time, apart from both packages.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.io.downlink import Codes, Downlink, Packets
from estimator.receiver.signal import LedImage, Signal

Array = NDArray[np.float64]
ROW_TIME_S = 10e-6
EXPOSURE_S = 40e-6
STEPS = 400
READ_NOISE_E = 3.0


@dataclass(frozen=True)
class Sent:
    """Chips that an LED repeats, `chip_s` each, `phase` chips into the period at time 0; mean 1."""

    chips: str
    chip_s: float
    phase: float
    depth: float = 1.0

    def gains(self, start_s: Array, exposure_s: float = EXPOSURE_S) -> Array:
        """Means over exposures by the midpoint rule: a switch within a step is off by half of one of 400."""
        levels = np.where(np.array(list(self.chips)) == "1", 1.0, 1 - self.depth)
        levels /= levels.mean()
        times = start_s[:, None] + (np.arange(STEPS) + 0.5) * exposure_s / STEPS
        return np.asarray(levels[np.floor(times / self.chip_s + self.phase).astype(int) % len(levels)].mean(axis=1))


def led_image(
    sent: Sent | None,
    generator: np.random.Generator,
    centre_px: tuple[float, float] = (1000.0, 1500.0),
    radii_px: tuple[float, float] = (43.0, 43.0),
    electrons: float = 800.0,
    start_s: float = 3.0,
    envelope: float = 0.02,
) -> LedImage:
    """Image of an upright ellipse with these half axes along u and v, of a mean of `electrons` a pixel; None is steady.

    The error of each line's envelope is a share `envelope` of its level.
    """
    u, v = centre_px
    rows = np.arange(int(np.ceil(v - radii_px[1])), int(v + radii_px[1]))
    chord = 2 * radii_px[0] * np.sqrt(np.clip(1 - ((rows + 0.5 - v) / radii_px[1]) ** 2, 0, 1))
    rows, chord = rows[chord > 0.5 * radii_px[0]], chord[chord > 0.5 * radii_px[0]]
    starts_s = start_s + rows * ROW_TIME_S
    gains = np.ones(len(rows)) if sent is None else sent.gains(starts_s)
    read = READ_NOISE_E * np.sqrt(chord) * generator.normal(size=len(rows))
    light = generator.poisson(electrons * chord * gains) + read
    level = light / chord * (1 + envelope * generator.normal(size=len(rows)))
    variance = (np.maximum(level, 0) + READ_NOISE_E**2) / chord + (envelope * 2 * electrons) ** 2
    moments = np.diag(np.square(radii_px)) / 4
    return LedImage(u, v, moments, Signal(starts_s, EXPOSURE_S, level, 1 / variance))


def balanced_codes(count: int, length: int, generator: np.random.Generator, longest: int = 4) -> tuple[str, ...]:
    """Random balanced codes without runs longer than `longest`, distinct up to shifts."""
    found: dict[str, str] = {}
    while len(found) < count:
        chips = "".join(map(str, generator.permutation(np.arange(length) % 2)))
        if "0" * (longest + 1) not in chips * 2 and "1" * (longest + 1) not in chips * 2:
            found.setdefault(min(chips[k:] + chips[:k] for k in range(length)), chips)
    return tuple(found.values())


def code_downlink(codes: tuple[str, ...], leds_each: int = 25, chip_us: float = 25.0) -> Downlink:
    """Downlink of panels of `leds_each` LEDs with ids 100, 101, ..., and a code each."""
    transmitters = tuple(
        Codes(
            send="code",
            chip_us=chip_us,
            depth=1.0,
            clock_error=1e-4,
            leds=tuple(range(100 + first, 100 + min(first + leds_each, len(codes)))),
            codes=codes[first : first + leds_each],
        )
        for first in range(0, len(codes), leds_each)
    )
    return Downlink(demodulation="pixels", transmitters=transmitters)


SHUFFLED = (7, 19, 2, 23, 11, 0, 15, 5, 21, 9, 17, 3, 24, 13, 6, 20, 1, 10, 18, 4, 14, 22, 8, 16, 12)
PITCH_M = 0.13
PACKETS = Packets.model_validate(
    {
        **{"send": "packet", "chip_us": 50.0, "depth": 1.0, "clock_error": 1e-4, "preamble": "00011011000111"},
        **{"polynomial": 0x3D65, "coordinate_bits": 13, "coordinate_unit_m": 0.001},
        "delays_chips": tuple(5 * one for one in SHUFFLED),
        "offsets_m": tuple(((k % 5 - 2) * PITCH_M, (k // 5 - 2) * PITCH_M) for k in range(25)),
        "led": {"shape": "disc", "radius_m": 0.01},
    }
)


def remainder(bits: str, polynomial: int) -> str:
    """CRC of 16 bits by long division of polynomials: `bits` times x^16, modulo x^16 + `polynomial`."""
    divisor, dividend = (1 << 16) | polynomial, int(bits, 2) << 16
    for place in range(len(bits) - 1, -1, -1):
        if dividend >> (place + 16) & 1:
            dividend ^= divisor << place
    return f"{dividend:016b}"


def packet_chips(x: int, y: int, z: int) -> str:
    """Chips of a packet, as datasets/FORMAT.md says."""
    data = f"{x:013b}{y:013b}{z:013b}0"
    return PACKETS.preamble + "".join("10" if bit == "1" else "01" for bit in data + remainder(data, 0x3D65))
