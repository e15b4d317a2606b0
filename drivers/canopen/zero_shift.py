"""What moves an encoder's zero inside the device: preset (6003h) and offset (6509h), read only.

A preset that is set after the encoder was calibrated turns the robot that the bench believes in. The device
computes the offset from the preset; both stay as they are until the next preset.
"""

from __future__ import annotations

from drivers.canopen.services import Node, ServiceError

_OBJECTS = (0x6003, "preset", False), (0x6509, "offset", True)
"""Index, name, and whether it is signed."""


def read_zero_shift(node: Node) -> str:
    """Return preset and offset in counts, such as "preset 0, offset -120"; empty if the device has neither.

    An object that the device refuses to show counts as missing.

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
