"""The link over SocketCAN, with a socket that plays the kernel: echoes, their stamps, and other frames."""

from __future__ import annotations

import socket
import time
from collections import deque
from typing import Any

import pytest
from can.interfaces.socketcan.constants import SO_TIMESTAMPNS

from drivers.canopen._link import SocketcanLink
from drivers.canopen.frames import SYNC, frame

POSITION = frame(0x281, bytes(4))


class KernelSocket:
    """Frames with flags and stamps (s of CLOCK_MONOTONIC) that wait to be received."""

    def __init__(self) -> None:
        self.waiting: deque[tuple[bytes, int, float]] = deque()
        self.sent: list[bytes] = []

    def setsockopt(self, *_: object) -> None:
        raise PermissionError

    def send(self, whole: bytes, flags: int) -> int:
        assert flags & socket.MSG_DONTWAIT
        self.sent.append(whole)
        return len(whole)

    def recvmsg(
        self, size: int, told: int, flags: int
    ) -> tuple[bytes, list[tuple[int, int, bytes]], int, Any]:
        assert flags & socket.MSG_DONTWAIT
        if not self.waiting:
            raise BlockingIOError
        whole, marks, stamp = self.waiting.popleft()
        ns = round(stamp * 1e9) + time.time_ns() - time.monotonic_ns()
        packed = (ns // 10**9).to_bytes(8, "little") + (ns % 10**9).to_bytes(8, "little")
        return whole, [(socket.SOL_SOCKET, SO_TIMESTAMPNS, packed)], marks, ("can0",)


class Bus:
    def __init__(self) -> None:
        self.socket = KernelSocket()


@pytest.fixture
def bus() -> Bus:
    return Bus()


@pytest.fixture
def link(bus: Bus) -> SocketcanLink:
    return SocketcanLink(bus)  # type: ignore[arg-type]


def test_sync_time_uses_echo_stamp(link: SocketcanLink, bus: Bus) -> None:
    sent = link.send_frame(frame(SYNC))
    assert link.sync_time(sent) == sent
    bus.socket.waiting.append((frame(SYNC), socket.MSG_CONFIRM | socket.MSG_DONTROUTE, sent + 0.000130))
    bus.socket.waiting.append((POSITION, 0, sent + 0.0003))
    assert link.receive_frame(0.0) == POSITION
    assert link.sync_time(sent) == pytest.approx(sent + 0.000130, abs=5e-6)
    assert link.receive_frame(0.0) is None


def test_receive_frame_after_echo_waits_for_answer(
    link: SocketcanLink, bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = link.send_frame(frame(SYNC))
    arriving = deque([(frame(SYNC), socket.MSG_CONFIRM, sent), (POSITION, 0, sent)])

    def select(*wanted: Any) -> tuple[Any, ...]:
        bus.socket.waiting.append(arriving.popleft())
        return wanted[:3]

    monkeypatch.setattr("drivers.canopen._link.select.select", select)
    assert link.receive_frame(1.0) == POSITION
    assert not arriving


def test_receive_frame_returns_foreign_sync(link: SocketcanLink, bus: Bus) -> None:
    sent = link.send_frame(frame(SYNC))
    bus.socket.waiting.append((frame(SYNC), 0, sent + 0.0001))
    assert link.receive_frame(0.0) == frame(SYNC)
    assert link.sync_time(sent) == sent


@pytest.mark.parametrize("away", [-0.001, 0.01])
def test_sync_time_ignores_echo_of_other_sync(link: SocketcanLink, bus: Bus, away: float) -> None:
    sent = link.send_frame(frame(SYNC))
    bus.socket.waiting.append((frame(SYNC), socket.MSG_CONFIRM, sent + away))
    assert link.receive_frame(0.0) is None
    assert link.sync_time(sent) == sent


@pytest.mark.parametrize("size", [0, 1, 15])
def test_receive_frame_truncated_frame_raises(bus: Bus, link: SocketcanLink, size: int) -> None:
    bus.socket.waiting.append((POSITION[:size], 0, 1.0))
    with pytest.raises(OSError, match=f"found a frame of {size} bytes, expected 16"):
        link.receive_frame(0.0)
