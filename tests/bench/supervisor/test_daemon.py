"""The whole bench with the simulated robot in step with the loop, as its users run it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import psutil
import pytest

from bench.base.errors import ExitCode, Refused
from bench.base.lifecycle import Cause, Phase, Request, State
from bench.calibration.archive import add_calibration
from bench.calibration.calibration import BallPosition
from bench.config import database_url, load_configuration
from bench.network.client import CommandRefused
from bench.records.telemetry.record_file import read_swing
from bench.simulation.replay import replay_cycles
from bench.store.database import open_database
from bench.swing.correction import basis_of, digest_of
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from tests.running_bench import BenchProcess, running_bench, write_configuration

BALL = BallPosition(0.251, -1.559, 5e-4)

pytestmark = [
    pytest.mark.live,
    pytest.mark.paced,
    pytest.mark.timeout(400),  # the first start compiles
]


def wait_for_records(bench: BenchProcess, count: int) -> list[Path]:
    deadline = time.monotonic() + 20.0
    while len(bench.records) < count and time.monotonic() < deadline:
        time.sleep(0.1)
    return bench.records


def test_daemon_power_up_to_shutdown_stores_one_swing(tmp_path: Path) -> None:
    file = write_configuration(tmp_path, "whole")
    with running_bench(file) as bench:
        status = bench.client.status()
        assert (status["state"], bench.cause) == ("ESTOP", "POWER_UP")
        with pytest.raises(Refused, match="lease"):
            bench.client.reset()
        # A second daemon meets the first one's lock.
        second = subprocess.run(
            [sys.executable, "-m", "bench", "--config", str(file), "run"],
            capture_output=True,
            check=False,
            text=True,
            timeout=120,
        )
        assert second.returncode == 1
        assert str(bench.process.pid) in second.stderr
        with bench.client.lease("test"):
            assert bench.make_ready()["homed"]
            with pytest.raises(CommandRefused):
                bench.client.swing()  # not armed
            bench.take_address()
            bench.swing()
            bench.wait_phase(Phase.FOLLOW_THROUGH)
            assert bench.client.wait_for("READY")["swings"] == 1
        (record,) = wait_for_records(bench, 1)
        cycles, metadata = read_swing(record)
        assert metadata["complete"] is True
        assert cycles["plant_head_speed"].max() > 40.0
        replay = replay_cycles(*read_swing(record), record.name)
        assert all(not difference.ticks for difference in replay.differences())
        folder = bench.folder
        assert bench.end() == 0
        assert not folder.exists()
        assert bench.records == [record]


def test_daemon_sighup_in_swing_completes_swing_and_exits(tmp_path: Path) -> None:
    file = write_configuration(tmp_path, "hangup")
    with running_bench(file) as bench, bench.client.lease("test"):
        bench.make_ready()
        bench.take_address()
        bench.swing()
        bench.wait_phase(Phase.DOWNSWING)
        processes = psutil.Process(bench.process.pid).children(recursive=True)
        for process in (*processes, bench.process):
            process.send_signal(signal.SIGHUP)  # a terminal sends it to all
        assert bench.process.wait(60.0) == 0
        (record,) = bench.records
        cycles, metadata = read_swing(record)
        assert metadata["complete"] is True
        assert cycles["phase"][-1] == Phase.STANDING
    with running_bench(file) as bench:
        assert bench.cause == "POWER_UP"  # not after an unclean shutdown


def test_daemon_correction_applies_at_rest_and_is_refused_in_swing(tmp_path: Path) -> None:
    profile = load_profile(find_profile("default"))
    basis, digest = basis_of(profile), digest_of(profile)
    weights = (0.2 * np.random.default_rng(2).uniform(-1, 1, basis.size)).tolist()
    with running_bench(write_configuration(tmp_path, "corrected")) as bench, bench.client.lease("test"):
        with pytest.raises(CommandRefused, match="another profile"):
            bench.client.correct("0123456789abcdef", weights)
        with pytest.raises(CommandRefused, match="weights"):
            bench.client.correct(digest, weights[:-1])
        bench.make_ready()
        bench.take_address()
        bench.client.correct(digest, weights)
        assert bench.client.status()["correction"] == 1
        bench.swing()
        bench.wait_phase(Phase.BACKSWING)
        with pytest.raises(CommandRefused, match="a joint still moves"):
            bench.client.correct(digest, [])
        bench.wait_phase(Phase.FOLLOW_THROUGH)
        bench.client.wait_for("READY")
        bench.client.correct(digest, [])
        assert bench.client.status()["correction"] == 0
        (record,) = wait_for_records(bench, 1)
        cycles, metadata = read_swing(record)
        assert metadata["profile"]["correction"] == {"number": 1, "weights": weights}
        swung = cycles[cycles["phase"] == Phase.DOWNSWING]
        wanted = basis.correction(np.array(weights)).applied_to(profile)
        first = int(cycles["tick"][(cycles["request"] == Request.SWING) & (cycles["answer"] == 1)][0])
        sample = swung["tick"] - first
        moved = np.abs(wanted.angle[sample] - profile.angle[sample]).max()
        assert moved > 0.005
        assert np.abs(swung["reference_angle"] - wanted.angle[sample]).max() < moved / 10
        replay = replay_cycles(*read_swing(record), record.name)
        assert all(not difference.ticks for difference in replay.differences())


def test_learn_command_running_bench_stores_result_and_swings(tmp_path: Path) -> None:
    """Two swings are no lesson: the test checks only that they were made, seen and stored."""
    file = write_configuration(tmp_path, "learner")
    with running_bench(file) as bench:
        learn = ["learn", "default", "--swings", "1", "--json"]
        learned = subprocess.run(
            [sys.executable, "-m", "bench", "--config", str(file), *learn],
            capture_output=True,
            check=False,
            text=True,
            timeout=300,
        )
        assert learned.returncode in (ExitCode.OK, ExitCode.REFUSED), learned.stderr
        told = json.loads(learned.stdout)
        assert (told["version"], told["simulated"], told["source"]) == (1, True, "encoders+model")
        assert [swing["cause"] for swing in told["content"]["swings"]] == ["NONE", "NONE"]
        assert len(bench.records) == 2
        for swing, record in zip(told["content"]["swings"], bench.records, strict=True):
            fastest = read_swing(record)[0]["plant_head_speed"].max()
            assert swing["head_speed_mps"] == pytest.approx(fastest, rel=0.015)
        assert bench.client.status()["lease"] is None


def test_daemon_network_stop_needs_no_lease_and_lost_lease_disarms(tmp_path: Path) -> None:
    with running_bench(write_configuration(tmp_path, "stops")) as bench:
        with bench.client.lease("test"):
            bench.make_ready()
            bench.take_address()
        bench.client.wait_for("READY")  # given back: disarmed
        with bench.client.lease("test"):
            bench.take_address()
            bench.swing()
            bench.wait_phase(Phase.BACKSWING)
        bench.client.stop()
        stopped = bench.wait_until(lambda record: record["state"] == State.FAULT)
        assert stopped["cause"] == Cause.OPERATOR_STOP
        with bench.client.lease("test"):
            bench.make_ready()
            bench.take_address()
            bench.client.emergency_stop()
        stopped = bench.wait_until(lambda record: record["state"] == State.ESTOP)
        assert stopped["cause"] == Cause.NETWORK_STOP


@pytest.mark.parametrize(("name", "number"), [("recorder", signal.SIGKILL), ("publisher", signal.SIGSTOP)])
def test_daemon_support_lost_in_swing_completes_swing_and_blocks_arming(
    tmp_path: Path, name: str, number: signal.Signals
) -> None:
    with running_bench(write_configuration(tmp_path, name)) as bench, bench.client.lease("test"):
        bench.make_ready()
        bench.take_address()
        struck = psutil.Process(bench.pid(name))
        bench.swing()
        bench.wait_phase(Phase.BACKSWING)
        struck.send_signal(number)
        if number is signal.SIGKILL:  # seen at once, and mended within seconds
            bench.wait_until(lambda record: not record["support_ready"])
        bench.wait_phase(Phase.FOLLOW_THROUGH)
        bench.wait_until(lambda record: record["state"] == State.READY)
        if number is signal.SIGSTOP:
            bench.wait_until(lambda record: not record["support_ready"])
            with pytest.raises(CommandRefused, match="record"):
                bench.client.arm()
            struck.send_signal(signal.SIGCONT)
        bench.wait_until(lambda record: bool(record["support_ready"]))
        bench.take_address()  # it is back


@pytest.mark.parametrize("name", ["loop", "supervisor"])
def test_daemon_restart_after_kill_reports_estop_and_last_stop(tmp_path: Path, name: str) -> None:
    file = write_configuration(tmp_path, "killed")
    with running_bench(file) as bench:
        with bench.client.lease("test"):
            bench.make_ready()
            bench.take_address()
            bench.swing()
            bench.wait_phase(Phase.BACKSWING)
            time.sleep(0.1)  # where it was is on the disk by then
            children = [psutil.Process(bench.pid(child)) for child in ("loop", "recorder", "publisher")]
            os.kill(bench.pid(name), signal.SIGKILL)
            code = bench.process.wait(30.0)
        assert code == (-signal.SIGKILL if name == "supervisor" else ExitCode.DEVICE)
        _, alive = psutil.wait_procs(children, timeout=20.0)
        assert alive == []
    with running_bench(file) as bench:
        status = bench.client.status()
        assert (status["state"], bench.cause) == ("ESTOP", "RESTART")
        assert status["last_stop"] is not None
        assert "BACKSWING" in json.dumps(status["last_stop"])
        assert bench.end() == 0


def test_loop_frozen_supervisor_latches_fault(tmp_path: Path) -> None:
    with running_bench(write_configuration(tmp_path, "frozen")) as bench, bench.client.lease("test"):
        bench.make_ready()
        bench.take_address()
        bench.process.send_signal(signal.SIGSTOP)
        try:
            stopped = bench.wait_until(lambda record: record["state"] == State.FAULT)
        finally:
            bench.process.send_signal(signal.SIGCONT)
        assert stopped["cause"] == Cause.SUPERVISOR


def test_daemon_expired_calibration_blocks_arming(tmp_path: Path) -> None:
    file = write_configuration(tmp_path, "expired")
    bench_settings = load_configuration(file).bench
    then = datetime.now(UTC) - timedelta(days=2)
    with open_database(database_url(bench_settings.database, bench_settings.data_dir), then) as database:
        add_calibration(
            database,
            bench_settings.id,
            BALL,
            date=then,
            expires=then + timedelta(days=1),
            by="test",
            method="rule",
        )
    with running_bench(file) as bench, bench.client.lease("test"):
        bench.make_ready()
        with pytest.raises(CommandRefused, match="expired"):
            bench.client.arm()
        assert bench.client.status()["state"] == "READY"


def test_daemon_read_only_refuses_reset(tmp_path: Path) -> None:
    file = write_configuration(tmp_path, "read")
    with running_bench(file, "--read-only") as bench, bench.client.lease("test"):
        with pytest.raises(CommandRefused, match="observe only"):
            bench.client.reset()
        assert bench.client.status()["read_only"]
