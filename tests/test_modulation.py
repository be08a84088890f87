"""What LEDs transmit: waves and their integrals, codes, packets, clocks and flicker."""

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest

from vlcrender.modulation import packet
from vlcrender.modulation.codes import MAX_PERCENT, MAX_RUN, code_book, window_chips
from vlcrender.modulation.flicker import (
    flicker,
    low_risk_percent,
    no_effect_percent,
    spectrum,
)
from vlcrender.modulation.wave import CosineWave, TwoLevelWave, Wave

CODE = "00011011001011110100101100001101"
PACKET = packet.packet_chips((4500, 3500, 3450))


def chips_at(chips: str, chip_s: float, depth: float) -> Callable[[float], float]:
    """The wave as its definition says, at a time of its own clock."""
    share = chips.count("1") / len(chips)
    lit = 1 / (share + (1 - share) * (1 - depth))
    return lambda t: lit if chips[math.floor(t / chip_s) % len(chips)] == "1" else lit * (1 - depth)


def pulse_at(frequency_hz: float, duty: float, depth: float) -> Callable[[float], float]:
    lit = 1 / (duty + (1 - duty) * (1 - depth))
    return lambda t: lit if t * frequency_hz % 1 < duty else lit * (1 - depth)


def numerical_mean(value: Callable[[float], float], start: float, duration: float) -> float:
    """Mean by the trapezoidal rule, on cells that are halved until a step in one contributes less than 1e-11.

    The first cells are shorter than every chip and pulse, so that none is missed.
    """

    def cell(a: float, b: float, at_a: float, at_b: float) -> float:
        if abs(at_b - at_a) * (b - a) < 1e-11:
            return (at_a + at_b) / 2 * (b - a)
        middle = (a + b) / 2
        at_middle = value(start + middle * duration)
        return cell(a, middle, at_a, at_middle) + cell(middle, b, at_middle, at_b)

    edges = np.linspace(0, 1, 201).tolist()
    values = [value(start + share * duration) for share in edges]
    return sum(map(cell, edges, edges[1:], values, values[1:]))


WAVES: dict[str, tuple[Wave, Callable[[float], float]]] = {
    "code": (TwoLevelWave.of_chips(CODE, 25e-6, 1.0), chips_at(CODE, 25e-6, 1.0)),
    "shallow code": (TwoLevelWave.of_chips(CODE, 25e-6, 0.4), chips_at(CODE, 25e-6, 0.4)),
    "packet": (TwoLevelWave.of_chips(PACKET, 50e-6, 1.0), chips_at(PACKET, 50e-6, 1.0)),
    "tone": (TwoLevelWave.of_pulse(1700.0, 0.5, 1.0), pulse_at(1700.0, 0.5, 1.0)),
    "pwm": (TwoLevelWave.of_pulse(1000.0, 0.13, 0.8), pulse_at(1000.0, 0.13, 0.8)),
    "mains": (CosineWave(0.01, 0.3), lambda t: 1 + 0.3 * math.cos(2 * math.pi * t / 0.01)),
}


@pytest.mark.parametrize("name", WAVES)
def test_means_of_exposures_are_those_of_a_numerical_integral(name: str, rng: np.random.Generator) -> None:
    """`numerical_mean` is off by 1e-11 at most at each of ten edges."""
    nominal, value = WAVES[name]
    error, phase = 3e-3, 0.37
    wave = nominal.started(error, phase)
    starts = rng.uniform(0, 5 * wave.period_s, 6)
    for exposure_s in (10e-6, 95e-6):
        means = wave.mean(starts, exposure_s)
        for start, mean in zip(starts.tolist(), means.tolist(), strict=True):
            own_start = start * (1 + error) + phase * nominal.period_s
            assert mean == pytest.approx(numerical_mean(value, own_start, exposure_s * (1 + error)), abs=1e-6)
        integral = wave.integral(starts + exposure_s) - wave.integral(starts)
        # integrals of up to 0.05 s have the rounding 7e-18 s
        assert integral / exposure_s == pytest.approx(means, abs=1e-10)


@pytest.mark.parametrize("name", WAVES)
def test_the_mean_over_a_period_is_1(name: str, rng: np.random.Generator) -> None:
    wave = WAVES[name][0].started(-1e-3, 0.8)
    starts = rng.uniform(0, 1, 20)
    # some ten roundings of numbers up to 127, the antiderivative over whole periods
    assert wave.mean(starts, wave.period_s) == pytest.approx(np.ones(20), abs=1e-13)
    assert wave.mean(starts, 7 * wave.period_s) == pytest.approx(np.ones(20), abs=1e-13)


def test_levels_keep_the_mean_luminance() -> None:
    """Lit 1 / (D + (1 - D) (1 - depth)), dark 1 - depth of it; a balanced full wave is lit at twice the mean."""
    assert TwoLevelWave.of_chips(CODE, 25e-6, 1.0).levels.max() == pytest.approx(2.0)
    assert TwoLevelWave.of_chips(CODE, 25e-6, 1.0).levels.min() == 0.0
    assert TwoLevelWave.of_pulse(1000.0, 0.25, 0.5).levels == pytest.approx([1.6, 0.8])


def test_a_late_start_costs_no_digits() -> None:
    """After an hour, 4.5e6 periods, the phase is rounded to 1e-9 periods: 1e-9 / (40 us / 800 us) times the level 2."""
    wave = TwoLevelWave.of_chips(CODE, 25e-6, 1.0)
    starts = np.arange(40) * 10e-6
    periods = 4_500_000
    late = wave.mean(starts + periods * wave.period_s, 40e-6)
    assert late == pytest.approx(wave.mean(starts, 40e-6), abs=4e-8)


def test_a_fast_clock_shortens_chips_and_a_phase_starts_later_chips() -> None:
    wave = TwoLevelWave.of_chips("00000001", 100e-6, 1.0).started(0.25, 0.5)
    assert wave.period_s == pytest.approx(640e-6)
    # the lit eighth of the period comes after 3/8 of a period of 640 us, for 80 us
    assert wave.mean(np.array([240e-6]), 80e-6) == pytest.approx([8.0])
    assert wave.mean(np.array([200e-6, 320e-6]), 40e-6) == pytest.approx([0.0, 0.0], abs=1e-9)
    assert wave.phase(240e-6) == pytest.approx(7 / 8)
    with pytest.raises(ValueError, match="duration_s = 0"):
        wave.mean(np.zeros(1), 0.0)


def test_bits_are_the_chips_as_sent() -> None:
    assert TwoLevelWave.of_chips(CODE, 25e-6, 0.5).bits == CODE
    assert TwoLevelWave.of_pulse(1000.0, 0.5, 1.0).bits is None
    assert CosineWave(0.01, 0.3).bits is None


@pytest.mark.parametrize("name", WAVES)
def test_the_spectrum_is_that_of_an_fft(name: str) -> None:
    """Means over N parts of a period: their FFT has sinc(k / N) of each line, and lines k + m N folded onto it.

    A wave of e edges with steps up to 8 has |c_k| <= 8 e / (2 pi k), and the factor k / (m N) of the means' sinc takes
    a folded line to below 8 e k / (2 pi m^2 N^2): for e = 126, k = 18 and N = 2^14 that is 1e-5.
    """
    wave = WAVES[name][0]
    frequencies, percents = spectrum(wave)
    parts = 1 << 14
    means = wave.mean(np.arange(parts) * wave.period_s / parts, wave.period_s / parts)
    k = np.arange(1, len(frequencies) + 1)
    lines = np.abs(np.fft.fft(means))[k] / parts / np.sinc(k / parts)
    assert frequencies == pytest.approx(k / wave.period_s)
    assert percents == pytest.approx(200 * lines, abs=200 * 1e-5)


def test_a_square_wave_has_its_first_line_alone_below_3_khz() -> None:
    frequencies, percents = spectrum(TwoLevelWave.of_pulse(1700.0, 0.5, 1.0))
    assert frequencies.tolist() == [pytest.approx(1700.0)]
    assert percents.tolist() == [pytest.approx(400 / math.pi)]


def test_limits_of_ieee_1789() -> None:
    frequencies = np.array([60.0, 100.0, 1250.0, 1251.0, 3000.0, 3001.0])
    assert low_risk_percent(frequencies) == pytest.approx([1.5, 8.0, 100.0, math.inf, math.inf, math.inf])
    assert no_effect_percent(frequencies) == pytest.approx([0.6, 3.33, 41.625, 41.6583, 99.9, math.inf])


def test_a_line_exactly_at_the_end_of_a_limit_counts() -> None:
    worst = flicker(TwoLevelWave.of_chips("01" * 16, 25e-6, 1.0).started(0.0, 0.3))
    assert worst.no_effect.share < 1e-12  # its first line is at 20 kHz
    line = flicker(TwoLevelWave.of_chips(CODE, 25e-6, 1.0)).low_risk
    assert (line.frequency_hz, line.limit_percent) == (pytest.approx(1250.0), pytest.approx(100.0))


# codes


@pytest.mark.parametrize(("count", "length"), [(1225, 32), (25, 16), (300, 64)])
def test_codes_are_balanced_without_long_runs_and_distinct(count: int, length: int) -> None:
    book = code_book(count, length)
    assert len(book) == count
    smallest = set()
    for code in book:
        assert len(code) == length
        assert code.count("1") == length // 2
        assert "0" * (MAX_RUN + 1) not in code * 2
        assert "1" * (MAX_RUN + 1) not in code * 2
        smallest.add(min(code[i:] + code[:i] for i in range(length)))
    assert len(smallest) == count


def test_no_part_of_window_chips_is_in_two_places_of_a_book() -> None:
    book, window = code_book(1225, 32), window_chips(1225, 32)
    assert window == 20
    parts = [(code * 2)[i : i + window] for code in book for i in range(32)]
    assert len(set(parts)) == len(parts) == 1225 * 32
    shorter = [part[:12] for part in parts]
    assert len(set(shorter)) < len(shorter)


def test_codes_flicker_little_at_their_repetition_rate() -> None:
    """By the definition of the first harmonic, in place of the wave's own."""
    turns = np.exp(-2j * np.pi * (np.arange(32) + 0.5) / 32) * np.sinc(1 / 32)
    for code in code_book(1225, 32):
        chips = np.array([float(chip) for chip in code])
        assert 200 * abs(chips @ turns) / 32 / chips.mean() <= MAX_PERCENT + 1e-9


def test_more_leds_than_codes_is_refused() -> None:
    with pytest.raises(ValueError, match=r"codes of 12 chips for 200 LEDs"):
        code_book(200, 12)


# packets


def syndromes() -> list[int]:
    """What an error of each of the 56 bits alone changes in the check of a packet, as numbers."""
    count = packet.DATA_BITS + packet.CRC_BITS
    found = []
    for place in range(count):
        bits = np.zeros(count, dtype=np.int64)
        bits[place] = 1
        check_bits = packet.crc16(bits[: packet.DATA_BITS]) ^ bits[packet.DATA_BITS :]
        found.append(int("".join(map(str, check_bits.tolist())), 2))
    return found


def least_undetected() -> int:
    """Smallest number of bit errors, up to 6, that the CRC does not detect: they sum to a syndrome of 0."""
    single = np.array(syndromes())
    pairs = np.array(list(itertools.combinations(range(len(single)), 2)))
    sums = single[pairs[:, 0]] ^ single[pairs[:, 1]]
    if len(set(single.tolist())) < len(single):
        return 2
    if np.isin(sums, single).any():
        return 3
    if len(np.unique(sums)) < len(sums):
        return 4
    triples = {0}
    for k in range(len(single)):
        apart = (pairs != k).all(axis=1) & (pairs[:, 1] < k)
        more = (sums[apart] ^ single[k]).tolist()
        # a triple that equals a pair: 5 errors, or 3 or 1 where they share places, which is excluded above
        if np.isin(more, sums).any():
            return 5
        if not triples.isdisjoint(more) or len(set(more)) < len(more):
            return 6
        triples.update(more)
    return 7


def test_the_crc_detects_every_error_of_up_to_5_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    """All 4.2 million patterns of up to 5 of 56 bits, by sums of syndromes: the CRC is linear."""
    assert least_undetected() == 6
    for weaker in (0x1021, 0x8005):
        monkeypatch.setattr(packet, "POLYNOMIAL", weaker)
        assert least_undetected() == 4


def test_the_crc_is_that_of_en_13757() -> None:
    """Check value of CRC-16/EN-13757, same polynomial, bit order and start, which complements its result: 0xC2B7."""
    bits = np.unpackbits(np.frombuffer(b"123456789", dtype=np.uint8)).astype(np.int64)
    assert int("".join(map(str, packet.crc16(bits).tolist())), 2) ^ 0xFFFF == 0xC2B7


def test_packets_come_back(rng: np.random.Generator) -> None:
    for mm in [(0, 0, 0), (8191, 8191, 8191), *(tuple(row) for row in rng.integers(0, 8192, (50, 3)).tolist())]:
        chips = packet.packet_chips(mm)
        assert len(chips) == packet.CHIPS == 126
        assert chips.count("1") == 63
        assert max(len(list(run)) for _, run in itertools.groupby(chips * 2)) <= MAX_RUN
        assert packet.decode_chips(chips) == mm


def test_a_packet_with_wrong_chips_is_none() -> None:
    for place in range(packet.CHIPS):
        wrong = PACKET[:place] + "10"[int(PACKET[place])] + PACKET[place + 1 :]
        assert packet.decode_chips(wrong) is None
    for bit in range(packet.DATA_BITS + packet.CRC_BITS):
        place = len(packet.PREAMBLE) + 2 * bit
        flipped = PACKET[:place] + PACKET[place : place + 2][::-1] + PACKET[place + 2 :]
        assert packet.decode_chips(flipped) is None
    assert packet.decode_chips(PACKET[1:] + PACKET[:1]) is None
    data = np.zeros(packet.DATA_BITS, dtype=np.int64)
    data[-1] = 1  # the spare bit, with a CRC that is right
    bits = np.concatenate([data, packet.crc16(data)])
    assert packet.decode_chips(packet.PREAMBLE + "".join("10" if bit else "01" for bit in bits)) is None


def test_the_preamble_is_in_no_stretch_of_manchester_code() -> None:
    """It is balanced, has no run above 3, and differs in 2 chips or more from each 14 chips of such code."""
    preamble = np.array([int(chip) for chip in packet.PREAMBLE])
    assert preamble.sum() == 7
    for data in range(2**8):
        bits = [data >> i & 1 for i in range(8)]
        chips = np.array([chip for bit in bits for chip in (bit, 1 - bit)])
        for start in (0, 1):
            assert (chips[start : start + 14] != preamble).sum() >= 2


def test_delays_tell_leds_apart_and_no_shift_of_the_array_is_a_later_start() -> None:
    delays = np.array(packet.delays_chips(25)).reshape(5, 5)
    assert sorted((delays // packet.DELAY_CHIPS).ravel().tolist()) == list(range(25))
    for rows, columns in itertools.product(range(-3, 4), repeat=2):
        if (rows, columns) == (0, 0):
            continue
        here = delays[max(0, -rows) : 5 - max(0, rows), max(0, -columns) : 5 - max(0, columns)]
        there = delays[max(0, rows) : 5 + min(0, rows), max(0, columns) : 5 + min(0, columns)]
        assert len(np.unique((there - here) % packet.CHIPS)) > 1
