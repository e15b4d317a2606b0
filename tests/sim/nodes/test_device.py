"""The simulated CANopen devices, from their EDS files alone: what CiA 301, 401 and 406 say of them."""

from __future__ import annotations

import struct

import pytest

from drivers.base import PASSIVE, Command
from sim.nodes._device import CanopenDevice
from sim.nodes._profile_nodes import EncoderNode, ValveNode401
from sim.nodes.process import EDS


class Wire:
    """One device alone, its frames, and the clock."""

    def __init__(self, device: type[CanopenDevice]) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.commands: list[Command] = []
        self.count: int | None = 1000
        self.now = 0.0
        if device is EncoderNode:
            self.device: CanopenDevice = EncoderNode(
                5, EDS / "encoder.eds", self._note, 4096, lambda: self.count
            )
        else:
            self.device = ValveNode401(5, EDS / "valve_node.eds", self._note, self.commands.append)
        self.device.boot(self.now)

    def _note(self, identifier: int, data: bytes) -> None:
        self.sent.append((identifier, data))

    def receive(self, identifier: int, data: bytes = b"") -> list[tuple[int, bytes]]:
        """Put a frame to the device; return its frames."""
        self.sent.clear()
        self.device.receive(identifier, data, self.now)
        return self.sent.copy()

    def wait(self, duration: float) -> list[tuple[int, bytes]]:
        self.sent.clear()
        for _ in range(round(duration / 0.001)):
            self.now += 0.001
            self.device.run_timers(self.now)
        return self.sent.copy()

    def read(self, index: int, subindex: int = 0) -> int:
        ((_, answer),) = self.receive(0x605, struct.pack("<BHB4x", 0x40, index, subindex))
        if answer[0] == 0x80:
            raise Aborted(int.from_bytes(answer[4:], "little"))
        assert answer[0] & 0xF3 == 0x43, "expedited, size indicated"
        size = 4 - (answer[0] >> 2 & 3)
        return int.from_bytes(answer[4 : 4 + size], "little")

    def write(self, index: int, subindex: int, value: int, size: int) -> None:
        command = 0x23 | (4 - size) << 2
        request = struct.pack("<BHB", command, index, subindex) + value.to_bytes(4, "little")
        answers = self.receive(0x605, request)
        answer = next(data for identifier, data in answers if identifier == 0x585)
        if answer[0] == 0x80:
            raise Aborted(int.from_bytes(answer[4:], "little"))
        assert answer[0] == 0x60


class Aborted(Exception):
    """An SDO was aborted."""


@pytest.fixture
def encoder() -> Wire:
    return Wire(EncoderNode)


@pytest.fixture
def valves() -> Wire:
    return Wire(ValveNode401)


def test_canopen_device_boots_into_pre_operational(encoder: Wire) -> None:
    assert encoder.sent == [(0x705, b"\0")]
    assert encoder.device.state == 127
    assert encoder.receive(0x80) == []


def test_canopen_device_heartbeat_carries_state(encoder: Wire) -> None:
    assert encoder.wait(0.5) == []
    encoder.write(0x1017, 0, 100, 2)
    assert encoder.wait(0.35) == [(0x705, b"\x7f")] * 3
    encoder.receive(0, b"\x01\x05")
    assert (0x705, b"\x05") in encoder.wait(0.15)


@pytest.mark.parametrize(("command", "state"), [(1, 5), (2, 4), (128, 127)])
@pytest.mark.parametrize("node", [0, 5, 6])
def test_nmt_command_applies_to_addressed_node_or_all(
    encoder: Wire, command: int, state: int, node: int
) -> None:
    before = encoder.device.state
    encoder.receive(0, bytes([command, node]))
    assert encoder.device.state == (state if node in {0, 5} else before)


def test_canopen_device_reset_restores_defaults(encoder: Wire) -> None:
    encoder.write(0x1017, 0, 100, 2)
    assert encoder.receive(0, b"\x81\x05") == [(0x705, b"\0")]
    assert encoder.read(0x1017) == 0
    assert encoder.device.state == 127


def test_encoder_node_sync_sends_position_pdo(encoder: Wire) -> None:
    encoder.receive(0, b"\x01\x05")
    assert encoder.receive(0x80) == [(0x285, struct.pack("<I", 1000))]
    encoder.count = 4000
    assert encoder.receive(0x80) == [(0x285, struct.pack("<I", 4000))]
    encoder.count = None  # it hangs
    assert encoder.receive(0x80) == []


def test_encoder_node_event_timer_sends_pdo_until_disabled(encoder: Wire) -> None:
    encoder.receive(0, b"\x01\x05")
    assert [i for i, _ in encoder.wait(0.35)] == [0x185] * 3
    encoder.write(0x1800, 1, 0x80000185, 4)
    assert encoder.wait(0.35) == []


def test_encoder_node_reports_identity_resolution_and_preset(encoder: Wire) -> None:
    assert encoder.read(0x1000) & 0xFFFF == 406
    assert (encoder.read(0x6501), encoder.read(0x6502)) == (4096, 1)
    encoder.write(0x6003, 0, 100, 4)
    assert encoder.read(0x6004) == 100
    encoder.count = 1000 + 4095
    encoder.receive(0, b"\x01\x05")
    assert encoder.receive(0x80) == [(0x285, struct.pack("<I", 99))]


def test_encoder_node_health_change_sends_emergency(encoder: Wire) -> None:
    assert isinstance(encoder.device, EncoderNode)
    encoder.sent.clear()
    encoder.device.set_health(False)
    encoder.device.set_health(False)
    assert [(i, data[:3]) for i, data in encoder.sent] == [(0x85, b"\x00\x50\x21")]
    assert encoder.read(0x6503) == 1
    encoder.sent.clear()
    encoder.device.set_health(True)
    assert encoder.sent == [(0x85, bytes(8))]


ABORTS = [
    ((0x6FFF, 0, 1, 4), 0x06020000),
    ((0x1018, 9, 1, 4), 0x06090011),
    ((0x1000, 0, 1, 4), 0x06010002),
    ((0x1017, 0, 1, 4), 0x06070010),
    ((0x1801, 1, 0x286, 4), 0x06090030),
    ((0x1801, 5, 10, 2), 0x08000022),
    ((0x1A01, 0, 0, 1), 0x08000022),
    ((0x1801, 2, 241, 1), 0x06090030),
]


@pytest.mark.parametrize(("request_", "code"), ABORTS, ids=str)
def test_sdo_invalid_write_aborts_with_code(
    encoder: Wire, request_: tuple[int, int, int, int], code: int
) -> None:
    with pytest.raises(Aborted) as raised:
        encoder.write(*request_)
    assert raised.value.args == (code,)


def test_pdo_mapping_requires_disabled_empty_pdo(encoder: Wire) -> None:
    encoder.write(0x1801, 1, 0x80000285, 4)
    with pytest.raises(Aborted, match=str(0x08000022)):
        encoder.write(0x1A01, 1, 0x60040020, 4)
    encoder.write(0x1A01, 0, 0, 1)
    with pytest.raises(Aborted, match=str(0x06040041)):
        encoder.write(0x1A01, 1, 0x10180120, 4)
    encoder.write(0x1A01, 1, 0x65030010, 4)
    encoder.write(0x1A01, 0, 1, 1)
    encoder.write(0x1801, 1, 0x285, 4)
    encoder.receive(0, b"\x01\x05")
    assert encoder.receive(0x80) == [(0x285, b"\0\0")]


def test_pdo_mapping_over_eight_bytes_aborts(valves: Wire) -> None:
    valves.write(0x1801, 1, 0x80000285, 4)
    valves.write(0x1A01, 0, 0, 1)
    for n in range(1, 6):
        valves.write(0x1A01, n, 0x64010010 | n << 8, 4)
    with pytest.raises(Aborted, match=str(0x06040042)):
        valves.write(0x1A01, 0, 5, 1)
    valves.write(0x1A01, 0, 4, 1)


# Valves ----------------------------------------------------------------------------------------------


def commanded(valves: Wire) -> Wire:
    """Set the node up by hand and let it obey."""
    for n in (1, 2, 3):
        valves.write(0x6444, n, 16384 << 16, 4)
    valves.write(0x1401, 1, 0x80000305, 4)
    valves.write(0x1401, 5, 20, 2)
    valves.write(0x1401, 1, 0x305, 4)
    valves.receive(0, b"\x01\x05")
    valves.receive(0x205, b"\x03")
    valves.receive(0x305, struct.pack("<3h", 32767, 0, 16384))
    return valves


def test_valve_node_at_boot_sets_full_stroke_without_energy(valves: Wire) -> None:
    assert valves.commands[-1] == PASSIVE._replace(valve=(-1.0, -1.0, -1.0))


def test_valve_node_obeys_commands_only_when_operational(valves: Wire) -> None:
    command = commanded(valves).commands[-1]
    assert command.valve == pytest.approx((1.0, -1.0, 0.0), abs=1e-4)
    assert (command.supply_enable, command.exhaust_closed, command.guard_lock) == (True, True, True)
    valves.receive(0, b"\x80\x05")
    before = len(valves.commands)
    valves.receive(0x305, struct.pack("<3h", 0, 0, 0))
    assert len(valves.commands) == before


def centred(command: Command) -> bool:
    return command._replace(valve=(0.0, 0.0, 0.0)) == PASSIVE and max(map(abs, command.valve)) < 1e-4


def test_valve_node_command_timeout_centres_valves_and_sends_emergency(valves: Wire) -> None:
    commanded(valves)
    assert valves.wait(0.018) == []
    sent = valves.wait(0.003)
    assert [(i, data[:3]) for i, data in sent] == [(0x85, b"\x50\x82\x11")]
    assert centred(valves.commands[-1])
    assert valves.device.state == 127
    valves.receive(0x305, struct.pack("<3h", 32767, 0, 0))
    assert centred(valves.commands[-1])
    assert (0x85, bytes(8)) in valves.receive(0, b"\x01\x05")  # the error is over


@pytest.mark.parametrize(("behaviour", "state"), [(0, 127), (1, 5), (2, 4)])
def test_valve_node_command_timeout_enters_configured_state(valves: Wire, behaviour: int, state: int) -> None:
    valves.write(0x1029, 1, behaviour, 1)
    commanded(valves).wait(0.025)
    assert valves.device.state == state
    assert centred(valves.commands[-1])


def test_heartbeat_consumer_monitors_after_first_heartbeat(valves: Wire) -> None:
    valves.write(0x1016, 1, 0x7F << 16 | 30, 4)
    valves.receive(0, b"\x01\x05")
    assert valves.wait(0.2) == []
    valves.receive(0x77F, b"\x05")
    assert valves.wait(0.028) == []
    assert [data[:2] for _, data in valves.wait(0.004)] == [b"\x30\x81"]
    assert valves.device.state == 127


def test_heartbeat_consumer_restart_awaits_new_heartbeat(valves: Wire) -> None:
    valves.write(0x1016, 1, 0x7F << 16 | 30, 4)
    valves.receive(0, b"\x01\x05")
    valves.receive(0x77F, b"\x05")
    valves.receive(0, b"\x02\x05")
    assert valves.wait(1.0) == []
    valves.receive(0, b"\x80\x05")
    valves.receive(0, b"\x01\x05")
    valves.wait(0.2)
    assert valves.device.state == 5
    valves.receive(0x77F, b"\x05")
    assert [data[:2] for _, data in valves.wait(0.04)] == [b"\x30\x81"]


def test_valve_node_nmt_stop_centres_valves(valves: Wire) -> None:
    commanded(valves).receive(0, b"\x02\x05")
    assert centred(valves.commands[-1])
    assert valves.receive(0x605, struct.pack("<BHB4x", 0x40, 0x1000, 0)) == []


def test_valve_node_short_command_sends_emergency_and_keeps_valves(valves: Wire) -> None:
    commanded(valves)
    before = valves.commands[-1]
    assert [data[:2] for _, data in valves.receive(0x305, b"abc")] == [b"\x10\x82"]
    assert valves.commands[-1] == before


@pytest.mark.parametrize(
    "request_", [b"", b"\x40", bytes(8), b"\xff" * 8, b"\x80" + bytes(7), b"\xc2" + bytes(7)]
)
def test_sdo_server_malformed_request_keeps_answering(valves: Wire, request_: bytes) -> None:
    valves.receive(0x605, request_)
    assert valves.read(0x1000) == 0x000F0191
