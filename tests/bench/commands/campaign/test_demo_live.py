"""`golfbench demo` with a dedicated bench: its files, and that none of its processes keeps running."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from bench.base.errors import ExitCode
from bench.commands.campaign.demo import demo_configuration, demo_plan
from bench.config import load_configuration
from bench.records.shot.shot import ShotStatus
from bench.records.telemetry.record_file import read_swing
from tests.bench.records.shot.read_shots import read_shot_table

pytestmark = [
    pytest.mark.live,
    pytest.mark.paced,
    pytest.mark.timeout(400),  # the first start compiles
]


def start(out: Path, swings: int) -> subprocess.Popen[str]:
    """Start a demo as from a terminal: in a separate process group."""
    return subprocess.Popen(
        [sys.executable, "-m", "bench", "demo", "--swings", str(swings), "--output", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def wait_for(process: subprocess.Popen[str], out: Path, pattern: str) -> None:
    deadline = time.monotonic() + 300.0
    while not list(out.glob(pattern)):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.release
def test_demo_live_writes_all_outputs_and_ends_processes(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    with start(out, 2) as process:
        wait_for(process, out, "bench/campaigns/*/swings/000001.parquet")
        started = psutil.Process(process.pid).children(recursive=True)
        assert len(started) >= 4  # supervisor, loop, recorder, publisher
        output, errors = process.communicate(timeout=200)
    assert process.returncode == ExitCode.OK, errors
    assert not psutil.wait_procs(started, 5.0)[1]
    assert {"report.html", "demo.rrd", "shots.csv", "bench.log"} <= {path.name for path in out.iterdir()}
    shots = read_shot_table(out / "shots.csv")
    valid = [shot for shot in shots if shot.status is ShotStatus.VALID]
    assert {shot.ball for shot in valid} == {"tour", "range"}
    assert {(s.delivery_source, s.launch_source, s.carry_source) for s in valid} == {
        ("encoders+model", "simulated", "monitor")
    }
    files = sorted(out.glob("bench/campaigns/*/swings/*.parquet"))
    assert len(files) == len(shots)
    assert read_swing(files[0])[1]["shot"]["ball"] == shots[0].ball
    for word in ("Everything is simulated", "report.html", "demo.rrd", "shots.csv", "The robot delivered"):
        assert word in output
    assert "Every figure is simulated" in (out / "report.html").read_text()


def test_demo_live_ctrl_c_completes_swing_and_ends_processes(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    with start(out, 20) as process:
        wait_for(process, out, "bench/campaigns/*/swings/000001.parquet")
        started = psutil.Process(process.pid).children(recursive=True)
        os.killpg(process.pid, signal.SIGINT)
        output, errors = process.communicate(timeout=100)
    assert process.returncode == ExitCode.INTERRUPTED, errors
    assert "Traceback" not in errors
    assert not psutil.wait_procs(started, 5.0)[1]
    assert "brought to rest" in output
    assert 1 <= len(read_shot_table(out / "shots.csv")) <= 3
    assert not (out / "report.html").exists()
    phases = [line for line in (out / "bench.log").read_text().splitlines() if "phase " in line]
    assert "phase STANDING" in phases[-1]


def test_demo_configuration_live_uses_separate_simulated_bench(tmp_path: Path) -> None:
    shipped = load_configuration(Path("shipped"))
    configuration = demo_configuration(shipped, tmp_path, live=True)
    assert configuration.bench.id != shipped.bench.id
    assert configuration.network.endpoint != shipped.network.endpoint
    assert configuration.driver.name == "sim"
    plan = demo_plan(configuration, 10, 7)
    assert (plan.design.balls, plan.design.blocks, plan.design.seed) == (("tour", "range"), 5, 7)
    assert demo_plan(configuration, 3, 1).design.blocks == 2
