"""The entry `downlink` of dataset.json: what a receiver knows of the waves that LEDs transmit."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from vlcrender.config.toml_model import Settings
from vlcrender.modulation.keys import Downlink
from vlcrender.modulation.packet import COORDINATE_BITS, COORDINATE_UNIT_M, POLYNOMIAL, PREAMBLE
from vlcrender.modulation.transmission import Transmission, Transmitter, transmission_of
from vlcrender.scene.leds import Leds

Demodulation = Literal["given", "pixels"]


class CodeEntry(Settings):
    """LEDs with one clock that repeat codes."""

    send: Literal["code"]
    chip_us: float
    depth: float
    clock_error: float
    """Standard deviation, as in all entries."""
    leds: tuple[int, ...]
    codes: tuple[str, ...]


class ToneEntry(Settings):
    """LEDs with one clock that send square waves."""

    send: Literal["tone"]
    duty: float
    depth: float
    clock_error: float
    leds: tuple[int, ...]
    frequencies_hz: tuple[float, ...]


class PacketDisc(Settings):
    """Round LEDs of panels that send packets."""

    shape: Literal["disc"]
    radius_m: float


class PacketSquare(Settings):
    """Square LEDs of panels that send packets, sides along x and y."""

    shape: Literal["square"]
    side_m: float


class PacketEntry(Settings):
    """All panels that are alike and send packets; it does not tell where they are."""

    send: Literal["packet"]
    chip_us: float
    depth: float
    clock_error: float
    preamble: str
    polynomial: int
    coordinate_bits: int
    coordinate_unit_m: float
    delays_chips: tuple[int, ...]
    offsets_m: tuple[tuple[float, float], ...]
    """From the panel's centre to each LED, along x and y."""
    led: Annotated[PacketDisc | PacketSquare, Field(discriminator="shape")]


TransmitterEntry = Annotated[CodeEntry | ToneEntry | PacketEntry, Field(discriminator="send")]


class DownlinkEntry(Settings):
    """`downlink` in dataset.json."""

    demodulation: Demodulation
    transmitters: tuple[TransmitterEntry, ...]


OFFSET_DIGITS = 9
"""Decimals of offsets, metres: panels whose offsets differ by rounding alone are alike."""


def downlink_entry(leds: Leds, demodulation: Demodulation = "given") -> DownlinkEntry | None:
    """The entry of a scene's LEDs as told; None where no light identifies its LED and identities are given."""
    transmission = transmission_of(leds.transmitters)
    entries: list[CodeEntry | ToneEntry | PacketEntry] = []
    for transmitter in leds.transmitters:
        entry = _entry(transmitter, transmission, leds)
        if entry is not None and not (isinstance(entry, PacketEntry) and entry in entries):
            entries.append(entry)
    if not entries and demodulation == "given":
        return None
    return DownlinkEntry(demodulation=demodulation, transmitters=tuple(entries))


def _entry(
    transmitter: Transmitter, transmission: Transmission, leds: Leds
) -> CodeEntry | ToneEntry | PacketEntry | None:
    downlink, ids = transmitter.downlink, transmitter.led_ids
    if downlink is None or not downlink.identifies:
        return None
    depth, clock_error = downlink.modulation_depth, downlink.clock_sigma
    if downlink.send == "code":
        return CodeEntry(
            send="code",
            chip_us=_chip_us(downlink),
            depth=depth,
            clock_error=clock_error,
            leds=ids,
            codes=tuple(transmission.codes[led] for led in ids),
        )
    if downlink.send == "tone":
        return ToneEntry(
            send="tone",
            duty=downlink.lit_share,
            depth=depth,
            clock_error=clock_error,
            leds=ids,
            frequencies_hz=tuple(transmission.tones_hz[led] for led in ids),
        )
    places = np.searchsorted(leds.ids, ids)
    size_m = float(leds.half_widths_m[places[0]])
    offsets = leds.centers_m[places, :2] - np.array(transmitter.center_m[:2])
    led: PacketDisc | PacketSquare = PacketDisc(shape="disc", radius_m=size_m)
    if leds.squares[places[0]]:
        led = PacketSquare(shape="square", side_m=2 * size_m)
    return PacketEntry(
        send="packet",
        chip_us=_chip_us(downlink),
        depth=depth,
        clock_error=clock_error,
        preamble=PREAMBLE,
        polynomial=POLYNOMIAL,
        coordinate_bits=COORDINATE_BITS,
        coordinate_unit_m=COORDINATE_UNIT_M,
        delays_chips=tuple(transmission.delays[led] for led in ids),
        offsets_m=tuple((x, y) for x, y in (offsets.round(OFFSET_DIGITS) + 0.0).tolist()),
        led=led,
    )


def _chip_us(downlink: Downlink) -> float:
    return round(downlink.chip_s * 1e6, 9)
