"""The page, the schemas and real messages of the wire contract agree."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from bench.base.errors import BenchError
from bench.campaign.plan.plan_file import load_plan
from bench.campaign.plan.shot_sequence import all_trials
from bench.campaign.run.progress import CampaignProgress
from bench.campaign.run.runner_control import new_entry
from bench.config import load_configuration
from bench.network.client import BenchClient
from bench.network.command import FORMS, Verb, encode_command, encode_error, form_schema, parse_command
from bench.network.lease import new_key
from bench.network.messages import LOOP_VERSION, CampaignMessage, wire_contract
from bench.network.zenoh_session import open_client
from bench.records.shot.shot import Shot, ShotStatus
from bench.records.shot.shot_matcher import SettledOutcome
from bench.records.shot.shot_message import ShotPublication, read_shot_message, shot_publication
from bench.records.telemetry.batches import encode_batch, wire_schema
from bench.records.telemetry.cycle_record import CYCLE, arrow_schema
from bench.store.rows import CampaignState
from bench.supervisor._tick_timing import new_timing
from bench.supervisor._timing_record import summary
from bench.supervisor.launch_monitor import message_of
from drivers.launch_monitor.record import ClubFigures, LaunchRecord, MatchOutcome
from tests.bench.fake_bench_service import FakeDesk, RunningPlane, loopback_configuration, running_plane

NOW = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)
CONTRACT = wire_contract("bench1")
PUBLISHED = {row["key"].removeprefix("golfbench/bench1/"): row for row in CONTRACT["published"]}
FORM = {form["name"]: form for form in CONTRACT["commands"]["forms"]}


def problems(schema: dict[str, Any], message: Any) -> list[str]:
    """Return what `schema` objects to in `message`; a `message` of bytes is JSON."""
    content = json.loads(message) if isinstance(message, bytes) else json.loads(json.dumps(message))
    return [
        f"{error.json_path}: {error.message}" for error in Draft202012Validator(schema).iter_errors(content)
    ]


def unknown_keys(schema: Any, message: Any) -> Any:
    """Return the keys of `message` that the contract does not mention."""
    return message.keys() - schema["properties"].keys()


@pytest.fixture
def bench() -> Iterator[RunningPlane]:
    with running_plane(FakeDesk(), loopback_configuration()) as running:
        yield running


@pytest.fixture
def session(bench: RunningPlane) -> Iterator[zenoh.Session]:
    with open_client(bench.configuration.network, "bench1") as session:
        yield session


def test_wire_contract_schemas_are_valid_json_schemas() -> None:
    schemas = [row["schema"] for row in CONTRACT["published"] if "schema" in row]
    schemas += [form[part] for form in CONTRACT["commands"]["forms"] for part in ("request", "answer")]
    assert len(schemas) == 5 + 2 * len(FORMS)
    for schema in (*schemas, CONTRACT["commands"]["error"]):
        Draft202012Validator.check_schema(schema)


def test_bench_serves_wire_contract(bench: RunningPlane, session: zenoh.Session) -> None:
    (reply,) = session.get("golfbench/bench1/schema", timeout=5.0)
    assert reply.ok is not None
    assert json.loads(reply.ok.payload.to_bytes()) == json.loads(json.dumps(CONTRACT))


def test_wire_contract_columns_match_wire_schema() -> None:
    described = CONTRACT["telemetry"]["columns"]
    assert [(c["name"], c["type"]) for c in described] == [(f.name, str(f.type)) for f in wire_schema()]
    assert [c["unit"] for c in described] == [f.metadata[b"unit"].decode() for f in arrow_schema()]
    assert CONTRACT["telemetry"]["version"] == {
        key.decode(): value.decode() for key, value in wire_schema().metadata.items()
    }
    named = {c["name"] for c in described if "enumeration" in c}
    assert named == {"state", "request", "refusal", "phase", "reaction", "cause", "latest_cause"}
    assert {c["enumeration"] for c in described if "enumeration" in c} <= CONTRACT["enumerations"].keys()


def test_wire_contract_status_and_lease_answers_match_schema(bench: RunningPlane) -> None:
    with BenchClient.connect(bench.configuration) as client:
        for form in ("status", "stop", "estop", "disarm"):
            answer = client.send(Verb(form), encode_command(Verb(form)))
            assert problems(FORM[form]["answer"], answer) == []
        content = json.loads(client.send(Verb.STATUS, encode_command(Verb.STATUS)))["content"]
        assert unknown_keys(PUBLISHED["state"]["schema"], content) == set()
        take = client.send(Verb.LEASE, encode_command(Verb.LEASE, action="take", holder="Ann"))
        assert problems(FORM["lease take"]["answer"], take) == []
        lease: dict[str, Any] = {"key": json.loads(take)["content"]["key"], "sequence": 1}
        renew = client.send(Verb.LEASE, encode_command(Verb.LEASE, action="renew", **lease))
        assert problems(FORM["lease renew"]["answer"], renew) == []
        refused = client.send(Verb.ARM, encode_command(Verb.ARM, **lease))  # the sequence does not rise
        assert problems(FORM["arm"]["answer"], refused) == []
        assert json.loads(refused)["accepted"] is False


def test_wire_contract_error_matches_schema() -> None:
    error = encode_error(BenchError("a", "b", "c", "d"))
    assert problems(CONTRACT["commands"]["error"], error) == []


def test_wire_contract_published_states_and_events_match_schema(
    bench: RunningPlane, session: zenoh.Session
) -> None:
    channel: zenoh.handlers.FifoChannel[zenoh.Sample] = zenoh.handlers.FifoChannel(1000)
    subscriber = session.declare_subscriber("golfbench/bench1/*", channel)
    names = {"state": "ESTOP", "phase": "STANDING", "reaction": "NONE", "cause": "POWER_UP"}
    seen: set[str] = set()
    deadline = time.monotonic() + 30.0
    while len(seen) < 4 and time.monotonic() < deadline:
        # Again and again: the bench does not know at once of who listens.
        bench.plane.publish_state(bench.service.status())
        bench.plane.publish_event("loop died", text="the loop froze")
        bench.plane.publish_event("change", **names, tick=7, loop_time=0.007)
        bench.plane.publish_shot(shot_publication(record="/a"))
        while (sample := subscriber.try_recv()) is not None:
            name, content = str(sample.key_expr).rpartition("/")[2], sample.payload.to_bytes()
            assert problems(PUBLISHED[name]["schema"], content) == [], name
            seen.add(json.loads(content).get("event", name))
        time.sleep(0.05)
    assert seen == {"state", "loop died", "change", "shot"}


LAUNCH = LaunchRecord(
    12.5, "m", 7, 60.0, 0.2, -0.01, 300.0, 0.02, None, ClubFigures(42.0), (("carry", "no"),), ("fast",)
)
SHOT = Shot(1, 1, 1, "driver", "a", ShotStatus.VALID, club_speed_mps=42.0, time_utc=NOW)


@pytest.mark.parametrize(
    "message",
    [
        shot_publication(),
        shot_publication(
            shot_id="r-1", record="/a", number=3, lost_records=0, complete=True, replayable=True, cause="NONE"
        ),
        message_of(SettledOutcome(MatchOutcome.MATCHED, "r-1", LAUNCH, "", SHOT)),
        message_of(
            SettledOutcome(MatchOutcome.NO_LAUNCH, "r-1", None, "the launch monitor saw no ball", SHOT)
        ),
        message_of(SettledOutcome(MatchOutcome.NO_SWING, "", LAUNCH, "late", None)),
    ],
)
def test_wire_contract_shot_messages_have_all_keys(message: ShotPublication) -> None:
    schema = PUBLISHED["shot"]["schema"]
    assert problems(schema, message) == []
    assert list(message) == list(schema["properties"]) == schema["required"]
    for part in ("shot", "launch"):
        if (content := message[part]) is not None:
            (described,) = [one for one in schema["properties"][part]["anyOf"] if "properties" in one]
            assert content.keys() == described["properties"].keys()
    read_shot_message(json.dumps(message).encode())


def test_shot_publication_unknown_key_raises_error() -> None:
    with pytest.raises(KeyError, match="colour"):
        shot_publication(colour="red")


def test_wire_contract_loop_statistics_match_schema() -> None:
    figures = summary(new_timing(1_000_000))
    message = {"version": LOOP_VERSION, "time": 1.0, "seconds": 1.0, "batches": 1, "lost": 0, **figures}
    schema = PUBLISHED["loop"]["schema"]
    assert problems(schema, message) == []
    assert message.keys() == schema["properties"].keys()
    segment = schema["properties"]["segments"]["additionalProperties"]
    assert figures["segments"]["tick"].keys() == segment["properties"].keys()


def test_wire_contract_campaign_message_matches_schema() -> None:
    configuration = load_configuration(Path("shipped"))
    plan = load_plan(Path("clubs"), configuration)
    facts = {"driver": "canopen"}
    progress = CampaignProgress(new_entry(plan, configuration, NOW, simulated=False, real_time=facts), plan)
    schema = PUBLISHED["campaign/ID"]["schema"]
    assert problems(schema, progress.message) == []
    trial = all_trials(plan)[0]
    progress.shot(
        Shot(1, trial.block, trial.position, trial.arm.club, trial.arm.ball, ShotStatus.VALID, time_utc=NOW)
    )
    progress.say("a club was changed")
    progress.standing(CampaignState.WAITING, "mount club b")
    assert problems(schema, progress.message) == []
    assert progress.message.keys() == schema["properties"].keys() == CampaignMessage.__annotations__.keys()
    published = [state for state in CampaignState if state is not CampaignState.INTERRUPTED]
    assert schema["properties"]["state"]["enum"] == published


def test_wire_contract_telemetry_batch_metadata_matches() -> None:
    import pyarrow as pa

    message = encode_batch(np.zeros(2, CYCLE), 1, 0, 1.5)
    with pa.ipc.open_stream(message) as stream:
        _, facts = stream.read_next_batch_with_custom_metadata()
    assert {key.decode() for key in facts} == CONTRACT["telemetry"]["batch_metadata"].keys()


VALUES: dict[str, list[Any]] = {
    "version": [1, 2, True, "1", None],
    "key": [new_key(), "short", new_key() + "\n", 5],
    "sequence": [1, 2**53 - 1, 0, 2**53, "1", True],
    "holder": ["Ann", "A" * 64, "A" * 65, "", 3],
    "seconds": [5, 600.0, 4.9, 601, "30"],
    "profile": ["0123456789abcdef", "0123456789ABCDEF", 16],
    "weights": [[], [0.5, -1.5], [1.6], [True], "0.5", [0.0] * 128, [0.0] * 129],
}


@given(st.sampled_from(list(FORMS)), st.data())
def test_parse_command_accepts_same_messages_as_form_schema(form: str, data: st.DataObject) -> None:
    verb, _, action = form.partition(" ")
    needed, allowed = FORMS[form]
    names = [name for name in (*needed, *allowed) if name != "action"]
    message = {name: data.draw(st.sampled_from(VALUES[name])) for name in names}
    message |= {"action": action} if action else {}
    if data.draw(st.integers(0, 9)) == 0:
        message.pop(data.draw(st.sampled_from(names)))
    if data.draw(st.integers(0, 9)) == 0:
        message["colour"] = "red"
    try:
        parse_command(verb, json.dumps(message).encode())
        taken = True
    except BenchError:
        taken = False
    assert taken == (problems(form_schema(form), message) == [])
