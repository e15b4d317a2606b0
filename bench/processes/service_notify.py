"""What a service tells systemd: ready, a line of status, that it lives, that it stops (sd_notify(3)).

Telling never fails and never waits: without systemd, or with its socket gone or full, nothing is sent.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping

_LONGEST_STATUS = 1024
"""Bytes; systemd takes no message above one page."""


class ServiceNotifier:
    """The datagram socket that systemd names in NOTIFY_SOCKET.

    Each method returns whether the message was sent, which only tests need to know.
    """

    def __init__(self, address: str | None) -> None:
        """`address` is the socket's path, with `@` first when abstract; None: there is nobody to tell."""
        self._address = os.fsencode(address) if address and address[0] in "/@" else None
        self._socket: socket.socket | None = None
        if self._address is not None:
            if self._address.startswith(b"@"):
                self._address = b"\0" + self._address[1:]
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)

    @classmethod
    def of_environment(cls, environment: Mapping[str, str]) -> ServiceNotifier:
        """Return the notifier for the process whose environment this is."""
        return cls(environment.get("NOTIFY_SOCKET"))

    def ready(self, status: str = "") -> bool:
        """Tell that the start is over; from now on systemd waits for `alive`."""
        return self._tell("READY=1", status)

    def status(self, text: str) -> bool:
        """Tell in one line what the service does, for `systemctl status`."""
        return self._tell("", text)

    def alive(self) -> bool:
        """Pet the watchdog."""
        return self._tell("WATCHDOG=1")

    def stopping(self, status: str = "") -> bool:
        """Tell that the stop has begun; from now on systemd waits no more for `alive`."""
        return self._tell("STOPPING=1", status)

    def close(self) -> None:
        """Close the socket; what is told after that is not sent."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _tell(self, assignment: str, status: str = "") -> bool:
        if self._socket is None or self._address is None:
            return False
        lines = [assignment.encode()] if assignment else []
        if line := " ".join(status.split()):  # a line break would begin another assignment
            text = line.encode(errors="replace")[:_LONGEST_STATUS]
            lines.append(b"STATUS=" + text.decode(errors="ignore").encode())
        try:
            self._socket.sendto(b"\n".join(lines), self._address)
        except OSError:
            return False
        return True


def watchdog_interval(environment: Mapping[str, str], pid: int) -> float | None:
    """Return after how much silence (s) systemd kills process `pid`, None when it does not watch it."""
    try:
        interval = int(environment["WATCHDOG_USEC"]) * 1e-6
        watched = int(environment.get("WATCHDOG_PID", pid))
    except (KeyError, ValueError):
        return None
    return interval if interval > 0.0 and watched == pid else None
