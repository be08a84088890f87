"""Damage of input files for tests of their readers."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

from vlcrender.errors import InputError

T = TypeVar("T")
LETTERS = np.frombuffer(b"0-.,:;[]{}#eEnaifxyz*&!'\"\n \t\x00\xff%|>", np.uint8)


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes with a few of them replaced, removed or repeated."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        start = int(rng.integers(0, len(changed) or 1))
        stop = start + int(rng.integers(0, 6))
        pieces = rng.choice(LETTERS, size=3).tobytes(), b"", bytes(changed[start:stop]) * 2
        changed[start:stop] = pieces[rng.integers(3)]
    return bytes(changed)


def read_or_refused(start: Path | str, read: Callable[[], T]) -> T | None:
    """What a reader returns, None where it raises InputError: one line that begins with `start`."""
    try:
        return read()
    except InputError as error:
        message = str(error)
    assert message.startswith(str(start)), message
    assert "\n" not in message, message
    return None
