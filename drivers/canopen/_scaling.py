"""Encoder counts and presets (CiA 406) and polarity of I/O nodes (CiA 401): read, judged and set.

Polarity and masks of an I/O node (CiA 401): meaning of a 1, and the outputs and inputs that take part. With
inverted outputs the fallback "without energy" energises everything; with an inverted input an open emergency
stop reads as clear. A masked output follows neither commands nor, in some devices, the fallback. Devices have
the 8-bit objects, the 16-bit ones, both for the same channels, or none.

Values that move an encoder's zero inside the device: preset (6003h) and offset (6509h), read only. A preset
set after the calibration shifts all angles that the bench reads from the encoder. The device computes the
offset from the preset; both stay as they are until the next preset.

Meaning of an encoder's counts (CiA 406): direction, scaling and range, read, judged and set. The bench uses
the counts of the disc (6501h), rising clockwise. With scaling there would be 6001h per revolution, whatever
the disc resolves. With the other code sequence counts would fall, and the controller would open the wrong
valve. Objects that a device does not have cannot change its counts.
"""

from __future__ import annotations

from typing import NamedTuple

from drivers.base import DriverError
from drivers.canopen._services import Node, ServiceError

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
            f"{node.location(0x6202, 1, POLARITY[0x6202])}: found inverted outputs, and the device cannot "
            "store the change (1010h), so they are energised after a loss of power; set the polarity to 0 "
            "with the device's own tool, or use another device"
        )


_OBJECTS = (0x6003, "preset", False), (0x6509, "offset", True)
"""Index, name, and whether it is signed."""


def read_zero_shift(node: Node) -> str:
    """Return preset and offset in counts, such as "preset 0, offset -120"; empty if the device has neither.

    An object whose reading the device aborts counts as missing.

    Raises:
        ServiceError: the node does not answer.
    """
    parts = []
    for index, name, signed in _OBJECTS:
        try:
            found = node.read_bytes(index, 0, name)
        except ServiceError as error:
            if not error.code:
                raise
            continue
        parts.append(f"{name} {int.from_bytes(found, 'little', signed=signed)}")
    return ", ".join(parts)


_OPERATING, _UNITS, _RANGE, _STEP = 0x6000, 0x6001, 0x6002, 0x6005
_RESOLUTION, _REVOLUTIONS = 0x6501, 0x6502
_NAMES = {
    0x1000: "device type",
    _OPERATING: "operating parameters",
    _UNITS: "measuring units per revolution",
    _RANGE: "total measuring range",
    _STEP: "measuring step of a linear encoder",
    _RESOLUTION: "counts per revolution of the disc",
    _REVOLUTIONS: "revolutions",
}
_REVERSED, _SCALED, _MEASURED_BACKWARDS = 1 << 0, 1 << 2, 1 << 3
"""Bits of the operating parameters: code sequence, scaling, measuring direction."""
_JUDGED = _REVERSED | _SCALED | _MEASURED_BACKWARDS
_ROTARY_ABSOLUTE = frozenset({0, 1, 2, 3})
"""Encoder types (1000h, second word) of absolute rotary encoders; 0 where a device names none."""
_MAX = 0xFFFFFFFF


class EncoderScale(NamedTuple):
    """How an encoder counts, as its objects say; None where the device has no such object."""

    kind: int
    """Encoder type of CiA 406, the second word of 1000h."""
    operating: int | None
    units: int | None
    total: int | None
    """6002h; some devices give the number of positions there, others the last one."""
    step: int
    """6005h; 0 if absent."""
    resolution: int | None
    """Counts per revolution of the disc."""
    revolutions: int
    """Number of revolutions, at least 1."""

    @property
    def scaled(self) -> bool:
        """Whether the scaling is on."""
        return self.operating is not None and self.operating & _SCALED != 0

    @property
    def disc(self) -> int:
        """Counts per revolution without scaling; 0 if the device does not say."""
        return self.resolution or self.units or 0

    @property
    def counts(self) -> int:
        """Counts per revolution at present; 0 if the device does not say."""
        return self.units or 0 if self.scaled else self.disc


def read_scale(node: Node) -> EncoderScale:
    """Read how an encoder counts.

    Raises:
        ServiceError: the node refuses or does not answer.
    """

    def read(index: int, subindex: int = 0) -> int | None:
        found = node.find(index, subindex, _NAMES[index])
        return None if found is None else int.from_bytes(found, "little")

    # 6005h is an array in the profile and a plain number in some devices.
    step = read(_STEP, 1)
    return EncoderScale(
        (read(0x1000) or 0) >> 16 & 0xFFFF,
        read(_OPERATING),
        read(_UNITS),
        read(_RANGE),
        (read(_STEP) if step is None else step) or 0,
        read(_RESOLUTION),
        read(_REVOLUTIONS) or 1,
    )


def wanted_settings(node: Node, scale: EncoderScale, counts: int) -> list[tuple[int, int]]:
    """Return the objects to be set, and to what, for `counts` per revolution that rise clockwise.

    Raises:
        DriverError: no setting of this device gives them; the message names the action.
    """
    if scale.kind not in _ROTARY_ABSOLUTE:
        raise DriverError(
            f"{node.location(0x1000, 0, _NAMES[0x1000])}: found encoder type {scale.kind}, expected an "
            "absolute rotary encoder (1, 2 or 3); use another encoder"
        )
    if scale.step:
        raise DriverError(
            f"{node.location(_STEP, 1, _NAMES[_STEP])}: found {scale.step}, so the device counts lengths, "
            "not parts of a revolution; use a rotary encoder"
        )
    if counts != scale.disc and not (scale.scaled and scale.units == counts and scale.disc % counts == 0):
        raise _wrong_resolution(node, scale, counts)
    total = counts * scale.revolutions
    wanted = []
    if scale.units not in {None, counts}:
        wanted.append((_UNITS, counts))
    # 2^32 positions are 0 or the last one, 2^32 - 1, in 32 bits.
    if scale.total not in {None, total & _MAX, total - 1}:
        wanted.append((_RANGE, min(total, _MAX)))
    if scale.operating is not None:
        operating = scale.operating & ~_JUDGED | (_SCALED if counts != scale.disc else 0)
        if operating != scale.operating:
            wanted.append((_OPERATING, operating))
    return wanted


def set_scale(node: Node, counts: int, position: int) -> int:
    """Make the encoder give `counts` per revolution that rise clockwise; return the counts of its range.

    `position` is its position object. Everything is read again afterwards: setting one object changes others
    in some devices.

    Raises:
        DriverError: no setting gives these counts, or a setting is refused or not kept.
    """
    scale = read_scale(node)
    wanted = wanted_settings(node, scale, counts)
    if _is_fixed(node, wanted, scale, counts):
        wanted = []
    elif wanted:
        _set(node, wanted)
        scale = read_scale(node)
        for index, value in wanted_settings(node, scale, counts):
            raise DriverError(
                f"{node.location(index, 0, _NAMES[index])}: expected {value:#x} and set it, but the device "
                "has changed it again; set it with the device's own tool, or use another device"
            )
    total = counts * scale.revolutions
    found = node.read(position, 0, "position")
    if found >= total:
        raise DriverError(
            f"{node.location(position, 0, 'position')}: found {found}, expected less than {total} ({counts} "
            f"counts per revolution, {scale.revolutions} revolutions); cycle the device's power, then check "
            "its scaling (6000h, 6001h, 6002h)"
        )
    return total


def describe_scale(scale: EncoderScale) -> str:
    """Return one line on how an encoder counts."""
    revolutions = f"{scale.revolutions} revolutions" if scale.revolutions > 1 else "single turn"
    scaling = f", scaled to {scale.units} counts" if scale.scaled else ""
    reverse = ", reversed" if scale.operating is not None and scale.operating & _REVERSED else ""
    return f"{scale.disc} counts per revolution, {revolutions}{scaling}{reverse}"


def describe_settings(wanted: list[tuple[int, int]]) -> str:
    """Return the objects that the startup sets, as text."""
    return ", ".join(f"{index:04X}h = {value:#x} ({_NAMES[index]})" for index, value in wanted)


def _set(node: Node, wanted: list[tuple[int, int]]) -> None:
    """Set the objects; a device may accept units and range in the other order only."""
    try:
        for index, value in wanted:
            _set_one(node, index, value)
    except ServiceError as error:
        if not error.code or [index for index, _ in wanted[:2]] != [_UNITS, _RANGE]:
            raise
        try:
            _set_one(node, *wanted[1])
        except ServiceError:
            raise error from None
        for index, value in wanted:
            _set_one(node, index, value)


def _set_one(node: Node, index: int, value: int) -> None:
    try:
        node.set_if_different(index, 0, value, _NAMES[index])
    except ServiceError as error:
        if index != _OPERATING or not error.code:
            raise
        raise DriverError(
            f"{error}. Expected {value:#x}: counts that rise clockwise (bit 0 off), and scaling (bit 2) "
            f"{'on' if value & _SCALED else 'off'}. Set it with the device's own tool or switches"
        ) from error


def _is_fixed(node: Node, wanted: list[tuple[int, int]], scale: EncoderScale, counts: int) -> bool:
    """Return whether only the scaling differs, cannot be changed, and scales one to one."""
    if [index for index, _ in wanted] != [_OPERATING] or scale.operating is None:
        return False
    ((_, value),) = wanted
    if scale.operating ^ value != _SCALED or scale.units != counts or scale.disc != counts:
        return False
    try:
        return not node.set_if_different(_OPERATING, 0, value, _NAMES[_OPERATING])
    except ServiceError as error:
        if not error.code:
            raise
        return True


def _wrong_resolution(node: Node, scale: EncoderScale, counts: int) -> DriverError:
    location = node.location(_RESOLUTION, 0, _NAMES[_RESOLUTION])
    if not scale.disc:
        return DriverError(
            f"{location}: found none, and none in 6001h, expected {counts}; use an encoder that gives its "
            "resolution"
        )
    scaled = f" scaled to {scale.units} (6000h bit 2, 6001h)," if scale.scaled else ""
    return DriverError(
        f"{location}: found {scale.disc},{scaled} expected {counts}; set "
        f"plant.encoders.counts_per_revolution = {scale.disc} if this is the right encoder: the startup "
        "switches scaling off"
    )
