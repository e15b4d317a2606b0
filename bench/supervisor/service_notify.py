"""Notifications to systemd: ready, status line, watchdog, stopping (sd_notify(3)).

Sending never fails or blocks: without systemd, or with its socket gone or full, nothing is sent.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping

_MAX_STATUS = 1024
"""Max bytes of a status line; systemd accepts messages up to one page."""


class ServiceNotifier:
    """The datagram socket named in NOTIFY_SOCKET.

    Each method returns whether the message was sent, for tests.
    """

    def __init__(self, address: str | None) -> None:
        """Connect to the socket path `address`, starting with `@` if abstract; None disables sending."""
        self._address = os.fsencode(address) if address and address[0] in "/@" else None
        self._socket: socket.socket | None = None
        if self._address is not None:
            if self._address.startswith(b"@"):
                self._address = b"\0" + self._address[1:]
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)

    @classmethod
    def of_environment(cls, environment: Mapping[str, str]) -> ServiceNotifier:
        """Return the notifier for a process with this environment."""
        return cls(environment.get("NOTIFY_SOCKET"))

    def ready(self, status: str = "") -> bool:
        """Report that startup is complete; from now on systemd expects `alive`."""
        return self._send("READY=1", status)

    def status(self, text: str) -> bool:
        """Send a status line for `systemctl status`."""
        return self._send("", text)

    def alive(self) -> bool:
        """Reset systemd's watchdog."""
        return self._send("WATCHDOG=1")

    def stopping(self, status: str = "") -> bool:
        """Report the start of shutdown; from then on systemd no longer expects `alive`."""
        return self._send("STOPPING=1", status)

    def close(self) -> None:
        """Close the socket; later messages are not sent."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, assignment: str, status: str = "") -> bool:
        if self._socket is None or self._address is None:
            return False
        lines = [assignment.encode()] if assignment else []
        if line := " ".join(status.split()):  # a line break would start another assignment
            text = line.encode(errors="replace")[:_MAX_STATUS]
            lines.append(b"STATUS=" + text.decode(errors="ignore").encode())
        try:
            self._socket.sendto(b"\n".join(lines), self._address)
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
