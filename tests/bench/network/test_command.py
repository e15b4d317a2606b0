"""Requests: every message is a valid command, or an error that states the expected form."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.base.errors import BenchError
from bench.base.lifecycle import NEEDS_LEASE, Cause, Refusal, Request, State
from bench.network.bench_service import CommandAnswer
from bench.network.command import (
    FORMS,
    MAX_COMMAND_BYTES,
    PLAIN,
    REQUESTS,
    ParsedCommand,
    Verb,
    encode_answer,
    encode_command,
    encode_error,
    parse_answer,
    parse_command,
    parse_error,
)
from bench.network.lease import new_key
from bench.swing.correction_terms import MAX_WEIGHTS

KEY = new_key()
KEYED = json.dumps({"version": 1, "key": KEY, "sequence": 1})


def refused(verb: str, payload: bytes | str) -> BenchError:
    with pytest.raises(BenchError) as caught:
        parse_command(verb, payload.encode() if isinstance(payload, str) else payload)
    return caught.value


@pytest.mark.parametrize("verb", sorted(PLAIN))
def test_parse_command_plain_verb_rejects_key(verb: Verb) -> None:
    assert parse_command(verb, b'{"version": 1}') == ParsedCommand(verb)
    assert "an unknown key" in refused(verb, KEYED).found


@pytest.mark.parametrize("verb", sorted(REQUESTS.keys() - PLAIN))
def test_parse_command_motion_verb_requires_key_and_sequence(verb: Verb) -> None:
    assert parse_command(verb, KEYED.encode()) == ParsedCommand(verb, KEY, 1)
    assert refused(verb, '{"version": 1}').found == "missing"


def test_requests_keyed_verbs_match_needs_lease() -> None:
    assert {REQUESTS[verb] for verb in REQUESTS.keys() - PLAIN} == NEEDS_LEASE
    assert set(REQUESTS.values()) | {Request.NONE, Request.STOP, Request.EMERGENCY_STOP} == set(Request)


def correct(**values: Any) -> bytes:
    return encode_command(
        Verb.CORRECT, **{"key": KEY, "sequence": 1, "profile": "0123456789abcdef", "weights": [0.5], **values}
    )


def test_parse_command_correct_returns_profile_and_weights() -> None:
    assert parse_command("correct", correct()) == ParsedCommand(
        "correct", KEY, 1, profile="0123456789abcdef", weights=(0.5,)
    )
    assert parse_command("correct", correct(weights=[])) == ParsedCommand(
        "correct", KEY, 1, profile="0123456789abcdef"
    )
    most = correct(weights=[-1.2345678901234567] * MAX_WEIGHTS)
    assert len(most) <= MAX_COMMAND_BYTES
    assert len(parse_command("correct", most).weights) == MAX_WEIGHTS


def test_parse_command_lease_accepts_take_renew_release() -> None:
    take = encode_command(Verb.LEASE, action="take", holder="Ann")
    assert parse_command("lease", take) == ParsedCommand("lease take", holder="Ann", seconds=30.0)
    take = encode_command(Verb.LEASE, action="take", holder="Ann", seconds=60)
    assert parse_command("lease", take) == ParsedCommand("lease take", holder="Ann", seconds=60)
    renew = encode_command(Verb.LEASE, action="renew", key=KEY, sequence=2, seconds=12.5)
    assert parse_command("lease", renew) == ParsedCommand("lease renew", KEY, 2, seconds=12.5)
    release = encode_command(Verb.LEASE, action="release", key=KEY, sequence=3)
    assert parse_command("lease", release) == ParsedCommand("lease release", KEY, 3)


def test_parse_command_unknown_verb_error_lists_known_verbs() -> None:
    for verb in ("fly", "", "STATUS", "status ", "*", "a/b", "status\n"):
        error = refused(verb, "{}")
        assert error.found == "an unknown verb"
        assert all(str(known) in error.expected for known in Verb)


@pytest.mark.parametrize(
    ("verb", "payload", "location", "found"),
    [
        ("status", b"", "command status", "no JSON"),
        ("status", b"\xff\xfe", "command status", "a byte at 0 that is no UTF-8"),
        ("status", b"\xef\xbb\xbf{}", "command status", "no JSON"),
        ("status", b'{"version": 1', "command status", "no JSON"),
        ("status", b'{"version": 1} x', "command status", "no JSON"),
        ("status", b"[]", "command status", "[]"),
        ("status", b"null", "command status", "null"),
        ("status", b"[" * 4000, "command status", "values nested too deep"),
        ("status", b'{"version": NaN}', "command status: version", "NaN"),
        ("status", b'{"version": 1e999}', "command status: version", "Infinity"),
        ("status", b'{"version": 1, "version": 1}', 'command status: "version"', "given twice"),
        ("status", b'{"a": {"b": 1, "b": 2}}', 'command status: "b"', "given twice"),
        ("status", b"{}", "command status: version", "missing"),
        ("status", b'{"version": 2}', "command status: version", "2"),
        ("status", b'{"version": true}', "command status: version", "true"),
        ("status", b'{"version": 1.0}', "command status: version", "1.0"),
        ("status", b'{"version": "1"}', "command status: version", '"1"'),
        ("status", b'{"version": 1, "Version": 1}', 'command status: "Version"', "an unknown key"),
        ("status", b" " * MAX_COMMAND_BYTES + b"{}", "command status", f"{MAX_COMMAND_BYTES + 2} bytes"),
        ("lease", b'{"version": 1}', "command lease: action", "missing"),
        ("lease", b'{"version": 1, "action": "steal"}', "command lease: action", '"steal"'),
        ("lease", b'{"version": 1, "action": ["take"]}', "command lease: action", '["take"]'),
        ("lease", b'{"version": 1, "action": "take"}', "command lease: holder", "missing"),
    ],
)
def test_parse_command_invalid_message_reports_location_and_value(
    verb: str, payload: bytes, location: str, found: str
) -> None:
    error = refused(verb, payload)
    assert error.location == location
    assert error.found.startswith(found)
    assert error.expected
    assert error.action


VALID: dict[Verb, dict[str, Any]] = {
    Verb.ARM: {"version": 1, "key": KEY, "sequence": 1},
    Verb.LEASE: {"version": 1, "action": "take", "holder": "Ann", "seconds": 30},
    Verb.CORRECT: json.loads(correct()),
}
INVALID: dict[tuple[Verb, str], list[Any]] = {
    (Verb.ARM, "sequence"): [0, -1, 1.0, "1", True, None, [1], 2**53],
    (Verb.LEASE, "seconds"): [4.9, 601, True, "30", None, -30, 1e308, int("9" * 400)],
    (Verb.LEASE, "holder"): ["", " Ann", "A\nB", "\x1b[31m", "\ud800", 1, None],
    (Verb.CORRECT, "profile"): [None, "", "0123456789ABCDEF", "0123456789abcde", 7],
    (Verb.CORRECT, "weights"): [
        *(None, 1.0, "1", [float("nan")], [float("-inf")], [1.6], [-1.6], ["1"], [True], [[1.0]]),
        [0.0] * (MAX_WEIGHTS + 1),
    ],
}


@pytest.mark.parametrize(
    ("verb", "key", "value"), [(*where, value) for where, values in INVALID.items() for value in values]
)
def test_parse_command_invalid_value_is_rejected(verb: Verb, key: str, value: Any) -> None:
    assert refused(verb, json.dumps({**VALID[verb], key: value})).location == f"command {verb}: {key}"


def test_parse_command_error_omits_key() -> None:
    almost = KEY[:-1] + "!"
    error = refused("arm", json.dumps({"version": 1, "key": almost, "sequence": 1}))
    assert error.location == "command arm: key"
    assert almost not in str(error)


# Anything at all -------------------------------------------------------------------------------------

JSON: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=9), inner, max_size=3),
    max_leaves=8,
)
NAMES = sorted({name for needed, allowed in FORMS.values() for name in (*needed, *allowed)})
VALUES = JSON | st.sampled_from([1, 2, 30, KEY, "Ann", "take", "renew", "release"])
OBJECTS = st.dictionaries(st.sampled_from(NAMES) | st.text(max_size=9), VALUES, max_size=6)
VERBS = st.sampled_from(sorted(Verb)) | st.text()


def parsed(verb: str, payload: bytes) -> ParsedCommand | BenchError:
    """Return the command or error; any other exception fails the test."""
    try:
        return parse_command(verb, payload)
    except BenchError as caught:
        error = caught
    again = parse_error(encode_error(error))
    assert (again.location, again.found, again.expected, again.action) == error.args
    assert len(encode_error(error)) < 2048
    return error


@given(VERBS, st.binary())
def test_parse_command_any_bytes_return_command_or_bench_error(verb: str, payload: bytes) -> None:
    parsed(verb, payload)


@given(VERBS, OBJECTS | JSON)
def test_parse_command_any_json_returns_command_or_bench_error(verb: str, message: Any) -> None:
    parsed(verb, json.dumps(message).encode())


@settings(max_examples=30)
@given(
    st.builds(
        CommandAnswer,
        st.booleans(),
        st.sampled_from([state.name for state in State]),
        st.sampled_from([refusal.name for refusal in Refusal]),
        st.sampled_from([cause.name for cause in Cause]),
        *[st.text()] * 3,
        st.dictionaries(st.text(), st.integers() | st.text()),
    )
)
def test_parse_answer_restores_encoded_answer(answer: CommandAnswer) -> None:
    assert parse_answer(encode_answer(answer)) == answer


@given(st.binary() | JSON.map(lambda value: json.dumps(value).encode()))
def test_parse_answer_invalid_payload_raises_error(payload: bytes) -> None:
    with pytest.raises(BenchError, match="answer of the bench"):
        parse_answer(payload)
    assert parse_error(payload).location == "answer of the bench"
