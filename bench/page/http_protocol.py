"""The server's side of a connection: requests must begin in time, and a certificate has a name."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

from bench.page.request_filter import Application, Receive, Scope, Send

HEAD_TIME = 10.0
"""Max time for the head of a request to arrive, s; slower connections end."""
MAX_CONNECTIONS = 256
"""Max number of connections; further ones end at once."""


def http_protocol() -> type[asyncio.Protocol]:
    """Return the protocol class for uvicorn."""
    import h11
    from uvicorn.protocols.http.h11_impl import H11Protocol

    class BoundedProtocol(H11Protocol):
        """HTTP/1.1 with a time limit on the head of each request."""

        _head: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            if len(self.connections) > MAX_CONNECTIONS:
                transport.abort()
                return
            name = common_name(transport.get_extra_info("peercert"))
            self.app = _with_state(self.app, {"certificate": name, "abort": transport.abort})
            self._watch_head()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            self._watch_head()

        def connection_lost(self, exc: Exception | None) -> None:
            self._stop_watch()
            super().connection_lost(exc)

        def _watch_head(self) -> None:
            if self.conn.their_state is not h11.IDLE:
                self._stop_watch()
            elif self._head is None:
                self._head = self.loop.call_later(HEAD_TIME, self.transport.abort)

        def _stop_watch(self) -> None:
            if self._head is not None:
                self._head.cancel()
                self._head = None

    return BoundedProtocol


def common_name(certificate: Mapping[str, Any] | None) -> str:
    """Return the name in a verified `certificate`, as `ssl` describes it; empty without one."""
    subject = (certificate or {}).get("subject", ())
    names = [value for part in subject for key, value in part if key == "commonName"]
    return names[0] if len(names) == 1 else ""


def _with_state(application: Any, state: Mapping[str, Any]) -> Application:
    async def run(scope: Scope, receive: Receive, send: Send) -> None:
        scope["state"] = {**scope.get("state", {}), **state}
        await application(scope, receive, send)

    return run
