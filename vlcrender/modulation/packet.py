"""Packets: the coordinates of a panel's centre, protected by a CRC, as balanced chips.

A packet is a preamble of 14 chips and 56 bits in Manchester code (1 is sent as 10, 0 as 01), 126 chips: x, y and z in
millimetres, 13 bits each, most significant first; a spare bit, 0; and a CRC of 16 bits over the 40 bits before it. Each
LED of a panel repeats the packet without a pause, `delays_chips` later than LED 0 of the panel's clock.
"""

import numpy as np
from numpy.typing import NDArray

from vlcrender.core.random_keys import stream

Bits = NDArray[np.int64]

PREAMBLE = "00011011000111"
"""Balanced, no run above 3; it differs from every stretch of Manchester code in two chips or more."""
POLYNOMIAL = 0x3D65
"""x^16 + x^13 + x^12 + x^11 + x^10 + x^8 + x^6 + x^5 + x^2 + 1, of the protocol DNP (IEEE 1815): at 40 bits two packets
differ in 6 bits or more, where 0x1021 and 0x8005 have 4 (tests/test_modulation.py). The register starts at 0 and is not
complemented."""
CRC_BITS = 16
COORDINATE_BITS = 13
COORDINATE_UNIT_M = 0.001
MAX_COORDINATE_M = (2**COORDINATE_BITS - 1) * COORDINATE_UNIT_M
DATA_BITS = 3 * COORDINATE_BITS + 1
CHIPS = len(PREAMBLE) + 2 * (DATA_BITS + CRC_BITS)
"""Chips of a packet: 126."""
DELAY_CHIPS = 5
"""Step of the delays; it shares no divisor with CHIPS, so that CHIPS LEDs have different delays."""


def crc16(bits: Bits) -> Bits:
    """The CRC of bits (n,), first bit first: the 16 bits that follow them in a packet."""
    register, top, mask = 0, 1 << (CRC_BITS - 1), (1 << CRC_BITS) - 1
    for bit in bits.tolist():
        feedback = bool(register & top) != bool(bit)
        register = (register << 1 & mask) ^ (POLYNOMIAL if feedback else 0)
    return _as_bits(register, CRC_BITS)


def _as_bits(number: int, count: int) -> Bits:
    return np.array([number >> (count - 1 - i) & 1 for i in range(count)], dtype=np.int64)


def coordinates_mm(center_m: tuple[float, float, float]) -> tuple[int, int, int]:
    """A panel's centre as it is sent, millimetres. Raises ValueError for one that 13 bits do not hold."""
    x, y, z = (round(value / COORDINATE_UNIT_M) for value in center_m)
    if not all(0 <= value < 2**COORDINATE_BITS for value in (x, y, z)):
        raise ValueError(f"({x}, {y}, {z}) mm is not within 0 to {2**COORDINATE_BITS - 1} mm")
    return x, y, z


def packet_chips(mm: tuple[int, int, int]) -> str:
    """The chips of the packet with these coordinates, such as "0110", "1" for lit."""
    data = np.concatenate([*(_as_bits(value, COORDINATE_BITS) for value in mm), [0]])
    bits = np.concatenate([data, crc16(data)])
    return PREAMBLE + "".join("10" if bit else "01" for bit in bits)


def decode_chips(chips: str) -> tuple[int, int, int] | None:
    """The coordinates, mm, of a packet's 126 chips; None for chips that are no packet."""
    halves = [chips[i : i + 2] for i in range(len(PREAMBLE), len(chips), 2)]
    if len(chips) != CHIPS or not chips.startswith(PREAMBLE) or any(half not in ("10", "01") for half in halves):
        return None
    bits = np.array([half == "10" for half in halves], dtype=np.int64)
    data, check = bits[:DATA_BITS], bits[DATA_BITS:]
    if data[-1] or (crc16(data) != check).any():
        return None
    x, y, z = (
        int("".join(map(str, data[i * COORDINATE_BITS : (i + 1) * COORDINATE_BITS].tolist())), 2) for i in range(3)
    )
    return x, y, z


def delays_chips(count: int) -> tuple[int, ...]:
    """How many chips later than the panel's clock each of a panel's LEDs starts its packet: 5 PERM[k] of LED k.

    PERM is a fixed shuffle of 0, 1, ..., count - 1: with a linear delay, a shift of the array of LEDs would look like a
    later start of all of them.
    """
    shuffled = stream("downlink", 0, f"delays of {count} LEDs").permutation(count)
    return tuple((DELAY_CHIPS * shuffled).tolist())
