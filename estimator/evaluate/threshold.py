"""Limits that scores have to keep: `ml:median=1mm`, for regression tests in CI."""

import math
import re
from dataclasses import dataclass

from estimator.errors import InputError
from estimator.evaluate.score import Scores, VariantScore

UNITS_M = {"um": 1e-6, "µm": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0}
LENGTHS = ("median", "p95", "max", "rmse")
STATISTICS = (*LENGTHS, "failures")
_NUMBER = re.compile(r"(?P<number>\d+\.?\d*(?:[eE][+-]?\d+)?)\s*(?P<unit>[a-zµ%]*)")


@dataclass(frozen=True)
class Threshold:
    """The largest value of a statistic that a variant may have: metres, or a number of frames or a share of them."""

    text: str
    variant: str
    statistic: str
    limit: float
    is_share: bool = False

    @classmethod
    def of(cls, text: str) -> "Threshold":
        """VARIANT:STATISTIC=LIMIT. Raises InputError."""
        head, _, value = text.rpartition("=")
        variant, _, statistic = head.rpartition(":")
        found = _NUMBER.fullmatch(value.strip())
        if not variant or statistic not in STATISTICS or found is None:
            raise InputError(
                f"--fail-above {text}: needed VARIANT:STATISTIC=LIMIT, such as ml:median=1mm; statistics: "
                f"{', '.join(STATISTICS)}"
            )
        number, unit = float(found["number"]), found["unit"]
        if statistic == "failures":
            if unit not in ("", "%"):
                raise InputError(f"--fail-above {text}: failures are a number of frames, or a share with %")
            return cls(text, variant, statistic, number / 100 if unit else number, is_share=bool(unit))
        if unit not in UNITS_M:
            raise InputError(f"--fail-above {text}: a length needs one of the units {', '.join(UNITS_M)}")
        return cls(text, variant, statistic, number * UNITS_M[unit])

    def exceeded_by(self, scores: Scores) -> str | None:
        """What exceeds the limit, as text; None where nothing does. A failed frame counts as infinite.

        Raises InputError if the variant is not scored.
        """
        names = {one.variant: one for one in scores.variants}
        if self.variant not in names:
            raise InputError(f"--fail-above {self.text}: no estimates of {self.variant}; there are: {', '.join(names)}")
        value = self._value(names[self.variant])
        if value <= self.limit:
            return None
        return f"{self.variant}: {self.statistic} {self._told(value)} exceeds {self._told(self.limit)}"

    def _value(self, one: VariantScore) -> float:
        if self.statistic == "failures":
            return one.failed / max(one.frames, 1) if self.is_share else one.failed
        if self.statistic in ("median", "p95"):
            of_all = None if one.of_all is None else getattr(one.of_all, f"{self.statistic}_m")
            return math.inf if of_all is None else float(of_all)
        if one.failed or one.error_3d is None:
            return math.inf
        return float(getattr(one.error_3d, f"{self.statistic}_m"))

    def _told(self, value: float) -> str:
        if self.statistic == "failures":
            return f"{100 * value:.3g} %" if self.is_share else f"{value:g}"
        return "inf" if math.isinf(value) else f"{value * 1e3:.4g} mm"
