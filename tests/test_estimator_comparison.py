"""Paired comparison of two variants: by hand, and by closed forms of the signed-rank test."""

from collections.abc import Sequence

import numpy as np
import pytest
from test_estimator_score import LEDS_M, TRUTH, failed, ok, truths

from estimator.evaluate.comparison import best, compare
from estimator.evaluate.score import VariantScore, score_variant


def scored(name: str, errors_m: Sequence[float | None]) -> VariantScore:
    """A variant that is off by so much in x, or failed."""
    x, y, z = TRUTH
    rows = [failed(k, "a: b") if e is None else ok(k, (x + e, y, z)) for k, e in enumerate(errors_m)]
    return score_variant(name, rows, truths(len(rows)), LEDS_M)


def test_a_pair_by_hand() -> None:
    """Differences -1, -2, +1 and 0: median -0.5; signed ranks without the zero 1.5, 3 and 1.5."""
    a = scored("a", [1.0, 1.0, 2.0, 4.0, 5.0, None, None])
    b = scored("b", [2.0, 3.0, 1.0, 4.0, None, 9.0, None])
    pair = compare(a, b)
    assert (pair.both, pair.only_a, pair.only_b, pair.neither) == (4, 1, 1, 1)
    assert (pair.a_nearer, pair.b_nearer) == (2, 1)
    assert pair.median_difference_m == pytest.approx(-0.5)
    assert pair.wilcoxon_p is not None
    back = compare(b, a)
    assert (back.only_a, back.a_nearer, back.median_difference_m) == (1, 1, pytest.approx(0.5))
    assert back.wilcoxon_p == pytest.approx(pair.wilcoxon_p)


def test_when_a_is_always_nearer_the_test_says_how_seldom_that_is_by_chance() -> None:
    """Of 2^8 equally likely signs of eight differences, two are all alike."""
    pair = compare(scored("a", [0.1] * 8), scored("b", [0.2 + 0.01 * k for k in range(8)]))
    assert pair.wilcoxon_p == pytest.approx(2 / 2**8)
    assert pair.interval is not None
    assert pair.interval.high_m < 0


def test_what_is_common_to_a_frame_cancels() -> None:
    """Frames differ by metres, the variants by a constant centimetre: the interval is that, to rounding."""
    hard = np.random.default_rng(1).uniform(0, 10, 30)
    pair = compare(scored("a", (hard + 0.01).tolist()), scored("b", hard.tolist()))
    assert pair.interval is not None
    assert (pair.interval.low_m, pair.interval.high_m) == (pytest.approx(0.01), pytest.approx(0.01))


def test_without_a_common_frame_or_a_difference_there_is_nothing_to_test() -> None:
    pair = compare(scored("a", [1.0, None]), scored("b", [None, 1.0]))
    assert (pair.both, pair.median_difference_m, pair.interval, pair.wilcoxon_p) == (0, None, None, None)
    pair = compare(scored("a", [1.0, 2.0]), scored("b", [1.0, 2.0]))
    assert (pair.both, pair.a_nearer, pair.b_nearer, pair.wilcoxon_p) == (2, 0, 0, None)
    assert compare(scored("a", []), scored("b", [])).both == 0


def test_the_best_is_nearest_over_all_frames() -> None:
    """One that answers one frame of three perfectly is no match for one that answers all."""
    choosy, steady, lost = scored("a", [0.0, None, None]), scored("b", [1.0] * 3), scored("c", [None] * 3)
    assert best((choosy, steady, lost)) is steady
    assert best((lost, choosy)) is choosy
    nearer = scored("d", [0.1, 0.1, None])
    assert best((steady, nearer)) is nearer
