"""Where the page is reached, and who may do what: by certificate, by token, or by being on this machine.

The roles are those of `bench.network.zenoh_session`: a viewer looks and may stop, an operator commands. On
the loopback without TLS and tokens everybody is an operator, as for the bench itself.

In front of every request: own host and origin only, small requests in time, strict headers. A browser on this
machine also shows other sites. They can send requests to the page's address, under another name too (DNS
rebinding): the Host must be one of the page's own, and a request that changes something must come from the
page's own origin as JSON, which no foreign form can send.
"""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import Awaitable, Callable, Collection, Mapping, MutableMapping
from enum import IntEnum
from hmac import compare_digest
from ipaddress import ip_address
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, NamedTuple

from bench.base.address import PAGE_PORT, identity_files
from bench.base.errors import BenchError, Refused
from bench.base.from_toml import read_text

if TYPE_CHECKING:
    from bench.config import Configuration

MIN_TOKEN_LENGTH = 20
"""Min length of a token, characters."""
MAX_SESSIONS = 64
SESSION = 12 * 3600.0
"""Duration of a session after its sign-in, s."""


class PageRole(IntEnum):
    """Role of a reader, in rising order."""

    STOPPER = 0
    """Holds a certificate without a role: may stop, as on the network."""
    VIEWER = 1
    OPERATOR = 2


class _Session(NamedTuple):
    role: PageRole
    until: float


class PageAccess:
    """Roles of the page's readers."""

    def __init__(
        self,
        viewers: Collection[str] = (),
        operators: Collection[str] = (),
        tokens: Mapping[str, PageRole] | None = None,
        *,
        closed: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`viewers` and `operators` are names in certificates; `closed`: no access without either."""
        self._names = dict.fromkeys(viewers, PageRole.VIEWER) | dict.fromkeys(operators, PageRole.OPERATOR)
        self._tokens, self._clock = dict(tokens or {}), clock
        self._closed = closed or bool(self._tokens)
        self._sessions: dict[str, _Session] = {}
        self._lock = Lock()

    @property
    def tokens(self) -> bool:
        """Whether there are tokens to sign in with."""
        return bool(self._tokens)

    def role(self, name: str, session: str) -> PageRole | None:
        """Return the role by certificate `name` and `session`, each empty if absent; None without a role."""
        with self._lock:
            held = self._sessions.get(session)
        if held is not None and self._clock() < held.until:
            return held.role
        if name:
            return self._names.get(name, PageRole.STOPPER)
        return None if self._closed else PageRole.OPERATOR

    def sign_in(self, token: str) -> str | None:
        """Return a new session for `token`; None if it is unknown."""
        found = [
            role for known, role in self._tokens.items() if compare_digest(known.encode(), token.encode())
        ]
        if not found:
            return None
        session = secrets.token_urlsafe(32)
        with self._lock:
            while len(self._sessions) >= MAX_SESSIONS:
                del self._sessions[next(iter(self._sessions))]
            self._sessions[session] = _Session(found[0], self._clock() + SESSION)
        return session


def read_tokens(file: Path) -> dict[str, PageRole]:
    """Return the tokens in `file`: "viewer TOKEN" or "operator TOKEN" a line; comments begin with #.

    Raises:
        BenchError: it cannot be read, others may read it, a line is invalid, or there is no token.
    """
    text = read_text(file, "a text file with tokens", "Write it.")
    mode = file.stat().st_mode
    if mode & 0o077:
        expected, action = "readable by its owner only: it holds secrets", f"chmod 600 {file}"
        raise BenchError(str(file), f"mode {mode & 0o777:o}", expected, action)
    tokens = {}
    for number, line in enumerate(map(str.strip, text.splitlines()), 1):
        if not line or line.startswith("#"):
            continue
        role, _, token = line.partition(" ")
        if role not in ("viewer", "operator") or len(token.strip()) < MIN_TOKEN_LENGTH:
            expected = f"viewer or operator, and a token of {MIN_TOKEN_LENGTH} characters or more"
            action = 'Make one: python -c "import secrets; print(secrets.token_urlsafe(24))"'
            raise BenchError(f"{file}, line {number}", "another line", expected, action)
        tokens[token.strip()] = PageRole[role.upper()]
    if not tokens:
        raise BenchError(str(file), "no token", "at least one", "Write one a line: operator TOKEN.")
    return tokens


class PageAddress(NamedTuple):
    """Where the page is reached, and by whom."""

    host: str = "127.0.0.1"
    """IP address to listen at."""
    port: int = PAGE_PORT
    identity: str = ""
    """Path, without ending, of certificate and key; empty: no TLS, on the loopback only."""
    tokens: Path | None = None
    """File of tokens; None: none."""

    @property
    def scheme(self) -> str:
        """Scheme of the page's URL."""
        return "https" if self.identity else "http"


def checked_address(address: PageAddress) -> tuple[str, ...]:
    """Return HOST:PORT of all names under which the page is reached.

    Raises:
        BenchError: the host is no IP address; the certificate or its key is invalid.
        Refused: beyond the loopback without TLS.
    """
    try:
        ip = ip_address(address.host)
    except ValueError:
        expected = "an IP address of this machine, or 0.0.0.0 for all"
        action = "Give --host 127.0.0.1 or another address of this machine."
        raise BenchError("--host", repr(address.host), expected, action) from None
    if not ip.is_loopback and not address.identity:
        expected = "a certificate for this machine: commands and tokens must not be readable on the network"
        action = "Make one: golfbench certificates DIR NAME --address HOST, then add --identity DIR/NAME."
        raise Refused(f"--host {address.host}", "an address for other machines without TLS", expected, action)
    names = {"127.0.0.1", "localhost", "[::1]"} if ip.is_loopback else set[str]()
    if not ip.is_unspecified:
        names.add(f"[{ip}]" if ip.version == 6 else str(ip))
    if address.identity:
        names |= _certified_names(identity_files(address.identity).certificate)
    default = 443 if address.identity else 80
    return tuple(
        sorted({f"{n}:{address.port}" for n in names} | (names if address.port == default else set()))
    )


def _certified_names(file: Path) -> set[str]:
    """Return host names and addresses in the certificate `file`, as a URL has them."""
    from cryptography import x509

    certificate = x509.load_pem_x509_certificate(file.read_bytes())
    try:
        found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        action = "Make one with golfbench certificates DIR NAME --address HOST."
        raise BenchError(str(file), "a client's certificate", "one with addresses", action) from None
    addresses = found.get_values_for_type(x509.IPAddress)
    return set(found.get_values_for_type(x509.DNSName)) | {
        f"[{ip}]" if ip.version == 6 else str(ip) for ip in addresses
    }


def page_access(address: PageAddress, configuration: Configuration) -> PageAccess:
    """Return the roles of persons at the page's `address`; raises the errors of `read_tokens`."""
    tokens: dict[str, PageRole] = read_tokens(address.tokens) if address.tokens else {}
    network = configuration.network
    return PageAccess(network.viewers, network.operators, tokens, closed=bool(address.identity))


# Requests --------------------------------------------------------------------------------------------

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
