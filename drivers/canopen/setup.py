"""The start-up of the nodes: who they are, what they send and hear, what they do when the bench is silent.

Everything that is written is read back. Nothing here moves anything: the nodes are pre-operational.
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
"""Of a PDO's identifier: valid or not, and the identifier; the rest is the device's own."""
_MOST_PDOS = 4
_ON_EVENT = 255
_MISSING = frozenset({0x06020000, 0x06090011})
"""Abort codes: no such object, no such sub-index."""


def set_up_encoder(node: Node, settings: CanopenSettings, counts: int) -> int:
    """Let the encoder send its position with every SYNC; return the counts of its whole range.

    Raises:
        DriverError: it is no such device, has not `counts` in a revolution, or refuses a setting.
    """
    chosen = settings.encoders
    _identify(node, _ENCODER_PROFILE, chosen.vendor, chosen.product)
    node.expect(
        0x6501,
        0,
        counts,
        "counts per revolution",
        "set plant.encoders.counts_per_revolution to what the encoder has, or scale the encoder",
    )
    revolutions = node.read(0x6502, 0, "revolutions") or 1
    _silence(node, _TPDO, keep=1)
    _set_pdo(node, _TPDO + 1, _TPDO_MAP + 1, TPDO2 + node.number, 1, [chosen.position << 16 | 32])
    _set_heartbeat(node, settings)
    return counts * revolutions


def set_up_valve_node(node: Node, settings: CanopenSettings, watchdog: float) -> None:
    """Let the valve node hear commands and tell of inputs, and fall back to the centre on silence.

    Raises:
        DriverError: it is no such device, refuses a setting, or cannot fall back while no relay is named.
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
            f"{node.place(_TPDO, 5, 'event timer of the inputs')}: the device has none, so that a broken "
            "line would not show; take another one"
        )
    for n, group in enumerate(pressure_groups(chosen), start=1):
        base = (TPDO2, TPDO3)[n - 1]
        mapped = [0x6401 << 16 | channel << 8 | 16 for channel in group]
        _set_pdo(node, _TPDO + n, _TPDO_MAP + n, base + node.number, settings.pressure_ticks, mapped)
    _set_heartbeat(node, settings)


def set_fallback(node: Node, chosen: ValveNodeSettings) -> None:
    """Set what the outputs do without commands: valves at their centre, switches without energy.

    A node that can is let store it (1010h) when it was another one: after a loss of power in the middle of a
    swing it comes up with centred spools, not at 0 V.

    Raises:
        DriverError: the node refuses, and no external relay is named that does it in its stead.
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
    """Set a value where it is another one, and return whether it was; it is read back in any case."""
    if node.read(index, subindex, name) == value:
        return False
    node.set(index, subindex, value, size, name)
    return True


def _set_error_behaviour(node: Node) -> bool:
    """Let the node leave its operational state on an error, as one without 1029h does; tell if it is new."""
    try:
        return _renew(node, 0x1029, 1, 0, 1, "error behaviour")
    except ServiceError as error:
        if error.code not in _MISSING:
            raise
        return False


def _store(node: Node) -> None:
    """Let the node keep its settings over a loss of power, if it can."""
    try:
        node.write(0x1010, 1, int.from_bytes(b"save", "little"), 4, "store parameters")
    except ServiceError as error:
        if error.code not in _MISSING:
            raise


def _offer(node: Node, index: int, subindex: int, value: int, size: int, name: str) -> bool:
    """Set a value; return whether the device has that object at all."""
    try:
        node.set(index, subindex, value, size, name)
    except ServiceError as error:
        if error.code not in _MISSING:
            raise
        return False
    return True


def _without_fallback(what: object) -> DriverError:
    return DriverError(
        f"{what}. A node that does not let go of the valves by itself when the bench is silent is refused: "
        "0 V is full stroke. Take another one, or fit an external watchdog relay that centres the valves and "
        "name it in canopen.valve_node.watchdog_relay"
    )


def _identify(node: Node, profile: int, vendor: int, product: int) -> None:
    """Refuse a device of another profile, vendor or product.

    Raises:
        DriverError: it is another one, or does not answer.
    """
    node.expect(
        0x1000,
        0,
        profile,
        "device type",
        f"expected is profile {profile}: correct the node numbers in [canopen], or the device's number",
        mask=0xFFFF,
    )
    for subindex, wanted, name in ((1, vendor, "vendor"), (2, product, "product")):
        if wanted:
            cure = f"another device was fitted: see that it does the same, then correct {name} in [canopen]"
            node.expect(0x1018, subindex, wanted, name, cure)


def _silence(node: Node, communication: int, keep: int = -1) -> None:
    """Switch off every PDO of one direction that the device has, but number `keep`."""
    for number in range(_MOST_PDOS):
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
    """Set up one PDO in the order that CiA 301 asks for: off, contents, time, on.

    Returns whether the device has the event timer (ms) that was asked for.
    """
    _invalidate(node, index)
    node.set(index, 2, kind, 1, "transmission type")
    try:
        node.write(mapping, 0, 0, 1, "number of objects in the PDO")
        for n, entry in enumerate(mapped, start=1):
            node.write(mapping, n, entry, 4, "object in the PDO")
        node.write(mapping, 0, len(mapped), 1, "number of objects in the PDO")
    except ServiceError as error:
        if error.code != 0x06010002:  # a fixed mapping may be the right one
            raise
    cure = "the device has a fixed mapping: take one whose mapping can be set"
    node.expect(mapping, 0, len(mapped), "number of objects in the PDO", cure)
    for n, entry in enumerate(mapped, start=1):
        node.expect(mapping, n, entry, "object in the PDO", cure)
    has_timer = bool(event_timer) and _offer(node, index, 5, event_timer, 2, "event timer")
    node.set(index, 1, identifier | _NO_REMOTE, 4, "identifier of the PDO", _COB_ID_MASK)
    return has_timer


def _set_heartbeat(node: Node, settings: CanopenSettings) -> None:
    node.set(0x1017, 0, round(1e3 * settings.heartbeat), 2, "heartbeat")
