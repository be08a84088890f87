"""Exceptions of this package: unusable input, and a frame without a position."""

from collections.abc import Mapping


class InputError(ValueError):
    """Input that cannot be used. The message is one line: the file, key or value, and what is allowed."""


class EstimationFailure(ValueError):
    """A frame whose position cannot be estimated. Failures are counted by message, so it holds no measured numbers.

    `stage` is the stage that failed, `why` the reason, `ranges_m` the ranges (LED id -> metres) found before it failed.
    """

    def __init__(self, stage: str, why: str, ranges_m: Mapping[int, float] | None = None) -> None:
        """Make the message `stage: why`."""
        super().__init__(f"{stage}: {why}")
        self.stage = stage
        self.why = why
        self.ranges_m: Mapping[int, float] = ranges_m or {}

    def __reduce__(self) -> tuple[type["EstimationFailure"], tuple[str, str, dict[int, float]]]:
        """Pickle by the constructor's arguments, so that worker processes can return a failure."""
        return type(self), (self.stage, self.why, dict(self.ranges_m))
