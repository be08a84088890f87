"""Transmitters of a scene: which LEDs share a clock, what each LED transmits, and the waves of a dataset."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from vlcrender.core.random_keys import stream
from vlcrender.modulation.codes import code_book
from vlcrender.modulation.keys import Downlink
from vlcrender.modulation.packet import CHIPS, MAX_COORDINATE_M, coordinates_mm, delays_chips, packet_chips
from vlcrender.modulation.wave import CosineWave, TwoLevelWave, Wave


@dataclass(frozen=True)
class Transmitter:
    """A panel, or a single LED: LEDs that share a clock."""

    number: int
    """Number of the luminaire: single LEDs in the order of the scene file, then panels grid by grid."""
    where: str
    """Its table in the scene file, such as "panels[0]"."""
    downlink: Downlink | None
    """What it transmits; None and "steady" are the same."""
    led_ids: tuple[int, ...]
    """Ids of its LEDs by index: along the columns of a panel, then its rows."""
    center_m: tuple[float, float, float]
    """Centre of its array of LEDs, world, by the map: the coordinates that packets send."""

    @property
    def modulated(self) -> bool:
        """Whether its light is not steady."""
        return self.downlink is not None and self.downlink.send != "steady"


@dataclass(frozen=True)
class Transmission:
    """What the LEDs of a scene transmit, by LED id, apart from clocks and phases."""

    codes: Mapping[int, str]
    """Code of each LED with one."""
    tones_hz: Mapping[int, float]
    """Tone of each LED with one."""
    delays: Mapping[int, int]
    """Delay of each LED with packets, chips."""
    packets: Mapping[int, str]
    """Chips of the packet of each LED with packets."""


def transmission_of(transmitters: Sequence[Transmitter]) -> Transmission:
    """What all LEDs transmit: codes and tones are given to LEDs in the order of their ids.

    LEDs whose codes have the same length share a code book. Raises ValueError, with the table in the scene file, for
    more LEDs than there are codes of their length, for a centre that packets cannot send, and for a panel of more LEDs
    than there are delays.
    """
    by_length: dict[int, list[tuple[int, Transmitter]]] = {}
    toned: list[tuple[int, Downlink]] = []
    delays: dict[int, int] = {}
    packets: dict[int, str] = {}
    for transmitter in transmitters:
        downlink = transmitter.downlink
        if downlink is None:
            continue
        if downlink.send == "code":
            by_length.setdefault(downlink.chips, []).extend((led, transmitter) for led in transmitter.led_ids)
        elif downlink.send == "tone":
            toned += [(led, downlink) for led in transmitter.led_ids]
        elif downlink.send == "packet":
            own = _delays(transmitter, downlink)
            delays |= dict(zip(transmitter.led_ids, own, strict=True))
            packets |= dict.fromkeys(transmitter.led_ids, _packet(transmitter))
    codes: dict[int, str] = {}
    for length, members in by_length.items():
        try:
            book = code_book(len(members), length)
        except ValueError as error:
            raise ValueError(f"{members[-1][1].where}.downlink.code_length = {length}: {error}; take more") from None
        ids = sorted(led for led, _ in members)
        codes |= dict(zip(ids, book, strict=True))
    tones: dict[int, float] = {led: downlink.tone_hz(0) for led, downlink in toned if downlink.frequency_hz is not None}
    counted = sorted(((led, downlink) for led, downlink in toned if led not in tones), key=lambda pair: pair[0])
    tones |= {led: downlink.tone_hz(i) for i, (led, downlink) in enumerate(counted)}
    return Transmission(codes, tones, delays, packets)


def _delays(transmitter: Transmitter, downlink: Downlink) -> tuple[int, ...]:
    count = len(transmitter.led_ids)
    if not downlink.delayed:
        return (0,) * count
    if count > CHIPS:
        raise ValueError(
            f"{transmitter.where}.downlink.delays: {count} LEDs a panel need {count} delays, and a packet has {CHIPS} "
            'chips; write delays = "common"'
        )
    return delays_chips(count)


def _packet(transmitter: Transmitter) -> str:
    try:
        return packet_chips(coordinates_mm(transmitter.center_m))
    except ValueError:
        center = ", ".join(f"{value:g}" for value in transmitter.center_m)
        raise ValueError(
            f'{transmitter.where}.downlink.send = "packet": the centre ({center}) m of the LEDs is beyond the '
            f"coordinates of packets, 0 to {MAX_COORDINATE_M:g} m; take codes"
        ) from None


def led_waves(transmitters: Sequence[Transmitter], seed: int, map_number: int = 0) -> dict[int, Wave]:
    """The wave of each LED that is not steady, by LED id, on the rig's clock from the start of the dataset, time 0.

    Clock error and phase at time 0 of each transmitter are drawn from the seed of the dataset and the number of the
    building (map); lamps on the mains share both. Codes and packets do not depend on them.
    """
    transmission = transmission_of(transmitters)
    waves: dict[int, Wave] = {}
    for transmitter in transmitters:
        downlink = transmitter.downlink
        if downlink is None or not transmitter.modulated:
            continue
        owner = "mains" if downlink.send == "mains" else transmitter.number
        generator = stream(seed, "map", map_number, "downlink clock", owner)
        error, phase = downlink.clock_sigma * float(generator.standard_normal()), float(generator.uniform())
        for led in transmitter.led_ids:
            waves[led] = _wave(downlink, led, transmission, error, phase)
    return waves


def nominal_waves(transmitters: Sequence[Transmitter]) -> dict[int, Wave]:
    """The wave of each LED that is not steady, by LED id, with an exact clock and phase 0 (a packet, by its delay)."""
    transmission = transmission_of(transmitters)
    return {
        led: _wave(transmitter.downlink, led, transmission, 0.0, 0.0)
        for transmitter in transmitters
        if transmitter.downlink is not None and transmitter.modulated
        for led in transmitter.led_ids
    }


def _wave(downlink: Downlink, led: int, transmission: Transmission, clock_error: float, phase: float) -> Wave:
    depth = downlink.modulation_depth
    wave: Wave
    if downlink.send == "code":
        wave = TwoLevelWave.of_chips(transmission.codes[led], downlink.chip_s, depth)
    elif downlink.send == "packet":
        wave = TwoLevelWave.of_chips(transmission.packets[led], downlink.chip_s, depth)
        phase = (phase - transmission.delays[led] / CHIPS) % 1.0
    elif downlink.send == "tone":
        wave = TwoLevelWave.of_pulse(transmission.tones_hz[led], downlink.lit_share, depth)
    elif downlink.send == "pwm":
        wave = TwoLevelWave.of_pulse(downlink.light_hz, downlink.lit_share, depth)
    else:
        wave = CosineWave(1 / downlink.light_hz, depth)
    return wave.started(clock_error, phase)
