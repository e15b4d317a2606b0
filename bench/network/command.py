"""Messages of the command plane: commands over the network and their answers.

A command is a JSON object at `golfbench/<bench>/command/<verb>`, of the keys that `FORMS` gives for its
verb and no others. `parse_command` is the edge: its results need no further check. Answers are JSON
objects too (`encode_answer`, `parse_answer`); an invalid message gets an error (`encode_error`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Any, NamedTuple, NotRequired, TypedDict

from bench.base.errors import BenchError
from bench.base.json_schema import json_object, misfits, shown
from bench.base.lifecycle import Cause, Refusal, Request, State
from bench.network.bench_service import ArmingBlock, CommandAnswer
from bench.network.lease import DEFAULT_SECONDS, MAX_HOLDER_LENGTH, MAX_SECONDS, MIN_SECONDS, is_holder
from bench.swing.correction_terms import MAX_WEIGHT, MAX_WEIGHTS

VERSION = 1
"""Version of every message."""

MAX_COMMAND_BYTES = 4096
"""Max size of a command, bytes."""

LAST_SEQUENCE = 2**53 - 1
"""The largest whole number that every JSON reader keeps exactly."""

CONVENIENCE = (
    "An emergency stop over the network is a convenience, not a safety function: "
    "in danger press the button next to the robot."
)


class Verb(StrEnum):
    """A command of the network."""

    STATUS = "status"
    LEASE = "lease"
    HOME = "home"
    ARM = "arm"
    DISARM = "disarm"
    ACCESS = "access"
    SECURE = "secure"
    SWING = "swing"
    TEE = "tee"
    STOP = "stop"
    ESTOP = "estop"
    RESET = "reset"
    CORRECT = "correct"


class ParsedCommand(NamedTuple):
    """A valid command; the values that its form does not have are not used."""

    form: str
    """One of FORMS: the verb, and for the lease its action."""
    key: str = ""
    """Key of the lease."""
    sequence: int = 0
    holder: str = ""
    """Name of the one who takes the lease."""
    seconds: float = DEFAULT_SECONDS
    """Duration of the lease from now, s."""
    profile: str = ""
    """Digest of the profile that a correction was learned for."""
    weights: tuple[float, ...] = ()
    """Weights of the correction; empty: as designed."""

    @property
    def verb(self) -> Verb:
        """Its verb."""
        return Verb(self.form.partition(" ")[0])


REQUESTS: Mapping[Verb, Request] = {
    verb: Request[verb.name]
    for verb in map(Verb, ("home", "arm", "disarm", "access", "secure", "swing", "tee", "reset"))
}
"""Verbs that become requests to the loop, one at a time. Stop and emergency stop bypass them."""

STOPS = frozenset({Verb.STOP, Verb.ESTOP})

PLAIN = STOPS | {Verb.STATUS, Verb.DISARM}
"""Verbs that need no lease: those that end motion, and status."""


# The edge --------------------------------------------------------------------------------------------


class _Value(NamedTuple):
    """Check of a key's value."""

    expected: str
    schema: Mapping[str, Any]
    """JSON Schema; `holds` checks the rest."""
    holds: Callable[[Any], bool] = lambda _: True
    secret: bool = False


_VALUES: Mapping[str, _Value] = {
    "version": _Value(
        f"{VERSION}, a whole number", {"type": "integer", "minimum": VERSION, "maximum": VERSION}
    ),
    "key": _Value(
        "the key that came with the lease, 22 characters",
        {"type": "string", "pattern": "^[A-Za-z0-9_-]{22}$", "maxLength": 22},
        secret=True,
    ),
    "sequence": _Value(
        "a whole number from 1 to 2^53 - 1", {"type": "integer", "minimum": 1, "maximum": LAST_SEQUENCE}
    ),
    "holder": _Value(
        f"a name of 1 to {MAX_HOLDER_LENGTH} printable characters, no space at its ends",
        {"type": "string", "minLength": 1, "maxLength": MAX_HOLDER_LENGTH},
        is_holder,
    ),
    "profile": _Value(
        "the digest of a profile, 16 hexadecimal characters",
        {"type": "string", "pattern": "^[0-9a-f]{16}$", "maxLength": 16},
    ),
    "weights": _Value(
        f"at most {MAX_WEIGHTS} numbers from -{MAX_WEIGHT:g} to {MAX_WEIGHT:g}",
        {
            "type": "array",
            "maxItems": MAX_WEIGHTS,
            "items": {"type": "number", "minimum": -MAX_WEIGHT, "maximum": MAX_WEIGHT},
        },
    ),
    "seconds": _Value(
        f"{MIN_SECONDS:g} to {MAX_SECONDS:g} s, a number",
        {"type": "number", "minimum": MIN_SECONDS, "maximum": MAX_SECONDS},
    ),
}

_KEYED = ("key", "sequence")
FORMS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    **{verb.value: (("version",), ()) for verb in Verb if verb in PLAIN},
    **{verb.value: (("version", *_KEYED), ()) for verb in REQUESTS if verb not in PLAIN},
    "correct": (("version", *_KEYED, "profile", "weights"), ()),
    "lease take": (("version", "action", "holder"), ("seconds",)),
    "lease renew": (("version", "action", *_KEYED), ("seconds",)),
    "lease release": (("version", "action", *_KEYED), ()),
}
"""Keys that a message must have and those it may have, by form."""


def form_schema(form: str) -> dict[str, Any]:
    """Return the JSON Schema of the messages of a form of `FORMS`."""
    needed, allowed = FORMS[form]
    values = {name: {**value.schema, "description": value.expected} for name, value in _VALUES.items()}
    values["action"] = {"const": form.partition(" ")[2]}
    return {
        "type": "object",
        "properties": {name: values[name] for name in (*needed, *allowed)},
        "required": list(needed),
        "additionalProperties": False,
    }


def parse_command(verb: str, payload: bytes) -> ParsedCommand:
    """Return the command that came as `payload` at `verb`.

    Raises:
        BenchError: there is no such verb, or the payload is not exactly what `FORMS` says.
    """
    if verb not in Verb.__members__.values():
        known = ", ".join(Verb)
        raise BenchError(
            f"command {shown(verb)}", "an unknown verb", f"one of {known}", f"Use one of {known}."
        )
    location = f"command {verb}"
    message = _read_object(location, payload)
    form = verb
    if verb == Verb.LEASE:
        action = message.get("action")
        if action not in ("take", "renew", "release"):
            found = "missing" if "action" not in message else shown(action)
            raise BenchError(
                f"{location}: action", found, '"take", "renew" or "release"', "Set action to one of these."
            )
        form = f"{verb} {action}"
    _check_keys(location, message, *FORMS[form])
    values = {name: value for name, value in message.items() if name not in ("version", "action")}
    if "weights" in values:
        values["weights"] = tuple(map(float, values["weights"]))
    return ParsedCommand(form, **values)


def encode_command(verb: Verb, **values: Any) -> bytes:
    """Return the message for `verb` with `values` as its keys in addition to the version."""
    return json.dumps({"version": VERSION, **values}).encode()


def _check_keys(
    location: str, message: dict[str, Any], needed: tuple[str, ...], allowed: tuple[str, ...]
) -> None:
    known = ", ".join((*needed, *(f"{name} (optional)" for name in allowed)))
    for name in message:
        if name not in needed and name not in allowed:
            raise BenchError(f"{location}: {shown(name)}", "an unknown key", known, "Remove or correct it.")
    for name in needed:
        if name not in message:
            raise BenchError(f"{location}: {name}", "missing", known, f"Add the key {name}.")
    for name, value in message.items():
        if name == "action":
            continue
        wanted = _VALUES[name]
        if any(misfits(value, wanted.schema, name)) or not wanted.holds(value):
            found = "something else, not repeated here" if wanted.secret else shown(value)
            raise BenchError(f"{location}: {name}", found, wanted.expected, f"Correct the value of {name}.")


def _read_object(location: str, payload: bytes) -> dict[str, Any]:
    expected, action = "a JSON object in UTF-8", "Send an object as `golfbench` does."
    if len(payload) > MAX_COMMAND_BYTES:
        raise too_long(location, len(payload))

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        read: dict[str, Any] = {}
        for name, value in pairs:
            if name in read:
                raise BenchError(
                    f"{location}: {shown(name)}", "given twice", "each key once", "Remove one of the two."
                )
            read[name] = value
        return read

    try:
        message = json.loads(payload.decode("utf-8"), object_pairs_hook=unique)
    except UnicodeDecodeError as error:
        raise BenchError(location, f"a byte at {error.start} that is no UTF-8", expected, action) from None
    except json.JSONDecodeError as error:
        raise BenchError(
            location, f"no JSON: {error.msg} at character {error.pos}", expected, action
        ) from None
    except RecursionError:
        raise BenchError(location, "values nested too deep", "one flat JSON object", action) from None
    if not isinstance(message, dict):
        raise BenchError(location, shown(message), expected, action)
    return message


def too_long(location: str, length: int) -> BenchError:
    """Return the error for a message of `length` bytes."""
    return BenchError(
        location, f"{length} bytes", f"at most {MAX_COMMAND_BYTES} bytes", "Send a shorter message."
    )


# Answers ---------------------------------------------------------------------------------------------


class LeaseContent(TypedDict):
    """Content of the answer when the lease is taken or renewed."""

    holder: str
    seconds_left: float
    key: NotRequired[str]
    """Key of a newly taken lease; every keyed command carries it."""


class ArmContent(TypedDict):
    """Content of the answer to a request to arm that configuration, calibrations or profile block."""

    arming_blocks: list[ArmingBlock]


class ErrorParts(TypedDict):
    """Parts of an error in a message."""

    location: str
    found: str
    expected: str
    action: str


def encode_answer(answer: CommandAnswer) -> bytes:
    """Return `answer` as the message that `parse_answer` reads.

    Raises:
        ValueError: its content cannot be written as JSON.
    """
    return json.dumps({"version": VERSION, **answer._asdict()}, allow_nan=False).encode()


def encode_error(error: BenchError) -> bytes:
    """Return `error` as the message that `parse_error` reads."""
    return json.dumps({"version": VERSION, "error": error.record()}).encode()


def parse_answer(payload: bytes) -> CommandAnswer:
    """Return the answer in `payload`; raises BenchError: it is no answer of this version."""
    match json_object(payload):
        case {
            "version": 1,
            "accepted": bool(accepted),
            "state": str(state),
            "refusal": str(refusal),
            "cause": str(cause),
            "reason": str(reason),
            "action": str(action),
            "note": str(note),
            "content": dict(content),
        } if state in State.__members__ and refusal in Refusal.__members__ and cause in Cause.__members__:
            return CommandAnswer(accepted, state, refusal, cause, reason, action, note, content)
    raise _other_version(payload)


def parse_error(payload: bytes) -> BenchError:
    """Return the error in `payload`, or an error about its version."""
    match json_object(payload):
        case {
            "version": 1,
            "error": {
                "location": str(location),
                "found": str(found),
                "expected": str(expected),
                "action": str(action),
            },
        }:
            return BenchError(location, found, expected, action)
    return _other_version(payload)


def _other_version(payload: bytes) -> BenchError:
    return not_understood(shown(payload[:40].decode("utf-8", "replace")), f"JSON of version {VERSION}")


def not_understood(found: str, expected: str) -> BenchError:
    """Return the error for an answer of another golfbench."""
    action = "Use the same golfbench for bench and command line."
    return BenchError("answer of the bench", found, expected, action)
