"""Random streams keyed by (seed, frame, name): any frame can be made again alone, in any order, bit for bit."""

import hashlib

import numpy as np


def stream(seed: int, frame: int, name: str) -> np.random.Generator:
    """Return the counter-based (Philox 4x64) generator of one stream.

    The 128-bit key is a BLAKE2 hash of all three, so that neighbouring seeds or frames share nothing.
    """
    digest = hashlib.blake2b(f"{seed}/{frame}/{name}".encode(), digest_size=16).digest()
    return np.random.Generator(np.random.Philox(key=int.from_bytes(digest, "little")))
