"""The wire contract of a bench, for machines: what it publishes and answers, made from the types it uses.

The bench answers with it on `golfbench/BENCH/schema`, and `golfbench schema` prints it. The page beside
this file is the same for people.
"""

from __future__ import annotations

from typing import Any

from bench.json_schema import Schema, names_of, schema_of
from bench.lifecycle import ACCEPTED_IN
from bench.network.bench_service import STATUS_VERSION, BenchStatus
from bench.network.command import (
    FORMS,
    LAST_SEQUENCE,
    LONGEST_MESSAGE,
    PLAIN,
    REQUESTS,
    VERSION,
    ArmContent,
    CommandAnswer,
    ErrorParts,
    LeaseContent,
    Verb,
    form_schema,
)
from bench.network.lease import DEFAULT, LONGEST, SHORTEST
from bench.network.messages import (
    CAMPAIGN_VERSION,
    LOOP_VERSION,
    CampaignMessage,
    ChangeEvent,
    LeaseEvent,
    LoopMessage,
    TroubleEvent,
)
from bench.shot.shot import ShotStatus
from bench.shot.shot_message import SHOT_VERSION, ShotPublication
from bench.telemetry.cycle_record import FIELDS, LONGEST_BATCH, SCHEMA_VERSION, unit_of
from bench.telemetry.enumerations import ENUMERATIONS
from drivers.launch_monitor.matching import MatchOutcome

CONTRACT_VERSION = 1
"""Version of the contract itself: of the keys below, and of the form in which they are described."""

DIALECT = "https://json-schema.org/draft/2020-12/schema"

_JSON, _ARROW = "application/json", "application/vnd.apache.arrow.stream"
_ARROW_TYPES = {"f8": "double", "i8": "int64", "i4": "int32", "u1": "uint8", "?": "bool"}

_MAY_CHANGE = (
    "A message keeps its version while keys are added to it, or names to its enumerations: ignore a key "
    "that you do not know, and treat a name that you do not know as unknown.",
    "A message gets the next version when a key is removed, renamed, or changes its type, unit or meaning: "
    "refuse a version that you do not know.",
    "A command has exactly the keys of its schema: one with another key is refused.",
    "The columns of telemetry change only with their version, the schema's metadata golfbench_schema.",
    "Texts for people (text, reason, note, found, expected, action) may change at any time.",
)
_LOSS = (
    "Publications are sent once and dropped where a receiver does not keep up; none is repeated or kept.",
    "Telemetry: sequence counts messages from 1 since the publisher's start; a gap is a loss on the network, "
    "a smaller number a restart. lost counts cycles that were lost before they could be sent. A gap of tick "
    "inside a batch is a tick that the loop missed.",
    "State is repeated five times a second and complete each time; without one for 1 s the bench is silent.",
    "Shots and events are not repeated; what they say is also in records, database and state.",
    "A query is answered once or not at all: no answer means denied, not running, or busy for too long.",
)
_LEASE = (
    'Take: {"version": 1, "action": "take", "holder": NAME}; the answer\'s content has the key.',
    "Each keyed command carries the key and a sequence, from 1 on, higher each time: one that does not rise "
    "is refused and not done. Renewing and releasing are keyed commands.",
    "The lease expires unless renewed: renew at a third of its duration. When it expires or is released, "
    "an armed bench disarms; a swing that has begun completes. A restart of the bench voids it.",
    "Stop, emergency stop, disarm and status need no lease.",
)


def wire_contract(bench: str = "BENCH") -> dict[str, Any]:
    """Return the contract of `bench`, valid as JSON."""
    root = f"golfbench/{bench}"
    return {
        "contract_version": CONTRACT_VERSION,
        "bench": bench,
        "protocol": "zenoh 1, as a client of the bench's endpoint; no scouting",
        "json_schema": DIALECT,
        "may_change": list(_MAY_CHANGE),
        "loss": list(_LOSS),
        "lease": {
            "rules": list(_LEASE),
            "min_seconds": SHORTEST,
            "default_seconds": DEFAULT,
            "max_seconds": LONGEST,
            "last_sequence": LAST_SEQUENCE,
        },
        "published": _published(root),
        "commands": {
            "encoding": _JSON,
            "longest_message": LONGEST_MESSAGE,
            "error": _message(
                {"type": "object", "properties": {"error": schema_of(ErrorParts)}, "required": ["error"]},
                VERSION,
            ),
            "forms": [_command(root, form) for form in FORMS],
        },
        "schema": {"key": f"{root}/schema", "encoding": _JSON, "answer": "this object"},
        "telemetry": _telemetry(),
        "enumerations": ENUMERATIONS | {kind.__name__: names_of(kind) for kind in (MatchOutcome, ShotStatus)},
    }


def _published(root: str) -> list[dict[str, Any]]:
    """Return the keys of publications and their messages' schemas."""
    event: Schema = {
        "anyOf": [_message(schema_of(kind), VERSION) for kind in (ChangeEvent, LeaseEvent, TroubleEvent)]
    }
    state, shot = _message(schema_of(BenchStatus), STATUS_VERSION), schema_of(ShotPublication)
    campaign = _message(schema_of(CampaignMessage), CAMPAIGN_VERSION)
    rows: list[tuple[str, str, str, Schema]] = [
        ("state", "on change and five times a second", "state of the bench", state),
        ("event", "on change", "changes of state, troubles of the loop", event),
        ("shot", "when a record is stored or an outcome settled", "shots", _message(shot, SHOT_VERSION)),
        ("loop", "once a second", "timing of the loop", _message(schema_of(LoopMessage), LOOP_VERSION)),
        ("campaign/ID", "at each shot and change; also answered to a query", "state of a campaign", campaign),
    ]
    telemetry = {
        "key": f"{root}/telemetry",
        "when": "about 50 times a second",
        "content": "cycles of the loop, see telemetry",
        "encoding": _ARROW,
    }
    described = [
        {"key": f"{root}/{name}", "when": when, "content": content, "encoding": _JSON, "schema": schema}
        for name, when, content, schema in rows
    ]
    return [telemetry, *described]


def _command(root: str, form: str) -> dict[str, Any]:
    """Return key, request and answer of a form of a command."""
    name = form.partition(" ")[0]
    verb = Verb(name)
    content: Schema = {"type": "object"}
    if verb is Verb.STATUS:
        content = _message(schema_of(BenchStatus), STATUS_VERSION)
    elif form in ("lease take", "lease renew"):
        content = schema_of(LeaseContent)
    elif verb is Verb.ARM:
        content = schema_of(ArmContent)
    answer = schema_of(CommandAnswer)
    if content != {"type": "object"}:  # a refused command may have no content
        content = {"anyOf": [content, {"type": "object", "maxProperties": 0}]}
    answer["properties"] = answer["properties"] | {"content": content}
    states = sorted(state.name for state in ACCEPTED_IN[REQUESTS[verb]]) if verb in REQUESTS else None
    return {
        "name": form,
        "key": f"{root}/command/{verb}",
        "lease": verb not in PLAIN and form != "lease take",
        "accepted_in": states,
        "request": form_schema(form),
        "answer": _message(answer, VERSION),
    }


def _message(schema: Schema, version: int) -> Schema:
    """Return `schema` with its version as a constant."""
    properties = {"version": {"const": version}} | schema["properties"] | {"version": {"const": version}}
    required = ["version", *(name for name in schema["required"] if name != "version")]
    return schema | {"properties": properties, "required": required}


def _telemetry() -> dict[str, Any]:
    """Return the columns of telemetry and of records."""
    columns = [
        {
            "name": column,
            "type": _ARROW_TYPES[field.dtype],
            "unit": unit_of(field, index),
            "description": field.text,
        }
        | ({"enumeration": field.names} if field.names else {})
        for field in FIELDS
        for index, column in enumerate(field.columns)
    ]
    return {
        "form": "one Arrow IPC stream of one record batch a message",
        "version": {"golfbench_schema": f"cycle/{SCHEMA_VERSION}"},
        "max_rows": LONGEST_BATCH,
        "batch_metadata": {
            "sequence": "number of the message, from 1 on, as text",
            "lost": "cycles lost before they could be sent, as text",
            "time": "UTC of the newest cycle's tick, s since 1970, as text",
        },
        "columns": columns,
    }
