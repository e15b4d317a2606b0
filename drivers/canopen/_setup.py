"""Startup of the nodes: check identity, configure PDOs and heartbeats, set the fallback on silence.

Every setting is read back. Nothing moves: the nodes are pre-operational.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from drivers.base import ACTUATORS, DriverError
from drivers.canopen._scaling import check_stored, set_polarity, set_scale
from drivers.canopen._services import MISSING, Node, ServiceError
from drivers.canopen.frames import RPDO1, TPDO1, TPDO2, analogue_groups, valve_counts
from drivers.canopen.settings import CanopenSettings, EncoderSettings, ValveNodeSettings

ENCODER_PROFILE, IO_PROFILE = 406, 401
_RPDO, _RPDO_MAP, _TPDO, _TPDO_MAP = 0x1400, 0x1600, 0x1800, 0x1A00
_INVALID, _NO_REMOTE = 0x80000000, 0x40000000
_COB_ID_MASK = 0x800007FF
"""Valid bit and identifier of a PDO's COB-ID; the other bits are device-specific."""
_PREDEFINED_PDOS = 4
"""PDOs of each direction that may be on without being set; devices number further ones without gaps."""
_MAX_PDOS = 512
_MAX_MAPPED = 64
_ON_EVENT = 255
STORE_TIME = 10.0
"""Time-out of storing the settings in a node (1010h), s; common devices take 2 s to 5 s."""
ERROR_BEHAVIOUR = 0x1029, 0x67FE
"""Objects of the behaviour on a communication error: CiA 301, and older devices of CiA 401."""
OUTPUT_ERRORS = (0x6206, 0x6207), (0x6306, 0x6307)
"""Error modes and error values of the outputs in groups of 8 and of 16."""


def set_up_encoder(node: Node, settings: CanopenSettings, counts: int) -> int:
    """Configure the encoder to send its position with every SYNC; return the counts of its whole range.

    Raises:
        DriverError: wrong device, not `counts` per revolution rising clockwise, or a setting is refused.
    """
    chosen = settings.encoders
    identify(node, ENCODER_PROFILE, chosen.vendor, chosen.product)
    total = set_scale(node, counts, chosen.position)
    pdo, mapping = require_position_pdo(node, chosen)
    _silence(node, _TPDO, {pdo - _TPDO})
    _set_pdo(node, pdo, mapping, TPDO2 + node.number, 1, [chosen.position << 16 | 32])
    _set_heartbeat(node, settings)
    return total


def require_position_pdo(node: Node, chosen: EncoderSettings) -> tuple[int, int]:
    """Return communication and mapping object of the PDO of the position.

    Raises:
        DriverError: the device does not have them, or does not answer.
    """
    pdo, mapping = chosen.position_pdo, chosen.position_pdo + _TPDO_MAP - _TPDO
    for index, subindex, name in ((pdo, 1, "identifier of the PDO"), (mapping, 0, "mapping of the PDO")):
        if node.find(index, subindex, name) is None:
            raise DriverError(
                f"{node.location(index, subindex, name)}: found no such object, expected the PDO that the "
                "encoder sends with SYNC; set canopen.encoders.position_pdo to the one in its manual: "
                "0x1801, or 0x1802 in version 2 of DS 406"
            )
    return pdo, mapping


def set_up_valve_node(node: Node, settings: CanopenSettings, watchdog: float) -> None:
    """Configure the valve node's commands, inputs and fallback to centred valves on silence.

    Raises:
        DriverError: wrong device, a setting is refused, or no fallback and no watchdog relay.
    """
    chosen = settings.valve_node
    identify(node, IO_PROFILE, chosen.vendor, chosen.product)
    groups = analogue_groups(settings)
    _silence(node, _RPDO, {0})
    _silence(node, _TPDO, {0, *(group.number for group in groups)})
    _set_fallback(node, settings)
    valves = [0x6411 << 16 | channel << 8 | 16 for channel in chosen.valves]
    silence = round(1e3 * watchdog)
    watches_commands = _set_pdo(
        node, _RPDO, _RPDO_MAP, RPDO1 + node.number, _ON_EVENT, [*valves, 0x62000108], silence
    )
    entry = settings.master << 16 | silence
    watches_heartbeat = _offer(node, 0x1016, 1, entry, 4, "consumer of the bench's heartbeat")
    if not (watches_commands or watches_heartbeat or chosen.watchdog_relay):
        raise without_fallback(
            f"canopen: node {node.number} ({node.role}) has neither object 1400h:5 (event timer of the "
            "command) nor 1016h:1 (consumer of the bench's heartbeat)"
        )
    inputs_timer = round(1e3 * settings.interlock_period)
    if not _set_pdo(node, _TPDO, _TPDO_MAP, TPDO1 + node.number, _ON_EVENT, [0x60000108], inputs_timer):
        raise DriverError(
            f"{node.location(_TPDO, 5, 'event timer of the inputs')}: missing in the device, so a broken "
            "line would go undetected; use another device"
        )
    for group in groups:
        n, mapped = group.number, [0x6401 << 16 | channel << 8 | 16 for channel in group.channels]
        _set_pdo(node, _TPDO + n, _TPDO_MAP + n, group.base + node.number, group.ticks, mapped)
    _set_heartbeat(node, settings)


def _set_fallback(node: Node, settings: CanopenSettings) -> None:
    """Set the fallback of the outputs without commands: valves centred, switches de-energised.

    Changed settings are stored in the node (1010h) if it can: after a power loss in mid-swing it starts with
    centred spools, not at 0 V.

    Raises:
        DriverError: the node refuses, and no external watchdog relay is configured.
    """
    chosen = settings.valve_node
    new, inverted = set_polarity(node)
    for channel, centre, actuator in zip(chosen.valves, chosen.centre, ACTUATORS, strict=True):
        count = valve_counts(centre, chosen)
        with _excused(chosen):
            mode = f"error mode of the valve of the {actuator}"
            new |= node.set_if_different(0x6443, channel, 1, mode)
            new |= _set_error_value(node, channel, count, chosen.error_value_shift, actuator)
        node.set(0x6411, channel, count, 2, f"valve of the {actuator}")
    with _excused(chosen):
        new |= _set_output_errors(node)
    node.set(0x6200, 1, 0, 1, "outputs")
    new |= _set_error_behaviour(node)
    check_stored(node, inverted, new and _store(node, STORE_TIME))


@contextmanager
def _excused(chosen: ValveNodeSettings) -> Iterator[None]:
    """Let the device lack an object of its fallback if an external relay is configured.

    Raises:
        DriverError: no relay is configured, or the device refuses an object that it has.
    """
    try:
        yield
    except ServiceError as error:
        if error.code not in MISSING:
            raise
        if not chosen.watchdog_relay:
            raise without_fallback(error) from None


def _set_error_value(node: Node, channel: int, count: int, shift: int, actuator: str) -> bool:
    """Set the value of a valve without commands, in 16 or 32 bits; return whether it was another."""
    name = f"error value of the valve of the {actuator}"
    size = len(node.read_bytes(0x6444, channel, name))
    if size not in {2, 4}:
        raise ServiceError(
            f"{node.location(0x6444, channel, name)}: found {size} bytes, expected 2 or 4; use another device"
        )
    try:
        return node.set_if_different(0x6444, channel, count << shift if size == 4 else count, name)
    except ServiceError as error:
        if size == 4 and error.code and error.code not in MISSING:
            action = (
                f"{error}. If it takes values without a shift, set canopen.valve_node.error_value_shift = 0"
            )
            raise ServiceError(action, error.code) from error
        raise


def _set_output_errors(node: Node) -> bool:
    """De-energise all outputs without commands; return whether that was set otherwise."""
    mode_name, value_name = "error mode of the outputs", "error value of the outputs"
    groups = [pair for pair in OUTPUT_ERRORS if node.find(pair[0], 1, mode_name) is not None]
    new = False
    for mode, value in groups or OUTPUT_ERRORS[:1]:
        size = len(node.read_bytes(mode, 1, mode_name))
        new |= node.set_if_different(mode, 1, (1 << 8 * size) - 1, mode_name)
        new |= node.set_if_different(value, 1, 0, value_name)
    return new


def _set_error_behaviour(node: Node) -> bool:
    """Make the node leave the operational state on an error; return whether the setting changed."""
    for index in ERROR_BEHAVIOUR:
        if node.find(index, 1, "error behaviour") is not None:
            return node.set_if_different(index, 1, 0, "error behaviour")
    return False


def _store(node: Node, longest: float) -> bool:
    """Store the node's settings over a power loss within `longest` s; return whether it supports that."""
    save = int.from_bytes(b"save", "little")
    return _is_there(partial(node.write, 0x1010, 1, save, 4, "store parameters", longest))


def _offer(node: Node, index: int, subindex: int, value: int, size: int, name: str) -> bool:
    """Set a value; return whether the device has the object."""
    return _is_there(partial(node.set, index, subindex, value, size, name))


def _is_there(access: Callable[[], object]) -> bool:
    """Return whether the device has the object of `access`; ServiceError if that fails otherwise."""
    try:
        access()
    except ServiceError as error:
        if error.code not in MISSING:
            raise
        return False
    return True


def without_fallback(what: object) -> DriverError:
    """Return the refusal of a node that does not go passive automatically, for the reason `what`."""
    return DriverError(
        f"{what}. A node that does not centre the valves on a loss of communication is refused: "
        "0 V is full stroke. Use another node, or fit an external watchdog relay that centres the valves and "
        "name it in canopen.valve_node.watchdog_relay"
    )


def identify(node: Node, profile: int, vendor: int, product: int) -> None:
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
            action = (
                f"another device is fitted: check that it is equivalent, then correct {name} in [canopen]"
            )
            node.expect(0x1018, subindex, wanted, name, action)


def _silence(node: Node, communication: int, keep: set[int]) -> None:
    """Disable every PDO of one direction except the numbers in `keep`, which are set afterwards."""
    for number in range(_MAX_PDOS):
        is_there = number in keep or _is_there(partial(_invalidate, node, communication + number))
        if not is_there and number >= _PREDEFINED_PDOS - 1:
            break


def _invalidate(node: Node, index: int) -> None:
    found = node.read(index, 1, "identifier of the PDO")
    if not found & _INVALID:
        node.set(index, 1, found | _INVALID, 4, "identifier of the PDO", _INVALID)


def _set_pdo(
    node: Node, index: int, mapping: int, identifier: int, kind: int, mapped: list[int], event_timer: int = 0
) -> bool:
    """Configure one PDO in the order required by CiA 301: disable, map, set timer, enable.

    Settings that are right already are not written: some devices have a fixed mapping or fixed
    identifiers, and refuse with whatever abort code. Returns whether the device has the requested event
    timer (ms).
    """
    fits = _mapping(node, mapping) == mapped
    if fits and _is_on(node, index, identifier, kind):
        found = node.find(index, 5, "event timer") if event_timer else None
        if found is None or int.from_bytes(found, "little") == event_timer:
            return found is not None
        try:
            return _offer(node, index, 5, event_timer, 2, "event timer")
        except ServiceError as error:
            if not error.code:
                raise  # else it wants the PDO disabled for that
    _invalidate(node, index)
    node.set_if_different(index, 2, kind, "transmission type")
    if not fits:
        _map(node, mapping, mapped)
    has_timer = bool(event_timer) and _offer(node, index, 5, event_timer, 2, "event timer")
    node.set(index, 1, identifier | _NO_REMOTE, 4, "identifier of the PDO", _COB_ID_MASK)
    return has_timer


def _is_on(node: Node, index: int, identifier: int, kind: int) -> bool:
    """Return whether a PDO is enabled with this identifier and transmission type."""
    found = node.read(index, 1, "identifier of the PDO")
    return (found ^ identifier) & _COB_ID_MASK == 0 and node.read(index, 2, "transmission type") == kind


def _mapping(node: Node, mapping: int) -> list[int]:
    """Return the objects in a PDO."""
    count = node.read(mapping, 0, "number of objects in the PDO")
    return [node.read(mapping, n, "object in the PDO") for n in range(1, min(count, _MAX_MAPPED) + 1)]


def _map(node: Node, mapping: int, mapped: list[int]) -> None:
    """Map objects into a PDO that is disabled.

    Raises:
        DriverError: the device refuses, or keeps another mapping.
    """
    action = "if the device has a fixed mapping, use one with a configurable mapping"
    try:
        node.write(mapping, 0, 0, 1, "number of objects in the PDO")
        for n, entry in enumerate(mapped, start=1):
            node.write(mapping, n, entry, 4, "object in the PDO")
        node.write(mapping, 0, len(mapped), 1, "number of objects in the PDO")
    except ServiceError as error:
        raise ServiceError(f"{error}; {action}" if error.code else f"{error}", error.code) from error
    node.expect(mapping, 0, len(mapped), "number of objects in the PDO", action)
    for n, entry in enumerate(mapped, start=1):
        node.expect(mapping, n, entry, "object in the PDO", action)


def _set_heartbeat(node: Node, settings: CanopenSettings) -> None:
    node.set(0x1017, 0, round(1e3 * settings.heartbeat), 2, "heartbeat")
