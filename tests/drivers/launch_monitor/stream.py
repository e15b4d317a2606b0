"""A shot as a monitor sends it, a plain connection to send it over, and a server."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from drivers.base import Launch
from drivers.launch_monitor.open_connect import write_shot
from drivers.launch_monitor.server import LaunchMonitorServer
from drivers.launch_monitor.settings import LaunchMonitorSettings

LAUNCH = Launch(65.0, 0.2, 0.01, 300.0, -0.05)


def shot(number: int = 1) -> bytes:
    return write_shot(number, LAUNCH, "monitor")


def receive(connection: socket.socket, count: int) -> bytes:
    """Return the data received up to `count` answers, or up to the end of the connection."""
    connection.settimeout(10.0)
    data = b""
    while data.count(b'"Code"') < count or not data.endswith(b"}"):
        piece = connection.recv(65_536)
        if not piece:
            break
        data += piece
    return data


@contextmanager
def serving(*, clock: Callable[[], float] = time.monotonic, **settings: Any) -> Iterator[LaunchMonitorServer]:
    """Yield an open server with `settings` at a free port."""
    server = LaunchMonitorServer(LaunchMonitorSettings(**settings), port=0, clock=clock)
    server.open()
    try:
        yield server
    finally:
        server.close()
