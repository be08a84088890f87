"""Keys of all random numbers: texts such as "seed/frame/name", hashed by BLAKE2 into keys of counter-based generators.

Two keys that differ in any part share nothing, neighbouring seeds and frames included. So any frame can be made again
alone, in any order, bit for bit. Fixed patterns of a device are keyed by its serial number in place of seed and frame.
"""

import hashlib

import numpy as np

KERNEL_KEY_BITS = 64
"""Key of Philox 4x32-10, the generator of the kernels (`philox.kernel_seed`)."""
STREAM_KEY_BITS = 128
"""Key of Philox 4x64, the generator of NumPy."""


def random_key(*parts: int | str) -> str:
    """Text of a key: its parts, joined by "/". A key may be a part of a longer one."""
    return "/".join(map(str, parts))


def key_number(bits: int, *parts: int | str) -> int:
    """BLAKE2b hash of `random_key(*parts)` as an integer of this many bits."""
    digest = hashlib.blake2b(random_key(*parts).encode(), digest_size=bits // 8).digest()
    return int.from_bytes(digest, "little")


def stream(*parts: int | str) -> np.random.Generator:
    """NumPy generator (Philox 4x64) of the key with these parts: (seed, frame, name), or (serial, 0, name)."""
    return np.random.Generator(np.random.Philox(key=key_number(STREAM_KEY_BITS, *parts)))
