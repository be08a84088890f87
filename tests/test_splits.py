"""Train, validation and test by position: whole blocks of the floor, in the shares asked for, with a gap between."""

import numpy as np
import pytest
from conftest import small_plan

import vlcrender as vr
from vlcrender.dataset.recipe.splits import NAMES, Split, blocks_of
from vlcrender.errors import InputError

ROOM_M = np.array([7.0, 5.2])


def test_blocks_have_the_shares_and_depend_on_the_seed() -> None:
    split = Split(block_m=0.5, train=0.6, validation=0.15, test=0.25)
    blocks = blocks_of(split, *ROOM_M, 1)
    assert blocks.shape == (14, 11)  # 5.2 m are ten whole blocks and a cut one
    counts = np.bincount(blocks.ravel(), minlength=3)
    # Ends of the shares are rounded to whole blocks: each count is within 1 of its share.
    assert np.abs(counts - blocks.size * np.array([0.6, 0.15, 0.25])).max() <= 1
    assert np.array_equal(blocks, blocks_of(split, *ROOM_M, 1))
    assert not np.array_equal(blocks, blocks_of(split, *ROOM_M, 2))


def test_a_position_has_the_split_of_its_block(rng: np.random.Generator) -> None:
    split = Split(block_m=0.8)
    blocks = blocks_of(split, *ROOM_M, 7)
    for x, y in rng.uniform((0, 0), ROOM_M, (200, 2)):
        assert split.name_at((x, y, 1.0), ROOM_M, 7) == NAMES[blocks[int(x / 0.8), int(y / 0.8)]]


def test_splits_are_further_apart_than_the_gap(rng: np.random.Generator) -> None:
    gap_m = 0.3
    split = Split(block_m=0.8, train=0.5, validation=0.2, test=0.3, gap_m=gap_m)
    places = rng.uniform((0, 0), ROOM_M, (3000, 2))
    names = np.array([split.name_at(place, ROOM_M, 7) or "none" for place in places])
    assert set(names) == {*NAMES, "none"}
    for a, b in (("train", "test"), ("train", "validation"), ("validation", "test")):
        apart = np.linalg.norm(places[names == a][:, None] - places[names == b][None], axis=2)
        assert apart.min() >= gap_m
    # No test place is given up, and no place that is far from other blocks.
    whole = Split(block_m=0.8, train=0.5, validation=0.2, test=0.3)
    before = np.array([whole.name_at(place, ROOM_M, 7) for place in places])
    assert np.array_equal(names == "test", before == "test")
    assert np.array_equal(names[names != "none"], before[names != "none"])


@pytest.mark.parametrize(
    ("assignment", "problem"),
    [
        ("split.train=0.5", "train + validation + test = 0.8: has to be 1"),
        ("split.block_m=0", "split.block_m"),
    ],
)
def test_impossible_splits_are_refused(assignment: str, problem: str) -> None:
    with pytest.raises(InputError, match=problem.replace("+", r"\+")):
        small_plan("split.test=0.2", assignment)


def test_a_share_without_a_block_is_refused() -> None:
    with pytest.raises(InputError, match=r"split: validation = 0.1 of 2 x 2 blocks is no block"):
        Split(block_m=4.0).name_at((1.0, 1.0), ROOM_M, 1)


def test_seeds_have_up_to_128_bits() -> None:
    plan = small_plan(f"seed={2**128 - 1}")
    assert plan.recipe.seed == vr.Recipe.model_validate_json(plan.recipe.model_dump_json()).seed == 2**128 - 1
    with pytest.raises(InputError, match="seed"):
        small_plan(f"seed={2**128}")
