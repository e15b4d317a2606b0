"""zenoh sessions: the daemon listens at one endpoint, all others connect there and nowhere else.

No scouting by multicast or gossip, no shared memory (a process that is killed would leave its files). The
daemon is a peer and all others are clients, because a peer forwards only messages from clients. So the
telemetry of the publisher process, also a client, reaches a viewer through the daemon.

Other machines connect by TLS with a certificate on either side, to the daemon's `network.beyond` or to a
zenoh router that the daemon connects to. Their roles are by the name in the certificate, in the form of
zenoh's access control. A viewer receives what bench and campaigns publish and asks for their status; an
operator also commands and runs campaigns. Every client that may connect, which takes a certificate of the
bench's authority, may stop the bench. Messages without TLS come from this machine (the configuration allows
nothing else) and are not restricted. Denied messages are dropped silently.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from contextlib import suppress
from threading import Thread
from typing import TYPE_CHECKING, Any, Literal

import zenoh

from bench.base.address import identity_files
from bench.base.errors import BenchError, ExitCode
from bench.base.interrupt import CLOSING_THREAD

if TYPE_CHECKING:
    from bench.base.address import NetworkSettings

MAX_TRANSPORT_BYTES = 2**20
"""Max size of a message, bytes; the transport drops longer ones."""

MAX_SEND_WAIT = 0.1
"""Max time a send waits for a blocked peer before the link to it is closed, s."""

SESSION_CLOSE_TIMEOUT = 1.0
"""Max time for which the end of a session waits for peers that do not read, s; zenoh's own is ten."""

TLS = "tls/"
"""Prefix of an endpoint for other machines."""

_QUEUE = 16
"""Batches (64 kB) of a link that wait to be sent; half a second of telemetry at 1 kHz, with zenoh's own 2 a
stall of a busy machine costs messages."""

_TIMEOUT = 0.02
"""Time that the daemon's publication waits for room in a full queue (s). Once in vain, the next ones to that
peer do not wait, so a dead subscriber costs it once. A client may wait for `MAX_SEND_WAIT`. Without any wait,
messages were lost whenever zenoh's threads stood still on a busy machine for longer than the queue lasts."""


class NoAnswer(BenchError):
    """No answer from the bench; zenoh does not report whether it refused the connection or is not running."""

    exit_code = ExitCode.NO_ANSWER

    def __init__(self, bench: str, endpoint: str, waited: str = "no process listens there") -> None:
        super().__init__(
            f"bench {bench} at {endpoint}",
            f"no answer: denied or not running ({waited})",
            "a running bench of this name",
            "Start it (golfbench run); a first start compiles for minutes. Or correct bench.id and "
            "network.endpoint of the configuration."
            + " Or ask the bench's administrator for a role, or for a new certificate."
            * endpoint.startswith(TLS),
        )


def open_daemon(network: NetworkSettings) -> zenoh.Session:
    """Return a session that listens at the endpoint, and beyond this machine where `network` says so.

    It starts without the router, and connects and reconnects to it when it is available.

    Raises:
        BenchError: nothing can listen there, for example because another process does; the endpoint is that
            of another machine; the certificate or its key is invalid.
    """
    if network.endpoint.startswith(TLS):
        location, found = f"network.endpoint {network.endpoint}", "an endpoint for other machines"
        action = "Write it as network.beyond. Only a client on another machine has it as network.endpoint."
        raise BenchError(
            location, found, "tcp/127.0.0.1:PORT, where the bench's own processes connect", action
        )
    listen = [endpoint for endpoint in (network.endpoint, network.beyond) if endpoint]
    configuration = _configuration("peer", network, listen=listen, connect=[network.router])
    if network.beyond or network.router:
        configuration["access_control"] = access_control(network.viewers, network.operators)
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(configuration)))
    except zenoh.ZError as error:
        in_use = "in use" in str(error)
        location = f"network.endpoint {' and network.beyond '.join(listen)}"
        expected = "a free endpoint of this machine"
        action = "Another bench may be running: golfbench status. Or choose another port."
        raise BenchError(
            location, "already in use" if in_use else _first_line(error), expected, action
        ) from None


def close_session(session: zenoh.Session) -> None:
    """Close `session`; a peer that reads nothing does not hold it up for longer than a second.

    A thread does the rest: Python's exit waits for it, `golfbench` does not (`bench.base.interrupt.leave`).
    As a daemon thread it would abort the process at its end, out of zenoh.
    """
    closing = Thread(target=_close, args=(session,), name=CLOSING_THREAD)
    closing.start()
    closing.join(SESSION_CLOSE_TIMEOUT)


def _close(session: zenoh.Session) -> None:
    with suppress(zenoh.ZError, RuntimeError):  # it gave such a peer up; another thread is still closing it
        session.close()


def open_client(network: NetworkSettings, bench: str) -> zenoh.Session:
    """Return a session connected to the daemon of `bench`; it connects again when the daemon comes back.

    Raises:
        NoAnswer: no process listens there, or it rejects this certificate.
        BenchError: the certificate or its key is invalid.
    """
    configuration = _configuration("client", network, connect=[network.endpoint])
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(configuration)))
    except zenoh.ZError:
        secure = network.endpoint.startswith(TLS)
        waited = "no process listens there" + ", or it rejects this certificate" * secure
        raise NoAnswer(bench, network.endpoint, waited) from None


def _configuration(
    mode: Literal["peer", "client"],
    network: NetworkSettings,
    *,
    connect: Sequence[str],
    listen: Sequence[str] = (),
) -> dict[str, Any]:
    timeout = round(1e6 * (_TIMEOUT if listen else MAX_SEND_WAIT))
    # drop: a publication; block: a query or an answer waits this long for a stuck peer, then its link goes.
    congestion = {
        "drop": {"wait_before_drop": timeout, "max_wait_before_drop_fragments": timeout},
        "block": {"wait_before_close": round(1e6 * MAX_SEND_WAIT)},
    }
    link: dict[str, Any] = {
        "rx": {"max_message_size": MAX_TRANSPORT_BYTES},
        "tx": {"queue": {"size": {"data": _QUEUE}, "congestion_control": congestion}},
    }
    if any(endpoint.startswith(TLS) for endpoint in (*listen, *connect)):
        link["tls"] = _tls(network.identity)
    return {
        "mode": mode,
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "listen": {"endpoints": list(listen)},
        "connect": {"endpoints": [endpoint for endpoint in connect if endpoint]},
        "transport": {"shared_memory": {"enabled": False}, "link": link},
    }


def _tls(identity: str) -> dict[str, Any]:
    """Return zenoh's settings for the certificate IDENTITY.pem.

    Raises:
        BenchError: a file is missing, no PEM, or of another certificate.
    """
    files = identity_files(identity)
    return {
        "root_ca_certificate": str(files.authority),
        "listen_certificate": str(files.certificate),
        "listen_private_key": str(files.key),
        "connect_certificate": str(files.certificate),
        "connect_private_key": str(files.key),
        "enable_mtls": True,
        "close_link_on_expiration": True,
    }


def _first_line(error: Exception) -> str:
    return str(error).partition(" at /")[0].strip()


_COMMANDS = "golfbench/*/command/**"
_CAMPAIGNS = "golfbench/*/campaign/**"
_READS = ("reads", "hears", "campaign", "campaign answered", "campaign offered", "schema", "schema answered")
"""Rules of every role."""
_MESSAGES = (
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "reply",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
)


def access_control(viewers: Collection[str], operators: Collection[str]) -> dict[str, Any]:
    """Return zenoh's `access_control` for a bench; `viewers`, `operators`: common names of certificates.

    A bench takes a router it connects to for an operator; the router's own is in
    bench/configurations/router.json5.
    """
    asked = {
        "status": ("golfbench/*/command/status",),
        "command": (_COMMANDS,),
        "stop": ("golfbench/*/command/stop", "golfbench/*/command/estop"),
        "campaign": (_CAMPAIGNS,),
        "schema": ("golfbench/*/schema",),
    }
    rules = [
        _allow("reads", "ingress", "declare_subscriber", "golfbench/**"),
        _allow("hears", "egress", "put", "golfbench/**"),
    ]
    for name, keys in asked.items():
        rules.append(_allow(name, "ingress", "query", *keys))
        rules.append(_allow(f"{name} answered", "egress", "reply", *keys))
    rules += [
        _allow("campaign told", "ingress", ("put", "declare_queryable", "reply"), _CAMPAIGNS),
        _allow("campaign offered", "egress", ("query", "declare_queryable"), _CAMPAIGNS),
        # A client asks even if no one answers; a router passes on the commands that it knows of.
        _allow("command offered", "egress", "declare_queryable", _COMMANDS),
        _allow("anything", "both", _MESSAGES, "**"),
    ]
    policies = [
        _policy("anybody", ["stop", "stop answered"], link_protocols=["tls"]),
        _policy("this machine", ["anything"], link_protocols=["tcp"]),
    ]
    if viewers:
        may = [*_READS, "status", "status answered"]
        policies.append(_policy("viewers", may, cert_common_names=sorted(viewers)))
    if operators:
        may = [*_READS, "command", "command answered", "command offered", "campaign told"]
        policies.append(_policy("operators", may, cert_common_names=sorted(operators)))
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [subject for subject, _ in policies],
        "policies": [policy for _, policy in policies],
    }


def _allow(name: str, flow: str, messages: str | tuple[str, ...], *keys: str) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": ["ingress", "egress"] if flow == "both" else [flow],
        "messages": [messages] if isinstance(messages, str) else list(messages),
        "key_exprs": list(keys),
    }


def _policy(name: str, rules: list[str], **who: list[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    return {"id": name, **who}, {"rules": rules, "subjects": [name]}
