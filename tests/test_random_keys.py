"""Random keys: the hash that every dataset's bits depend on, and the numbers that kernels draw with it."""

import hashlib

import numpy as np

from vlcrender.camera.roi import Roi
from vlcrender.core.backend import dr, exact_math, mi
from vlcrender.core.philox import kernel_seed, normals, uniforms
from vlcrender.core.random_keys import random_key, stream
from vlcrender.sensor.pixel_indices import pixel_indices


def blake2(text: str, size: int) -> int:
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=size).digest(), "little")


def test_streams_are_philox_keyed_by_blake2_of_their_parts() -> None:
    by_hand = np.random.Generator(np.random.Philox(key=blake2("2016/7/aim", 16)))
    assert np.array_equal(stream(2016, 7, "aim").integers(0, 2**60, 10), by_hand.integers(0, 2**60, 10))


def test_a_kernels_seed_is_64_bits_of_blake2_of_its_parts() -> None:
    assert int(kernel_seed(2016, 7, "shot-noise")[0]) == blake2("2016/7/shot-noise", 8)


def test_a_key_may_be_part_of_a_longer_one() -> None:
    key = random_key(2016, 7, "shot-noise")
    assert random_key(key, "read") == "2016/7/shot-noise/read"
    assert int(kernel_seed(key, "read")[0]) == int(kernel_seed(2016, 7, "shot-noise", "read")[0])


def test_uniform_numbers_are_those_of_dr_jits_philox() -> None:
    with exact_math():
        column, row = pixel_indices([Roi(-20, 5, 300, 400)])
        seed, number = kernel_seed("uniforms"), mi.UInt32(7)
        peer = mi.Philox4x32(seed, column, row, number, iterations=10).next_float32x4()
        for ours, theirs in zip(uniforms(seed, column, row, number), peer, strict=True):
            assert np.array_equal(ours.numpy(), theirs.numpy())


def test_normal_numbers_are_box_and_mullers_of_two_uniforms() -> None:
    """In float64 by NumPy: float32 has 2^-24 = 6e-8 an operation, on numbers up to 5.8, through a dozen operations."""
    with exact_math():
        column, row = pixel_indices([Roi(-20, 5, 300, 400)])
        seed = kernel_seed("normals")
        drawn = [number.numpy() for number in normals(seed, column, row)]
        u = uniforms(seed, column, row, mi.UInt32(0))
        dr.eval(u)
    first, second = (u[i].numpy().astype(float) for i in range(2))
    radius = np.sqrt(-2 * np.log(1 - first))
    assert np.abs(drawn[0] - radius * np.cos(2 * np.pi * second)).max() < 5.8 * 12 * 6e-8
    assert np.abs(drawn[1] - radius * np.sin(2 * np.pi * second)).max() < 5.8 * 12 * 6e-8


def test_pixel_indices_count_from_the_region_and_wrap_at_2_to_the_32() -> None:
    regions = [Roi(-1, 7, 2, 3), Roi(4, -1, 2, 1)]
    column, row = (index.numpy().tolist() for index in pixel_indices(regions[:1]))
    assert column == [7, 8, 9, 7, 8, 9]
    assert row == [2**32 - 1] * 3 + [0] * 3
    columns, rows = (index.numpy().tolist() for index in pixel_indices(regions))
    assert columns == [*column, 2**32 - 1, 2**32 - 1]
    assert rows == [*row, 4, 5]
