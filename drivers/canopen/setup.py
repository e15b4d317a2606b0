"""Startup of the nodes: check identity, configure PDOs and heartbeats, set the fallback on silence.

Every setting is read back. Nothing moves: the nodes are pre-operational.
"""

from __future__ import annotations

from drivers.base import ACTUATORS, DriverError
from drivers.canopen.frames import RPDO1, TPDO1, TPDO2, TPDO3, pressure_groups, valve_counts
from drivers.canopen.services import Node, ServiceError
from drivers.canopen.settings import CanopenSettings, ValveNodeSettings

_ENCODER_PROFILE, _IO_PROFILE = 406, 401
_RPDO, _RPDO_MAP, _TPDO, _TPDO_MAP = 0x1400, 0x1600, 0x1800, 0x1A00
_INVALID, _NO_REMOTE = 0x80000000, 0x40000000
_COB_ID_MASK = 0x800007FF
"""Valid bit and identifier of a PDO's COB-ID; the other bits are device-specific."""
_MAX_PDOS = 4
_ON_EVENT = 255
_MISSING = frozenset({0x06020000, 0x06090011})
"""Abort codes: no such object, no such sub-index."""


def set_up_encoder(node: Node, settings: CanopenSettings, counts: int) -> int:
    """Configure the encoder to send its position with every SYNC; return the counts of its whole range.

    Raises:
        DriverError: wrong device, not `counts` per revolution, or a setting is refused.
    """
    chosen = settings.encoders
    _identify(node, _ENCODER_PROFILE, chosen.vendor, chosen.product)
    node.expect(
        0x6501,
        0,
        counts,
        "counts per revolution",
        "set plant.encoders.counts_per_revolution to the encoder's resolution, or scale the encoder",
    )
    revolutions = node.read(0x6502, 0, "revolutions") or 1
    _silence(node, _TPDO, keep=1)
    _set_pdo(node, _TPDO + 1, _TPDO_MAP + 1, TPDO2 + node.number, 1, [chosen.position << 16 | 32])
    _set_heartbeat(node, settings)
    return counts * revolutions


def set_up_valve_node(node: Node, settings: CanopenSettings, watchdog: float) -> None:
    """Configure the valve node's commands, inputs and fallback to centred valves on silence.

    Raises:
        DriverError: wrong device, a setting is refused, or no fallback and no watchdog relay.
    """
    chosen = settings.valve_node
    _identify(node, _IO_PROFILE, chosen.vendor, chosen.product)
    _silence(node, _RPDO)
    _silence(node, _TPDO)
    set_fallback(node, chosen)
    valves = [0x6411 << 16 | channel << 8 | 16 for channel in chosen.valves]
    silence = round(1e3 * watchdog)
    watches_commands = _set_pdo(
        node, _RPDO, _RPDO_MAP, RPDO1 + node.number, _ON_EVENT, [*valves, 0x62000108], silence
    )
    entry = settings.master << 16 | silence
    watches_heartbeat = _offer(node, 0x1016, 1, entry, 4, "consumer of the bench's heartbeat")
    if not (watches_commands or watches_heartbeat or chosen.watchdog_relay):
        raise _without_fallback(
            f"canopen: node {node.number} ({node.role}) has neither object 1400h:5 (event timer of the "
            "command) nor 1016h:1 (consumer of the bench's heartbeat)"
        )
    inputs_timer = round(1e3 * settings.interlock_period)
    if not _set_pdo(node, _TPDO, _TPDO_MAP, TPDO1 + node.number, _ON_EVENT, [0x60000108], inputs_timer):
        raise DriverError(
            f"{node.place(_TPDO, 5, 'event timer of the inputs')}: missing in the device, so a broken "
            "line would go undetected; use another device"
        )
    for n, group in enumerate(pressure_groups(chosen), start=1):
        base = (TPDO2, TPDO3)[n - 1]
        mapped = [0x6401 << 16 | channel << 8 | 16 for channel in group]
        _set_pdo(node, _TPDO + n, _TPDO_MAP + n, base + node.number, settings.pressure_ticks, mapped)
    _set_heartbeat(node, settings)


def set_fallback(node: Node, chosen: ValveNodeSettings) -> None:
    """Set the fallback of the outputs without commands: valves centred, switches de-energised.

    Changed settings are stored in the node (1010h) if it can: after a power loss in mid-swing it starts with
    centred spools, not at 0 V.

    Raises:
        DriverError: the node refuses, and no external watchdog relay is named.
    """
    new = False
    try:
        for channel, centre, actuator in zip(chosen.valves, chosen.centre, ACTUATORS, strict=True):
            count = valve_counts(centre, chosen)
            value = count << chosen.error_value_shift
            new |= _renew(node, 0x6443, channel, 1, 1, f"error mode of the valve of the {actuator}")
            new |= _renew(node, 0x6444, channel, value, 4, f"error value of the valve of the {actuator}")
            node.set(0x6411, channel, count, 2, f"valve of the {actuator}")
        new |= _renew(node, 0x6206, 1, 0xFF, 1, "error mode of the outputs")
        new |= _renew(node, 0x6207, 1, 0, 1, "error value of the outputs")
        node.set(0x6200, 1, 0, 1, "outputs")
        new |= _set_error_behaviour(node)
    except ServiceError as error:
        if error.code not in _MISSING or not chosen.watchdog_relay:
            raise _without_fallback(error) if error.code in _MISSING else error from None
    if new:
        _store(node)


def _renew(node: Node, index: int, subindex: int, value: int, size: int, name: str) -> bool:
    """Set a value if it differs, and return whether it did; the value is read back in either case."""
    if node.read(index, subindex, name) == value:
        return False
    node.set(index, subindex, value, size, name)
    return True


def _set_error_behaviour(node: Node) -> bool:
    """Make the node leave the operational state on an error (1029h); return whether the setting changed."""
    try:
        return _renew(node, 0x1029, 1, 0, 1, "error behaviour")
    except ServiceError as error:
        if error.code not in _MISSING:
            raise
        return False


def _store(node: Node) -> None:
    """Store the node's settings over a power loss, if it supports that."""
    try:
        node.write(0x1010, 1, int.from_bytes(b"save", "little"), 4, "store parameters")
    except ServiceError as error:
        if error.code not in _MISSING:
            raise


def _offer(node: Node, index: int, subindex: int, value: int, size: int, name: str) -> bool:
    """Set a value; return whether the device has the object."""
    try:
        node.set(index, subindex, value, size, name)
    except ServiceError as error:
        if error.code not in _MISSING:
            raise
        return False
    return True


def _without_fallback(what: object) -> DriverError:
    return DriverError(
        f"{what}. A node that does not centre the valves by itself when the bench is silent is refused: "
        "0 V is full stroke. Use another node, or fit an external watchdog relay that centres the valves and "
        "name it in canopen.valve_node.watchdog_relay"
    )


def _identify(node: Node, profile: int, vendor: int, product: int) -> None:
    """Check device profile, vendor and product.

    Raises:
        DriverError: one of them differs, or the node does not answer.
    """
    node.expect(
        0x1000,
        0,
        profile,
        "device type",
        f"expected device profile {profile}: correct the node numbers in [canopen] or at the device",
        mask=0xFFFF,
    )
    for subindex, wanted, name in ((1, vendor, "vendor"), (2, product, "product")):
        if wanted:
            cure = f"another device is fitted: check that it is equivalent, then correct {name} in [canopen]"
            node.expect(0x1018, subindex, wanted, name, cure)


def _silence(node: Node, communication: int, keep: int = -1) -> None:
    """Disable every PDO of one direction except number `keep`."""
    for number in range(_MAX_PDOS):
        if number == keep:
            continue
        try:
            _invalidate(node, communication + number)
        except ServiceError as error:
            if error.code not in _MISSING:
                raise


def _invalidate(node: Node, index: int) -> None:
    found = node.read(index, 1, "identifier of the PDO")
    if not found & _INVALID:
        node.set(index, 1, found | _INVALID, 4, "identifier of the PDO", _INVALID)


def _set_pdo(
    node: Node, index: int, mapping: int, identifier: int, kind: int, mapped: list[int], event_timer: int = 0
) -> bool:
    """Configure one PDO in the order required by CiA 301: disable, map, set timer, enable.

    Returns whether the device has the requested event timer (ms).
    """
    _invalidate(node, index)
    node.set(index, 2, kind, 1, "transmission type")
    try:
        node.write(mapping, 0, 0, 1, "number of objects in the PDO")
        for n, entry in enumerate(mapped, start=1):
            node.write(mapping, n, entry, 4, "object in the PDO")
        node.write(mapping, 0, len(mapped), 1, "number of objects in the PDO")
    except ServiceError as error:
        if error.code != 0x06010002:  # a fixed mapping may already be right
            raise
    cure = "the device has a fixed mapping: use a device with a configurable mapping"
    node.expect(mapping, 0, len(mapped), "number of objects in the PDO", cure)
    for n, entry in enumerate(mapped, start=1):
        node.expect(mapping, n, entry, "object in the PDO", cure)
    has_timer = bool(event_timer) and _offer(node, index, 5, event_timer, 2, "event timer")
    node.set(index, 1, identifier | _NO_REMOTE, 4, "identifier of the PDO", _COB_ID_MASK)
    return has_timer


def _set_heartbeat(node: Node, settings: CanopenSettings) -> None:
    node.set(0x1017, 0, round(1e3 * settings.heartbeat), 2, "heartbeat")
