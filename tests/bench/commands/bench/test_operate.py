"""The verbs of a running bench on the command line: words, exit codes, the kept lease, the live status."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from io import StringIO
from pathlib import Path
from typing import Any, cast

import pytest
from rich.console import Console

from bench.base.address import free_port
from bench.base.errors import ExitCode
from bench.base.lifecycle import Cause, Refusal, Request, State
from bench.commands.bench.status_table import status_table
from bench.network.bench_service import BenchStatus, CauseStatus, CommandAnswer
from bench.network.client import REST
from bench.records.shot.recorded_shot import shot_to_json
from bench.records.shot.shot import Shot, ShotStatus
from bench.supervisor.status import NO_LAUNCH_MONITOR
from tests.bench.fake_bench_service import FakeDesk, RunningPlane, loopback_configuration, running_plane
from tests.conftest import Outcome, Run


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def golfbench(port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run) -> Run:
    """Run a command line for the bench at `port`, as a user with a separate login session."""
    configuration = tmp_path / "bench.toml"
    configuration.write_text(f'base = "shipped"\n[network]\nendpoint = "tcp/127.0.0.1:{port}"\n')
    monkeypatch.setenv("GOLFBENCH_CONFIG", str(configuration))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "run"))
    return run


@pytest.fixture
def leased(running: RunningPlane, golfbench: Run) -> Run:
    """Run a command line for the running bench, whose lease is taken."""
    assert golfbench("lease", "take").code == 0
    return golfbench


@pytest.fixture
def running(port: int, golfbench: Run) -> Iterator[RunningPlane]:
    with running_plane(FakeDesk(), loopback_configuration(port)) as running:
        yield running


def test_operate_commands_lease_to_release_print_each_state(running: RunningPlane, golfbench: Run) -> None:
    taken = golfbench("lease", "take", "--holder", "Ann", "--seconds", "60")
    assert taken.out.startswith("bench bench1: Ann holds it for 60 s; each command renews it")
    day = [
        ("reset", "SAFE"),
        ("access", "ACCESS"),
        ("access --end", "SAFE"),
        ("home", "READY"),
        ("arm", "ARMED"),
        ("tee", "ARMED"),
        ("swing --no-wait", "READY"),
        ("arm", "ARMED"),
        ("disarm", "READY"),
    ]
    for line, state in day:
        code, out, err = golfbench(*line.split())
        assert (code, err) == (0, "")
        assert out.startswith(f"bench bench1: {state}. ")
    assert running.service.requests[-3:] == [Request.SWING, Request.ARM, Request.DISARM]
    assert golfbench("lease", "release").out == "bench bench1: lease released\n"
    assert golfbench("lease", "show").out == "bench bench1: lease not held\n"
    assert running.plane.counts()["refused"] == 0


def test_arm_wait_returns_armed_and_at_rest(running: RunningPlane, leased: Run) -> None:
    leased("reset")
    ready = "bench bench1: READY. Vented and homed. Next: golfbench arm --wait\n"
    assert leased("home", "--wait").out == ready
    began = time.monotonic()
    armed = leased("arm", "--wait")
    assert armed.out.startswith("bench bench1: ARMED. Air on, the robot may move. Next: golfbench tee")
    assert time.monotonic() - began >= REST
    assert leased("swing").code == 0


def test_swing_command_prints_delivery_launch_and_carry(running: RunningPlane, leased: Run) -> None:
    running.service.state = State.ARMED
    swung = leased("swing")
    assert swung == Outcome(
        0,
        "swing 1: 43.05 m/s (96.3 mph) at the ball, attack +1.94°, strike +0.1 mm to the toe, -0.1 mm up\n"
        "ball: 64.15 m/s (143.5 mph), launch 12.4°, spin 2406 rpm, carry 208.0 m (227.5 yd) by model\n"
        "bench bench1: READY. Vented and homed. Next: golfbench arm --wait\n",
        "",
    )


def test_swing_command_without_record_is_refused_after_timeout(
    running: RunningPlane, leased: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    running.service.state, running.service.publish_shot = State.ARMED, lambda message: None
    code, _, err = leased("swing", "--timeout", "1")
    assert code == ExitCode.REFUSED
    assert "no record within 1 s" in err


def test_swing_command_stopped_swing_exits_with_1(running: RunningPlane, leased: Run) -> None:
    publish = running.service.publish_shot
    row = Shot(1, 1, 1, "driver", "default", ShotStatus.FAILED, "stopped by the operator")
    stopped = {"cause": "OPERATOR_STOP", "shot": shot_to_json(row)}
    running.service.state = State.ARMED
    running.service.publish_shot = lambda message: publish({**message, **stopped})  # type: ignore[typeddict-item]
    code, out, _ = leased("swing")
    assert code == ExitCode.REFUSED
    assert out.startswith("swing 1: no delivery\nstopped by the operator\n")


@pytest.mark.parametrize(
    ("state", "action"),
    [
        (State.ESTOP, "golfbench reset"),
        (State.FAULT, "golfbench reset"),
        (State.SAFE, "golfbench home --wait"),
        (State.READY, "golfbench arm --wait"),
        (State.ACCESS, "golfbench access --end"),
    ],
)
def test_swing_command_refused_names_action_of_state(
    running: RunningPlane, leased: Run, state: State, action: str
) -> None:
    running.service.state = state
    code, _, err = leased("swing")
    assert code == ExitCode.REFUSED
    assert f"Next: {action}." in err
    assert running.service.requests == []


def test_swing_command_disarmed_reports_cause(running: RunningPlane, leased: Run) -> None:
    running.service.state, running.service.cause = State.READY, Cause.LEASE
    _, _, err = leased("swing")
    assert "found:    READY: disarmed, as the lease lapsed or was released" in err
    assert "action:   Take it, then arm. Next: golfbench arm --wait." in err


def test_home_wait_ctrl_c_reports_robot_continues(
    running: RunningPlane, leased: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    running.service.state = State.SAFE

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("bench.network.client.BenchClient.wait_for", interrupt)
    code, _, err = leased("home", "--wait")
    assert code == ExitCode.INTERRUPTED
    assert "only the waiting ended, the robot continues" in err
    assert "golfbench stop" in err
    monkeypatch.undo()


def test_stop_command_moving_robot_prints_final_state(running: RunningPlane, golfbench: Run) -> None:
    """The stop is taken in the state before; the robot brakes first."""
    service = running.service
    service.state = State.HOMING

    def stop(request: Request) -> CommandAnswer:
        threading.Timer(0.3, setattr, (service, "state", State.FAULT)).start()
        return CommandAnswer(True, State.HOMING.name)

    service.stop = stop  # type: ignore[method-assign]
    code, out, _ = golfbench("stop")
    assert code == 0
    first, last = out.splitlines()
    assert first == "bench bench1: stopping"
    assert last.startswith("bench bench1: FAULT. ")
    assert last.endswith("Next: golfbench reset")


def test_arm_wait_not_at_rest_renews_lease_and_times_out(running: RunningPlane, golfbench: Run) -> None:
    golfbench("lease", "take", "--seconds", "5")
    running.service.state, running.service.armed_phase = State.READY, "RETURN"
    code, _, err = golfbench("arm", "--wait", "--timeout", "6")
    assert code == ExitCode.REFUSED
    assert "bench bench1 after 6 s" in err
    assert "found:    ARMED in phase RETURN" in err
    assert "expected: ARMED, at rest at the address" in err
    assert running.plane.lease() is not None, "5 s, taken over 6 s ago"
    assert golfbench("disarm").code == 0


def test_stop_command_past_no_return_reports_latched_stop(running: RunningPlane, golfbench: Run) -> None:
    service, status = running.service, running.service.status
    service.state = State.SWINGING
    service.status = lambda: status() | {"reaction": "COMPLETE"}  # type: ignore[method-assign]

    def stop(request: Request) -> CommandAnswer:
        threading.Timer(0.3, setattr, (service, "state", State.FAULT)).start()
        return CommandAnswer(True, State.SWINGING.name)

    service.stop = stop  # type: ignore[method-assign]
    first = golfbench("stop").out.splitlines()[0]
    assert first == "bench bench1: stopping: completes this swing, then brakes, vents and latches the stop"


def test_access_with_latched_cause_first_reports_unlocked_guard(
    running: RunningPlane, golfbench: Run
) -> None:
    status, latched = running.service.status, CauseStatus(name="RESTART", text="unclean", action="")
    running.service.status = lambda: status() | {"cause": latched}  # type: ignore[method-assign]
    golfbench("lease", "take")
    expected = "bench bench1: ACCESS. Vented, guard unlocked. Unclean. Next: golfbench access --end\n"
    assert golfbench("access").out == expected


def test_access_end_without_access_reports_expected_guard(running: RunningPlane, leased: Run) -> None:
    running.service.refuse = Refusal.STATE
    err = leased("access", "--end").err
    assert err.startswith("error: access --end of bench bench1\n")
    assert "expected: an access, or a guard opened in one\n" in err


@pytest.mark.parametrize("state", [State.SAFE, State.READY])
def test_disarm_at_rest_is_done_already(running: RunningPlane, golfbench: Run, state: State) -> None:
    running.service.state = state
    assert golfbench("disarm") == Outcome(0, f"bench bench1: {state.name}. Disarmed already.\n", "")
    running.service.state = State.ESTOP
    assert golfbench("disarm").code == ExitCode.REFUSED


@pytest.mark.parametrize("line", ["home", "access"])
def test_command_for_disarmed_robot_in_armed_suggests_disarm(
    running: RunningPlane, leased: Run, line: str
) -> None:
    running.service.state = State.ARMED
    assert leased(line).err.endswith("action:   Disarm first. Next: golfbench disarm.\n")


def test_operate_command_renews_lease(running: RunningPlane, leased: Run) -> None:
    before = running.plane.lease()
    leased("reset")
    after = running.plane.lease()
    assert before is not None
    assert after is not None
    assert after.expiry > before.expiry


def test_stop_and_estop_commands_without_lease_are_accepted(running: RunningPlane, golfbench: Run) -> None:
    told = "bench bench1: FAULT. The bench was switched on. Next: golfbench reset\n"
    assert golfbench("stop") == Outcome(0, told, "")
    code, out, _ = golfbench("estop")
    assert code == 0
    assert "convenience, not a safety function" in out
    assert [what for what, _ in running.service.stops] == ["stop", "estop"]


def test_arm_command_refused_exits_with_1_and_prints_state_and_reason(
    running: RunningPlane, leased: Run
) -> None:
    code, out, err = leased("arm")
    assert (code, out) == (ExitCode.REFUSED, "")
    assert err == (
        "error: arm of bench bench1\n"
        "  found:    refused in state ESTOP: not possible in this state\n"
        "  expected: state READY\n"
        "  action:   Clear the cause, then reset. Next: golfbench reset.\n"
    )


def test_operate_commands_without_lease_are_refused(running: RunningPlane, golfbench: Run) -> None:
    running.service.state = State.ARMED
    lines = ("home", "arm", "swing", "access", "access --end", "tee", "reset", "lease renew", "lease release")
    for line in lines:
        code, _, err = golfbench(*line.split())
        assert code == ExitCode.REFUSED
        assert "golfbench lease take" in err
    assert running.service.requests == []


def test_access_end_during_campaign_names_campaign_to_answer(
    running: RunningPlane, golfbench: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    golfbench("lease", "take", "--holder", "campaign c7")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "other"))
    code, _, err = golfbench("access", "--end")
    assert code == ExitCode.REFUSED
    assert "Answer the campaign's prompt: golfbench campaign answer c7." in err


@pytest.mark.parametrize("words", ["list", "check default", "--no-wait show", "-- --help"])
def test_swing_command_extra_argument_is_refused_without_request(
    running: RunningPlane, leased: Run, words: str
) -> None:
    running.service.state = State.ARMED
    code, _, err = leased("swing", *words.split())
    assert code == ExitCode.BAD_INPUT
    assert "golfbench profile" in err
    assert running.service.requests == []


def test_lease_take_second_user_is_refused_with_holder(
    running: RunningPlane, golfbench: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    golfbench("lease", "take", "--holder", "Ann")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "other"))
    code, _, err = golfbench("lease", "take", "--holder", "Bob")
    assert code == ExitCode.REFUSED
    assert re.search(r"Ann holds the bench for (29|30) s more", err)
    assert re.search(r"Ann holds it for (29|30) s more", golfbench("lease", "show").out)
    assert json.loads(golfbench("lease", "show", "--json").out)["holder"] == "Ann"


def test_lease_take_by_holder_renews_lease(running: RunningPlane, golfbench: Run) -> None:
    golfbench("lease", "take", "--holder", "Ann")
    first = running.plane.lease()
    again = golfbench("lease", "take", "--holder", "Ann", "--seconds", "90")
    assert again.out == "bench bench1: Ann holds it for 90 s more\n"
    second = running.plane.lease()
    assert first is not None
    assert second is not None
    assert second.key == first.key
    assert golfbench("reset").code == 0
    assert golfbench("lease", "renew").out == "bench bench1: held for 90 s more\n"


def test_lease_of_earlier_bench_run_is_invalid(port: int, golfbench: Run) -> None:
    with running_plane(FakeDesk(), loopback_configuration(port)):
        golfbench("lease", "take")
    with running_plane(FakeDesk(), loopback_configuration(port)):
        code, _, err = golfbench("reset")
        assert code == ExitCode.REFUSED
        assert "no valid lease" in err
        assert golfbench("lease", "take").code == 0
        assert golfbench("reset").code == 0


@pytest.mark.parametrize("seconds", ["4", "601", "x"])
def test_lease_take_invalid_seconds_is_refused(seconds: str, golfbench: Run) -> None:
    assert golfbench("lease", "take", "--seconds", seconds).code == ExitCode.BAD_INPUT


@pytest.mark.parametrize("line", ["status", "home", "stop", "estop", "swing", "lease take", "lease show"])
def test_operate_command_without_bench_exits_no_answer(line: str, golfbench: Run) -> None:
    code, _, err = golfbench(*line.split())
    assert code == ExitCode.NO_ANSWER
    assert "no answer: denied or not running" in err
    assert "a first start compiles for minutes" in err
    assert "golfbench run" in err


# Status ----------------------------------------------------------------------------------------------


def test_status_command_json_has_state_lease_and_joints(running: RunningPlane, golfbench: Run) -> None:
    golfbench("lease", "take", "--holder", "Ann")
    status = json.loads(golfbench("status", "--json").out)
    assert status["state"] == "ESTOP"
    assert status["lease"]["holder"] == "Ann"
    assert status["joints_deg"] == [32.71, 237.3, None]


def shown(age: float = 0.0, **changed: Any) -> str:
    console = Console(width=80, record=True, file=StringIO())
    console.print(status_table(cast(BenchStatus, FakeDesk().status() | changed), age))
    return console.export_text()


def test_status_table_shows_refused_launch_monitor_messages() -> None:
    link = {**NO_LAUNCH_MONITOR, "listening": "127.0.0.1:2921", "refused": 2, "refusal": "invalid JSON"}
    text = shown(launch_monitor=link)
    assert "not connected, listening at 127.0.0.1:2921" in text
    assert "refused 2, last: invalid JSON" in text


def test_status_table_shows_all_items_within_80_columns() -> None:
    text = shown()
    assert max(map(len, text.splitlines())) <= 80
    for part in (
        "bench bench1",
        "ESTOP",
        "STANDING",
        "POWER_UP: the bench was switched on",
        "not held",
        "not homed",
        "vented",
        "e-stop clear",
        "guard closed",
        "guard not locked",
        "shoulder 32.7°",
        "wrist –",
        "8.01 bar",
        "shoulder vane 1.01/1.01",
        "1000.0 Hz",
        "tick 123456",
        "skipped 3",
        "late 5",
        "p50 8 µs",
        "p99 41 µs",
        "tick p99 93 µs",
        "loop 4711",
        "recorder DEAD: killed by signal 9",
        "node 10 (valves and interlocks) has restarted",
        "frames 123456, missing 7",
        "prefer: memory lock none instead of all",
        "sim",
        "default",
        "driver, no ball on the tee",
        "POWER_UP, , 2026-11-21T12:00:00+00:00",
    ):
        assert part in text, part
    assert "SILENT" not in text
    assert "bus off" not in text  # none was counted


def test_status_table_old_status_shows_silent() -> None:
    assert "SILENT: last status 3.2 s ago" in shown(3.2)


@pytest.mark.live
@pytest.mark.paced
def test_status_watch_prints_state_changes_until_ctrl_c(running: RunningPlane, golfbench: Run) -> None:
    environment = os.environ | {"COLUMNS": "80", "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-m", "bench", "status", "--watch", "--json"]
    watch = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True)
    assert watch.stdout is not None
    try:
        assert json.loads(watch.stdout.readline())["state"] == "ESTOP"
        running.service.state = State.READY
        deadline = time.monotonic() + 20.0
        while not running.plane._state.matching_status.matching:  # type: ignore[attr-defined]
            assert time.monotonic() < deadline
            time.sleep(0.01)
        running.plane.publish_state(running.service.status())
        assert json.loads(watch.stdout.readline())["state"] == "READY"
        watch.send_signal(signal.SIGINT)
        assert watch.wait(20.0) == ExitCode.INTERRUPTED
    finally:
        watch.kill()
        watch.wait()
        watch.stdout.close()
