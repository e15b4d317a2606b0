"""What stands in front of every request: own host and origin only, small requests in time, strict headers.

A browser on this machine also shows other sites. They can send requests to the page's address, under another
name too (DNS rebinding): the Host must be one of the page's own, and a request that changes something must
come from the page's own origin as JSON, which no foreign form can send.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Collection, Mapping, MutableMapping
from typing import Any

MAX_BODY = 4096
"""Max size of a request's body, bytes."""
MAX_HEAD = 16384
"""Max size of a request's path and headers, bytes."""

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]

CONTENT_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'; require-trusted-types-for 'script'; "
    "trusted-types 'none'"
)
HEADERS = {
    "content-security-policy": CONTENT_POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}
"""Headers of every response, where it has none of that name itself."""


class RequestFilter:
    """An ASGI application in front of another one."""

    def __init__(self, application: Application, scheme: str, hosts: Collection[str]) -> None:
        """`hosts`: HOST:PORT of every name under which the page is reached."""
        self._application, self._scheme = application, scheme
        self._hosts = frozenset(host.lower() for host in hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a request, or pass it on."""
        if scope["type"] != "http":
            return
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = {name for name, _ in message["headers"]}
                added = ((name.encode(), value.encode()) for name, value in HEADERS.items())
                message["headers"] = [*message["headers"], *(one for one in added if one[0] not in given)]
            await send(message)

        size = (
            len(scope["path"]) + len(scope["query_string"]) + sum(map(len, map(b"".join, scope["headers"])))
        )
        refusal = self._refusal(scope["method"], scope["path"], headers)
        if size > MAX_HEAD:
            refusal = 431, "The request is too long."
        if refusal is not None:
            await _refuse(answer, *refusal)
        else:
            await self._application(scope, receive, answer)

    def _refusal(self, method: str, path: str, headers: dict[str, str]) -> tuple[int, str] | None:
        """Return status and text for a request that is not the page's own; None for one that is."""
        host = headers.get("host", "").lower()
        if host not in self._hosts:
            return 421, "This page has another name."
        site = headers.get("sec-fetch-site", "same-origin")
        if method in ("GET", "HEAD"):
            # A link from elsewhere may open the page; nothing else of it is for other sites.
            opened = headers.get("sec-fetch-mode"), headers.get("sec-fetch-dest"), path
            own = site in ("same-origin", "none") or opened == ("navigate", "document", "/")
            return None if own else (403, "Not for other sites.")
        if method != "POST":
            return 405, "GET or POST only."
        if headers.get("origin", "").lower() != f"{self._scheme}://{host}" or site != "same-origin":
            return 403, "Not from other sites."
        if headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
            return 415, "JSON only."
        length = headers.get("content-length", "0")
        known = length.isascii() and length.isdecimal() and "transfer-encoding" not in headers
        if not known or int(length[:20]) > MAX_BODY:
            return 413, "The request is too long."
        return None


async def _refuse(send: Send, status: int, text: str) -> None:
    content = text.encode()
    headers = [
        (b"content-type", b"text/plain; charset=utf-8"),
        (b"content-length", str(len(content)).encode()),
        (b"connection", b"close"),
    ]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": content})


REQUEST_TIME = 10.0
"""Max time for a request to arrive, s; slower connections end."""
MAX_CONNECTIONS = 256
"""Max number of connections; further ones end at once."""


def http_protocol() -> type[asyncio.Protocol]:
    """Return the protocol class for uvicorn."""
    import h11
    from uvicorn.protocols.http.h11_impl import H11Protocol

    class BoundedProtocol(H11Protocol):
        """HTTP/1.1 with a time limit on each request."""

        _limit: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            super().connection_made(transport)
            if len(self.connections) > MAX_CONNECTIONS:
                transport.abort()
                return
            name = common_name(transport.get_extra_info("peercert"))
            self.app = _with_certificate(self.app, name)
            self._monitor_request()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            self._monitor_request()

        def on_response_complete(self) -> None:
            super().on_response_complete()  # which may begin a request that was sent ahead
            if self.conn.their_state is h11.SEND_BODY:
                self._monitor_request()

        def connection_lost(self, exc: Exception | None) -> None:
            self._stop_watch()
            super().connection_lost(exc)

        def _monitor_request(self) -> None:
            if self.conn.their_state not in (h11.IDLE, h11.SEND_BODY):
                self._stop_watch()
            elif self._limit is None:
                self._limit = self.loop.call_later(REQUEST_TIME, self.transport.abort)

        def _stop_watch(self) -> None:
            if self._limit is not None:
                self._limit.cancel()
                self._limit = None

    return BoundedProtocol


def common_name(certificate: Mapping[str, Any] | None) -> str:
    """Return the name in a verified `certificate`, as `ssl` describes it; empty without one."""
    subject = (certificate or {}).get("subject", ())
    names = [value for part in subject for key, value in part if key == "commonName"]
    return names[0] if len(names) == 1 else ""


def _with_certificate(application: Any, name: str) -> Application:
    async def run(scope: Scope, receive: Receive, send: Send) -> None:
        scope["state"] = {**scope.get("state", {}), "certificate": name}
        await application(scope, receive, send)

    return run
