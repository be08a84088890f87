"""Packets: the coordinates that the LEDs of a panel send, from all LEDs and all frames of a burst in one fit.

An LED image shows a few bits of a packet; those of a panel, each delayed by its index, show all of it. The chips of
one period are the unknowns of a linear least-squares fit to the lines of all LED images, by their times. Which LED of
the panel each image is enters through the delays: each way to lay the images over the panel is a hypothesis. A packet
starts where preamble and Manchester code fit best. At most MAX_CHECKED hypotheses are checked by CRC, as each has a
chance of 2^-17 to pass, and the packet has to explain MIN_EXPLAINED of the lines' light.

Bits that no line shows are erasures. Up to MAX_ERASED of them follow from the CRC, which then checks the less: the
packet has to explain MIN_EXPLAINED_ERASED, and chips that several LED images show have to check the rest. A wrong
hypothesis has two such chips agree with a chance of a half or less. No bit that was read is corrected.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estimator.io.downlink import CRC_BITS, Packets
from estimator.receiver.signal import ChipWave, Floats, Ints, Signal

MAX_CHECKED = 8
STARTS_CHECKED = 3
"""Starts of the packet that are candidates of each hypothesis."""
MIN_EXPLAINED = 0.7
MAX_ERASED = 6
MIN_EXPLAINED_ERASED = 0.9
CHIPS_PER_ERASED = 2
"""Chips that several LED images show, needed for each erasure."""
SEEN_SHARE = 0.2
"""An LED image shows a chip if it weighs this share of the image's best one."""
MIN_SHOWN = 0.3
"""A bit of which the lines show less than this share of the prior's variance is an erasure; one half shows 0.5."""
MIN_MISFIT_RATIO = 1.5
"""The misfit of the packet with the images laid over the panel otherwise has to be this many times the best one's."""
BRIGHT_PERCENTILE = 96.0
"""Percentile of an LED image's levels that is taken as the level of a bright chip."""
PHASES = 8
RIDGE = 0.02
"""Weight of the prior that a chip is of the mean level, in units of the mean weight of a chip."""
CLOCK_SIGMAS = 3.0
CLOCK_STEP_CHIPS = 0.3
"""Clock errors that move chips by less than this, from the first to the last line, are not told apart."""

Bits = NDArray[np.int64]


def crc(bits: Bits, polynomial: int) -> Bits:
    """CRC (16,) of bits (n,), first bit first, by a register of 16 bits that starts at 0."""
    register, mask = 0, 2**CRC_BITS - 1
    for bit in bits.tolist():
        feedback = (register >> (CRC_BITS - 1)) ^ bit
        register = ((register << 1) & mask) ^ (polynomial if feedback else 0)
    return np.array([(register >> place) & 1 for place in range(CRC_BITS - 1, -1, -1)])


@dataclass(frozen=True)
class PacketFormat:
    """How a packet's chips are read and made, by the entry of dataset.json."""

    packets: Packets

    @cached_property
    def preamble(self) -> Ints:
        """Chips (n,) before the bits."""
        return np.array(list(map(int, self.packets.preamble)), dtype=np.int64)

    @property
    def length(self) -> int:
        """Chips of a packet."""
        return self.packets.length

    @property
    def bits(self) -> int:
        """Bits of a packet: data and CRC."""
        return self.packets.data_bits + CRC_BITS

    def chips(self, data: Bits) -> Ints:
        """All chips (length,) of a packet with these data bits (3 coordinates and a 0)."""
        bits = np.concatenate([data, crc(data, self.packets.polynomial)])
        return np.concatenate([self.preamble, np.column_stack([bits, 1 - bits]).ravel()])

    @cached_property
    def checks(self) -> Bits:
        """Parity checks (17, bits): those of the CRC, and the bit 0 after the coordinates."""
        count = self.packets.data_bits
        ones = np.eye(count, dtype=np.int64)
        of_crc = np.column_stack(
            [*(crc(one, self.packets.polynomial) for one in ones), np.eye(CRC_BITS, dtype=np.int64)]
        )
        return np.vstack([of_crc, np.concatenate([ones[-1], np.zeros(CRC_BITS, dtype=np.int64)])])

    def data(self, soft: Floats, erased: NDArray[np.bool_]) -> Bits | None:
        """Data bits of chips (length,) that are above 0 where bright; None where the checks do not fit.

        Bits that are `erased` (bits,) are those with which the checks fit; None if several would.
        """
        halves = soft[len(self.preamble) :].reshape(-1, 2)
        bits = ((halves[:, 0] > halves[:, 1]) & ~erased).astype(np.int64)
        missing = np.flatnonzero(erased)
        if len(missing) > MAX_ERASED:
            return None
        filled = solved_mod_2(self.checks[:, missing], self.checks @ bits % 2)
        if filled is None:
            return None
        bits[missing] = filled
        return bits[:-CRC_BITS]

    def coordinates(self, data: Bits) -> tuple[int, int, int]:
        """Centre of the panel by a packet's data bits, x, y, z in units of `coordinate_unit_m`."""
        x, y, z = (data[:-1].reshape(3, -1) @ (1 << np.arange(self.packets.coordinate_bits)[::-1])).tolist()
        return x, y, z

    def likeness(self, soft: Floats) -> Floats:
        """How much chips (length,), -1 to 1, look like a packet that starts at each of them, (length,)."""
        place = np.arange(self.length)
        turned = soft[(place[:, None] + place) % self.length]
        halves = turned[:, len(self.preamble) :].reshape(self.length, -1, 2)
        manchester = np.abs(halves[..., 0] - halves[..., 1]) - np.abs(halves[..., 0] + halves[..., 1])
        return np.asarray(turned[:, : len(self.preamble)] @ (2 * self.preamble - 1) + manchester.sum(axis=1) / 2)


def solved_mod_2(matrix: Bits, right: Bits) -> Bits | None:
    """The only solution x (n,) of matrix (m, n) x = right (m,) modulo 2; None if there is none, or more than one."""
    rows = np.column_stack([matrix, right])
    count = matrix.shape[1]
    for column in range(count):
        pivots = column + np.flatnonzero(rows[column:, column])
        if not len(pivots):
            return None
        rows[[column, pivots[0]]] = rows[[pivots[0], column]]
        others = rows[:, column].astype(bool)
        others[column] = False
        rows[others] ^= rows[column]
    return None if rows[count:, -1].any() else rows[:count, -1]


@dataclass(frozen=True, eq=False)
class PacketMatch:
    """A packet that a panel's LED images agree with: its data bits, the share of the light that it explains, and waves.

    `erased` counts the bits that no line shows. `indices` (images,) is the index in the panel of each LED image.
    `misfit_ratio` is the misfit of the best other way to lay the images over the panel, over that of this one.
    """

    data: Bits
    explained: float
    erased: int
    misfit_ratio: float
    indices: Ints
    waves: tuple[ChipWave, ...]

    @property
    def clear(self) -> bool:
        """Whether it is known which LED of the panel each image is."""
        return self.misfit_ratio >= MIN_MISFIT_RATIO


@dataclass(frozen=True, eq=False)
class _Fit:
    """Sums of a least-squares fit of the chips of one period: normal matrix, right side, and square of the levels."""

    normal: Floats
    right: Floats
    square: float
    shown: Ints
    """LED images that show each chip, (n,)."""

    def turned(self, chips: int) -> "_Fit":
        """The sums where the signal had started `chips` chips later."""
        normal = np.roll(self.normal, (-chips, -chips), axis=(0, 1))
        return _Fit(normal, np.roll(self.right, -chips), self.square, np.roll(self.shown, -chips))

    def of_one_image(self) -> "_Fit":
        """The sums of one LED image's frames, in which it shows each chip at most once."""
        weights = np.diag(self.normal)
        return replace(self, shown=(weights > SEEN_SHARE * weights.max(initial=0.0)).astype(np.int64))

    @property
    def redundancy(self) -> int:
        """Chips shown by a further LED image."""
        return int(np.maximum(self.shown - 1, 0).sum())

    def soft(self) -> tuple[Floats, Floats]:
        """Chips (n,), about -1 to 1, 0 where no line shows them; and their covariance (n, n), 1 where none does."""
        ridge = RIDGE * np.trace(self.normal) / len(self.right) + 1e-12
        covariance = np.linalg.inv(self.normal / ridge + np.eye(len(self.right)))
        return np.clip(2 * covariance @ self.right / ridge, -1.5, 1.5), covariance

    def misfits(self, chips: Ints) -> Floats:
        """Weighted squares that chips (length,) leave, for each place of the first of them, (length,)."""
        place = np.arange(len(chips))
        each = chips[(place[:, None] - place) % len(chips)].T - 0.5
        return np.asarray(self.square - 2 * each @ self.right + np.einsum("ij,ij->i", each @ self.normal, each))


def decode_packet(
    images: Sequence[Sequence[Signal]], hypotheses: Sequence[Ints], packets: Packets
) -> PacketMatch | None:
    """Decode the packet of a panel.

    Parameters
    ----------
    images
        For each LED image its signals, one for each frame that shows it.
    hypotheses
        Ways to lay the images over the panel: the index of each of them, (images,).
    packets
        What the panels send.

    Returns
    -------
    PacketMatch or None
        None where no packet is found.
    """
    form = PacketFormat(packets)
    normal = [_normalised(signals, packets.depth) for signals in images]
    if not hypotheses or not any(len(signal) for signals in normal for signal in signals):
        return None
    clock = _best_clock(normal, packets)
    period = form.length
    sums = [_added([clock.sums(signal, period) for signal in signals], period).of_one_image() for signals in normal]
    if sum(int(one.shown.sum()) for one in sums) < form.bits - MAX_ERASED:
        return None
    delays = np.array(packets.delays_chips)
    ways = _different(hypotheses, delays, period)
    fits = [
        _added([fit.turned(int(delays[index])) for fit, index in zip(sums, hypotheses[way[0]], strict=True)], period)
        for way in ways
    ]
    for number, start, data, erased in _checked(fits, form):
        chips = form.chips(data)
        misfits = [fit.misfits(chips) for fit in fits]
        own = float(misfits[number][start])
        explained = 1 - own / fits[number].square
        if explained < (MIN_EXPLAINED_ERASED if erased else MIN_EXPLAINED):
            continue
        others = [float(some.min()) for other, some in enumerate(misfits) if other != number]
        # Ways that no signal tells apart are equally good.
        others += [own] * (len(ways[number]) - 1)
        ratio = min(others, default=np.inf) / max(own, 1e-12 * fits[number].square)
        indices = hypotheses[ways[number][0]]
        late = [float(delays[index]) + start for index in indices]
        clock = clock.refined(images, chips, late, packets)
        waves = tuple(clock.wave(chips, one, packets.depth) for one in late)
        return PacketMatch(data, explained, erased, ratio, indices, waves)
    return None


def _different(hypotheses: Sequence[Ints], delays: Ints, period: int) -> list[list[int]]:
    """Numbers of the hypotheses in lists whose signals differ by a common delay alone, which is unknown anyway."""
    found: dict[tuple[int, ...], list[int]] = {}
    for number, indices in enumerate(hypotheses):
        relative = (delays[indices] - delays[indices[0]]) % period
        found.setdefault(tuple(relative.tolist()), []).append(number)
    return list(found.values())


def _checked(fits: Sequence[_Fit], form: PacketFormat) -> Iterator[tuple[int, int, Bits, int]]:
    """Hypothesis, place of the packet's start, data bits and number of erasures of the likeliest that pass the CRC."""
    candidates = []
    for number, fit in enumerate(fits):
        soft, covariance = fit.soft()
        likeness = form.likeness(soft)
        candidates += [
            (float(likeness[start]), number, int(start), soft, covariance)
            for start in np.argsort(-likeness)[:STARTS_CHECKED]
        ]
    candidates.sort(key=lambda one: -one[0])
    for _, number, start, soft, covariance in candidates[:MAX_CHECKED]:
        turned = np.roll(covariance, (-start, -start), axis=(0, 1))
        first = np.arange(len(form.preamble), form.length, 2)
        variance = (turned[first, first] + turned[first + 1, first + 1]) / 2 - turned[first, first + 1]
        erased = 1 - variance < MIN_SHOWN
        data = form.data(np.roll(soft, -start), erased)
        if data is not None and fits[number].redundancy >= CHIPS_PER_ERASED * erased.sum():
            yield number, start, data, int(erased.sum())


def _normalised(signals: Sequence[Signal], depth: float) -> tuple[Signal, ...]:
    """Signals of one LED with levels of 0 for a dark chip and 1 for a bright one, by its brightest lines."""
    levels = np.concatenate([signal.level for signal in signals])
    bright = float(np.percentile(levels, BRIGHT_PERCENTILE)) if len(levels) else 0.0
    if bright <= 0:
        return ()
    scaled = [signal.scaled(1 / (bright * depth)) for signal in signals]
    return tuple(
        Signal(one.start_s, one.exposure_s, np.clip(one.level - (1 - depth) / depth, -0.2, 1.2), one.weight)
        for one in scaled
    )


@dataclass(frozen=True)
class _Clock:
    """A panel's clock: chips of `chip_s`, `phase` chips into one at the time `at_s`."""

    chip_s: float
    phase: float
    at_s: float

    def overlaps(self, signal: Signal) -> tuple[int, Floats]:
        """First chip, and the share of each line's exposure in it and those that follow, (n, chips)."""
        at = (signal.start_s - self.at_s) / self.chip_s + self.phase
        during = signal.exposure_s / self.chip_s
        first = int(np.floor(at[0]))
        chips = np.arange(first, int(np.floor(at[-1] + during)) + 1)
        covered = np.minimum(at[:, None] + during, chips + 1) - np.maximum(at[:, None], chips)
        return first, np.clip(covered, 0, None) / during

    def sums(self, signal: Signal, period: int) -> _Fit:
        """Sums of a signal, with chips of equal place in the period added."""
        first, shares = self.overlaps(signal)
        folded = np.zeros((len(signal), period))
        for column, place in enumerate((first + np.arange(shares.shape[1])) % period):
            folded[:, place] += shares[:, column]
        weighted = folded * signal.weight[:, None]
        level = signal.level - 0.5
        square = float(signal.weight @ level**2)
        return _Fit(weighted.T @ folded, level @ weighted, square, np.zeros(period, dtype=np.int64))

    def wave(self, chips: Ints, late: float, depth: float) -> ChipWave:
        """Wave of an LED that starts its chips `late` chips after the clock."""
        return ChipWave(chips, self.chip_s, depth, self.at_s, self.phase - late)

    def refined(
        self, images: Sequence[Sequence[Signal]], chips: Ints, late: Sequence[float], packets: Packets
    ) -> "_Clock":
        """The clock near this one with which the waves of all LED images fit best, in phase and then in rate."""
        pairs = [(signal, delay) for some, delay in zip(images, late, strict=True) for signal in some]
        span = max(float(signal.start_s[-1]) for signal, _ in pairs) - self.at_s

        def misfit(clock: _Clock) -> float:
            left = 0.0
            for signal, delay in pairs:
                gains = clock.wave(chips, delay, packets.depth).gains(signal.start_s, signal.exposure_s)
                left += float(signal.weight @ signal.centred**2) * (1 - max(signal.correlation(gains), 0.0) ** 2)
            return left

        best = self
        for reach in (0.2, 0.05):
            for turned in (1, -1):
                # Ahead by as much at the first line as at the last one; then ahead at the one, behind at the other.
                shifts = reach * np.linspace(-1, 1, 5)
                tried = [best.shifted(shift, turned * shift, span) for shift in shifts.tolist()]
                best = min(tried, key=misfit)
        return best

    def shifted(self, first: float, last: float, span_s: float) -> "_Clock":
        """The clock that is so many chips ahead at `at_s`, and `span_s` later."""
        rate = 1 / self.chip_s + (last - first) / span_s
        return _Clock(1 / rate, self.phase + first, self.at_s)

    def misfit(self, signal: Signal) -> float:
        """Weighted squares that free chips leave in one signal."""
        _, shares = self.overlaps(signal)
        weighted = shares * signal.weight[:, None]
        level = signal.level - 0.5
        normal, right = weighted.T @ shares, level @ weighted
        ridge = 1e-3 * signal.weight.mean()
        chips = np.linalg.solve(normal + ridge * np.eye(len(right)), right)
        return float(signal.weight @ (level - shares @ chips) ** 2 + ridge * chips @ chips)


def _best_clock(images: Sequence[Sequence[Signal]], packets: Packets) -> _Clock:
    """Clock error and phase of the chips with which free chips fit each signal best."""
    signals = [signal for of_image in images for signal in of_image if len(signal)]
    at_s = min(float(signal.start_s[0]) for signal in signals)
    span = max(float(signal.start_s[-1]) for signal in signals) - at_s
    chip_s = packets.chip_us * 1e-6
    limit = CLOCK_SIGMAS * packets.clock_error
    steps = int(np.ceil(limit * span / chip_s / CLOCK_STEP_CHIPS))
    errors = np.linspace(-limit, limit, 2 * steps + 1) if steps else np.zeros(1)

    def misfit(clock: _Clock) -> float:
        return sum(clock.misfit(signal) for signal in signals)

    coarse = [_Clock(chip_s / (1 + error), part / PHASES, at_s) for error in errors for part in range(PHASES)]
    best = min(coarse, key=misfit)
    fine = [_Clock(best.chip_s, best.phase + part / (4 * PHASES), at_s) for part in range(-3, 4)]
    return min(fine, key=misfit)


def _added(fits: Sequence[_Fit], period: int) -> _Fit:
    return _Fit(
        np.sum([np.zeros((period, period)), *(one.normal for one in fits)], axis=0),
        np.sum([np.zeros(period), *(one.right for one in fits)], axis=0),
        sum(one.square for one in fits),
        np.sum([np.zeros(period, dtype=np.int64), *(one.shown for one in fits)], axis=0),
    )
