"""zenoh sessions: the daemon listens at one endpoint, everybody else connects there and nowhere else.

No scouting by multicast or gossip, no shared memory (a process that is killed would leave its files). The
daemon is a peer, all others are clients, because a peer passes on what comes from clients only: so the
telemetry of the publisher process, a client as well, reaches a viewer through the daemon.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Literal

import zenoh

from bench.errors import BenchError, ExitCode

if TYPE_CHECKING:
    from bench.config import NetworkSettings

LONGEST_MESSAGE = 2**20
"""Bytes; the transport drops a longer one before anybody sees it."""

LONGEST_WAIT = 0.1
"""s that a send waits for a peer that takes nothing, before the link to it is closed."""

_QUEUE = 16
"""Batches (64 kB) of a link that wait to be sent; half a second of telemetry at 1 kHz, with zenoh's own 2 a
stall of a busy machine costs messages."""


class NoAnswer(BenchError):
    """The bench does not answer. zenoh does not say whether it refused the connection or is not there."""

    exit_code = ExitCode.NO_ANSWER

    def __init__(self, bench: str, endpoint: str, waited: str = "nobody listens there") -> None:
        super().__init__(
            f"bench {bench} at {endpoint}",
            f"no answer: denied or not running ({waited})",
            "a running bench of this name",
            "Start it (golfbench run), or correct bench.id and network.endpoint of the configuration.",
        )


def open_daemon(network: NetworkSettings) -> zenoh.Session:
    """Return a session that listens at the endpoint.

    Raises:
        BenchError: nothing can listen there, for example because another process does.
    """
    try:
        return zenoh.open(_configuration("peer", listen=[network.endpoint]))
    except zenoh.ZError as error:
        in_use = "in use" in str(error)
        raise BenchError(
            f"network.endpoint {network.endpoint}",
            "already in use" if in_use else _first_line(error),
            "an endpoint of this machine where nobody listens",
            "Another bench may be running: golfbench status. Or choose another port.",
        ) from None


def open_client(network: NetworkSettings, bench: str) -> zenoh.Session:
    """Return a session connected to the daemon of `bench`; it connects again when the daemon comes back.

    Raises:
        NoAnswer: nobody listens there.
    """
    try:
        return zenoh.open(_configuration("client", connect=[network.endpoint]))
    except zenoh.ZError:
        raise NoAnswer(bench, network.endpoint) from None


def _configuration(
    mode: Literal["peer", "client"], *, listen: list[str] | None = None, connect: list[str] | None = None
) -> zenoh.Config:
    # drop: a publication never waits; block: a query or an answer waits this long for a stuck peer.
    congestion = {
        "drop": {"wait_before_drop": 0},
        "block": {"wait_before_close": round(1e6 * LONGEST_WAIT)},
    }
    configuration: dict[str, Any] = {
        "mode": mode,
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "listen": {"endpoints": listen or []},
        "connect": {"endpoints": connect or []},
        "transport": {
            "shared_memory": {"enabled": False},
            "link": {
                "rx": {"max_message_size": LONGEST_MESSAGE},
                "tx": {"queue": {"size": {"data": _QUEUE}, "congestion_control": congestion}},
            },
        },
    }
    return zenoh.Config.from_json5(json.dumps(configuration))


def _first_line(error: Exception) -> str:
    return str(error).partition(" at /")[0].strip()
