"""Receiver: codes, packets and panels from LED images with noise, made apart from the receiver's own waves."""

from dataclasses import replace
from math import sqrt

import numpy as np
import pytest
from downlink_signals import (
    EXPOSURE_S,
    PACKETS,
    ROW_TIME_S,
    Sent,
    balanced_codes,
    code_downlink,
    led_image,
    packet_chips,
    remainder,
)

from estimator.receiver.bits import NOT_SEEN, bit_error_rates, bits_seen, chip_levels
from estimator.receiver.codes import MIN_CORRELATION, PHASES, code_books, match_code, match_code_of_frames, match_phase
from estimator.receiver.packets import MAX_ERASED, PacketFormat, crc, solved_mod_2
from estimator.receiver.signal import ChipWave, PulseWave, Signal, WaveGains, folded, overlaps

CHIP_S = 25e-6
CODES = balanced_codes(200, 32, np.random.default_rng(5))
BOOKS = code_books(code_downlink(CODES))


def sent(led: int, generator: np.random.Generator) -> Sent:
    return Sent(CODES[led - 100], CHIP_S * (1 + 1e-4 * generator.normal()), 32 * generator.random())


def wave_of(chips: str, chip_s: float, at_s: float, phase: float, depth: float = 1.0) -> ChipWave:
    return ChipWave(np.array(list(map(int, chips))), chip_s, depth, at_s, phase)


@pytest.mark.parametrize("depth", [1.0, 0.3])
def test_a_decoded_wave_has_the_means_of_the_one_that_was_sent(depth: float) -> None:
    """Against the midpoint rule of 400 steps: a switch is misplaced by half a step at most, of levels up to 2."""
    starts_s = 0.7 + np.random.default_rng(1).uniform(0, 1e-3, 200)
    told = wave_of(CODES[3], CHIP_S, 0.7, 0.7 / CHIP_S % 32 + 5.3, depth).gains(starts_s, EXPOSURE_S)
    true = Sent(CODES[3], CHIP_S, 5.3, depth).gains(starts_s)
    switches = np.ceil(EXPOSURE_S / CHIP_S) + 1
    assert np.abs(told - true).max() < switches * 2 / 800
    assert wave_of(CODES[3], CHIP_S, 0.0, 0.0, depth).gains(starts_s, 32 * CHIP_S) == pytest.approx(1)


def test_gains_at_the_lines_of_a_frame() -> None:
    wave = wave_of(CODES[0], CHIP_S, 2.0, 1.0)
    gains = WaveGains(wave, 2.5, ROW_TIME_S, EXPOSURE_S)
    lines = np.array([0, 7, 2999])
    assert gains(lines) == pytest.approx(wave.gains(2.5 + lines * ROW_TIME_S, EXPOSURE_S))
    later = WaveGains(wave, 2.5 + 60e-6, ROW_TIME_S, EXPOSURE_S)
    assert later(lines) == pytest.approx(gains.advanced(60e-6)(lines))
    assert np.abs(later(lines) - gains(lines)).max() > 0.5


@pytest.mark.parametrize(("duty", "depth"), [(0.5, 1.0), (0.2, 0.6)])
def test_a_square_wave_by_the_midpoint_rule(duty: float, depth: float) -> None:
    starts_s = 0.3 + np.random.default_rng(1).uniform(0, 1e-2, 50)
    told = PulseWave(2100.0, duty, depth, 0.3, 0.4).gains(starts_s, EXPOSURE_S)
    chips = "1" * round(10 * duty) + "0" * round(10 - 10 * duty)
    true = Sent(chips, 1 / 21000, 4 - 0.3 * 21000, depth).gains(starts_s)
    assert np.abs(told - true).max() < 2 * 5 / 800


def test_overlaps_of_lines_with_chips_by_hand() -> None:
    """Lines of 1.5 chips that start at 0.75, 1.75 and 5.25 chips, folded with a period of 3."""
    signal = Signal(np.array([4.0, 5.0, 8.5]), 1.5, np.ones(3), np.ones(3))
    shares = overlaps(signal, 1.0, 0.75)
    third = 1 / 1.5
    expected = np.zeros((3, 7))
    expected[0, :3] = [0.25 * third, third, 0.25 * third]
    expected[1, 1:4] = [0.25 * third, third, 0.25 * third]
    expected[2, 5:] = [0.75 * third, 0.75 * third]
    assert shares == pytest.approx(expected)
    assert folded(shares, 3) == pytest.approx(
        expected[:, :3] + np.pad(expected[:, 3:6], 0) + [[0, 0, 0], [0, 0, 0], [0.5, 0, 0]]
    )


def test_the_matched_filters_give_the_correlations_of_the_waves() -> None:
    """The fast tables against the correlation of each hypothesis by itself; single precision, normal noise."""
    generator = np.random.default_rng(2)
    signal = led_image(sent(150, generator), generator).signal
    (book,) = BOOKS
    table = book.correlations(signal)
    for row, place in ((0, 0), (50, 17), (50, 100), (199, 127)):
        gains = book.wave(row, place / PHASES, float(signal.start_s[0])).gains(signal.start_s, EXPOSURE_S)
        assert table[row, place] == pytest.approx(signal.correlation(gains), abs=1e-4)


@pytest.mark.slow
def test_leds_are_identified_by_their_codes() -> None:
    """86 lines, 34 chips: every code is seen whole. All of 40 right, and the decoded wave is the one sent.

    Its phase is good to the noise of a line over its slope, 0.03 of the level in a rise over 4 lines, by some 16
    switches: well below a line, of 0.4 chips. A quarter of it changes a gain of a line in a rise by 2 * 0.1 / 1.6.
    """
    generator = np.random.default_rng(3)
    for _ in range(40):
        led = int(generator.integers(100, 300))
        one = sent(led, generator)
        signal = led_image(one, generator).signal
        match = match_code(signal, BOOKS)
        assert match is not None
        assert match.clear
        assert match.led == led
        assert np.abs(match.wave.gains(signal.start_s, EXPOSURE_S) - one.gains(signal.start_s)).max() < 0.125


def test_a_steady_led_and_one_without_a_code_of_the_book_are_not_identified() -> None:
    generator = np.random.default_rng(4)
    others = balanced_codes(15, 32, np.random.default_rng(6))
    for chips in others:
        strange = Sent(chips, CHIP_S, 32 * generator.random())
        match = match_code(led_image(strange, generator).signal, BOOKS)
        assert match is None or not match.clear
        match = match_code(led_image(None, generator, radii_px=(20.0, 20.0)).signal, BOOKS)
        assert match is None or not match.clear


def test_two_codes_that_differ_by_less_than_a_line_may_err_are_not_told_apart() -> None:
    """37 lines show 16 chips that two codes have in common; the last one sees a sixteenth of the next, which differs.

    Without noise the right code fits exactly. The other one is off by 2 / 16 of the mean in one of 37 lines, which
    have a standard deviation of about 0.8: a misfit of 0.0007. An envelope that errs by 2 % could make as much.
    """
    same = "1010011011000101"
    codes = (same + "0110011010100101", same + "1001011010010110")
    wave = wave_of(codes[0], CHIP_S, 1.0, 0.1)
    starts_s = 1.0 + np.arange(37) * ROW_TIME_S
    signal = Signal(starts_s, EXPOSURE_S, wave.gains(starts_s, EXPOSURE_S), np.ones(37))
    match = match_code(signal, code_books(code_downlink(codes)))
    assert match is not None
    assert match.led == 100
    assert match.misfit_ratio > 1.5
    assert 0 < match.misfit_difference < 0.003
    assert not match.clear
    longer_s = 1.0 + np.arange(45) * ROW_TIME_S
    longer = Signal(longer_s, EXPOSURE_S, wave.gains(longer_s, EXPOSURE_S), np.ones(45))
    match = match_code(longer, code_books(code_downlink(codes)))
    assert match is not None
    assert match.led == 100
    assert match.clear


def test_too_few_lines_are_no_signal() -> None:
    generator = np.random.default_rng(4)
    image = led_image(sent(100, generator), generator, radii_px=(3.0, 3.0))
    assert match_code(image.signal, BOOKS) is None
    constant = Signal(np.arange(20) * 1e-5, EXPOSURE_S, np.full(20, 5.0), np.ones(20))
    assert match_code(constant, BOOKS) is None
    assert match_code_of_frames([constant, image.signal], BOOKS, 1e-4) == [None, None]


def test_a_known_code_needs_fewer_lines_than_an_unknown_one() -> None:
    """Images of 36 lines, 16 chips of 32: the phases of one code are fewer than those of 200. None is wrong by more
    than a tenth of the 40 us of exposure, which moves gains by 2 levels.
    """
    generator = np.random.default_rng(21)
    known = unknown = 0
    for _ in range(20):
        led = int(generator.integers(100, 300))
        one = sent(led, generator)
        signal = led_image(one, generator, radii_px=(20.0, 20.0)).signal
        match, among_all = match_phase(signal, BOOKS[0], led), match_code(signal, BOOKS)
        assert match is not None
        unknown += among_all is not None and among_all.clear
        if match.clear:
            known += 1
            off = match.wave.gains(signal.start_s, EXPOSURE_S) - one.gains(signal.start_s)
            assert np.abs(off).max() < 2 / 10
    assert known >= 19
    assert unknown < known


@pytest.mark.slow
def test_a_few_dim_chips_that_fit_at_two_phases_tell_none() -> None:
    """Images of 14 and 16 lines with 10 electrons a pixel show 7 chips of 32 or so: some fit a wrong phase with a
    correlation of 0.9 and more, and the right one nearly as well. Of those that are clear none is wrong.
    """
    generator = np.random.default_rng(23)
    clear = wrong = 0
    for _ in range(300):
        led = int(generator.integers(100, 300))
        one = sent(led, generator)
        signal = led_image(one, generator, radii_px=(7.5, 7.5), electrons=10.0).signal
        match = match_phase(signal, BOOKS[0], led)
        assert match is not None
        off = np.abs(match.wave.gains(signal.start_s, EXPOSURE_S) - one.gains(signal.start_s)).max() > 0.5
        clear += match.clear
        wrong += match.correlation >= MIN_CORRELATION and off
        assert not (match.clear and off)
    assert clear > 200
    assert wrong > 0


def test_a_code_that_an_led_does_not_send_has_no_clear_phase() -> None:
    generator = np.random.default_rng(22)
    for _ in range(20):
        signal = led_image(sent(100, generator), generator, radii_px=(30.0, 30.0)).signal
        match = match_phase(signal, BOOKS[0], int(generator.integers(101, 300)))
        assert match is not None
        assert not match.clear
    constant = Signal(np.arange(20) * 1e-5, EXPOSURE_S, np.full(20, 5.0), np.ones(20))
    assert match_phase(constant, BOOKS[0], 100) is None
    assert match_phase(led_image(None, generator, radii_px=(3.0, 3.0)).signal, BOOKS[0], 100) is None


@pytest.mark.slow
def test_frames_of_a_burst_tell_together_what_one_alone_does_not() -> None:
    """Images of 26 lines, 10 chips of 32: 33 ms later the clock has gone on by 1333 chips and other ones are seen.

    Of 20 LEDs more than twice as many are identified by two frames together as by the first alone, none wrong.
    """
    generator = np.random.default_rng(8)
    alone = together = 0
    for _ in range(20):
        led = int(generator.integers(100, 300))
        one = sent(led, generator)
        signals = [
            led_image(one, generator, radii_px=(14.0, 14.0), start_s=3.0 + later).signal for later in (0.0, 1 / 30)
        ]
        first = match_code(signals[0], BOOKS)
        joint = match_code_of_frames(signals, BOOKS, 1e-4)
        assert all(match is not None for match in joint)
        alone += first is not None and first.clear and first.led == led
        for match, signal in zip(joint, signals, strict=True):
            if match is not None and match.clear:
                assert match.led == led
                # A phase of the other frame would be chips off.
                assert signal.correlation(match.wave.gains(signal.start_s, EXPOSURE_S)) > 0.97
        together += joint[0] is not None and joint[0].clear
    assert together > 2 * alone > 0


def test_bits_are_the_chips_as_they_were_sent() -> None:
    """At 800 e a pixel a chip has errors of some 2 %: none is wrong. 34 chips in view of 32: all are seen."""
    generator = np.random.default_rng(9)
    one = sent(123, generator)
    signal = led_image(one, generator, radii_px=(60.0, 60.0)).signal
    match = match_code(signal, BOOKS)
    assert match is not None
    assert bits_seen(signal, match.wave) == CODES[23]
    short = led_image(one, generator, radii_px=(25.0, 25.0)).signal
    seen = bits_seen(short, wave_of(CODES[23], one.chip_s, 0.0, one.phase))
    assert 12 <= 32 - seen.count(NOT_SEEN) < 24
    assert all(a in (b, NOT_SEEN) for a, b in zip(seen, CODES[23], strict=True))


@pytest.mark.slow
@pytest.mark.parametrize(("ratio", "electrons"), [(0.4, 0.2), (1.3, 0.2), (1.0, 1.0)])
def test_bit_errors_are_those_of_theory(ratio: float, electrons: float) -> None:
    """`BER = Q(1 / sqrt(v))` for the levels of chips by least squares, in dim light; 3 standard deviations.

    5000 bits in Manchester code; exposure over chip is `ratio`; 5 lines a chip, 60 px a line, 3 e of read noise, which
    is normal and most of the variance. Every third bit is judged: neighbours share noise, these hardly any.
    """
    generator = np.random.default_rng(11)
    lines, chip_s = 250, 5 * ROW_TIME_S
    wrong = total = 0
    expected = spread = 0.0
    while total < 5000:
        bits = generator.integers(0, 2, 40)
        chips = np.column_stack([bits, 1 - bits]).ravel()
        phase = generator.random()
        bright_e = np.full(lines, 60 * 2 * electrons)
        empty = Signal(np.arange(lines) * ROW_TIME_S, ratio * chip_s, np.zeros(lines), 1 / (bright_e / 2 + 540))
        shares = overlaps(empty, chip_s, phase)
        light_e = bright_e * (shares @ chips[: shares.shape[1]])
        level = (generator.poisson(light_e) + sqrt(540) * generator.normal(size=lines)) / bright_e
        levels, _ = chip_levels(replace(empty, level=level), chip_s, phase)
        firsts = np.arange(4, shares.shape[1] - 5, 6)
        rates = bit_error_rates(shares, bright_e, bright_e / 2 + 540, light_e + 540, firsts)
        wrong += int(((levels[firsts] > levels[firsts + 1]) != (chips[firsts] == 1)).sum())
        total += len(firsts)
        expected += float(rates.sum())
        spread += float((rates * (1 - rates)).sum())
    assert abs(wrong - expected) < 3 * sqrt(spread)


def test_the_theory_of_one_bit_by_hand() -> None:
    """One line a chip, exposed for it alone: the difference of two levels has the variance 2 s^2 / E^2 = 1."""
    noise_e2 = np.full(2, 50.0)
    rates = bit_error_rates(np.eye(2), np.full(2, 10.0), noise_e2, noise_e2, np.array([0]))
    assert rates == pytest.approx([0.158655], rel=1e-4)


def test_the_crc_is_the_remainder_of_a_division() -> None:
    generator = np.random.default_rng(1)
    for _ in range(20):
        bits = generator.integers(0, 2, 40)
        text = "".join(map(str, bits))
        assert "".join(map(str, crc(bits, 0x3D65))) == remainder(text, 0x3D65)


FORM = PacketFormat(PACKETS)


def test_a_packet_is_read_as_it_was_made() -> None:
    chips = np.array(list(map(int, packet_chips(3500, 2500, 3450))))
    data = FORM.data(2.0 * chips - 1, np.zeros(56, dtype=bool))
    assert data is not None
    assert FORM.coordinates(data) == (3500, 2500, 3450)
    assert np.array_equal(FORM.chips(data), chips)
    likeness = FORM.likeness(2.0 * np.roll(chips, 31) - 1)
    assert int(np.argmax(likeness)) == 31
    # at a packet's start all chips of the preamble agree, and each bit counts one: its two chips differ by 2, halved
    bits = (FORM.length - len(FORM.preamble)) / 2
    assert likeness[31] == pytest.approx(len(FORM.preamble) + bits)
    # steady light is as unlike as can be in each bit, and half of the balanced preamble's chips agree with it
    np.testing.assert_allclose(FORM.likeness(np.ones(FORM.length)), -bits)


def test_erasures_follow_from_the_crc_and_errors_do_not() -> None:
    """The code's distance is 6: any 5 erasures have one solution. A wrong bit is noticed, and never corrected."""
    generator = np.random.default_rng(2)
    soft = 2.0 * np.array(list(map(int, packet_chips(3500, 2500, 3450)))) - 1
    for _ in range(30):
        erased = np.zeros(56, dtype=bool)
        erased[generator.choice(56, min(5, MAX_ERASED), replace=False)] = True
        noisy = soft.copy()
        noisy[14:].reshape(-1, 2)[erased] = generator.normal(0, 0.1, (erased.sum(), 2))
        data = FORM.data(noisy, erased)
        assert data is not None
        assert FORM.coordinates(data) == (3500, 2500, 3450)
        wrong = int(generator.choice(np.flatnonzero(~erased)))
        noisy[14:].reshape(-1, 2)[wrong] *= -1
        found = FORM.data(noisy, np.zeros(56, dtype=bool))
        assert found is None
    assert FORM.data(soft, np.arange(56) < MAX_ERASED + 1) is None


def test_equations_modulo_2() -> None:
    matrix = np.array([[1, 1], [0, 1], [1, 0]])
    assert solved_mod_2(matrix, np.array([1, 1, 0])) is not None
    assert solved_mod_2(matrix, np.array([1, 1, 0])).tolist() == [0, 1]  # type: ignore[union-attr]
    assert solved_mod_2(matrix, np.array([1, 1, 1])) is None
    assert solved_mod_2(matrix[:1], np.array([1])) is None
