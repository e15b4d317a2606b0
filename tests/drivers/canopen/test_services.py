"""Concurrent questions of two clients to a node: bench and scan share the identifiers of each node's SDO."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.can_bus import FRAME
from drivers.canopen._services import Node, ServiceError
from drivers.canopen.scan import ScannedNode, scan
from sim.nodes.personality import ENCODER, IO, find_personality
from tests.drivers.canopen.in_step import SETTINGS, DriverInStep, Wire, nodes_plan, settings_of

FOREIGN = (
    (0x1000, 0),
    (0x1008, 0),  # a text, in segments
    (0x1018, 1),
    (0x2FFF, 0),  # no device has it
    (0x6202, 1),
    (0x6444, 1),
    (0x6444, 99),
    (0x6501, 0),
)
"""Objects that another client reads."""
Question = tuple[int, int]


class Beside(Wire):
    """A wire on which another client asks a node shortly before each question of the first."""

    def __init__(self, questions: list[Question]) -> None:
        super().__init__(
            replace(
                nodes_plan(),
                encoder_personality=find_personality("reversed-17", ENCODER),
                io_personality=find_personality("inverted-io", IO),
            )
        )
        self._questions, self._asked = questions, 0

    def send_frame(self, frame: bytes) -> float:
        identifier = int.from_bytes(frame[:4], "little")
        if 0x601 <= identifier <= 0x67F and self._questions:
            question = self._questions[self._asked % len(self._questions)]
            self._asked += 1
            self.nodes.receive(identifier, struct.pack("<BHB4x", 0x40, *question), self.now)
        return super().send_frame(frame)


def set_up(wire: Wire) -> list[dict[Question, bytes]]:
    """Return the objects set by a startup."""
    driver = DriverInStep(wire, SETTINGS)
    driver.open()
    assert driver.operational
    return [settings_of(device) for device in wire.nodes.devices]


def scanned(wire: Wire) -> list[ScannedNode]:
    return scan(SETTINGS, 2**17, clock=lambda: wire.now, open_bus=wire.opened)


@given(st.lists(st.sampled_from(FOREIGN), min_size=1, max_size=5))
@settings(max_examples=20, deadline=None)
def test_startup_with_other_sdo_client_sets_same_values(questions: list[Question]) -> None:
    assert set_up(Beside(questions)) == set_up(Beside([]))


def test_sdo_abort_for_other_client_is_ignored() -> None:
    wire, abort = Beside([]), bytes.fromhex("80ff2f0000000206")

    def meddle(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        """Let "no such object" of 2FFFh come before the answer that the outputs are inverted."""
        foreign = [(identifier, abort)] if data[1:4] == b"\x02\x62\x01" else []
        return [*foreign, (identifier, data)]

    wire.meddle = meddle
    set_up(wire)
    assert wire.nodes.valve_node.number_at(0x6202, 1) == 0


@pytest.mark.parametrize("question", [(0x1000, 0), (0x2FFF, 0), (0x6501, 0)])
def test_scan_with_other_sdo_client_finds_same_nodes(question: Question) -> None:
    assert scanned(Beside([question])) == scanned(Beside([]))


def test_sdo_interrupted_segmented_read_is_repeated() -> None:
    wire = Beside([])
    alone, interrupted = scanned(Beside([])), [False]

    def meddle(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        """Let the other client begin to read the name when its first segment has come."""
        if identifier == 0x581 and data[0] & 0xE0 == 0 and not interrupted[0]:
            interrupted[0] = True
            wire.nodes.receive(0x601, struct.pack("<BHB4x", 0x40, 0x1008, 0), wire.now)
        return [(identifier, data)]

    wire.meddle = meddle
    assert scanned(wire) == alone
    assert interrupted[0]


def test_sdo_late_answer_is_not_taken_for_next_request() -> None:
    wire, late = Beside([]), list[tuple[int, bytes]]()

    def meddle(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        """Hold the first answer of node 1 back until its second."""
        if identifier == 0x581 and not late:
            late.append((identifier, data))
            return []
        return [*late[:1], (identifier, data)] if identifier == 0x581 else [(identifier, data)]

    wire.meddle = meddle

    def send(frame: bytes) -> None:
        wire.send_frame(frame)

    node = Node(1, "encoder", send, take_from(wire), lambda: wire.now, 0.1)
    with pytest.raises(ServiceError, match=r"1000h:0 .* no answer within 0.1 s; check"):
        node.read(0x1000, 0, "device type")
    assert node.read(0x6501, 0, "resolution") == 2**17
    wire.meddle = lambda identifier, data: late
    with pytest.raises(ServiceError, match=r"no answer within 0.1 s, but 1 to other questions; another cli"):
        node.read(0x6501, 0, "resolution")


def take_from(wire: Wire) -> Callable[[float], tuple[int, bytes] | None]:
    def take(timeout: float) -> tuple[int, bytes] | None:
        whole = wire.receive_frame(timeout)
        if whole is None:
            return None
        identifier, length, data = FRAME.unpack(whole)
        return identifier, data[:length]

    return take
