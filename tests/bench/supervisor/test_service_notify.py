import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from bench.supervisor.status import notify_service, watchdog_interval


@pytest.fixture(params=["path", "abstract"])
def service_manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    """A socket as systemd's, and its name as it stands in NOTIFY_SOCKET."""
    name = str(tmp_path / "notify") if request.param == "path" else f"@golfbench-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(name.replace("@", "\0", 1))
        listener.settimeout(5.0)
        yield listener, name


def test_notify_service_message_arrives_unchanged(service_manager: tuple[socket.socket, str]) -> None:
    listener, name = service_manager
    assert notify_service("READY=1\nSTATUS=state ESTOP", {"NOTIFY_SOCKET": name})
    assert listener.recv(4096) == b"READY=1\nSTATUS=state ESTOP"


@pytest.mark.parametrize("address", [None, "", "relative/path", "vsock:2:1234"])
def test_notify_service_without_socket_sends_nothing(address: str | None) -> None:
    assert not notify_service("READY=1", {} if address is None else {"NOTIFY_SOCKET": address})


@pytest.mark.parametrize("name", ["/nonexistent/notify", "/" + "x" * 200, "@nobody-listens-here"])
def test_notify_service_missing_socket_returns_false(name: str) -> None:
    assert not notify_service("WATCHDOG=1", {"NOTIFY_SOCKET": name})


def test_notify_service_full_queue_does_not_block(service_manager: tuple[socket.socket, str]) -> None:
    listener, name = service_manager
    environment = {"NOTIFY_SOCKET": name}
    sent = sum(notify_service("WATCHDOG=1", environment) for _ in range(10_000))
    assert 0 < sent < 10_000  # the queue was full, and no call waited or raised
    messages = [listener.recv(64) for _ in range(sent)]
    assert set(messages) == {b"WATCHDOG=1"}
    assert notify_service("WATCHDOG=1", environment)


@pytest.mark.parametrize(
    ("environment", "interval"),
    [
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "42"}, 2.0),
        ({"WATCHDOG_USEC": "500000"}, 0.5),
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "41"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "-5"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": ""}, None),
        ({}, None),
    ],
)
def test_watchdog_interval_reads_environment(environment: dict[str, str], interval: float | None) -> None:
    assert watchdog_interval(environment, 42) == interval
