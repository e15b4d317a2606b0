"""Notifications to systemd: ready, status line, watchdog, stopping (sd_notify(3)).

Sending never fails or blocks: without systemd, or with its socket gone or full, nothing is sent.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping


class ServiceNotifier:
    """The datagram socket named in NOTIFY_SOCKET.

    Each method returns whether the message was sent, for tests.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        """Take the path, with a first `@` if abstract, from `environment`; without one nothing is sent."""
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = os.fsencode(address.replace("@", "\0", 1) if address[:1] == "@" else address)
        self._socket: socket.socket | None = None
        if address[:1] in ("/", "@"):
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)

    def ready(self, status: str) -> bool:
        """Report that startup is complete, with a line for `systemctl status`; from now on `alive` is due."""
        return self._send(f"READY=1\nSTATUS={status}")

    def alive(self) -> bool:
        """Reset systemd's watchdog."""
        return self._send("WATCHDOG=1")

    def stopping(self) -> bool:
        """Report the start of shutdown; from then on systemd no longer expects `alive`."""
        return self._send("STOPPING=1")

    def close(self) -> None:
        """Close the socket; later messages are not sent."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, message: str) -> bool:
        if self._socket is None:
            return False
        try:
            self._socket.sendto(message.encode(), self._address)
        except OSError:
            return False
        return True


def watchdog_interval(environment: Mapping[str, str], pid: int) -> float | None:
    """Return systemd's watchdog time for process `pid` (s), None if not watched."""
    try:
        interval = int(environment["WATCHDOG_USEC"]) * 1e-6
        watched = int(environment.get("WATCHDOG_PID", pid))
    except (KeyError, ValueError):
        return None
    return interval if interval > 0.0 and watched == pid else None
