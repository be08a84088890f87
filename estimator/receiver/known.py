"""Gains of LEDs whose identities are handed over: the wave of each is known, its phase follows from its lines.

A code is searched for its phase alone, a tone for its phase and its clock's error. A packet is decoded as from pixels
alone, and has to tell the LED that was handed over. An LED whose wave is not clear has no gains.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.io.downlink import Downlink, Packets
from estimator.receiver.codes import code_books, match_phase
from estimator.receiver.receive import pulse_wave, received
from estimator.receiver.signal import ChipWave, PulseWave, WaveGains, signal_of
from estimator.receiver.tones import match_tones
from estimator.spots.identify import gate_px, identify
from estimator.spots.lamps import has_stripes, lamps_of
from estimator.spots.striped import Lamp


def with_known_gains(frame: DeviceFrame) -> DeviceFrame:
    """The frame with the gains of the LEDs that `spots` names, where their identities are handed over.

    A frame whose identities are decoded has its gains by that, and LEDs have no stripes under a global shutter: both
    are returned as they are.
    """
    downlink = frame.downlink
    if downlink is None or not has_stripes(frame) or downlink.demodulation != "given":
        return frame
    row_time_s = frame.camera.shutter.row_time_s
    return replace(
        frame,
        gains={
            led: WaveGains(wave, frame.start_s, row_time_s, frame.exposure_s)
            for led, wave in _waves(frame, downlink, _lamps_of_leds(frame))
        },
    )


def _lamps_of_leds(frame: DeviceFrame) -> dict[int, Lamp]:
    """The striped LED image of each LED that `spots` names, by id."""
    lamps = lamps_of(frame)
    spots = [lamp.spot() for lamp in lamps]
    try:
        found = identify(spots, frame.spots, frame.leds, gate_px(frame.camera.width_px))
    except EstimationFailure:
        return {}
    of_led = {one.led.id: lamps[spots.index(one.spot)] for one in found}
    return {led: lamp for led, lamp in of_led.items() if lamp.striped}


def _waves(
    frame: DeviceFrame, downlink: Downlink, lamps: Mapping[int, Lamp]
) -> Iterator[tuple[int, ChipWave | PulseWave]]:
    """LEDs, by id, and their waves."""
    signals = {led: signal_of(lamp, frame) for led, lamp in lamps.items()}
    for book in code_books(downlink):
        for led in signals.keys() & set(book.leds.tolist()):
            match = match_phase(signals[led], book, led)
            if match is not None and match.clear:
                yield led, match.wave
    tones = match_tones(list(signals.values()), downlink, frame.camera.shutter.row_time_s)
    for (led, signal), tone in zip(signals.items(), tones, strict=True):
        if tone is not None and led in tone.leds:
            yield led, pulse_wave(signal, tone.fit, downlink, led)
    packets = tuple(one for one in downlink.transmitters if isinstance(one, Packets))
    if packets:
        alone = replace(frame, downlink=downlink.model_copy(update={"transmitters": packets}))
        (receptions,) = received([alone], [list(lamps.values())])
        for led, reception in zip(lamps, receptions, strict=True):
            if reception.led == led and reception.wave is not None:
                yield led, reception.wave
