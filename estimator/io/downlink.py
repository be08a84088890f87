"""Downlink: what the LEDs send, as the device knows it before it sees a frame (datasets/FORMAT.md)."""

from collections.abc import Collection, Sequence
from typing import Annotated, Literal, Self

from pydantic import Field, Strict, field_validator, model_validator

from estimator.io.records import Entry, LedId, Number, Positive

MAX_CHIPS = 4096
INDEX_BITS = 13
"""Bits of the index of an LED in its panel, in the ids that a receiver makes of packets."""
CRC_BITS = 16

LedIds = Annotated[tuple[LedId, ...], Field(min_length=1)]
Depth = Annotated[float, Field(gt=0, le=1)]
ClockError = Annotated[float, Field(ge=0, le=0.1)]
Chips = Annotated[str, Field(pattern=f"^[01]{{2,{MAX_CHIPS}}}$")]
Pair = Annotated[tuple[Number, Number], Strict(False)]


class Transmitter(Entry):
    """What LEDs with one clock in common send; keys as in dataset.json. See `Codes`, `Tones`, `Packets`.

    `depth` is the share of the light that is switched: 1 switches it off. `clock_error` is the standard deviation of
    the relative error of the transmitter's clock.
    """

    send: str
    depth: Depth
    clock_error: ClockError


class Codes(Transmitter):
    """LEDs that repeat a code each, of chips of `chip_us`: "1" is bright, "0" dark."""

    send: Literal["code"]
    chip_us: Positive
    leds: LedIds
    codes: tuple[Chips, ...]

    @field_validator("codes")
    @classmethod
    def _of_one_length(cls, codes: tuple[str, ...]) -> tuple[str, ...]:
        if len({len(code) for code in codes}) > 1:
            raise ValueError("codes have to be of one length")
        if any(len(set(code)) == 1 for code in codes):
            raise ValueError("a code needs chips of both kinds")
        return codes

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        if len(self.codes) != len(self.leds):
            raise ValueError("codes: needed one for each of leds")
        return self


class Tones(Transmitter):
    """LEDs that repeat a square wave each, bright for the share `duty` of a period; several may have one frequency."""

    send: Literal["tone"]
    duty: float = Field(gt=0, lt=1)
    leds: LedIds
    frequencies_hz: tuple[Positive, ...]

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        if len(self.frequencies_hz) != len(self.leds):
            raise ValueError("frequencies_hz: needed one for each of leds")
        return self


class DiscFace(Entry):
    """Face of every LED of a panel that sends packets: a disc."""

    shape: Literal["disc"]
    radius_m: Positive


class SquareFace(Entry):
    """Face of every LED of a panel that sends packets: a square."""

    shape: Literal["square"]
    side_m: Positive


class Packets(Transmitter):
    """Panels alike, each of which repeats a packet with the coordinates of its centre.

    A packet is `preamble`, then its bits in Manchester code (1 is bright then dark): `coordinate_bits` of each of x, y
    and z in units of `coordinate_unit_m`, a bit 0, and their CRC of 16 bits by `polynomial` with the start value 0, all
    with the most significant bit first. LED k of a panel starts `delays_chips[k]` late and stands at `offsets_m[k]`
    (along x and y of the world) of the panel's centre.
    """

    send: Literal["packet"]
    chip_us: Positive
    preamble: Annotated[str, Field(pattern="^[01]{0,64}$")]
    polynomial: int = Field(ge=1, lt=2**CRC_BITS)
    coordinate_bits: int = Field(ge=1, le=16)
    coordinate_unit_m: Positive
    delays_chips: Annotated[tuple[Annotated[int, Field(ge=0, le=MAX_CHIPS)], ...], Field(min_length=1)]
    offsets_m: tuple[Pair, ...]
    led: Annotated[DiscFace | SquareFace, Field(discriminator="shape")]

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        if len(self.offsets_m) != len(self.delays_chips):
            raise ValueError("offsets_m: needed one for each of delays_chips")
        if len(self.delays_chips) > 2**INDEX_BITS:
            raise ValueError(f"delays_chips: {len(self.delays_chips)} LEDs, more than {2**INDEX_BITS}")
        return self

    @property
    def data_bits(self) -> int:
        """Bits before the CRC: three coordinates and a bit 0."""
        return 3 * self.coordinate_bits + 1

    @property
    def length(self) -> int:
        """Chips of a packet."""
        return len(self.preamble) + 2 * (self.data_bits + CRC_BITS)


AnyTransmitter = Annotated[Codes | Tones | Packets, Field(discriminator="send")]
"""An entry of `transmitters`, told apart by `send`."""


class Downlink(Entry):
    """What the LEDs send; keys as in dataset.json.

    `demodulation` is "given" where the identities in a frame's `spots` are handed over, and "pixels" where `spots` is
    empty and a receiver has to decode the image.
    """

    demodulation: Literal["given", "pixels"]
    transmitters: Annotated[tuple[AnyTransmitter, ...], Field(min_length=1)]

    @field_validator("transmitters")
    @classmethod
    def _leds_once(cls, transmitters: tuple[Transmitter, ...]) -> tuple[Transmitter, ...]:
        named = [led for one in transmitters if isinstance(one, Codes | Tones) for led in one.leds]
        if len(set(named)) != len(named):
            raise ValueError("an LED is in leds twice")
        return transmitters

    @property
    def leds(self) -> frozenset[int]:
        """Ids of the LEDs that are named."""
        return frozenset(led for one in self.transmitters if isinstance(one, Codes | Tones) for led in one.leds)

    @property
    def sends_packets(self) -> bool:
        """Whether a transmitter sends the coordinates of its LEDs."""
        return any(isinstance(one, Packets) for one in self.transmitters)


def downlink_problem(downlink: Downlink | None, leds: Collection[int] | None) -> str | None:
    """What is wrong with a downlink beside an LED map (ids; None for null), None if nothing."""
    if leds is None:
        if downlink is None or downlink.demodulation != "pixels" or not downlink.sends_packets:
            return 'led_map: null needs a downlink with demodulation "pixels" and a transmitter of packets'
        if downlink.leds:
            return f"downlink: names LED {min(downlink.leds)}, but led_map is null"
    elif downlink is not None and (unknown := downlink.leds - set(leds)):
        return f"downlink: names LED {min(unknown)}, which is not in led_map"
    return None


def spots_problem(downlink: Downlink | None, spots: Sequence[object]) -> str | None:
    """What is wrong with handed over identities beside a downlink, None if nothing."""
    if downlink is not None and downlink.demodulation == "pixels" and spots:
        return f'{len(spots)} spots, but they have to be empty with demodulation "pixels"'
    return None
