"""Codes: for each LED of a scene a short balanced sequence of chips that it repeats.

The codes of a book are balanced, have no run of more than 4 equal chips across their ends, and are distinct even when
shifted. A light whose repetition rate shows is avoided: codes with more than MAX_PERCENT of modulation there are left
out.

A short LED image shows a part of a code only. No part of `window_chips` chips, at any shift, occurs twice in a book: 20
chips where 1225 LEDs have codes of 32. A receiver that sees fewer clear chips may find several LEDs that fit, and has
to reject such an image: of those 1225 codes, 70 % of the parts of 16 chips and 19 % of those of 18 occur elsewhere too.
But for one chip, 77 % of the parts of 20 do, 8 % of those of 24 and 0.5 % of those of 28
(`python docs/measure_downlink.py codes`).
"""

from functools import cache
from math import ceil, log2

import numpy as np
from numpy.typing import NDArray

from vlcrender.core.random_keys import stream

MAX_RUN = 4
"""Longest run of equal chips, across the ends too."""
MAX_PERCENT = 25.0
"""Largest modulation at the repetition rate, amplitude over mean, percent."""
BATCH = 4096
MAX_FRUITLESS = 50
"""Batches without a new code after which there are taken to be no more."""


def window_chips(count: int, length: int) -> int:
    """Chips of the shortest part that tells `count` codes of a length apart, at most the length.

    Parts of this many chips are at least 16 times as many as those of all codes.
    """
    return min(length, ceil(log2(16 * count * length)))


@cache
def code_book(count: int, length: int) -> tuple[str, ...]:
    """Codes for `count` LEDs, `length` chips each, such as "0110", "1" for lit; the same in every scene.

    Raises ValueError where there are not so many codes of this length.
    """
    window, generator = window_chips(count, length), stream("downlink", 0, f"{count} codes of {length} chips")
    found: list[str] = []
    taken: set[int] = set()
    fruitless = 0
    while len(found) < count:
        before = len(found)
        for chips in _candidates(generator, length):
            parts = _parts(chips, window)
            if len(set(parts)) == length and taken.isdisjoint(parts):
                taken.update(parts)
                found.append("".join(map(str, chips.tolist())))
        fruitless = 0 if len(found) > before else fruitless + 1
        if fruitless == MAX_FRUITLESS:
            raise ValueError(f"there are {len(found)} codes of {length} chips for {count} LEDs")
    return tuple(found[:count])


def _candidates(generator: np.random.Generator, length: int) -> NDArray[np.int64]:
    """Balanced random sequences without long runs and without much modulation at the repetition rate, (n, length)."""
    balanced = np.tile(np.arange(length) % 2, (BATCH, 1))
    chips = generator.permuted(balanced, axis=1)
    same = np.ones(chips.shape, dtype=bool)
    for shift in range(1, MAX_RUN + 1):
        same &= chips == np.roll(chips, -shift, axis=1)
    chips = chips[~same.any(axis=1)]
    turns = np.exp(-2j * np.pi * np.arange(length) / length)
    # c_1 of chips of 1 / length of a period each; the mean is 1/2
    percent = 100 * 2 * np.abs(chips @ turns) / length * np.sinc(1 / length) / 0.5
    return np.asarray(chips[percent <= MAX_PERCENT])


def _parts(chips: NDArray[np.int64], window: int) -> list[int]:
    """All cyclic parts of a code of `window` chips as numbers, one for each shift."""
    shifted = (np.arange(len(chips))[:, None] + np.arange(window)) % len(chips)
    parts: list[int] = (chips[shifted] @ (1 << np.arange(window, dtype=np.int64))).tolist()
    return parts
