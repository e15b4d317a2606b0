"""The bench from Python: verbs as methods, a lease that lives as long as its block, words when it says no."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from bench.base.errors import BenchError, ExitCode, Refused
from bench.base.lifecycle import Refusal, Request, State
from bench.config import BenchSettings
from bench.network.bench_service import BenchStatus
from bench.network.client import REST, BenchClient, CommandRefused
from bench.network.command import Verb, encode_command
from bench.network.zenoh_session import NoAnswer
from tests.bench.fake_bench_service import FakeDesk, RunningPlane, loopback_configuration, running_plane


@pytest.fixture
def running() -> Iterator[RunningPlane]:
    with running_plane(FakeDesk(), loopback_configuration()) as running:
        yield running


@pytest.fixture
def bench(running: RunningPlane) -> Iterator[BenchClient]:
    with BenchClient.connect(running.configuration) as bench:
        yield bench


class Supervisor:
    """Publishes the state as the daemon does, until the block's end."""

    def __init__(self, running: RunningPlane) -> None:
        self._running, self._ended = running, threading.Event()
        self._thread = threading.Thread(target=self._publish)

    def _publish(self) -> None:
        while not self._ended.wait(0.01):
            self._running.plane.publish_state(self._running.service.status())

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()


def test_bench_client_documented_session_completes_swing(running: RunningPlane, bench: BenchClient) -> None:
    with Supervisor(running), bench.lease("Ann"):
        bench.reset()
        bench.home()
        bench.wait_for("READY")
        bench.arm()
        bench.wait_until_armed()
        assert bench.swing().accepted
        assert bench.status()["swings"] == 1
    assert running.plane.lease() is None
    assert running.service.requests == [Request.RESET, Request.HOME, Request.ARM, Request.SWING]


def test_bench_client_has_method_for_each_verb(running: RunningPlane, bench: BenchClient) -> None:
    bench.take_lease("Ann")
    for ask in (bench.reset, bench.access, bench.secure, bench.home, bench.arm, bench.tee, bench.disarm):
        assert ask().accepted
    assert bench.stop().state == "FAULT"
    assert "no" in bench.emergency_stop().note
    assert len(running.service.requests) == 7


@pytest.mark.parametrize(
    ("verb", "state", "hindrance", "times"),
    [
        ("reset", State.ESTOP, "sways", 3),
        ("home", State.SAFE, "sways", 3),
        ("home", State.SAFE, "vents", 2),
        ("arm", State.READY, "sways", 3),
        ("arm", State.READY, "vents", 3),
        ("swing", State.ARMED, "fills", 3),
    ],
)
def test_bench_client_passing_refusal_retries_request(
    running: RunningPlane, bench: BenchClient, verb: str, state: State, hindrance: str, times: int
) -> None:
    bench.take_lease("Ann")
    running.service.state = state
    setattr(running.service, hindrance, times)
    assert getattr(bench, verb)().accepted
    assert len(running.service.requests) == times + 1


@pytest.mark.parametrize(
    ("verb", "state", "hindrance", "found", "action"),
    [
        ("swing", State.ARMED, "fills", "the chambers are not at their planned pressures yet", "Wait"),
        ("arm", State.READY, "vents", "the chambers are not verified empty yet", "Wait"),
        ("reset", State.ESTOP, "sways", "a joint still moves", "Wait until the robot rests"),
    ],
)
def test_bench_client_passing_refusal_timeout_reports_reason_and_action(
    running: RunningPlane,
    bench: BenchClient,
    verb: str,
    state: State,
    hindrance: str,
    found: str,
    action: str,
) -> None:
    bench.take_lease("Ann")
    running.service.state = state
    setattr(running.service, hindrance, 1000)
    with pytest.raises(CommandRefused) as caught:
        getattr(bench, verb)(retry_timeout=0.2)
    assert caught.value.found == f"refused in state {state.name}: {found}"
    assert caught.value.action == f"{action}, then retry."


def test_arm_recovering_robot_retries_request(running: RunningPlane, bench: BenchClient) -> None:
    bench.take_lease("Ann")
    running.service.state = State.RECOVERING
    with pytest.raises(CommandRefused) as caught:
        bench.arm(retry_timeout=0.2)
    assert len(running.service.requests) > 1
    assert caught.value.refusal is Refusal.STATE
    threading.Timer(0.3, setattr, (running.service, "state", State.READY)).start()
    assert bench.arm(retry_timeout=5.0).accepted


def test_swing_during_swing_is_refused_without_retry(running: RunningPlane, bench: BenchClient) -> None:
    bench.take_lease("Ann")
    running.service.state = State.SWINGING
    with pytest.raises(CommandRefused):
        bench.swing()
    assert running.service.requests == [Request.SWING]


def test_arm_refused_after_stop_is_not_retried(running: RunningPlane, bench: BenchClient) -> None:
    bench.take_lease("Ann")
    running.service.state = State.READY
    running.service.refuse = Refusal.STOPPED
    with pytest.raises(CommandRefused) as caught:
        bench.arm()
    assert caught.value.refusal is Refusal.STOPPED
    assert running.service.requests == [Request.ARM]


def test_command_refused_reports_state_reason_and_expected_state(bench: BenchClient) -> None:
    bench.take_lease("Ann")
    with pytest.raises(CommandRefused) as caught:
        bench.swing()
    error = caught.value
    assert error.exit_code == ExitCode.REFUSED
    assert error.location == "swing of bench bench1"
    assert error.found == "refused in state ESTOP: not possible in this state"
    assert error.expected == "state ARMED"
    assert error.answer.state == "ESTOP"


def test_bench_client_without_lease_sends_no_lease_command(running: RunningPlane, bench: BenchClient) -> None:
    for ask in (bench.arm, bench.release_lease, bench.renew_lease):
        with pytest.raises(Refused, match="golfbench lease take"):
            ask()
    assert running.plane.counts()["refused"] == 0


def test_lease_block_renews_and_releases_lease(running: RunningPlane, bench: BenchClient) -> None:
    with bench.lease("Ann", 5.0) as held:
        assert held.key not in repr(held)
        first = running.plane.lease()
        assert first is not None
        deadline = time.monotonic() + 10.0
        while (lease := running.plane.lease()) is not None and lease.expiry == first.expiry:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        assert lease is not None
        assert lease.key == held.key
    assert running.plane.lease() is None


def test_bench_client_concurrent_threads_keep_sequence_order(
    running: RunningPlane, bench: BenchClient
) -> None:
    bench.take_lease("Ann")
    refused: list[Exception] = []

    def renew() -> None:
        for _ in range(30):
            try:
                bench.renew_lease()
            except BenchError as error:
                refused.append(error)

    threads = [threading.Thread(target=renew) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert refused == []
    lease = running.plane.lease()
    assert lease is not None
    assert lease.sequence == 120


def test_wait_for_latched_fault_is_refused(running: RunningPlane, bench: BenchClient) -> None:
    running.service.state = State.READY
    with Supervisor(running):
        late = threading.Timer(0.2, running.service.stop, [Request.STOP])
        late.start()
        with pytest.raises(Refused, match="FAULT in phase STANDING: the bench was switched on"):
            bench.wait_for("ARMED", timeout=10.0)
        late.join()


def test_wait_for_timeout_is_refused(bench: BenchClient, running: RunningPlane) -> None:
    running.service.state = State.READY
    with pytest.raises(Refused, match=r"after 0\.2 s: found READY"):
        bench.wait_for("ARMED", timeout=0.2)


def test_wait_until_armed_returns_after_rest_at_address(running: RunningPlane, bench: BenchClient) -> None:
    running.service.state, running.service.armed_phase = State.ARMED, "RETURN"
    seen: list[str] = []

    def watch(status: BenchStatus) -> None:
        seen.append(status["phase"])
        if len(seen) == 3:
            running.service.armed_phase = "HOLD"

    with Supervisor(running):
        began = time.monotonic()
        assert bench.wait_until_armed(timeout=20.0, watch=watch)["phase"] == "HOLD"
    assert seen[:3] == ["RETURN"] * 3
    assert time.monotonic() - began >= REST


@pytest.mark.parametrize("state", [State.READY, State.FAULT, State.RECOVERING])
def test_wait_until_armed_disarmed_bench_is_refused(
    state: State, running: RunningPlane, bench: BenchClient
) -> None:
    running.service.state, running.service.armed_phase = State.ARMED, "RETURN"

    def watch(_: BenchStatus) -> None:
        running.service.state = state

    with Supervisor(running), pytest.raises(Refused, match=f"found {state.name} in phase") as caught:
        bench.wait_until_armed(timeout=20.0, watch=watch)
    assert caught.value.expected == "ARMED, at rest at the address"
    assert ("golfbench reset" in caught.value.action) == (state is State.FAULT)


def test_status_other_bench_id_raises_no_answer(running: RunningPlane) -> None:
    c = running.configuration
    other = replace(c, bench=BenchSettings(id="bench2", data_dir=c.bench.data_dir))
    with BenchClient.connect(other) as bench, pytest.raises(NoAnswer, match="bench2"):
        bench.status()


def test_reset_hanging_bench_raises_no_answer_at_timeout(running: RunningPlane) -> None:
    running.service.free.clear()
    with BenchClient.connect(running.configuration, timeout=0.3) as bench:
        bench.take_lease("Ann")
        with pytest.raises(NoAnswer, match=r"waited 0\.\d s"):
            bench.reset()
        assert bench.stop().accepted


def test_bench_client_reconnects_after_restart_with_void_lease() -> None:
    configuration = loopback_configuration()
    with running_plane(FakeDesk(), configuration):
        bench = BenchClient.connect(configuration, timeout=0.5)
        bench.take_lease("Ann")
    with bench:
        with pytest.raises(NoAnswer):
            bench.status()
        with running_plane(FakeDesk(), configuration):
            deadline = time.monotonic() + 10.0
            while not _answers(bench):
                assert time.monotonic() < deadline
                time.sleep(0.05)
            with pytest.raises(CommandRefused, match="no valid lease"):
                bench.reset()


def _answers(bench: BenchClient) -> bool:
    try:
        bench.status()
    except NoAnswer:
        return False
    return True


def test_send_invalid_message_raises_bench_error(bench: BenchClient) -> None:
    with pytest.raises(BenchError, match="an unknown verb") as caught:
        bench.send("fly", encode_command(Verb.STATUS))
    assert caught.value.exit_code == ExitCode.BAD_INPUT


@pytest.mark.parametrize("change", [{"version": 2}, {"state": None}], ids=["version", "without state"])
def test_status_incompatible_version_raises_error(
    change: dict[str, Any], running: RunningPlane, bench: BenchClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    status: dict[str, Any] = {**running.service.status(), **change}
    content = {name: value for name, value in status.items() if value is not None}
    answer = json.dumps(
        {
            **{"version": 1, "accepted": True, "state": "ESTOP", "refusal": "NONE", "cause": "NONE"},
            **{"reason": "", "action": "", "note": "", "content": content},
        }
    )
    monkeypatch.setattr(bench, "send", lambda *_: answer.encode())
    with pytest.raises(BenchError, match="Use the same golfbench"):
        bench.status()
