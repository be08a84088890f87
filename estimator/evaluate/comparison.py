"""Paired comparison of two variants on the same frames, which cancels the difficulty of the frames."""

import numpy as np
from pydantic import Field

from estimator.evaluate.score import VariantScore
from estimator.evaluate.statistics import Interval, median_interval
from estimator.io.records import Number, Row


class Comparison(Row):
    """Comparison of `a` with `b`. `both`, `only_a`, `only_b` and `neither` count the frames by which succeeded.

    The other values are over the frames of `both`: counts of frames where A or B is nearer to the truth; the median of
    A's 3D error minus B's, with its bootstrap interval; and the two-sided p-value of Wilcoxon's signed-rank test for
    differences symmetric about zero. They are null without a frame, the p-value also without a difference.
    """

    a: str
    b: str
    both: int
    only_a: int
    only_b: int
    neither: int
    a_nearer: int
    b_nearer: int
    median_difference_m: Number | None
    interval: Interval | None
    wilcoxon_p: float | None = Field(ge=0, le=1)


def compare(a: VariantScore, b: VariantScore) -> Comparison:
    """Compare two variants' scores of one dataset, frame by frame."""
    pairs = [(left.error_3d_m, right.error_3d_m) for left, right in zip(a.rows, b.rows, strict=True)]
    differences_m = [left - right for left, right in pairs if left is not None and right is not None]
    return Comparison(
        a=a.variant,
        b=b.variant,
        both=len(differences_m),
        only_a=sum(left is not None and right is None for left, right in pairs),
        only_b=sum(left is None and right is not None for left, right in pairs),
        neither=sum(left is None and right is None for left, right in pairs),
        a_nearer=sum(difference_m < 0 for difference_m in differences_m),
        b_nearer=sum(difference_m > 0 for difference_m in differences_m),
        median_difference_m=float(np.median(differences_m)) if differences_m else None,
        interval=median_interval(differences_m),
        wilcoxon_p=_signed_rank_p(differences_m) if any(differences_m) else None,
    )


def _signed_rank_p(differences_m: list[float]) -> float:
    from scipy.stats import wilcoxon  # as in estimator.evaluate.statistics

    return float(wilcoxon(differences_m).pvalue)


def best(variants: tuple[VariantScore, ...]) -> VariantScore:
    """Variant with the smallest median error over all frames, then p95, failures, name; a failed frame is infinite."""

    def sort_key(score: VariantScore) -> tuple[float, float, int, str]:
        median_m = p95_m = float("inf")
        if score.of_all is not None:
            median_m, p95_m = (
                float("inf") if error_m is None else error_m for error_m in (score.of_all.median_m, score.of_all.p95_m)
            )
        return median_m, p95_m, score.failed, score.variant

    return min(variants, key=sort_key)
