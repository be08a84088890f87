"""Overrides of a recipe's keys from Python, as the `key=value` texts of the command line."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from vlcrender.config.toml_model import toml_text
from vlcrender.errors import InputError

Overrides = Mapping[str, object] | Iterable[str]


def assignments(overrides: Overrides | None) -> list[str]:
    """`key=value` texts, values as TOML has them."""
    if overrides is None:
        return []
    if isinstance(overrides, str):
        raise InputError(
            f"overrides = {overrides!r}: has to be a mapping of keys to values, or a list of key=value texts"
        )
    if isinstance(overrides, Mapping):
        return [f"{key}={toml_text(_plain(value), f'overrides: {key}')}" for key, value in overrides.items()]
    return list(overrides)


def _plain(value: object) -> object:
    """A value without arrays, numbers and paths of NumPy and pathlib."""
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value
