"""The entry `downlink` of dataset.json: what a receiver knows of the waves that LEDs transmit."""

from collections.abc import Collection
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from vlcrender.config.toml_model import Settings
from vlcrender.dataset.format.values import Count, LedSize, Number, Positive, repeated
from vlcrender.modulation.keys import Downlink
from vlcrender.modulation.packet import COORDINATE_BITS, COORDINATE_UNIT_M, POLYNOMIAL, PREAMBLE
from vlcrender.modulation.transmission import Transmission, Transmitter, transmission_of
from vlcrender.scene.leds import Leds

MAX_CHIPS = 4096
MAX_PACKET_LEDS = 2**13
Depth = Annotated[float, Field(gt=0, le=1)]
ClockError = Annotated[float, Field(ge=0, le=0.1)]
Chips = Annotated[str, Field(pattern=f"^[01]{{2,{MAX_CHIPS}}}$")]
Demodulation = Literal["given", "pixels"]


class CodeEntry(Settings):
    """LEDs with one clock that repeat codes."""

    send: Literal["code"]
    chip_us: Positive
    depth: Depth
    clock_error: ClockError
    """Standard deviation, as in all entries."""
    leds: Annotated[tuple[Count, ...], Field(min_length=1)]
    codes: tuple[Chips, ...]

    @model_validator(mode="after")
    def _codes_agree(self) -> Self:
        if len(self.codes) != len(self.leds):
            raise ValueError("codes: needed one for each of leds")
        if len({len(code) for code in self.codes}) > 1 or any(len(set(code)) == 1 for code in self.codes):
            raise ValueError("codes have to be of one length, and of chips of both kinds")
        return self


class ToneEntry(Settings):
    """LEDs with one clock that send square waves."""

    send: Literal["tone"]
    duty: Annotated[float, Field(gt=0, lt=1)]
    depth: Depth
    clock_error: ClockError
    leds: Annotated[tuple[Count, ...], Field(min_length=1)]
    frequencies_hz: tuple[Positive, ...]

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        if len(self.frequencies_hz) != len(self.leds):
            raise ValueError("frequencies_hz: needed one for each of leds")
        return self


class PacketDisc(Settings):
    """Round LEDs of panels that send packets."""

    shape: Literal["disc"]
    radius_m: LedSize


class PacketSquare(Settings):
    """Square LEDs of panels that send packets, sides along x and y."""

    shape: Literal["square"]
    side_m: LedSize


class PacketEntry(Settings):
    """All panels that are alike and send packets; it does not tell where they are."""

    send: Literal["packet"]
    chip_us: Positive
    depth: Depth
    clock_error: ClockError
    preamble: Annotated[str, Field(pattern="^[01]{0,64}$")]
    polynomial: Annotated[int, Field(ge=1, lt=2**16)]
    coordinate_bits: Annotated[int, Field(ge=1, le=16)]
    coordinate_unit_m: Positive
    delays_chips: Annotated[tuple[Annotated[int, Field(ge=0, le=MAX_CHIPS)], ...], Field(min_length=1)]
    offsets_m: tuple[tuple[Number, Number], ...]
    """From the panel's centre to each LED, along x and y."""
    led: Annotated[PacketDisc | PacketSquare, Field(discriminator="shape")]

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        if len(self.offsets_m) != len(self.delays_chips):
            raise ValueError("offsets_m: needed one for each of delays_chips")
        if len(self.delays_chips) > MAX_PACKET_LEDS:
            raise ValueError(f"delays_chips: {len(self.delays_chips)} LEDs, more than {MAX_PACKET_LEDS}")
        return self


TransmitterEntry = Annotated[CodeEntry | ToneEntry | PacketEntry, Field(discriminator="send")]


class DownlinkEntry(Settings):
    """`downlink` in dataset.json."""

    demodulation: Demodulation
    transmitters: Annotated[tuple[TransmitterEntry, ...], Field(min_length=1)]

    @property
    def led_ids(self) -> list[int]:
        """Ids of the LEDs that codes and tones name."""
        return [led for one in self.transmitters if not isinstance(one, PacketEntry) for led in one.leds]

    @model_validator(mode="after")
    def _leds_once(self) -> Self:
        if (led := repeated(self.led_ids)) is not None:
            raise ValueError(f"LED {led} is in leds twice")
        return self


def downlink_problem(downlink: DownlinkEntry | None, leds: Collection[int] | None) -> str | None:
    """What is wrong with a downlink beside an LED map (ids; None for null), None if nothing."""
    if leds is None:
        sends_packets = downlink is not None and any(isinstance(one, PacketEntry) for one in downlink.transmitters)
        if downlink is None or downlink.demodulation != "pixels" or not sends_packets:
            return 'led_map: null needs a downlink with demodulation "pixels" and a transmitter of packets'
        return f"downlink: names LED {downlink.led_ids[0]}, but led_map is null" if downlink.led_ids else None
    unknown = set() if downlink is None else set(downlink.led_ids) - set(leds)
    return f"downlink: names LED {min(unknown)}, which is not in led_map" if unknown else None


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
