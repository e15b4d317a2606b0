"""Types of the messages that a bench and its campaigns publish, and the wire contract made from all types.

Those of state and shot: `bench.network.bench_service`, `bench.records.shot.shot_message`.

The bench answers with its contract on `golfbench/BENCH/schema`, and `golfbench schema` prints it. For people
it is `bench/manual/integrator/wire_contract.md`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NotRequired, TypedDict

from bench.base.address import root_key
from bench.base.json_schema import Schema, names_of, schema_of
from bench.base.lifecycle import ACCEPTED_IN, Cause, Phase, Reaction, State
from bench.network.bench_service import STATUS_VERSION, BenchStatus, CommandAnswer
from bench.network.command import (
    FORMS,
    LAST_SEQUENCE,
    MAX_COMMAND_BYTES,
    PLAIN,
    REQUESTS,
    VERSION,
    ArmContent,
    ErrorParts,
    LeaseContent,
    Verb,
    form_schema,
)
from bench.network.lease import DEFAULT_SECONDS, MAX_SECONDS, MIN_SECONDS
from bench.records.shot.shot import ShotStatus
from bench.records.shot.shot_message import SHOT_VERSION, ShotPublication
from bench.records.telemetry.cycle_record import (
    ENUMERATIONS,
    FIELDS,
    MAX_BATCH_CYCLES,
    SCHEMA_VERSION,
    unit_of,
)
from drivers.launch_monitor.record import MatchOutcome

LOOP_VERSION = 1
CAMPAIGN_VERSION = 1


class ChangeEvent(TypedDict):
    """State, phase, reaction or cause changed."""

    version: int
    event: Literal["change"]
    time: float
    """Time of the message on the supervisor's clock (CLOCK_MONOTONIC), s."""
    state: Annotated[str, State]
    phase: Annotated[str, Phase]
    reaction: Annotated[str, Reaction]
    cause: Annotated[str, Cause]
    tick: int
    """Number of the tick since the loop's start."""
    loop_time: float
    """Time of the tick on the loop's clock, s."""


class LeaseEvent(TypedDict):
    """The lease lapses soon unless it is renewed, or has ended: lapsed or released."""

    version: int
    event: Literal["lease lapses", "lease ended"]
    time: float
    """Time of the message on the supervisor's clock (CLOCK_MONOTONIC), s."""
    holder: str
    seconds_left: NotRequired[float]
    """Time until the lease expires (s)."""


class FaultEvent(TypedDict):
    """The loop met an exception, or ended."""

    version: int
    event: Literal["exception", "loop died"]
    time: float
    """Time of the message on the supervisor's clock (CLOCK_MONOTONIC), s."""
    text: str


class SegmentTiming(TypedDict):
    """Durations of one segment of the ticks, us; None if nothing was counted."""

    count: int
    p50_us: float | None
    p99_us: float | None
    p999_us: float | None
    max_us: float | None


class LoopMessage(TypedDict):
    """Timing of the loop since the message before."""

    version: int
    time: float
    """UTC, s since 1970."""
    seconds: float
    """Time since the message before, s."""
    batches: int
    """Telemetry messages since the publisher's start."""
    lost: int
    """Records that the ring lost for the publisher, since its start."""
    ticks: int
    skipped: int
    """Grid points without a tick."""
    late: int
    """Ticks that began late."""
    page_faults: int
    preemptions: int
    """Preemptions of the loop's thread."""
    stalls: dict[str, int]
    """Ticks that were late or followed skipped ones, by why."""
    period_us: float
    segments: dict[str, SegmentTiming]


class BallCount(TypedDict):
    """Shots with one ball; without warm-up."""

    valid: int
    planned: int


class LastShot(TypedDict):
    """The newest shot of a campaign; figures that were not measured are null."""

    shot: int
    block: int
    role: str
    ball: str
    sample: int
    """Number of the physical ball; 0 if balls are not distinguished."""
    club: str
    swing: str
    status: ShotStatus
    reason: str
    """Why the shot is not valid."""
    club_speed_mps: float | None
    attack_angle_deg: float | None
    ball_speed_mps: float | None
    launch_angle_deg: float | None
    spin_rpm: float | None
    carry_m: float | None
    carry_source: str
    time_utc: str
    """ISO 8601."""


class ComingWork(TypedDict):
    """Work by hand that comes next."""

    shots: int
    """Number of shots before it."""
    text: str
    seconds: float | None
    """Time until then, s; None while the pace is not known."""


class CampaignNews(TypedDict):
    """Newest event of a campaign."""

    text: str
    time_utc: str
    """ISO 8601."""


class CampaignMessage(TypedDict):
    """State of a campaign."""

    version: int
    campaign: str
    """Id of the campaign."""
    name: str
    """Name of its plan."""
    state: Literal["running", "waiting", "paused", "suspended", "stopped", "aborted", "finished"]
    reason: str
    """Prompt while it waits, or why it does not run; else empty."""
    shots: int
    """Shots so far, also those that are not valid."""
    valid: int
    done: int
    """Planned shots that are settled."""
    planned: int
    block: int
    """Block of the newest shot, from 1; 0 before the first."""
    blocks: int
    balls: dict[str, BallCount]
    seconds_left: float | None
    """Expected time to the end, s; None while the pace is not known."""
    last_shot: LastShot | None
    next_work: ComingWork | None
    event: CampaignNews | None


CONTRACT_VERSION = 1
"""Version of the contract itself: its keys below, and the form of their description."""

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
    "an armed bench disarms; a swing in progress completes. A restart of the bench voids it.",
    "Stop, emergency stop, disarm and status need no lease.",
)


def wire_contract(bench: str = "BENCH") -> dict[str, Any]:
    """Return the wire contract of `bench` (keys, schemas, limits) as JSON values."""
    root = root_key(bench)
    return {
        "contract_version": CONTRACT_VERSION,
        "bench": bench,
        "protocol": "zenoh 1, as a client of the bench's endpoint; no scouting",
        "json_schema": DIALECT,
        "may_change": list(_MAY_CHANGE),
        "loss": list(_LOSS),
        "lease": {
            "rules": list(_LEASE),
            "min_seconds": MIN_SECONDS,
            "default_seconds": DEFAULT_SECONDS,
            "max_seconds": MAX_SECONDS,
            "last_sequence": LAST_SEQUENCE,
        },
        "published": _published(root),
        "commands": {
            "encoding": _JSON,
            "longest_message": MAX_COMMAND_BYTES,
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
    event: Schema = {
        "anyOf": [_message(schema_of(kind), VERSION) for kind in (ChangeEvent, LeaseEvent, FaultEvent)]
    }
    state, shot = _message(schema_of(BenchStatus), STATUS_VERSION), schema_of(ShotPublication)
    campaign = _message(schema_of(CampaignMessage), CAMPAIGN_VERSION)
    rows: list[tuple[str, str, str, Schema]] = [
        ("state", "on change and five times a second", "state of the bench", state),
        ("event", "on change", "changes of state, faults of the loop", event),
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
    verb = Verb(form.partition(" ")[0])
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
        "max_rows": MAX_BATCH_CYCLES,
        "batch_metadata": {
            "sequence": "number of the message, from 1 on, as text",
            "lost": "cycles lost before they could be sent, as text",
            "time": "UTC of the newest cycle's tick, s since 1970, as text",
        },
        "columns": columns,
    }
