"""Where the page is reached, and who may do what: by certificate, by token, or by being on this machine.

The roles are those of `bench.network.zenoh_session`: a viewer looks and may stop, an operator commands. On
the loopback without TLS and tokens everybody is an operator, as for the bench itself.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Collection, Mapping
from enum import IntEnum
from hmac import compare_digest
from ipaddress import ip_address
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, NamedTuple

from bench.base.address import identity_files
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


PORT = 8600
"""Port of the page unless another one is given."""


class PageAddress(NamedTuple):
    """Where the page is reached, and by whom."""

    host: str = "127.0.0.1"
    """IP address to listen at."""
    port: int = PORT
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
        raise BenchError(
            "--host",
            repr(address.host),
            expected,
            "Give --host 127.0.0.1 or another address of this machine.",
        ) from None
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
