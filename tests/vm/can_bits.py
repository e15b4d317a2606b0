"""Bits that a classic CAN frame takes on the wire, stuff bits counted one by one (ISO 11898-1)."""

from __future__ import annotations

_CRC_POLYNOMIAL = 0x4599
_UNSTUFFED = 13
"""CRC delimiter, acknowledgement and its delimiter, end of frame, pause: 1 + 2 + 7 + 3."""


def bits_of(identifier: int, data: bytes) -> int:
    """Return the bits of a data frame with an identifier of 11 bits."""
    head = f"0{identifier:011b}000{len(data):04b}" + "".join(f"{byte:08b}" for byte in data)
    crc = 0
    for bit in head:
        feed = (bit == "1") ^ (crc >> 14 & 1)
        crc = (crc << 1 & 0x7FFF) ^ (_CRC_POLYNOMIAL if feed else 0)
    stuffed, last, run = 0, "", 0
    for bit in f"{head}{crc:015b}":
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:  # the stuff bit, which begins the next run
            stuffed, last, run = stuffed + 1, "1" if bit == "0" else "0", 1
    return len(head) + 15 + stuffed + _UNSTUFFED
