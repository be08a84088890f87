"""Splits of a dataset's frames into train, validation and test, by where on the floor they were taken."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from vlcrender.config.toml_model import Settings
from vlcrender.core.random_keys import stream
from vlcrender.errors import InputError

SplitName = Literal["train", "validation", "test"]
NAMES: tuple[SplitName, ...] = ("train", "validation", "test")
Share = Annotated[float, Field(ge=0, le=1)]


class Split(Settings):
    """Train, validation and test frames by position: square blocks of the floor, each of one split, drawn by the seed.

    Whole blocks are drawn, so that a test position is not among training positions.
    """

    block_m: Annotated[float, Field(ge=0.01, le=1000)] = 1.0
    """Side of a block, metres. Blocks start at the world's origin; those at the far walls may be cut."""
    train: Share = 0.7
    """Share of the blocks for training. The three shares add up to 1."""
    validation: Share = 0.1
    """Share of the blocks for validation."""
    test: Share = 0.2
    """Share of the blocks for the test."""
    gap_m: Annotated[float, Field(ge=0, le=1000)] = 0.0
    """Training and validation frames nearer than this to a test block, and training frames nearer than this to a
    validation block, belong to no split, metres."""

    @model_validator(mode="after")
    def _shares_are_a_whole(self) -> Self:
        total = self.train + self.validation + self.test
        if abs(total - 1) > 1e-9:
            raise ValueError(f"train + validation + test = {total:g}: has to be 1")
        return self

    def name_at(self, position_m: Sequence[float], room_m: NDArray[np.float64], seed: int) -> SplitName | None:
        """The split of a position (x, y, ...), world metres; None in the gap between two splits.

        room_m: extent of the room along x and y, (2,) or more. Raises InputError as `blocks_of`.
        """
        blocks = blocks_of(self, float(room_m[0]), float(room_m[1]), seed)
        place = np.asarray(position_m[:2], dtype=np.float64)
        own = blocks[_block_at(place, self.block_m, blocks.shape)]
        if self.gap_m > 0 and _distance_m(place, np.argwhere(blocks > own), self.block_m) < self.gap_m:
            return None
        return NAMES[int(own)]


def _block_at(place_m: NDArray[np.float64], block_m: float, shape: tuple[int, ...]) -> tuple[int, int]:
    x, y = np.clip(place_m // block_m, 0, np.array(shape) - 1).astype(int).tolist()
    return x, y


def _distance_m(place_m: NDArray[np.float64], blocks: NDArray[np.intp], block_m: float) -> float:
    """Distance from a place (2,) to the nearest of some blocks (n, 2), given by their numbers along x and y."""
    if not len(blocks):
        return float("inf")
    low = blocks * block_m
    beyond = np.maximum(np.maximum(low - place_m, place_m - low - block_m), 0)
    return float(np.hypot(beyond[:, 0], beyond[:, 1]).min())


@lru_cache(maxsize=8)
def blocks_of(split: Split, x_m: float, y_m: float, seed: int) -> NDArray[np.int64]:
    """Number in NAMES of each block, (blocks along x, blocks along y), of a floor of x_m by y_m metres.

    Raises InputError where a split of a share above 0 gets no block.
    """
    columns, rows = (max(1, int(np.ceil(side_m / split.block_m - 1e-9))) for side_m in (x_m, y_m))
    count = columns * rows
    ends = np.round(np.cumsum([split.train, split.validation, split.test]) * count).astype(int)
    sizes = np.diff(ends, prepend=0).tolist()
    for name, share, size in zip(NAMES, (split.train, split.validation, split.test), sizes, strict=True):
        if share > 0 and not size:
            raise InputError(
                f"split: {name} = {share:g} of {columns} x {rows} blocks is no block; lower block_m, or raise {name}"
            )
    blocks = np.empty(count, dtype=np.int64)
    blocks[stream(seed, 0, "split").permutation(count)] = np.repeat(np.arange(len(NAMES)), sizes)
    return blocks.reshape(columns, rows)
