"""Polarity and masks of an I/O node (CiA 401): what a 1 means, and which outputs and inputs take part.

With inverted outputs the fallback "without energy" energises everything; with an inverted input an open
emergency stop reads as clear. A masked output follows neither commands nor, in some devices, the fallback.
Devices have the 8-bit objects, the 16-bit ones, both for the same channels, or none.
"""

from __future__ import annotations

from typing import NamedTuple

from drivers.base import DriverError
from drivers.canopen.services import Node, ServiceError

POLARITY = {
    0x6002: "polarity of the inputs",
    0x6102: "polarity of the inputs, 16 bits",
    0x6202: "polarity of the outputs",
    0x6302: "polarity of the outputs, 16 bits",
}
"""Objects of which each bit inverts a channel."""
_OUTPUTS = frozenset({0x6202, 0x6302})
_MASKS = {
    0x6208: "mask of the outputs",
    0x6308: "mask of the outputs, 16 bits",
    0x6006: "mask of the inputs that are sent on change",
}
"""Objects of which each bit lets a channel take part."""
_ON_CHANGE = 0x6005
"""Object that is 1 where inputs are sent on change."""


class PolaritySetting(NamedTuple):
    """One object that must be set before inputs and outputs mean what they say."""

    main_index: int
    subindex: int
    found: bytes
    wanted: int
    name: str


def wrong_settings(node: Node) -> list[PolaritySetting]:
    """Return the objects of polarity and masks that the device has otherwise.

    Raises:
        ServiceError: the node refuses or does not answer.
    """
    wrong = []
    places = [(index, 1, name) for index, name in (*POLARITY.items(), *_MASKS.items())]
    for index, subindex, name in (*places, (_ON_CHANGE, 0, "inputs are sent on change")):
        found = node.find(index, subindex, name)
        if found is None:
            continue
        wanted = (1 << 8 * len(found)) - 1 if index in _MASKS else int(index == _ON_CHANGE)
        if int.from_bytes(found, "little") != wanted:
            wrong.append(PolaritySetting(index, subindex, found, wanted, name))
    return wrong


def set_polarity(node: Node) -> tuple[bool, bool]:
    """Make inputs and outputs mean what they say, and let all of them take part.

    Returns whether anything was changed, and whether outputs were inverted before.

    Raises:
        ServiceError: the node refuses, or does not keep a setting.
    """
    wrong = wrong_settings(node)
    for index, subindex, found, wanted, name in wrong:
        try:
            node.set(index, subindex, wanted, len(found), name)
        except ServiceError as error:
            if index not in POLARITY:
                raise
            raise ServiceError(
                f"{error}. Found {found[::-1].hex()}h: inverted channels make the fallback energise outputs, "
                "or an open contact read as closed. Set it to 0 with the device's own tool",
                error.code,
            ) from error
    return bool(wrong), any(one.main_index in _OUTPUTS for one in wrong)


def check_stored(node: Node, inverted: bool, stored: bool) -> None:
    """Require that outputs which were inverted before are stored as not inverted.

    Raises:
        DriverError: they are inverted again after a loss of power.
    """
    if inverted and not stored:
        raise DriverError(
            f"{node.place(0x6202, 1, POLARITY[0x6202])}: found inverted outputs, and the device cannot store "
            "the change (1010h), so they are energised after a loss of power; set the polarity to 0 with "
            "the device's own tool, or use another device"
        )
