from __future__ import annotations

import random

import pytest

from drivers.canopen.frames import worst_bits
from tests.vm.can_bits import bits_of


@pytest.mark.parametrize("length", range(9))
def test_bits_of_lies_between_unstuffed_and_worst_case(length: int) -> None:
    chance = random.Random(length)
    for _ in range(300):
        data = chance.choice((bytes(length), b"\xff" * length, chance.randbytes(length)))
        assert 47 + 8 * length <= bits_of(chance.randrange(0x800), data) <= worst_bits(length)


def test_bits_of_matches_independent_stuffing() -> None:
    for identifier in range(0x800):
        crc = _divided(int(f"0{identifier:011b}0000000", 2), 19)
        wire = f"0{identifier:011b}0000000{crc:015b}"
        assert bits_of(identifier, b"") == 47 + _runs_of_five(wire)


def _divided(value: int, length: int) -> int:
    """Return the remainder of the polynomial division."""
    value <<= 15
    for shift in range(length - 1, -1, -1):
        if value >> (shift + 15) & 1:
            value ^= (1 << 15 | 0x4599) << shift
    return value


def _runs_of_five(wire: str) -> int:
    """Stuff the text as a controller does; return how much longer it became."""
    stuffed = ""
    for bit in wire:
        stuffed += bit
        if stuffed[-5:] in ("00000", "11111"):
            stuffed += "1" if bit == "0" else "0"
    return len(stuffed) - len(wire)
