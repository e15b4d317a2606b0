"""Roles over the network, by the name in a certificate, in the form of zenoh's access control.

A viewer receives what bench and campaigns publish and asks for their status; an operator commands and runs
campaigns as well. Whoever may connect at all, which takes a certificate of the bench's authority, may stop
it. What comes without TLS comes from this machine (the configuration takes nothing else) and is not
restricted. What is denied is dropped silently.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

_ALL = "golfbench/**"
_COMMANDS = "golfbench/*/command/**"
_CAMPAIGNS = "golfbench/*/campaign/**"
_STATUS = "golfbench/*/command/status"
_SCHEMA = "golfbench/*/schema"
_STOPS = ("golfbench/*/command/stop", "golfbench/*/command/estop")
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


def access_control(
    viewers: Collection[str], operators: Collection[str], benches: Collection[str] = ()
) -> dict[str, Any]:
    """Return zenoh's `access_control` for a bench, or with `benches` for a router between them and clients.

    `viewers` and `operators` are common names of certificates; so are `benches`, and each of them speaks for
    the bench of that name and no other. A bench takes a router it connects to for an operator; to a router
    everybody comes by TLS, a bench of the same machine too.
    """
    reads = _allow("reads", "ingress", "declare_subscriber", _ALL), _allow("hears", "egress", "put", _ALL)
    rules = [
        *reads,
        *_asks("status", _STATUS),
        *_asks("command", _COMMANDS),
        *_asks("stop", *_STOPS),
        *_asks("campaign", _CAMPAIGNS),
        *_asks("schema", _SCHEMA),
        _allow("campaign told", "ingress", ("put", "declare_queryable", "reply"), _CAMPAIGNS),
        _allow("campaign offered", "egress", ("query", "declare_queryable"), _CAMPAIGNS),
        # A client asks without knowing whether somebody answers; a router passes on what it knows of.
        _allow("command offered", "egress", "declare_queryable", _COMMANDS),
    ]
    policies = [_policy("anybody", ["stop", "stop answered"], link_protocols=["tls"])]
    if benches:  # who listens to all benches listens to each
        rules.append(_allow("wanted", "egress", "declare_subscriber", _ALL))
    else:
        rules.append(_allow("anything", "both", _MESSAGES, "**"))
        policies.append(_policy("this machine", ["anything"], link_protocols=["tcp"]))
    if viewers:
        may = [*_READS, "status", "status answered"]
        policies.append(_policy("viewers", may, cert_common_names=sorted(viewers)))
    if operators:
        may = [*_READS, "command", "command answered", "command offered", "campaign told"]
        policies.append(_policy("operators", may, cert_common_names=sorted(operators)))
    for name in sorted(benches):
        own = f"golfbench/{name}/**"
        rules += [
            _allow(f"{name} tells", "ingress", ("put", "declare_queryable", "reply"), own),
            _allow(f"{name} is asked", "egress", "query", own),
        ]
        may = [f"{name} tells", f"{name} is asked", "wanted"]
        policies.append(_policy(name, may, cert_common_names=[name]))
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [subject for subject, _ in policies],
        "policies": [policy for _, policy in policies],
    }


def _asks(name: str, *keys: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the rules for sending queries and for receiving the replies."""
    return _allow(name, "ingress", "query", *keys), _allow(f"{name} answered", "egress", "reply", *keys)


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
