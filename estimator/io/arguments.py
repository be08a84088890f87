"""Types of arguments of the command line."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

if TYPE_CHECKING:
    from cyclopts import Token


def _whole(_: Any, tokens: "Sequence[Token]") -> int:
    text = tokens[0].value
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"{text} is not a whole number") from None


Whole = Annotated[int, Parameter(converter=_whole)]
"""A whole number; Cyclopts by itself rounds 1.5."""
