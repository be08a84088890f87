"""The two ways this package says no: bad input ends a command, a failed estimate is a result."""

from collections.abc import Mapping


class InputError(Exception):
    """What the user gave cannot be used; one line that names the file, key or value and what is allowed."""


class EstimationFailure(Exception):
    """A frame has no position, and why. Failures are counted by this text, so it holds no measured numbers."""

    def __init__(self, stage: str, why: str, ranges_m: Mapping[int, float] | None = None) -> None:
        """Name the stage that gave up; `ranges_m` are the LED ranges (LED id -> metres) made before it did."""
        super().__init__(f"{stage}: {why}")
        self.stage = stage
        self.why = why
        self.ranges_m: Mapping[int, float] = ranges_m or {}
