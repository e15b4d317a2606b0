"""Messages of the command plane: commands over the network and their answers.

A command is a JSON object at `golfbench/<bench>/command/<verb>`, of the keys that `FORMS` gives for its
verb and no others. `parse_command` is the edge: what it returns needs no further check. Answers are JSON
objects too (`encode_answer`, `parse_answer`); an invalid message gets an error (`encode_error`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from enum import StrEnum
from math import isfinite
from typing import Annotated, Any, NamedTuple, NoReturn, NotRequired, TypedDict

from bench.errors import BenchError
from bench.lifecycle import Cause, Refusal, Request, State
from bench.network.bench_service import ArmingBlock
from bench.network.lease import DEFAULT, LONGEST, LONGEST_HOLDER, SHORTEST, is_holder
from bench.swing.correction_bounds import GREATEST_WEIGHT, MOST_WEIGHTS

VERSION = 1
"""Version of every message."""

LONGEST_MESSAGE = 4096
"""Max size of a command, bytes."""

LAST_SEQUENCE = 2**53 - 1
"""The largest whole number that every JSON reader keeps exactly."""

CONVENIENCE = (
    "An emergency stop over the network is a convenience, not a safety function: "
    "in danger press the button beside the robot."
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


class Plain(NamedTuple):
    """Status, disarm, stop or emergency stop: needs no lease."""

    verb: Verb


class Keyed(NamedTuple):
    """A request that needs the lease."""

    verb: Verb
    key: str
    sequence: int


class Correct(NamedTuple):
    """Set or clear the learned correction of the coming swings; needs the lease."""

    key: str
    sequence: int
    profile: str
    """Digest of the profile that it was learned for."""
    weights: tuple[float, ...]


class TakeLease(NamedTuple):
    """Take the lease."""

    holder: str
    seconds: float = DEFAULT


class RenewLease(NamedTuple):
    """Renew the lease."""

    key: str
    sequence: int
    seconds: float = DEFAULT


class ReleaseLease(NamedTuple):
    """Release the lease."""

    key: str
    sequence: int


Command = Plain | Keyed | Correct | TakeLease | RenewLease | ReleaseLease

REQUESTS: Mapping[Verb, Request] = {
    Verb.HOME: Request.HOME,
    Verb.ARM: Request.ARM,
    Verb.DISARM: Request.DISARM,
    Verb.ACCESS: Request.ACCESS,
    Verb.SECURE: Request.SECURE,
    Verb.SWING: Request.SWING,
    Verb.TEE: Request.TEE,
    Verb.RESET: Request.RESET,
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
    """JSON Schema; what it does not say, `holds` does."""
    holds: Callable[[Any], bool] = lambda _: True
    secret: bool = False


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: Any) -> bool:
    return _is_whole(value) or isinstance(value, float)


_KINDS: Mapping[str, Callable[[Any], bool]] = {
    "integer": _is_whole,
    "number": _is_number,
    "string": lambda value: isinstance(value, str),
    "array": lambda value: isinstance(value, list),
}


def _fits(value: Any, schema: Mapping[str, Any]) -> bool:
    """Return whether `value` is what `schema` says, with the words of it that `_VALUES` uses."""
    if not _KINDS[schema["type"]](value):
        return False
    match schema["type"]:
        case "string":
            length = schema.get("minLength", 0) <= len(value) <= schema.get("maxLength", LONGEST_MESSAGE)
            return length and re.fullmatch(schema.get("pattern", "(?s:.*)"), value) is not None
        case "array":
            return len(value) <= schema["maxItems"] and all(_fits(item, schema["items"]) for item in value)
    return bool(schema["minimum"] <= value <= schema["maximum"])


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
        f"a name of 1 to {LONGEST_HOLDER} printable characters, no space at its ends",
        {"type": "string", "minLength": 1, "maxLength": LONGEST_HOLDER},
        is_holder,
    ),
    "profile": _Value(
        "the digest of a profile, 16 hexadecimal characters",
        {"type": "string", "pattern": "^[0-9a-f]{16}$", "maxLength": 16},
    ),
    "weights": _Value(
        f"at most {MOST_WEIGHTS} numbers from -{GREATEST_WEIGHT:g} to {GREATEST_WEIGHT:g}",
        {
            "type": "array",
            "maxItems": MOST_WEIGHTS,
            "items": {"type": "number", "minimum": -GREATEST_WEIGHT, "maximum": GREATEST_WEIGHT},
        },
    ),
    "seconds": _Value(
        f"{SHORTEST:g} to {LONGEST:g} s, a number",
        {"type": "number", "minimum": SHORTEST, "maximum": LONGEST},
    ),
}

_PLAIN_FORM = (("version",), ())
_KEYED_FORM = (("version", "key", "sequence"), ())
FORMS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    **{verb.value: _PLAIN_FORM for verb in Verb if verb in PLAIN},
    **{verb.value: _KEYED_FORM for verb in REQUESTS if verb not in PLAIN},
    "correct": (("version", "key", "sequence", "profile", "weights"), ()),
    "lease take": (("version", "action", "holder"), ("seconds",)),
    "lease renew": (("version", "action", "key", "sequence"), ("seconds",)),
    "lease release": (("version", "action", "key", "sequence"), ()),
}
"""Keys that a message must have and those it may have, by verb; for the lease by verb and action."""


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


def parse_command(verb: str, payload: bytes) -> Command:
    """Return the command that came as `payload` at `verb`.

    Raises:
        BenchError: there is no such verb, or the payload is not exactly what `FORMS` says.
    """
    if verb not in Verb.__members__.values():
        known = ", ".join(Verb)
        raise _fault(f"command {_shown(verb)}", "an unknown verb", f"one of {known}", "Correct the verb.")
    place = f"command {verb}"
    message = _read_object(place, payload)
    form = verb
    if verb == Verb.LEASE:
        action = message.get("action")
        if action not in ("take", "renew", "release"):
            found = "missing" if "action" not in message else _shown(action)
            raise _fault(f"{place}: action", found, '"take", "renew" or "release"', "Correct it.")
        form = f"{verb} {action}"
    _check_keys(place, message, *FORMS[form])
    values = {name: value for name, value in message.items() if name not in ("version", "action")}
    match form:
        case "lease take":
            return TakeLease(**values)
        case "lease renew":
            return RenewLease(**values)
        case "lease release":
            return ReleaseLease(**values)
        case "correct":
            return Correct(**{**values, "weights": tuple(map(float, values["weights"]))})
        case _ if verb in PLAIN:
            return Plain(Verb(verb))
        case _:
            return Keyed(Verb(verb), **values)


def encode_command(verb: Verb, **values: Any) -> bytes:
    """Return the message for `verb` with `values` as its keys beside the version."""
    return json.dumps({"version": VERSION, **values}).encode()


def _check_keys(
    place: str, message: dict[str, Any], needed: tuple[str, ...], allowed: tuple[str, ...]
) -> None:
    known = ", ".join((*needed, *(f"{name} (optional)" for name in allowed)))
    for name in message:
        if name not in needed and name not in allowed:
            raise _fault(f"{place}: {_shown(name)}", "an unknown key", known, "Remove or correct it.")
    for name in needed:
        if name not in message:
            raise _fault(f"{place}: {name}", "missing", known, "Add it.")
    for name, value in message.items():
        if name == "action":
            continue
        wanted = _VALUES[name]
        if not (_fits(value, wanted.schema) and wanted.holds(value)):
            found = "something else, not repeated here" if wanted.secret else _shown(value)
            raise _fault(f"{place}: {name}", found, wanted.expected, "Correct it.")


def _read_object(place: str, payload: bytes) -> dict[str, Any]:
    expected, cure = "a JSON object in UTF-8", "Send an object as `golfbench` does."
    if len(payload) > LONGEST_MESSAGE:
        raise too_long(place, len(payload))

    def no_number(text: str) -> NoReturn:
        raise _fault(place, f"the number {text[:20]}", "numbers that JSON has and a double holds", cure)

    def finite(text: str) -> float:
        number = float(text)
        return number if isfinite(number) else no_number(text)

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        read: dict[str, Any] = {}
        for name, value in pairs:
            if name in read:
                raise _fault(f"{place}: {_shown(name)}", "given twice", "each key once", "Remove one.")
            read[name] = value
        return read

    try:
        message = json.loads(
            payload.decode("utf-8"), object_pairs_hook=unique, parse_constant=no_number, parse_float=finite
        )
    except UnicodeDecodeError as error:
        raise _fault(place, f"a byte at {error.start} that is no UTF-8", expected, cure) from None
    except json.JSONDecodeError as error:
        raise _fault(place, f"no JSON: {error.msg} at character {error.pos}", expected, cure) from None
    except RecursionError:
        raise _fault(place, "values nested too deep", "one flat JSON object", cure) from None
    if not isinstance(message, dict):
        raise _fault(place, _shown(message), expected, cure)
    return message


def too_long(place: str, length: int) -> BenchError:
    """Return the error for a message of `length` bytes."""
    return _fault(place, f"{length} bytes", f"at most {LONGEST_MESSAGE} bytes", "Send less.")


def _fault(place: str, found: str, expected: str, cure: str) -> BenchError:
    return BenchError(place, found, expected, cure)


def _shown(value: Any) -> str:
    """Return `value` as JSON, in ASCII so that it disturbs no terminal, cut if long."""
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


# Answers ---------------------------------------------------------------------------------------------


class LeaseContent(TypedDict):
    """Content of the answer to who takes or renews the lease."""

    holder: str
    seconds_left: float
    key: NotRequired[str]
    """Of a lease that was taken now: every keyed command carries it."""


class ArmContent(TypedDict):
    """Content of the answer to a request to arm that configuration, calibrations or profile block."""

    arming_blocks: list[ArmingBlock]


class ErrorParts(TypedDict):
    """Parts of an error in a message."""

    place: str
    found: str
    expected: str
    cure: str


class CommandAnswer(NamedTuple):
    """The bench's answer to a valid command."""

    accepted: bool
    state: Annotated[str, State]
    """State after the answer."""
    refusal: Annotated[str, Refusal] = Refusal.NONE.name
    """Why it was refused."""
    cause: Annotated[str, Cause] = Cause.NONE.name
    """Why the robot was stopped or disarmed before."""
    reason: str = ""
    """Why it was refused, for people; empty when accepted."""
    cure: str = ""
    """What to do about the refusal, for people."""
    note: str = ""
    """Further information for the operator."""
    content: Mapping[str, Any] = {}
    """`status` of status; `holder`, `seconds_left` and, for who took it, `key` of lease; the reasons that
    block arming of `arm`."""


def encode_answer(answer: CommandAnswer) -> bytes:
    """Return `answer` as the message that `parse_answer` reads.

    Raises:
        ValueError: its content cannot be written as JSON.
    """
    return json.dumps({"version": VERSION, **answer._asdict()}, allow_nan=False).encode()


def encode_error(error: BenchError) -> bytes:
    """Return `error` as the message that `parse_error` reads."""
    parts = {name: getattr(error, name) for name in ErrorParts.__annotations__}
    return json.dumps({"version": VERSION, "error": parts}).encode()


def parse_answer(payload: bytes) -> CommandAnswer:
    """Return the answer in `payload`.

    Raises:
        BenchError: it is no answer of this version.
    """
    try:
        match json.loads(payload):
            case {
                "version": 1,
                "accepted": bool(accepted),
                "state": str(state),
                "refusal": str(refusal),
                "cause": str(cause),
                "reason": str(reason),
                "cure": str(cure),
                "note": str(note),
                "content": dict(content),
            } if state in State.__members__ and refusal in Refusal.__members__ and cause in Cause.__members__:
                return CommandAnswer(accepted, state, refusal, cause, reason, cure, note, content)
    except (ValueError, RecursionError):
        pass
    raise _other_version(payload)


def parse_error(payload: bytes) -> BenchError:
    """Return the error in `payload`, or an error about its version."""
    try:
        match json.loads(payload):
            case {"version": 1, "error": {**parts}}:
                match parts:
                    case {"place": str(a), "found": str(b), "expected": str(c), "cure": str(d)}:
                        return BenchError(a, b, c, d)
    except (ValueError, RecursionError):
        pass
    return _other_version(payload)


def _other_version(payload: bytes) -> BenchError:
    expected, cure = f"JSON of version {VERSION}", "Use the same golfbench for bench and command line."
    return BenchError("answer of the bench", _shown(payload[:40].decode("utf-8", "replace")), expected, cure)
