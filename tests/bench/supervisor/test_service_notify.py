import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from bench.supervisor.service_notify import ServiceNotifier, watchdog_interval


@pytest.fixture(params=["path", "abstract"])
def service_manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    """A socket as systemd's, and its name as it stands in NOTIFY_SOCKET."""
    name = str(tmp_path / "notify") if request.param == "path" else f"@golfbench-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(name.replace("@", "\0", 1))
        listener.settimeout(5.0)
        yield listener, name


def test_service_notifier_messages_follow_protocol(service_manager: tuple[socket.socket, str]) -> None:
    listener, name = service_manager
    notifier = ServiceNotifier({"NOTIFY_SOCKET": name})
    assert notifier.ready("state ESTOP")
    assert notifier.alive()
    assert notifier.stopping()
    messages = [listener.recv(4096) for _ in range(3)]
    assert messages == [b"READY=1\nSTATUS=state ESTOP", b"WATCHDOG=1", b"STOPPING=1"]
    notifier.close()
    assert not notifier.alive()
    notifier.close()


@pytest.mark.parametrize("address", [None, "", "relative/path", "vsock:2:1234"])
def test_service_notifier_without_socket_sends_nothing(address: str | None) -> None:
    notifier = ServiceNotifier({} if address is None else {"NOTIFY_SOCKET": address})
    assert not notifier.ready("state ESTOP")
    notifier.close()


@pytest.mark.parametrize("name", ["/nonexistent/notify", "/" + "x" * 200, "@nobody-listens-here"])
def test_service_notifier_missing_socket_returns_false(name: str) -> None:
    notifier = ServiceNotifier({"NOTIFY_SOCKET": name})
    assert not notifier.alive()
    notifier.close()


def test_service_notifier_full_queue_does_not_block(
    service_manager: tuple[socket.socket, str],
) -> None:
    listener, name = service_manager
    notifier = ServiceNotifier({"NOTIFY_SOCKET": name})
    sent = sum(notifier.alive() for _ in range(100_000))
    assert 0 < sent < 100_000  # the queue was full, and no call waited or raised
    messages = [listener.recv(64) for _ in range(sent)]
    assert set(messages) == {b"WATCHDOG=1"}
    assert notifier.alive()
    notifier.close()


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
