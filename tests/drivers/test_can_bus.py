"""The bus between processes: what every participant gets, loses, and may do."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest
from can.interfaces import VALID_INTERFACES

from drivers.can_bus import ERROR, FRAME, LocalSocketBus, folder_of, switch

Join = Callable[..., LocalSocketBus]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "can"


@pytest.fixture
def join(folder: Path) -> Iterator[Join]:
    """Return a function that joins the bus."""
    joined: list[LocalSocketBus] = []

    def one(**settings: object) -> LocalSocketBus:
        bus = can.Bus(interface="local_socket", channel=str(folder), **settings)  # type: ignore[arg-type]
        assert isinstance(bus, LocalSocketBus)
        joined.append(bus)
        return bus

    yield one
    for bus in joined:
        bus.shutdown()
        bus.shutdown()


def message(identifier: int = 0x123, data: bytes = b"abc", **settings: object) -> can.Message:
    settings = {"is_extended_id": False} | settings
    return can.Message(arbitration_id=identifier, data=data, **settings)  # type: ignore[arg-type]


def heard(bus: can.BusABC) -> list[can.Message]:
    return list(iter(lambda: bus.recv(0.05), None))


def test_local_socket_is_registered_with_python_can() -> None:
    assert "local_socket" in VALID_INTERFACES


@pytest.mark.parametrize(
    "sent",
    [
        message(),
        message(0x7FF, b""),
        message(0x1ABCDEF0, b"12345678", is_extended_id=True),
        message(0x55, b"", is_remote_frame=True, dlc=4),
        message(0x44, bytes([0, 1, 0, 0, 0, 0, 0, 0]), is_error_frame=True),
    ],
    ids=["data", "empty", "extended", "remote", "error"],
)
def test_local_bus_delivers_frame_to_all_others(sent: can.Message, join: Join) -> None:
    first, second, third = join(), join(), join()
    first.send(sent)
    for bus in (second, third):
        (got,) = heard(bus)
        assert got.equals(sent, timestamp_delta=None, check_channel=False, check_direction=False)
    assert heard(first) == []


def test_local_bus_single_sender_keeps_order(join: Join) -> None:
    first, second = join(), join()
    for n in range(200):
        first.send(message(n))
    assert [got.arbitration_id for got in heard(second)] == list(range(200))


def test_local_bus_several_senders_keep_order(join: Join) -> None:
    reader, senders = join(), [join() for _ in range(3)]
    for n in range(150):
        senders[n * n % 3].send(message(n))
    senders[1].shutdown()
    assert [got.arbitration_id for got in heard(reader)] == list(range(150))


def test_local_bus_timestamp_is_send_time(join: Join) -> None:
    first, second = join(), join()
    before = time.time()
    first.send(message())
    after = time.time()
    time.sleep(0.05)
    (got,) = heard(second)
    assert before - 0.01 < got.timestamp < after + 0.01


def test_local_bus_receive_own_messages_returns_own_frame(join: Join) -> None:
    bus = join(receive_own_messages=True)
    bus.send(message())
    assert [got.arbitration_id for got in heard(bus)] == [0x123]


def test_local_bus_filters_pass_matches_and_error_frames(join: Join) -> None:
    chosen = join(can_filters=[{"can_id": 0x120, "can_mask": 0x7F0, "extended": False}])
    other = join()
    for sent in (
        message(0x12F),
        message(0x130),
        message(0x12F, is_extended_id=True),
        message(0x40, bytes(8), is_error_frame=True),
    ):
        other.send(sent)
    assert [(got.arbitration_id, got.is_error_frame) for got in heard(chosen)] == [
        (0x12F, False),
        (0x40, True),
    ]


def test_receive_frame_only_filtered_frames_times_out(join: Join) -> None:
    chosen, other = join(can_filters=[{"can_id": 1, "can_mask": 0x7FF}]), join()
    for _ in range(20):
        other.send(message(2))
    begin = time.monotonic()
    assert chosen.receive_frame(0.05) is None
    assert 0.04 < time.monotonic() - begin < 5.0


def test_local_bus_slow_reader_loses_frames_without_delay(join: Join) -> None:
    sender, lazy, busy = join(), join(), join()
    for n in range(3000):
        sender.send(message(n % 0x800))
        assert busy.receive_frame(5.0) is not None
    kept = len(heard(lazy))
    assert 100 < kept < 3000
    assert sender.overruns == 3000 - kept


def test_local_bus_killed_participant_is_removed(folder: Path, join: Join) -> None:
    code = (
        "import can, os, sys; bus = can.Bus(interface='local_socket', channel=sys.argv[1]);"
        "print('here', flush=True); sys.stdin.read(); os._exit(0)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdin is not None
        assert other.stdout is not None
        assert other.stdout.readline() == b"here\n"
        bus = join()
        bus.send(message())
        other.kill()
    assert len(list(folder.glob("*.sock"))) == 2
    bus.send(message())
    late = join()  # finds a socket that nobody listens to
    bus.send(message(7))
    assert [got.arbitration_id for got in heard(late)] == [7]
    assert len(list(folder.glob("*.sock"))) == 2


def test_switch_off_blocks_sending_until_on(folder: Path, join: Join) -> None:
    first, second = join(), join()
    first.send(message())
    switch(folder, on=False)
    for _ in range(2):
        with pytest.raises(can.CanOperationError) as raised:
            first.send(message())
        assert raised.value.error_code == errno.ENETDOWN
    switch(folder, on=True)
    first.send(message(2))
    assert [got.arbitration_id for got in heard(second)] == [0x123, 2]


def test_send_frame_uses_socketcan_layout(join: Join) -> None:
    first, second = join(), join()
    first.send_frame(FRAME.pack(0x40 | ERROR, 8, bytes(8)))
    (got,) = heard(second)
    assert (got.is_error_frame, got.arbitration_id, got.dlc) == (True, 0x40, 8)
    assert FRAME.size == 16


def test_local_bus_fd_frame_is_refused(join: Join) -> None:
    with pytest.raises(can.CanOperationError, match="classic"):
        join().send(message(data=bytes(12), is_fd=True))


def test_shutdown_removes_socket(folder: Path, join: Join) -> None:
    bus = join()
    bus.shutdown()
    assert list(folder.iterdir()) == []


def test_local_bus_world_writable_folder_is_refused(folder: Path, join: Join) -> None:
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.raises(can.CanInitializationError, match="this user alone"):
        join()


def test_local_bus_overlong_path_is_refused(tmp_path: Path) -> None:
    with pytest.raises(can.CanInitializationError, match="shorter"):
        can.Bus(interface="local_socket", channel=str(tmp_path / ("x" * 100)))


def test_folder_of_name_is_user_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert folder_of("bench1") == tmp_path / f"golfbench-can-{os.getuid()}-bench1"
    assert folder_of(tmp_path / "x") == tmp_path / "x"


def test_local_bus_clock_set_back_looks_once(
    folder: Path, join: Join, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = join(), join()
    ahead = time.time() + 3600.0
    os.utime(folder, (ahead, ahead))
    looks = 0

    def look() -> None:
        nonlocal looks
        looks += 1
        original()

    original = one._look
    monkeypatch.setattr(one, "_look", look)
    for _ in range(5):
        one.send(message())
    assert looks == 1
    assert len(heard(other)) == 5
    third = join()
    one.send(message())
    assert len(heard(third)) == 1
