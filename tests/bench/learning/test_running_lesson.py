"""A running bench learns by a launch monitor and by the marks on the face, as its users ask for it."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.base.address import free_port
from bench.base.errors import ExitCode
from bench.config import load_configuration
from bench.learning.delivery import strike_from_mark
from bench.network.client import BenchClient
from bench.records.shot.shot_message import ShotPublication, launch_from_json
from bench.records.telemetry.record_file import read_swing
from tests.running_bench import BenchProcess, running_bench, simulated_monitor, write_configuration

pytestmark = [
    pytest.mark.live,
    pytest.mark.paced,
    pytest.mark.timeout(400),  # the first start compiles
]


def learned_swings(file: Path, source: str, marks: str = "") -> tuple[list[dict[str, Any]], str]:
    """Learn with one swing more than the first; return its swings and its output."""
    arguments = ["learn", "default", "--source", source, "--swings", "1", "--json"]
    ended = subprocess.run(
        [sys.executable, "-m", "bench", "--config", str(file), *arguments],
        input=marks,
        capture_output=True,
        check=False,
        text=True,
        timeout=300,
    )
    assert ended.returncode in (ExitCode.OK, ExitCode.REFUSED), ended.stderr
    told = json.loads(ended.stdout)
    assert told["source"] == source
    swings: list[dict[str, Any]] = told["content"]["swings"]
    assert [swing["cause"] for swing in swings] == ["NONE", "NONE"]
    return swings, ended.stderr


def hear_shots(bench: BenchProcess, ended: threading.Event, into: list[ShotPublication]) -> None:
    """Collect the published shots."""
    with BenchClient.connect(bench.configuration) as client, client.shots() as following:
        while not ended.is_set():
            message = following()
            if message is None:
                time.sleep(0.02)
            else:
                into.append(message)


@pytest.mark.release
def test_learn_command_missing_launch_monitor_data_uses_encoders(tmp_path: Path) -> None:
    more = f"[launch_monitor]\nenabled = true\nport = {free_port()}\n[launch_monitor.window]\nlatest = 8.0\n"
    file = write_configuration(tmp_path, "monitored-lesson", more)
    heard: list[ShotPublication] = []
    ended = threading.Event()
    with running_bench(file) as bench, simulated_monitor(file, "--club", "--drop", "2"):
        deadline = time.monotonic() + 60.0
        while not ((link := bench.client.status()["launch_monitor"]) and link["present"]):
            assert time.monotonic() < deadline
            time.sleep(0.1)
        ear = threading.Thread(target=hear_shots, args=(bench, ended, heard))
        ear.start()
        try:
            swings, said = learned_swings(file, "launch-monitor")
        finally:
            ended.set()
            ear.join()
        fastest = read_swing(bench.records[-1])[0]["plant_head_speed"].max()
    (launch,) = [launch_from_json(told) for message in heard if (told := message["launch"]) is not None]
    assert launch.club.speed is not None
    assert launch.club.attack_angle is not None
    assert swings[0]["head_speed_mps"] == launch.club.speed
    assert swings[0]["attack_angle_deg"] == pytest.approx(np.degrees(launch.club.attack_angle))
    assert swings[1]["head_speed_mps"] == pytest.approx(fastest, rel=0.015)
    assert said.count("no launch monitor data for this swing") == 1


@pytest.mark.release
def test_learn_command_invalid_impact_mark_prompts_again(tmp_path: Path) -> None:
    file = write_configuration(tmp_path, "marked-lesson")
    with running_bench(file):
        swings, said = learned_swings(file, "impact-marks", "400 2\nhigh on the toe\n3,-1.5\n\n")
    plant = load_configuration(file).plant
    assert swings[0]["strike_mm"] == pytest.approx(1e3 * strike_from_mark(3.0, -1.5, plant))
    assert swings[1]["strike_mm"] != swings[0]["strike_mm"]  # no mark: the encoders
    assert said.count("two numbers are wanted") == 2
