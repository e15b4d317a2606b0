"""A running bench with a launch monitor: outcomes of every kind, and what breaks on the way."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import zenoh

from bench.base.address import free_port
from bench.network.client import CommandRefused
from bench.records.shot.shot_message import ShotPublication, read_shot_message
from bench.records.telemetry.record_file import read_swing
from drivers.base import Launch
from drivers.launch_monitor.open_connect import write_heartbeat, write_shot
from drivers.launch_monitor.record import MatchOutcome
from tests.running_bench import (
    LONGEST_START,
    BenchProcess,
    running_bench,
    simulated_monitor,
    write_configuration,
)

LAUNCH = Launch(62.0, 0.2, 0.01, 300.0, 0.02)
LATEST = 8.0
"""s: on a busy machine a process may wait for seconds."""

pytestmark = [
    pytest.mark.live,
    pytest.mark.paced,
    pytest.mark.timeout(400),  # the first start compiles
]


def configuration(folder: Path, name: str) -> tuple[Path, int]:
    port = free_port()
    text = (
        "[lifecycle]\nhold_between_swings = true\n"
        f"[launch_monitor]\nenabled = true\nport = {port}\n"
        f"[launch_monitor.window]\nlatest = {LATEST}\ntimeout = 12.0\n"
    )
    return write_configuration(folder, name, text), port


@contextmanager
def shots(bench: BenchProcess) -> Iterator[Callable[[], dict[str, Any]]]:
    """Yield a function that waits for the next message on `shot` with an outcome."""
    heard: list[bytes] = []

    def hear(sample: zenoh.Sample) -> None:
        heard.append(sample.payload.to_bytes())

    subscriber = bench.client._session.declare_subscriber(
        f"golfbench/{bench.configuration.bench.id}/shot", zenoh.handlers.Callback(hear, indirect=False)
    )

    def following() -> dict[str, Any]:
        deadline = time.monotonic() + 120.0
        while time.monotonic() < deadline:
            while heard:
                message: dict[str, Any] = json.loads(heard.pop(0))
                if message.get("outcome"):
                    return message
            time.sleep(0.01)
        raise TimeoutError(bench.log[-1500:])

    yield following
    subscriber.undeclare()


def monitored(bench: BenchProcess, holds: Callable[[Any], object]) -> Any:
    """Wait until the launch monitor's part of the status is as it should be; return it."""
    deadline = time.monotonic() + LONGEST_START
    while not holds(link := bench.client.status()["launch_monitor"]):
        assert time.monotonic() < deadline, link
        time.sleep(0.05)
    return link


def test_launch_monitor_simulated_shots_have_expected_outcomes(tmp_path: Path) -> None:
    file, _ = configuration(tmp_path, "monitored")
    with running_bench(file) as bench, shots(bench) as following, bench.client.lease("test"):
        link = monitored(bench, lambda link: link["listening"])
        assert not link["present"]
        with simulated_monitor(file, "--drop", "2") as monitor:
            monitored(bench, lambda link: link["present"])
            bench.make_ready()
            bench.take_address()
            bench.client.tee()
            bench.swing()
            told = following()
            read: ShotPublication = read_shot_message(json.dumps(told).encode())
            assert (read["outcome"], read["reason"]) == (MatchOutcome.MATCHED, "")
            cycles, metadata = read_swing(Path(told["record"]))
            assert metadata["shot_id"] == told["shot_id"]
            assert read["launch"] is not None
            assert read["launch"]["device"] == "simulated monitor"
            # Delivery and ball agree, though the one was seen by encoders and the other by the monitor.
            shot = told["shot"]
            assert shot["launch_source"] == "launch monitor"
            assert shot["delivery_source"] == "encoders+model"
            assert 1.2 < shot["ball_speed_mps"] / shot["club_speed_mps"] < 1.55
            assert cycles["plant_head_speed"].max() == pytest.approx(shot["club_speed_mps"], rel=0.05)

            bench.client.wait_for("ARMED")
            bench.client.wait_until_armed()
            bench.client.tee()
            bench.swing()
            told = following()  # dropped
            assert (told["outcome"], told["launch"]) == ("swing without a launch", None)
            assert told["shot"]["ball_speed_mps"] is None
            assert told["shot"]["status"] == "excluded"
            assert Path(told["record"]).exists()

            bench.client.wait_for("ARMED")
            bench.client.wait_until_armed()
            bench.swing()  # nothing on the tee
            assert following()["reason"] == "no ball struck"
            outcomes = monitored(bench, lambda link: sum(link["outcomes"].values()) == 3)["outcomes"]
            assert outcomes == {
                "matched": 1,
                "swing without a launch": 2,
                "launch without a swing": 0,
                "launch sent again": 0,
                "second launch of a swing": 0,
            }
            monitor.send_signal(signal.SIGTERM)
            assert monitor.wait(20.0) == 0
        monitored(bench, lambda link: not link["present"])


def test_launch_monitor_faults_are_reported_and_bench_continues(tmp_path: Path) -> None:
    file, port = configuration(tmp_path, "disturbed")
    with running_bench(file) as bench, shots(bench) as following, bench.client.lease("test"):
        monitored(bench, lambda link: link["listening"])
        with socket.create_connection(("127.0.0.1", port), 5.0) as one:
            one.sendall(b'{"DeviceID": [}' + b'{"BallData": 3}' + b"\x00\xff{")
            link = monitored(bench, lambda link: link["refused"] >= 2)
            assert link["present"]
            one.sendall(b"}" + write_shot(1, LAUNCH, "first"))
            told = following()
            assert (told["outcome"], told["shot_id"], told["launch"]["device"]) == (
                "launch without a swing",
                None,
                "first",
            )
            one.sendall(write_shot(2, LAUNCH, "first")[:90])  # and away, in the middle of a message
        link = monitored(bench, lambda link: not link["present"])
        assert link["refused"] == 4  # "{}" is none either
        with (
            socket.create_connection(("127.0.0.1", port), 5.0) as one,
            socket.create_connection(("127.0.0.1", port), 5.0) as two,
        ):
            one.sendall(write_heartbeat(0, "first"))
            two.sendall(write_heartbeat(0, "second"))
            link = monitored(bench, lambda link: len(link["monitors"]) == 2)
            assert "2 monitors" in link["note"]
            bench.make_ready()
            bench.take_address()
            bench.client.tee()
            bench.swing()
            bench.wait_until(lambda record: not record["ball_present"] and record["phase"] > 0)
            one.sendall(write_shot(3, LAUNCH, "first"))
            two.sendall(write_shot(1, LAUNCH._replace(speed=63.0), "second"))
            first, second = following(), following()
            assert (first["outcome"], second["outcome"]) == ("matched", "second launch of a swing")
            assert "2 different launches" in first["reason"]
            assert first["shot"]["status"] == "excluded"
            assert first["shot_id"] == second["shot_id"] is not None
            # Its process dies: the bench lives on, says so, and the next one serves again.
            pid = bench.pid("launch monitor")
            with suppress(CommandRefused):  # on a busy machine it may have let go by itself
                bench.client.disarm()
            subprocess.run(["kill", "-KILL", str(pid)], check=True)
            monitored(bench, lambda link: not link["listening"] and not link["present"])
            assert bench.client.status()["support_ready"]
        monitored(bench, lambda link: link["listening"])
        assert bench.pid("launch monitor") != pid
        with socket.create_connection(("127.0.0.1", port), 5.0) as one:
            monitored(bench, lambda link: link["present"])
        assert bench.end() == 0


@pytest.mark.release
def test_launch_monitor_port_in_use_is_reported_and_retried(tmp_path: Path) -> None:
    file, port = configuration(tmp_path, "taken")
    with socket.create_server(("127.0.0.1", port)) as other:
        with running_bench(file) as bench:
            link = monitored(bench, lambda link: "cannot listen" in link["note"])
            assert (link["present"], link["listening"]) == (False, "")
            assert bench.client.status()["support_ready"]  # one may swing without
            other.close()
            monitored(bench, lambda link: link["listening"] == f"127.0.0.1:{port}")
