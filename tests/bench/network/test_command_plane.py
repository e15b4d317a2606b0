"""The command plane over real zenoh: everything is answered, stops overtake, memory and time are bounded."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import zenoh

from bench.base.errors import BenchError
from bench.base.lifecycle import Request, State
from bench.network.bench_service import CommandAnswer
from bench.network.command import (
    CONVENIENCE,
    MAX_COMMAND_BYTES,
    REQUESTS,
    Verb,
    encode_command,
    parse_answer,
    parse_error,
)
from bench.network.command_plane import MAX_REQUEST_WAIT, QUEUE, CommandPlane
from bench.network.lease import new_key
from bench.network.zenoh_session import close_session, open_client, open_daemon
from tests.bench.fake_bench_service import FakeDesk, RunningPlane, loopback_configuration, running_plane
from tests.waiting import wait_until


class FakeClock:
    """Shows the time it is set to."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


class Asker:
    """Sends the given messages, valid or not."""

    def __init__(self, session: zenoh.Session, root: str = "golfbench/bench1") -> None:
        self.session, self.root = session, root
        self.sequence = 0

    def send(
        self, verb: str, payload: bytes, **options: Any
    ) -> Callable[[], CommandAnswer | BenchError | None]:
        """Send without waiting; the function returned waits for the answer, None when there is none."""
        key = verb if verb.startswith("golfbench/") else f"{self.root}/command/{verb}"
        replies = self.session.get(key, payload=payload, timeout=5.0, **options)

        def wait() -> CommandAnswer | BenchError | None:
            for reply in replies:
                if reply.ok is not None:
                    return parse_answer(reply.ok.payload.to_bytes())
                assert reply.err is not None
                return parse_error(reply.err.payload.to_bytes())
            return None

        return wait

    def ask(self, verb: str, payload: bytes | None = None, **values: Any) -> CommandAnswer:
        answer = self.send(verb, encode_command(Verb(verb), **values) if payload is None else payload)()
        assert isinstance(answer, CommandAnswer), answer
        return answer

    def error(self, verb: str, payload: bytes) -> BenchError:
        answer = self.send(verb, payload)()
        assert isinstance(answer, BenchError), answer
        return answer

    def take(self, holder: str = "Ann", seconds: float = 30.0) -> str:
        answer = self.ask("lease", action="take", holder=holder, seconds=seconds)
        assert answer.accepted, answer
        self.sequence = 0
        return str(answer.content["key"])

    def ask_keyed(self, verb: str, key: str, **values: Any) -> CommandAnswer:
        self.sequence += 1
        return self.ask(verb, key=key, sequence=self.sequence, **values)


@pytest.fixture
def clock() -> FakeClock:
    return FakeClock()


@pytest.fixture
def bench(clock: FakeClock) -> Iterator[RunningPlane]:
    with running_plane(FakeDesk(), loopback_configuration(), clock) as running:
        yield running


@pytest.fixture
def asker(bench: RunningPlane) -> Iterator[Asker]:
    with open_client(bench.configuration.network, "bench1") as session:
        yield Asker(session)


@pytest.fixture
def another(bench: RunningPlane) -> Iterator[Asker]:
    with open_client(bench.configuration.network, "bench1") as session:
        yield Asker(session)


# What is asked and answered --------------------------------------------------------------------------


def test_correct_command_requires_lease_and_reaches_bench_service(bench: RunningPlane, asker: Asker) -> None:
    values: dict[str, Any] = {"profile": "0123456789abcdef", "weights": [0.5, -1.0]}
    assert not asker.ask("correct", key=new_key(), sequence=1, **values).accepted
    assert bench.service.corrections == []
    key = asker.take()
    assert asker.ask_keyed("correct", key, **values) == CommandAnswer(True, "ESTOP", cause="POWER_UP")
    assert bench.service.corrections == [("0123456789abcdef", (0.5, -1.0))]
    repeated = asker.ask("correct", key=key, sequence=asker.sequence, **values)
    assert (repeated.accepted, repeated.refusal) == (False, "SEQUENCE")
    assert repeated.reason.startswith("sequence 1 after 1")
    assert asker.ask("status").content["correction"] == 1


def test_command_plane_all_verbs_reach_bench_service(bench: RunningPlane, asker: Asker) -> None:
    key = asker.take()
    day = ["reset", "access", "secure", "home", "arm", "tee", "swing", "arm", "disarm"]
    states = ["SAFE", "ACCESS", "SAFE", "READY", "ARMED", "ARMED", "READY", "ARMED", "READY"]
    for verb, state in zip(day, states, strict=True):
        answer = asker.ask(verb) if verb == "disarm" else asker.ask_keyed(verb, key)
        assert answer._replace(cause="NONE") == CommandAnswer(True, state)
    assert bench.service.requests == [REQUESTS[Verb(verb)] for verb in day]
    assert asker.ask("stop")[:2] == (True, "FAULT")
    answer = asker.ask("estop")
    assert (*answer[:2], answer.note) == (True, "ESTOP", CONVENIENCE)
    assert "convenience, not a safety function" in CONVENIENCE
    assert [what for what, _ in bench.service.stops] == ["stop", "estop"]
    assert asker.ask_keyed("lease", key, action="release")[:2] == (True, "ESTOP")
    assert bench.plane.lease() is None


def test_status_command_reports_lease_and_counts_without_key(
    asker: Asker, another: Asker, clock: FakeClock
) -> None:
    key = asker.take("Ann", 40.0)
    another.error("fly", b"{}")
    assert not another.ask("lease", action="take", holder="Bob").accepted
    clock.now += 10.0
    answer = another.ask("status")
    status = answer.content
    assert answer.state == status["state"] == "ESTOP"
    assert status["lease"] == {"holder": "Ann", "seconds_left": 30.0, "lapsing": False}
    assert status["counts"] == {"commands": 1, "refused": 1, "malformed": 1, "dropped": 0}
    assert key not in json.dumps(answer)


@pytest.mark.parametrize(
    ("state", "action"),
    [
        (State.ESTOP, "Clear the cause, then reset."),
        (State.SAFE, "Home the robot."),
        (State.READY, "Arm to swing, or open the access to change club or ball."),
        (State.ACCESS, "Close the guard, then end the access."),
    ],
)
def test_swing_command_state_refusal_reports_reason_and_next_action(
    bench: RunningPlane, asker: Asker, state: State, action: str
) -> None:
    key = asker.take()
    bench.service.state = state
    answer = asker.ask_keyed("swing", key)
    cause = "POWER_UP" if state is State.ESTOP else "NONE"
    assert answer == CommandAnswer(False, state.name, "STATE", cause, "not possible in this state", action)


def test_lease_status_near_expiry_reports_lapsing(
    bench: RunningPlane, clock: FakeClock, asker: Asker
) -> None:
    asker.take("Ann", 30.0)
    for left, lapsing in ((30.0, False), (8.0, False), (7.0, True)):
        clock.now += bench.plane.lease_status()["seconds_left"] - left  # type: ignore[index]
        assert bench.plane.lease_status() == {"holder": "Ann", "seconds_left": left, "lapsing": lapsing}


def test_command_plane_service_error_answers_failed_and_continues(bench: RunningPlane, asker: Asker) -> None:
    key = asker.take()
    bench.service.error = OSError("the ring is gone")
    for answer in (asker.ask_keyed("reset", key), asker.ask("stop"), asker.ask("estop")):
        assert not answer.accepted
        assert answer.refusal == "FAILED"
        assert answer.reason == "the bench could not do it, OSError: the ring is gone"
    bench.service.error = None
    assert asker.ask_keyed("reset", key).accepted


# The lease -------------------------------------------------------------------------------------------


def test_lease_command_second_client_is_refused_until_release(
    bench: RunningPlane, asker: Asker, another: Asker
) -> None:
    key = asker.take("Ann")
    refusal = another.ask("lease", action="take", holder="Bob")
    assert refusal.refusal == "HELD"
    assert refusal.reason == "Ann holds the bench for 30 s more"
    assert refusal.action == "wait, or ask Ann to release it"
    assert another.ask_keyed("reset", new_key()) == refusal
    assert not another.ask_keyed("lease", new_key(), action="release").accepted
    assert bench.service.requests == []
    assert asker.ask_keyed("lease", key, action="release").accepted
    assert another.take("Bob")


def test_command_plane_motion_verb_without_lease_is_refused(bench: RunningPlane, asker: Asker) -> None:
    for verb in ("home", "arm", "access", "secure", "swing", "tee", "reset"):
        answer = asker.ask_keyed(verb, new_key())
        assert (answer.accepted, answer.refusal) == (False, "NO_LEASE")
    assert bench.service.requests == []


def test_lease_command_expires_unless_renewed(bench: RunningPlane, asker: Asker, clock: FakeClock) -> None:
    key = asker.take("Ann", 30.0)
    clock.now += 29.0
    renewed = asker.ask_keyed("lease", key, action="renew", seconds=20.0)
    assert renewed.content == {"holder": "Ann", "seconds_left": 20.0}
    clock.now += 19.0
    assert asker.ask_keyed("reset", key).accepted
    clock.now += 1.0
    assert bench.plane.lease() is None
    assert not asker.ask_keyed("home", key).accepted
    assert bench.service.requests == [Request.RESET]


# Invalid messages ------------------------------------------------------------------------------------


def test_command_plane_invalid_message_is_answered_with_error(asker: Asker) -> None:
    assert asker.error("fly", b"{}").expected.startswith("one of status, lease, home")
    assert asker.error("a/b", b"{}").found == "an unknown verb"
    assert asker.error("status", b"\xff").found == "a byte at 0 that is no UTF-8"
    assert asker.error("arm", b'{"version": 1}').location == "command arm: key"
    assert asker.error("status", b" " * (MAX_COMMAND_BYTES + 1)).found == "4097 bytes"
    assert asker.error("status", b" " * 500_000).found == "500000 bytes"
    assert asker.error("golfbench/**", b"{}").found == "an unknown verb"
    assert asker.ask("status").content["counts"]["malformed"] == 7


def test_command_plane_attachment_counts_for_message_size(asker: Asker) -> None:
    large = asker.send("status", encode_command(Verb.STATUS), attachment=b"x" * MAX_COMMAND_BYTES)()
    assert isinstance(large, BenchError)
    assert large.expected == f"at most {MAX_COMMAND_BYTES} bytes"


@pytest.mark.parametrize(
    "payload", [b"", b'{"version": 2}', b"x" * 100_000], ids=["empty", "version 2", "long"]
)
def test_stop_command_invalid_message_still_stops(payload: bytes, bench: RunningPlane, asker: Asker) -> None:
    for number, verb in enumerate(("stop", "estop"), 1):
        asker.error(verb, payload)
        wait_until(lambda: len(bench.service.stops) == number)  # noqa: B023
        assert bench.service.stops[-1][0] == verb


def test_estop_command_wildcard_bench_stops(bench: RunningPlane, asker: Asker) -> None:
    answer = asker.send("golfbench/*/command/estop", encode_command(Verb.ESTOP))()
    assert isinstance(answer, CommandAnswer)
    assert answer.state == "ESTOP"
    assert [what for what, _ in bench.service.stops] == ["estop"]


# Floods ----------------------------------------------------------------------------------------------


def test_stop_command_overtakes_request_flood(bench: RunningPlane, asker: Asker, another: Asker) -> None:
    bench.service.free.clear()
    key = asker.take()
    flood = [
        asker.send("reset", encode_command(Verb.RESET, key=key, sequence=number))
        for number in range(1, 3 * QUEUE)
    ]
    wait_until(lambda: len(bench.service.requests) == 1)
    began = time.monotonic()
    assert another.ask("stop").accepted
    assert another.ask("estop").accepted
    assert asker.ask("estop").accepted
    assert time.monotonic() - began < 2.0
    assert another.ask("status").accepted
    bench.service.free.set()
    answers = [wait() for wait in flood]
    busy = [a for a in answers if isinstance(a, CommandAnswer) and a.refusal == "BUSY"]
    assert len(busy) == len(flood) - QUEUE - 1
    assert len(bench.service.requests) == QUEUE + 1


def test_stop_command_flood_is_accepted_completely(bench: RunningPlane, asker: Asker, another: Asker) -> None:
    flood = [asker.send("stop", encode_command(Verb.STOP)) for _ in range(20 * QUEUE)]
    assert another.ask("estop").accepted
    answers = [wait() for wait in flood]
    assert all(isinstance(answer, CommandAnswer) and answer.accepted for answer in answers)
    assert {what for what, _ in bench.service.stops} == {"stop", "estop"}


def test_command_plane_expired_request_is_refused(
    bench: RunningPlane, asker: Asker, clock: FakeClock
) -> None:
    bench.service.free.clear()
    key = asker.take()
    first = asker.send("reset", encode_command(Verb.RESET, key=key, sequence=1))
    wait_until(lambda: len(bench.service.requests) == 1)
    second = asker.send("home", encode_command(Verb.HOME, key=key, sequence=2))
    asker.ask("status")  # comes after it on the same link
    clock.now += MAX_REQUEST_WAIT + 0.1
    bench.service.free.set()
    answer = first()
    assert isinstance(answer, CommandAnswer)
    assert answer.accepted
    late = second()
    assert isinstance(late, CommandAnswer)
    assert late.refusal == "TOO_LATE"
    assert (bench.service.requests, bench.service.late) == ([Request.RESET], [True])


def test_command_plane_expired_disarm_and_release_are_carried_out(
    bench: RunningPlane, asker: Asker, clock: FakeClock
) -> None:
    bench.service.free.clear()
    key = asker.take()
    waits = [asker.send("arm", encode_command(Verb.ARM, key=key, sequence=1))]
    wait_until(lambda: len(bench.service.requests) == 1)
    waits.append(asker.send("disarm", encode_command(Verb.DISARM)))
    waits.append(asker.send("lease", encode_command(Verb.LEASE, action="release", key=key, sequence=2)))
    asker.ask("status")  # comes after them on the same link
    clock.now += MAX_REQUEST_WAIT + 0.1
    bench.service.free.set()
    assert [getattr(wait(), "refusal", "") for wait in waits] == ["STATE", "STATE", "NONE"]
    assert (bench.service.requests, bench.service.late) == ([Request.ARM, Request.DISARM], [True, False])
    assert bench.plane.lease() is None


# The end ---------------------------------------------------------------------------------------------

STUCK = """
import sys, zenoh
from bench.config import NetworkSettings
from bench.network.zenoh_session import open_client
session = open_client(NetworkSettings(sys.argv[1]), "bench1")
print("flooding", flush=True)
while True:
    session.get("golfbench/bench1/command/status", id, payload=b'{"version": 1}', timeout=60.0)
"""


@pytest.mark.live
def test_command_plane_close_stuck_flooding_client_ends_in_time() -> None:
    configuration = loopback_configuration()
    with running_plane(FakeDesk(), configuration) as running:
        command = [sys.executable, "-c", STUCK, configuration.network.endpoint]
        client = subprocess.Popen(command, stdout=subprocess.PIPE)
        assert client.stdout is not None
        try:
            client.stdout.readline()
            wait_until(lambda: running.plane.counts()["commands"] > 100)
            client.send_signal(signal.SIGSTOP)
            with open_client(configuration.network, "bench1") as session:
                assert Asker(session).ask("stop").accepted
            began = time.monotonic()
            assert running.plane.close()
            close_session(running.session)
            assert time.monotonic() - began < 2.0
        finally:
            client.kill()
            client.wait()
            client.stdout.close()


@pytest.mark.live
def test_command_plane_close_hanging_service_ends_in_time() -> None:
    with running_plane(FakeDesk(), loopback_configuration()) as running:
        running.service.free.clear()
        with open_client(running.configuration.network, "bench1") as session:
            asker = Asker(session)
            key = asker.take()
            first = asker.send("reset", encode_command(Verb.RESET, key=key, sequence=1))
            second = asker.send("home", encode_command(Verb.HOME, key=key, sequence=2))
            wait_until(lambda: len(running.service.requests) == 1)
            asker.ask("status")
            began = time.monotonic()
            assert not running.plane.close()
            assert time.monotonic() - began < 2.0
            running.service.free.set()
            assert isinstance(first(), CommandAnswer)
            answer = second()
            assert isinstance(answer, CommandAnswer)
            assert answer.refusal == "SHUTTING_DOWN"
            assert running.service.requests == [Request.RESET]


def test_command_plane_close_leaves_no_declaration_or_thread() -> None:
    configuration = loopback_configuration()
    before = threading.active_count()
    with open_daemon(configuration.network) as session, open_client(configuration.network, "bench1") as other:
        CommandPlane(session, "bench1", FakeDesk()).close()
        assert Asker(other).send("status", b"{}")() is None
        CommandPlane(session, "bench1", FakeDesk()).close()
    assert threading.active_count() == before


# What is published -----------------------------------------------------------------------------------


def test_publish_state_sends_on_change_and_at_five_hertz(
    bench: RunningPlane, asker: Asker, clock: FakeClock
) -> None:
    heard: list[dict[str, Any]] = []
    subscriber = asker.session.declare_subscriber(
        "golfbench/bench1/state", lambda sample: heard.append(json.loads(sample.payload.to_bytes()))
    )
    wait_until(lambda: bench.plane._state.matching_status.matching)  # type: ignore[attr-defined]
    told = []
    for _ in range(100):
        told.append(bench.plane.publish_state(bench.service.status()))
        clock.now += 0.01
    assert sum(told) == 5
    bench.service.state = State.SAFE
    assert bench.plane.publish_state(bench.service.status())
    asker.take("Ann")
    assert bench.plane.publish_state(bench.service.status())
    wait_until(lambda: len(heard) == 7)
    assert [status["state"] for status in heard] == ["ESTOP"] * 5 + ["SAFE"] * 2
    assert [status["lease"] for status in heard[5:]] == [
        None,
        {"holder": "Ann", "seconds_left": 30.0, "lapsing": False},
    ]
    subscriber.undeclare()


def test_publish_event_carries_name_time_and_content(bench: RunningPlane, asker: Asker) -> None:
    heard: list[dict[str, Any]] = []
    subscriber = asker.session.declare_subscriber(
        "golfbench/bench1/event", lambda sample: heard.append(json.loads(sample.payload.to_bytes()))
    )
    wait_until(lambda: bench.plane._event.matching_status.matching)  # type: ignore[attr-defined]
    bench.plane.publish_event("process ended", process="recorder")
    wait_until(lambda: bool(heard))
    assert heard[0] == {"version": 1, "event": "process ended", "time": 1000.0, "process": "recorder"}
    subscriber.undeclare()
