"""A program at a running bench: the refusals it retries, and the actions it leaves to a person."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
import pytest

from bench.base.errors import Refused
from bench.base.lifecycle import REFUSAL_WORDS, Cause, Refusal, Request, State
from bench.network.bench_operator import BenchOperator
from bench.network.bench_service import BenchStatus, CommandAnswer
from bench.network.client import BenchClient, CommandRefused, HeldLease
from bench.network.command import Verb
from bench.records.telemetry.cycle_record import CYCLE
from tests.bench.fake_bench_service import FakeDesk


class RestingBench:
    """Rests at its address by its status; refuses a swing for each of `refusals`."""

    bench = "resting"

    def __init__(self, *refusals: Refusal) -> None:
        self.asked: list[str] = []
        self.refusals = list(refusals)
        self.state: dict[str, Any] = {**FakeDesk().status(), "time": 0.0, "tick": 0}
        self.state |= {"state": "ARMED", "phase": "HOLD"}

    def status(self) -> dict[str, Any]:
        self.state["time"] += 2.0
        self.state["tick"] += 2000
        return self.state

    @contextmanager
    def lease(self, holder: str, seconds: float) -> Iterator[None]:
        self.asked.append("lease")
        self.state["lease"] = {"holder": holder}
        yield
        self.asked.append("release")

    def swing(self, retry_timeout: float) -> None:
        self.asked.append("swing")
        if self.refusals:
            refusal = self.refusals.pop(0)
            answer = CommandAnswer(False, "ARMED", refusal.name, reason=REFUSAL_WORDS[refusal][0])
            raise CommandRefused(self.bench, Verb.SWING, answer)


def operator_of(
    bench: RestingBench, todo: list[str] | None = None, *, simulated: bool = True
) -> BenchOperator:
    said: list[str] = [] if todo is None else todo
    return BenchOperator(cast(BenchClient, bench), "me", simulated=simulated, ask_person=said.append)


def prepared(bench: RestingBench) -> Callable[[BenchStatus], bool]:
    def prepare(status: BenchStatus) -> bool:
        bench.asked.append("prepare")
        return True

    return prepare


def test_begin_swing_temporary_refusal_repeats_request() -> None:
    """Re-armed after a stopped swing it may still sway when its status says HOLD."""
    bench = RestingBench(Refusal.NOT_AT_ADDRESS, Refusal.STATE)
    tick = operator_of(bench).begin_swing(prepared(bench), ball=False)
    assert bench.asked == ["lease"] + ["prepare", "swing"] * 3
    assert tick == bench.state["tick"]


def test_begin_swing_refusal_beyond_timeout_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.network.bench_operator.READY", 0.2)
    bench = RestingBench(*[Refusal.NOT_AT_ADDRESS] * 1000)
    with pytest.raises(CommandRefused, match="does not rest"):
        operator_of(bench).begin_swing(prepared(bench), ball=False)


@pytest.mark.parametrize("refusal", [Refusal.READ_ONLY, Refusal.BLOCKED, Refusal.CORRECTION])
def test_begin_swing_permanent_refusal_is_raised_immediately(refusal: Refusal) -> None:
    bench = RestingBench(refusal)
    with pytest.raises(CommandRefused):
        operator_of(bench).begin_swing(prepared(bench), ball=False)
    assert bench.asked.count("swing") == 1


def test_rest_at_address_real_bench_releases_lease_for_person() -> None:
    bench = RestingBench()
    bench.state["driver"] = "canopen"
    ways = iter(["SAFE", "SAFE", "HOMING", "ARMED", "ARMED", "ARMED"])
    still, todo = bench.status, list[str]()

    def status() -> dict[str, Any]:
        bench.state["state"] = next(ways)
        return still()

    operator = operator_of(bench, todo, simulated=False)
    operator.take_lease()
    bench.status = status  # type: ignore[method-assign]
    assert operator.rest_at_address()["state"] == "ARMED"
    assert bench.asked == ["lease", "release", "lease"]
    assert len(todo) == 1
    assert "golfbench reset" in todo[0]


class StoppedClient(BenchClient):
    """Refuses the first request for a reason that passes; a person then stops the program."""

    def __init__(self, state: str, refusal: Refusal) -> None:
        self.bench, self.refusal, self.asked = "stopped", refusal, list[str]()
        self.told: Any = {**FakeDesk().status(), "state": state, "time": 0.0, "lease": {"holder": "me"}}

    @property
    def is_over(self) -> bool:
        return len(self.asked) > 0

    def status(self) -> BenchStatus:
        self.told["time"] += 2.0
        return cast(BenchStatus, self.told)

    @contextmanager
    def lease(self, holder: str, seconds: float = 5.0) -> Iterator[HeldLease]:
        yield HeldLease(holder, "key", seconds)

    def stop(self) -> CommandAnswer:
        self.asked.append("stop")
        return CommandAnswer(True, "FAULT")

    def _ask_keyed(self, verb: Verb, **values: Any) -> CommandAnswer:
        assert not self.is_over, f"{verb} after the stop"
        self.asked.append(verb)
        raise CommandRefused(
            self.bench, verb, CommandAnswer(False, self.told["state"], self.refusal.name, reason="moves")
        )


@pytest.mark.parametrize("by", ["abort", "interrupt"])
@pytest.mark.parametrize(
    ("state", "refusal", "verb"),
    [
        ("FAULT", Refusal.MOVING, "reset"),
        ("SAFE", Refusal.MOVING, "home"),
        ("READY", Refusal.NOT_VENTED, "arm"),
        ("ARMED", Refusal.MOVING, "tee"),
        ("ARMED", Refusal.AIR, "swing"),
    ],
)
def test_begin_swing_stop_by_person_ends_retries_of_request(
    by: str, state: str, refusal: Refusal, verb: str
) -> None:
    client = StoppedClient(state, refusal)
    client.told["phase"] = "HOLD"
    operator = BenchOperator(
        *(client, "me"),
        simulated=True,
        ask_person=print,
        aborted=lambda: client.is_over and by == "abort",
        interrupted=lambda: client.is_over and by == "interrupt",
    )
    with pytest.raises(Refused if by == "abort" else KeyboardInterrupt):
        operator.begin_swing(lambda status: True, ball=verb == "tee")
    assert client.asked == ([verb, "stop"] if by == "abort" else [verb])


class DisarmableBench(RestingBench):
    """Arms at once; holds its address after a swing with `series`, else vents."""

    def __init__(self, *, series: bool = True) -> None:
        super().__init__()
        self.state |= {"state": "READY", "phase": "STANDING", "series": series, "cause": None}

    def arm(self, retry_timeout: float) -> None:
        self.asked.append("arm")
        self.state |= {"state": "ARMED", "phase": "HOLD", "cause": None}

    def reset(self, retry_timeout: float) -> None:
        self.state["state"] = "READY"

    def vent(self, state: str = "READY", cause: str = "") -> None:
        found = {"name": cause, "text": ""} if cause else None
        self.state |= {"state": state, "phase": "STANDING", "cause": found}


@pytest.mark.parametrize("series", [True, False])
def test_rest_at_address_bench_disarmed_by_request_is_refused(series: bool) -> None:
    bench = DisarmableBench(series=series)
    operator = operator_of(bench)
    operator.rest_at_address()
    bench.vent()
    with pytest.raises(Refused, match=r"disarmed by request of another client"):
        operator.rest_at_address()
    assert bench.asked == ["lease", "arm"]


class SwingingBench(DisarmableBench):
    """Vents after each swing; publishes its record."""

    def swing(self, retry_timeout: float) -> None:
        super().swing(retry_timeout)
        self.vent()

    @contextmanager
    def shots(self) -> Iterator[Callable[[], dict[str, Any]]]:
        yield lambda: {"record": "swing.parquet", "outcome": None, "tick": self.state["tick"], "shot_id": ""}


@pytest.mark.parametrize("state", [State.RECOVERING, State.READY])
def test_rest_at_address_after_swing_disarmed_by_request_is_refused(
    monkeypatch: pytest.MonkeyPatch, state: State
) -> None:
    """Its end vents the robot in any case; a request in READY is one that was refused."""
    cycles = np.zeros(3, CYCLE)
    cycles["state"] = State.SWINGING, state, State.READY
    cycles["request"][1] = Request.DISARM
    monkeypatch.setattr("bench.network.bench_operator.read_swing", lambda path: (cycles, {}))
    bench = SwingingBench(series=False)
    with operator_of(bench) as operator:
        operator.swing(lambda status: True, ball=False)
        if state is State.RECOVERING:
            with pytest.raises(Refused, match=r"disarmed by request of another client"):
                operator.rest_at_address()
        else:
            operator.rest_at_address()
    assert bench.asked.count("arm") == (1 if state is State.RECOVERING else 2)


@pytest.mark.parametrize("cause", [Cause.ARMED_TIME, Cause.SUPPORT])
def test_rest_at_address_bench_disarmed_automatically_arms(cause: Cause) -> None:
    bench = DisarmableBench()
    operator = operator_of(bench)
    operator.rest_at_address()
    bench.vent(cause=cause.name)
    assert operator.rest_at_address()["state"] == "ARMED"


def test_rest_at_address_after_vented_swing_release_or_reset_arms() -> None:
    bench = DisarmableBench(series=False)
    operator = operator_of(bench)
    operator.rest_at_address()
    bench.vent()
    operator.wait_until_over()
    operator.rest_at_address()
    bench.vent()
    operator.release()
    operator.rest_at_address()
    bench.vent("FAULT", "GUARD")
    operator.rest_at_address()
    assert bench.asked.count("arm") == 4


@pytest.mark.parametrize(("driver", "simulated"), [("canopen", True), ("sim", False)])
def test_rest_at_address_robot_of_other_kind_is_refused(driver: str, simulated: bool) -> None:
    bench = DisarmableBench()
    bench.vent("FAULT", "GUARD")
    bench.state["driver"] = driver
    with pytest.raises(Refused) as refusal:
        operator_of(bench, simulated=simulated).rest_at_address()
    assert refusal.value.found == f"driver {driver}"
    assert refusal.value.expected.startswith("a simulated robot" if simulated else "a real robot")
    assert bench.asked == []
