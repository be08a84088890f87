"""Axes of plots: linear, logarithmic or of texts, with the places of their labels."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

MIN_SPAN = 50.0
"""An axis whose positive values span this factor is logarithmic unless told otherwise."""
MAX_LABELS = 9


@dataclass(frozen=True)
class Axis:
    """An axis from `low` to `high`, either linear or logarithmic; or of `texts`, which stand at 0, 1, 2, ..."""

    low: float
    high: float
    logarithmic: bool = False
    texts: tuple[str, ...] = ()

    @classmethod
    def of(cls, values: Sequence[float], logarithmic: bool | None, pad: float = 0.04) -> "Axis":
        """Axis with room for the finite values, logarithmic where asked, or where it is None and the values' span asks.

        Values that are not positive have no place on a logarithmic axis.
        """
        finite = [value for value in values if math.isfinite(value)]
        positive = [value for value in finite if value > 0]
        if logarithmic is None:
            logarithmic = bool(positive) and len(positive) == len(finite) and max(positive) >= MIN_SPAN * min(positive)
        if logarithmic and positive:
            ends = math.log10(min(positive)), math.log10(max(positive))
            space = pad * (ends[1] - ends[0]) if ends[1] > ends[0] else 0.1
            return cls(10 ** (ends[0] - space), 10 ** (ends[1] + space), True)
        low, high = min(finite, default=0.0), max(finite, default=1.0)
        space = pad * (high - low) if high > low else 0.04 * abs(high) or 1.0
        return cls(low - space, high + space)

    @classmethod
    def of_texts(cls, texts: Sequence[str]) -> "Axis":
        """Axis of texts."""
        return cls(-0.5, len(texts) - 0.5, texts=tuple(texts))

    def share(self, value: float) -> float:
        """Place of a value along the axis, 0 to 1; what lies outside is at the nearer end."""
        inside = min(max(value, self.low), self.high)
        if self.logarithmic:
            return math.log(inside / self.low) / math.log(self.high / self.low)
        return (inside - self.low) / (self.high - self.low)

    def labels(self) -> list[float]:
        """Values to label: 1, 2 and 5 times powers of ten; of a logarithmic axis as many as fit, of texts all."""
        if self.texts:
            return [float(index) for index in range(len(self.texts))]
        if not self.logarithmic:
            step = self._step()
            return [index * step for index in range(math.ceil(self.low / step), math.floor(self.high / step) + 1)]
        decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        for digits in ((1, 2, 5), (1, 3), (1,)):
            found = [
                value
                for decade in decades
                for digit in digits
                if self.low <= (value := digit * 10.0**decade) <= self.high
            ]
            if len(found) <= MAX_LABELS:
                return found
        return found[:: math.ceil(len(found) / MAX_LABELS)]

    def _step(self) -> float:
        smallest = (self.high - self.low) / MAX_LABELS
        decade = 10.0 ** math.floor(math.log10(smallest))
        return next(digit * decade for digit in (1, 2, 5, 10) if digit * decade >= smallest)
