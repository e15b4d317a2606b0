"""List the nodes on a bus and whether the startup would take them. Reads only: nothing is set or started.

A stopped node, as a bench leaves the valve node, answers no question. It is made pre-operational, in which it
moves nothing, for as long as it is read. While a bench is active on the bus, which alone may command nodes,
they stay stopped, and a node that it has started meanwhile is not stopped.
"""

from __future__ import annotations

import time as wall
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import NamedTuple

from drivers.base import JOINTS, DriverError
from drivers.can_bus import FRAME
from drivers.canopen._link import FrameLink, open_link
from drivers.canopen._scaling import (
    describe_scale,
    describe_settings,
    read_scale,
    read_zero_shift,
    wanted_settings,
    wrong_settings,
)
from drivers.canopen._services import MISSING, Node, ServiceError
from drivers.canopen._setup import (
    ENCODER_PROFILE,
    ERROR_BEHAVIOUR,
    IO_PROFILE,
    OUTPUT_ERRORS,
    identify,
    require_position_pdo,
    without_fallback,
)
from drivers.canopen.frames import HEARTBEAT, NMT, SDO_REQUEST, SDO_RESPONSE, frame
from drivers.canopen.settings import CanopenSettings

_ALL_NODES = range(1, 128)
_READ_DEVICE_TYPE = bytes((0x40, 0x00, 0x10, 0, 0, 0, 0, 0))
_STOP, _ENTER_PRE_OPERATIONAL = 2, 128
"""NMT commands."""
_STOPPED, _OPERATIONAL = 4, 5
"""States in a heartbeat."""
_PROTOCOL_ABORTS = range(0x05030000, 0x05050000)
"""Abort codes of a disturbed SDO transfer, such as by requests of another client."""
_ATTEMPTS = 3
"""Attempts to reach or read one node."""
_GAP = 0.002
"""Time between two questions, s: an interface queues few frames."""


class ScannedNode(NamedTuple):
    """One node of the bus, or a configured one that does not answer."""

    number: int
    role: str
    """Role by the configuration; empty if it is not configured."""
    device: str
    """Name, vendor, product and profile as the device gives them; empty without an answer."""
    properties: str
    """Counts, polarity and fallback by its objects."""
    taken: bool
    """Whether the startup would take it in its role, as far as reading shows."""
    verdict: str
    """Objects that the startup sets, or the reason and action of a refusal."""
    zero_shift: str = ""
    """Source of a shift of the zero inside an encoder (`read_zero_shift`)."""


def scan(
    settings: CanopenSettings,
    counts: int,
    *,
    clock: Callable[[], float] = wall.monotonic,
    open_bus: Callable[[CanopenSettings, list[int]], FrameLink] = open_link,
) -> list[ScannedNode]:
    """Return the nodes on the bus; `counts` per revolution are required of encoders.

    Raises:
        DriverError: the interface cannot be opened, or fails.
    """
    link = open_bus(settings, [base + number for base in (SDO_RESPONSE, HEARTBEAT) for number in _ALL_NODES])
    try:
        return _Scanner(link, settings, counts, clock).run()
    except OSError as error:
        raise DriverError(
            f"canopen: channel {settings.channel!r}: {error}; check that the interface is up"
        ) from error
    finally:
        with suppress(Exception):
            link.shutdown()


class _Scanner:
    """One scan of an opened bus."""

    def __init__(
        self, link: FrameLink, settings: CanopenSettings, counts: int, clock: Callable[[], float]
    ) -> None:
        self._link, self._settings, self._counts, self._clock = link, settings, counts, clock
        joints = zip(settings.encoders.nodes, JOINTS, strict=True)
        self._roles = {number: f"encoder of the {joint}" for number, joint in joints}
        self._roles[settings.valve_node.node] = "valves and interlocks"
        self._states: dict[int, int] = {}
        """Last state of each participant that sends a heartbeat."""

    def run(self) -> list[ScannedNode]:
        found = self._answering(_ALL_NODES)
        for _ in range(_ATTEMPTS - 1):  # a participant that the machine holds up loses frames
            if not (missing := self._roles.keys() - found - set(self._stopped())):
                break
            found |= self._answering(sorted(missing))
        silent = sorted(number for number in self._stopped() if number not in found)
        woken = [] if self._has_bench() else silent
        try:
            for number in woken:
                self._send(frame(NMT, bytes([_ENTER_PRE_OPERATIONAL, number])))
            found |= self._answering(woken) if woken else set()
            return [
                self._judge(number) if number in found else self._missing(number)
                for number in sorted(found | self._roles.keys())
            ]
        finally:
            if woken:
                self._listen(2.0 * self._settings.heartbeat)
            for number in woken:
                if self._states.get(number) != _OPERATIONAL and not self._has_bench():
                    self._send(frame(NMT, bytes([_STOP, number])))

    def _stopped(self) -> list[int]:
        """Return the nodes that say so in their heartbeat."""
        return [number for number, state in self._states.items() if state == _STOPPED]

    def _has_bench(self) -> bool:
        """Whether a bench sends its heartbeat on the bus."""
        return self._settings.master in self._states

    def _answering(self, numbers: Iterable[int]) -> set[int]:
        """Return the nodes among `numbers` that answer a question for their device type."""
        found = set()
        for number in numbers:
            self._send(frame(SDO_REQUEST + number, _READ_DEVICE_TYPE))
            found |= self._listen(_GAP)
        return found | self._listen(self._settings.sdo_timeout)

    def _listen(self, duration: float) -> set[int]:
        """Listen for `duration` s; return the nodes that answered a question."""
        found, end = set(), self._clock() + duration
        while (left := end - self._clock()) > 0.0:
            answer = self._take(left)
            if answer is not None:
                found.add(answer[0] - SDO_RESPONSE)
        return found

    def _send(self, whole: bytes) -> None:
        self._link.send_frame(whole)

    def _take(self, timeout: float) -> tuple[int, bytes] | None:
        """Return the next SDO response."""
        whole = self._link.receive_frame(timeout)
        if whole is None:
            return None
        identifier, length, data = FRAME.unpack(whole)
        if HEARTBEAT < identifier <= HEARTBEAT + _ALL_NODES[-1] and length == 1:
            self._states[identifier - HEARTBEAT] = data[0] & 0x7F
        return (identifier, data[:length]) if SDO_RESPONSE < identifier < SDO_REQUEST else None

    def _missing(self, number: int) -> ScannedNode:
        action = "no answer; check its power and number, and the bit rate and terminators of the bus"
        if number in self._stopped():
            action = (
                "stopped, while a bench is on this bus, which alone may command it; reset or end the bench, "
                "then scan again"
            )
        return ScannedNode(number, self._roles[number], "", "", False, action)

    def _judge(self, number: int) -> ScannedNode:
        """Read and judge a node; again if another client has come in between."""
        judged, disturbed = self._judge_once(number)
        for _ in range(_ATTEMPTS - 1):
            if not disturbed:
                break
            judged, disturbed = self._judge_once(number)
        return judged

    def _judge_once(self, number: int) -> tuple[ScannedNode, bool]:
        """Read and judge a node; return also whether a dialogue has failed that may succeed next time."""
        role = self._roles.get(number, "")
        node = Node(
            number, role or "not configured", self._send, self._take, self._clock, self._settings.sdo_timeout
        )
        device = properties = verdict = shift = ""
        try:
            profile = node.read(0x1000, 0, "device type") & 0xFFFF
            device = _describe_device(node, profile)
            if profile == ENCODER_PROFILE:
                scale = read_scale(node)
                properties, shift = describe_scale(scale), read_zero_shift(node)
                verdict = describe_settings(wanted_settings(node, scale, self._counts))
                require_position_pdo(node, self._settings.encoders)
                position = self._settings.encoders.position
                _need(
                    node, ((0x1017, 0, "heartbeat"), (position, 0, "position"), (0x1001, 0, "error register"))
                )
            elif profile == IO_PROFILE:
                properties, verdict = judge_io_node(node, self._settings)
            if not role:
                action = "in no role: correct the numbers in [canopen]"
                return ScannedNode(number, role, device, properties, False, action, shift), False
            chosen = self._settings.valve_node if "valves" in role else self._settings.encoders
            wanted = IO_PROFILE if "valves" in role else ENCODER_PROFILE
            identify(node, wanted, chosen.vendor, chosen.product)
        except DriverError as error:
            code = getattr(error, "code", None)
            refused = ScannedNode(number, role, device, properties, False, f"{error}", shift)
            return refused, code == 0 or code in _PROTOCOL_ABORTS
        verdict = verdict and f"after setting {verdict}"
        return ScannedNode(number, role, device, properties, True, verdict, shift), False


def judge_io_node(node: Node, settings: CanopenSettings) -> tuple[str, str]:
    """Return the properties of an I/O node and the values that the startup changes in it, as text.

    Raises:
        DriverError: it lacks an object that the bench needs.
    """
    chosen = settings.valve_node
    needed = [(0x6000, 1, "inputs"), (0x6200, 1, "outputs"), (0x1800, 5, "event timer of the inputs")]
    needed += [(0x1017, 0, "heartbeat")]
    needed += [(0x6411, channel, "analogue output of a valve") for channel in chosen.valves]
    needed += [
        (0x6401, channel, "analogue input of a pressure or spool") for channel in chosen.analogue_inputs
    ]
    _need(node, needed)
    if not chosen.watchdog_relay:
        fallback = [(0x6443, channel, "error mode of a valve") for channel in chosen.valves]
        fallback += [(0x6444, channel, "error value of a valve") for channel in chosen.valves]
        try:
            _need(node, fallback)
        except ServiceError as error:
            raise without_fallback(error) if error.code in MISSING else error from None
    watchdogs = [
        f"{index:04X}h:{subindex}"
        for index, subindex in ((0x1400, 5), (0x1016, 1))
        if node.find(index, subindex, "watchdog") is not None
    ]
    modes = [f"{mode:04X}h" for mode, _ in OUTPUT_ERRORS if node.find(mode, 1, "error mode") is not None]
    if not (watchdogs and modes) and not chosen.watchdog_relay:
        raise ServiceError(
            f"canopen: node {node.number} ({node.role}): found no "
            f"{'error mode of the outputs (6206h, 6306h)' if watchdogs else 'timer (1400h:5, 1016h:1)'}, so "
            "it does not go passive automatically; use another node, or fit an external watchdog relay and "
            "name it in canopen.valve_node.watchdog_relay"
        )
    changes = [f"{one.main_index:04X}h = {one.wanted:#x} ({one.name})" for one in wrong_settings(node)]
    size = node.find(0x6444, chosen.valves[0], "error value of a valve")
    behaviour = [
        f"{index:04X}h" for index in ERROR_BEHAVIOUR if node.find(index, 1, "error behaviour") is not None
    ]
    parts = [f"watched by {' and '.join(watchdogs) or chosen.watchdog_relay}"]
    parts += [f"outputs fall back by {' and '.join(modes)}"] if modes else []
    parts += [f"error values of {8 * len(size)} bits"] if size is not None else []
    parts += [f"error behaviour in {behaviour[0]}"] if behaviour else []
    return ", ".join(parts), ", ".join(changes)


def _need(node: Node, objects: Iterable[tuple[int, int, str]]) -> None:
    """Read objects (index, sub-index, name) that the startup needs.

    Raises:
        ServiceError: the device does not have one, or does not answer.
    """
    for index, subindex, name in objects:
        node.read_bytes(index, subindex, name)


def _describe_device(node: Node, profile: int) -> str:
    name = node.find(0x1008, 0, "device name") or b""
    text = "".join(letter for letter in name.decode("ascii", "replace") if letter.isprintable()).strip()
    vendor, product = (node.find(0x1018, subindex, "identity") or b"" for subindex in (1, 2))
    return (
        f"{text or 'no name'}, profile {profile}, vendor {int.from_bytes(vendor, 'little'):X}h, "
        f"product {int.from_bytes(product, 'little'):X}h"
    )
