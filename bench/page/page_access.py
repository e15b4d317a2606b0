"""Who may do what on the page: by certificate, by token, or by being on this machine.

The roles are those of `bench.network.access_control`: a viewer looks and may stop, an operator commands. On
the loopback without TLS and tokens everybody is an operator, as for the bench itself.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Collection, Mapping
from enum import IntEnum
from hmac import compare_digest
from pathlib import Path
from threading import Lock
from typing import NamedTuple

from bench.errors import BenchError
from bench.from_toml import read_text

SHORTEST_TOKEN = 20
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
        expected, cure = "readable by its owner only: it holds secrets", f"chmod 600 {file}"
        raise BenchError(str(file), f"mode {mode & 0o777:o}", expected, cure)
    tokens = {}
    for number, line in enumerate(map(str.strip, text.splitlines()), 1):
        if not line or line.startswith("#"):
            continue
        role, _, token = line.partition(" ")
        if role not in ("viewer", "operator") or len(token.strip()) < SHORTEST_TOKEN:
            expected = f"viewer or operator, and a token of {SHORTEST_TOKEN} characters or more"
            cure = 'Make one: python -c "import secrets; print(secrets.token_urlsafe(24))"'
            raise BenchError(f"{file}, line {number}", "another line", expected, cure)
        tokens[token.strip()] = PageRole[role.upper()]
    if not tokens:
        raise BenchError(str(file), "no token", "at least one", "Write one a line: operator TOKEN.")
    return tokens
