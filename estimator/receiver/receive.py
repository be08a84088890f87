"""Reception: the LED images of a burst's frames, and which LEDs they are by what they send.

Codes are decoded image by image first, then over the frames of the burst. Packets are decoded panel by panel over all
frames. An image that is not clearly one LED stays without identity: a missing identity costs accuracy, a wrong one the
position.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from estimator.errors import InputError
from estimator.io.device import DecodedSpot, DeviceFrame, Identity
from estimator.io.downlink import INDEX_BITS, Codes, DiscFace, Downlink, Packets, Tones
from estimator.io.led_map import AnyLed, DiscLed, Led, Luminaire, SquareLed
from estimator.io.shared import SharedResults
from estimator.receiver.bits import bits_seen
from estimator.receiver.codes import code_books, match_code, match_code_of_frames
from estimator.receiver.packets import PacketFormat, decode_packet
from estimator.receiver.panels import find_groups, same_images
from estimator.receiver.signal import ChipWave, Floats, LedImage, PulseWave, Signal, WaveGains, led_image
from estimator.receiver.tones import ToneFit, match_tones
from estimator.spots.lamps import lamps_of
from estimator.spots.striped import Lamp

MIN_OWN_CORRELATION = 0.8
"""Correlation of an LED image with the packet of its panel, below which it is of another lamp."""
MIN_MISFIT_RATIO_CUT = 3.0
MIN_CHIPS_CUT = 20.0
"""`codes.MIN_MISFIT_RATIO` for an LED image that the border cuts, and the chips that it has to show.

Its outline is less certain, and so are its levels."""
MAX_OFF_MAP_M = 0.01
"""A packet's LED is the LED of the map within this distance."""
REFLECTED = 2.0
"""Of two LED images of one code, the one that is this many times brighter is the LED, the other its reflection."""


@dataclass(frozen=True, eq=False)
class Told:
    """LED that a packet tells: of the map, or, where the map is null, as an entry with its panel as luminaire."""

    led: int
    entry: AnyLed | None
    luminaire: Luminaire | None


@dataclass(frozen=True, eq=False)
class Reception:
    """An LED image of a frame and what was decoded from it.

    `led` is None where no identity was accepted. `wave` is what the LED sends, None where not decoded, and `told` what
    its packet told.
    """

    lamp: Lamp
    led: int | None = None
    correlation: float = 0.0
    bits: str | None = None
    wave: ChipWave | PulseWave | None = None
    told: Told | None = None

    def identity(self) -> Identity:
        """The entry of the column `identities` of estimates."""
        return Identity(
            led=self.led,
            u_px=self.lamp.u_px,
            v_px=self.lamp.v_px,
            correlation=self.correlation,
            bits=self.bits,
            position_m=None if self.told is None or self.told.entry is None else self.told.entry.position_m,
        )


def receive(frames: Sequence[DeviceFrame]) -> tuple[tuple[Reception, ...], ...]:
    """Receive what the LEDs send in the frames of one burst and camera, in the order of time.

    Parameters
    ----------
    frames
        The frames; camera, downlink and map are those of the first. Without a downlink or a rolling shutter nothing is
        received.

    Returns
    -------
    tuple
        For each frame its LED images, each with the identity that was accepted, if any. An LED is at most once in a
        frame.

    Raises
    ------
    InputError
        The frames are not in the order of time.
    """
    if any(later.start_s <= former.start_s for former, later in pairwise(frames)):
        raise InputError("frames of a burst: start_s has to increase")
    if not frames:
        return ()
    lamps = [lamps_of(frame) for frame in frames]
    return received(frames, lamps)


def received(frames: Sequence[DeviceFrame], lamps: Sequence[Sequence[Lamp]]) -> tuple[tuple[Reception, ...], ...]:
    """Reception of LED images that are found: `lamps` are those of each frame."""
    downlink = frames[0].downlink
    images = [[led_image(lamp, frame) for lamp in some] for frame, some in zip(frames, lamps, strict=True)]
    found: list[list[Reception]] = [[Reception(lamp) for lamp in some] for some in lamps]
    if downlink is None:
        return tuple(map(tuple, found))
    for (frame, number), reception in _by_codes(frames, lamps, images):
        found[frame][number] = reception
    for packets in downlink.transmitters:
        if isinstance(packets, Packets):
            left = [[one.led is None for one in some] for some in found]
            for (frame, number), reception in _by_packets(frames, lamps, images, left, packets):
                found[frame][number] = reception
    for which, one_frame in enumerate(frames):
        rest = [number for number, one in enumerate(found[which]) if one.led is None and one.lamp.striped]
        by_tones = _by_tones(one_frame, [lamps[which][n] for n in rest], [images[which][n] for n in rest])
        for number, reception in by_tones:
            found[which][rest[number]] = reception
    return tuple(tuple(_each_led_once(some)) for some in found)


Place = tuple[int, int]
"""A frame of the burst, and an LED image of it."""


def _by_codes(
    frames: Sequence[DeviceFrame], lamps: Sequence[Sequence[Lamp]], images: Sequence[Sequence[LedImage]]
) -> Iterator[tuple[Place, Reception]]:
    """LED images that are identified by their codes."""
    downlink = frames[0].downlink
    books = () if downlink is None else code_books(downlink)
    if downlink is None or not books:
        return
    clock_error = max(one.clock_error for one in downlink.transmitters if isinstance(one, Codes))
    for places in same_images(images):
        signals = [images[frame][number].signal for frame, number in places]
        alone = [
            match_code(signal, books) if lamps[f][n].striped else None
            for signal, (f, n) in zip(signals, places, strict=True)
        ]
        clear = {match.led for match in alone if match is not None and match.clear}
        matches = alone
        if len(places) > 1 and not (len(clear) == 1 and all(match is not None and match.clear for match in alone)):
            joint = match_code_of_frames(signals, books, clock_error)
            matches = [one if one is not None and one.clear else None for one in joint]
        for (frame, number), match, signal in zip(places, matches, signals, strict=True):
            if match is None or not match.clear:
                continue
            shown = float(np.ptp(signal.start_s)) / match.wave.chip_s
            uncertain = match.misfit_ratio < MIN_MISFIT_RATIO_CUT or shown < MIN_CHIPS_CUT
            if not (lamps[frame][number].touches_border and uncertain):
                bits = bits_seen(signal, match.wave)
                yield (frame, number), Reception(lamps[frame][number], match.led, match.correlation, bits, match.wave)


def _by_packets(
    frames: Sequence[DeviceFrame],
    lamps: Sequence[Sequence[Lamp]],
    images: Sequence[Sequence[LedImage]],
    left: Sequence[Sequence[bool]],
    packets: Packets,
) -> Iterator[tuple[Place, Reception]]:
    """LED images that are identified by the packets of their panels, of those that are `left` over."""
    numbers = [[n for n, one in enumerate(some) if one and lamps[f][n].striped] for f, some in enumerate(left)]
    chosen = [[images[f][n] for n in some] for f, some in enumerate(numbers)]
    form = PacketFormat(packets)
    for group in find_groups(frames, chosen, packets):
        for hypotheses in group.alike():
            laid = np.flatnonzero(hypotheses[0] >= 0)
            members = [group.members[one] for one in laid]
            signals = [[chosen[f][n].signal for f, n in enumerate(member.numbers) if n >= 0] for member in members]
            match = decode_packet(signals, [one[laid] for one in hypotheses], packets)
            if match is None or not match.clear:
                continue
            for member, index, wave in zip(members, match.indices.tolist(), match.waves, strict=True):
                told = _told(packets, form.coordinates(match.data), index, frames[0].leds)
                if told is None:
                    continue
                for f, n in enumerate(member.numbers):
                    if n >= 0:
                        number, signal = numbers[f][n], chosen[f][n].signal
                        correlation = signal.correlation(wave.gains(signal.start_s, signal.exposure_s))
                        if correlation >= MIN_OWN_CORRELATION:
                            bits = bits_seen(signal, wave)
                            yield (f, number), Reception(lamps[f][number], told.led, correlation, bits, wave, told)
            break


def _by_tones(frame: DeviceFrame, lamps: Sequence[Lamp], images: Sequence[LedImage]) -> Iterator[tuple[int, Reception]]:
    """LED images of a frame, by number, that are identified by a tone that one LED alone has."""
    if frame.downlink is None:
        return
    signals = [image.signal for image in images]
    row_time_s = frame.camera.shutter.row_time_s
    for number, match in enumerate(match_tones(signals, frame.downlink, row_time_s)):
        if match is not None and len(match.leds) == 1:
            (led,), signal = match.leds, signals[number]
            wave = pulse_wave(signal, match.fit, frame.downlink, led)
            correlation = signal.correlation(wave.gains(signal.start_s, signal.exposure_s))
            yield number, Reception(lamps[number], led, correlation, None, wave)


def pulse_wave(signal: Signal, fit: ToneFit, downlink: Downlink, led: int) -> PulseWave:
    """The wave of an LED of the downlink that sends a tone, by the fit to its signal."""
    (sent,) = (one for one in downlink.transmitters if isinstance(one, Tones) and led in one.leds)
    return PulseWave(fit.frequency_hz, sent.duty, sent.depth, float(signal.start_s[0]), fit.phase)


def _told(packets: Packets, coordinates: tuple[int, int, int], index: int, leds: Mapping[int, Led]) -> Told | None:
    """The LED that a packet tells, by its index in the panel; None where the map is given and has no LED there."""
    centre_m = np.array(coordinates) * packets.coordinate_unit_m
    position_m = centre_m + [*packets.offsets_m[index], 0.0]
    if leds:
        near = min(leds.values(), key=lambda led: float(np.linalg.norm(np.subtract(led.position_m, position_m))))
        if np.linalg.norm(np.subtract(near.position_m, position_m)) > MAX_OFF_MAP_M:
            return None
        return Told(near.id, None, None)
    panel = 0
    for value in coordinates:
        panel = (panel << packets.coordinate_bits) + value
    number = (panel << INDEX_BITS) + index
    place = _triple(position_m)
    entry: AnyLed
    if isinstance(packets.led, DiscFace):
        entry = DiscLed(id=number, position_m=place, radius_m=packets.led.radius_m, luminaire=panel)
    else:
        entry = SquareLed(id=number, position_m=place, side_m=packets.led.side_m, luminaire=panel)
    rounding_m = packets.coordinate_unit_m / np.sqrt(12)
    luminaire = Luminaire(
        id=panel,
        position_m=_triple(centre_m),
        sigma_m=(rounding_m, rounding_m, rounding_m),
        sigma_rotation_deg=(0.0, 0.0, 0.0),
    )
    return Told(number, entry, luminaire)


def _triple(values: Floats) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _each_led_once(receptions: Sequence[Reception]) -> Iterator[Reception]:
    """Receptions of one frame, each LED at most once: the brightest of several, if REFLECTED times the next."""
    by_led: dict[int, list[Reception]] = {}
    for one in receptions:
        if one.led is not None:
            by_led.setdefault(one.led, []).append(one)
    kept = set()
    for some in by_led.values():
        some.sort(key=lambda one: -one.lamp.peak_e)
        if len(some) == 1 or some[0].lamp.peak_e >= REFLECTED * some[1].lamp.peak_e:
            kept.add(id(some[0]))
    for one in receptions:
        yield one if one.led is None or id(one) in kept else Reception(one.lamp, correlation=one.correlation)


def as_received(frame: DeviceFrame, receptions: Sequence[Reception]) -> DeviceFrame:
    """The frame with decoded identities in `spots`, their gains, and the LEDs that packets told where it has no map."""
    decoded = [(one.led, one) for one in receptions if one.led is not None]
    row_time_s = frame.camera.shutter.row_time_s
    told = [one.told for _, one in decoded if one.told is not None]
    leds = frame.leds or {one.led: one.entry for one in told if one.entry is not None}
    luminaires = frame.luminaires or {one.luminaire.id: one.luminaire for one in told if one.luminaire is not None}
    return replace(
        frame,
        spots=tuple(DecodedSpot(led=led, u_px=one.lamp.u_px, v_px=one.lamp.v_px) for led, one in decoded),
        leds=leds,
        luminaires=luminaires,
        identities=tuple(one.identity() for one in receptions),
        gains={
            led: WaveGains(one.wave, frame.start_s, row_time_s, frame.exposure_s)
            for led, one in decoded
            if one.wave is not None
        },
    )


def with_identities(frame: DeviceFrame) -> DeviceFrame:
    """The frame, received by itself if its identities have to be decoded and have not been; its other cameras too."""
    others = tuple(with_identities(other) for other in frame.other_cameras)
    if others != frame.other_cameras:
        frame = replace(frame, other_cameras=others)
    asked = frame.downlink is not None and frame.downlink.demodulation == "pixels"
    if not asked or frame.identities is not None:
        return frame
    return receive_frames((replace(frame, shared=frame.shared or SharedResults()),))[0]


def receive_frames(frames: Sequence[DeviceFrame]) -> tuple[DeviceFrame, ...]:
    """Decode what the LEDs send from the pixels of a burst.

    `estimate` and `run` do this where a dataset's `demodulation` is "pixels". Call it for frames of your own that
    belong to one burst: together they show more of what is sent than one by one.

    Parameters
    ----------
    frames
        Frames of one burst and camera, in the order of time, by `read_frame` or `frame`.

    Returns
    -------
    tuple of DeviceFrame
        The frames with the decoded identities as `spots`, all LED images in `identities`, and the gains of the LEDs by
        lines in `gains`. Where the map is null, `leds` are those that packets told.

    Raises
    ------
    InputError
        The frames are not in the order of time.
    EstimationFailure
        The lens cannot be undone at an LED image.
    """
    return tuple(as_received(frame, some) for frame, some in zip(frames, receive(frames), strict=True))
