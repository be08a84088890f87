"""Results that the variants of a frame share: each is computed once and charged to every variant."""

import time
from collections.abc import Callable, Hashable
from typing import TypeVar, cast

from estimator.errors import EstimationFailure

T = TypeVar("T")


class SharedResults:
    """Results by key, or the EstimationFailure in place of one, with the time that each took.

    A key holds all that a result depends on. Images take part by identity (a `Part` equals itself alone) and must not
    change. `spared_s` is the sum of the times, seconds, of the results that were found here and not computed anew.
    """

    def __init__(self) -> None:
        """Begin without results."""
        self.spared_s = 0.0
        self._results: dict[Hashable, tuple[object, float]] = {}

    def once(self, key: Hashable, compute: Callable[[], T]) -> T:
        """The result of a key, computed if it is not here; raises the EstimationFailure that came in its place."""
        if key in self._results:
            result, took_s = self._results[key]
            self.spared_s += took_s
        else:
            # What the computation in turn finds here counts as if it had been computed.
            start_s = time.perf_counter() + self.spared_s
            try:
                result = compute()
            except EstimationFailure as failure:
                result = failure
            self._results[key] = result, time.perf_counter() + self.spared_s - start_s
        if isinstance(result, EstimationFailure):
            raise result
        return cast(T, result)

    def settle(self) -> None:
        """Count the results so far as paid for: finding them spares nothing from now on."""
        self._results = {key: (result, 0.0) for key, (result, _) in self._results.items()}
