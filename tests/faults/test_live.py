"""Faults of a running bench, complete as a user starts it, and the operator's messages.

Patient where the plant has its own clock: the machine of the tests may be busy.
"""

from __future__ import annotations

from pathlib import Path

import numba
import pytest

from bench.base.lifecycle import Cause, Phase, Reaction, State
from bench.network.client import CommandRefused
from bench.records.telemetry.record_file import read_swing
from tests.running_bench import BenchProcess, played_nodes, running_bench, write_configuration

pytestmark = [
    pytest.mark.live,
    pytest.mark.timeout(400),  # the first start compiles
    pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="a tick takes longer than a period"),
]

PATIENT = """
[driver]
name = "{driver}"
watchdog = 0.3
[envelope]
encoder_timeout = 0.2
max_tick_interval = 0.3
[faults.sticking]
signal = "shoulder valve"
kind = "stuck"
value = -1.0
joint = "shoulder"
angle = 0.0                       # passed on the way from hanging, -0.29, to the address
duration = 3.0
"""


def stopped(bench: BenchProcess) -> tuple[Cause, Reaction]:
    """Arm, and swing if possible; return the cause of the stop and the reaction."""
    with bench.client.lease("test"):
        bench.recover()
        bench.client.arm()
        bench.wait_until(lambda record: record["cause"] != 0 or record["phase"] == Phase.HOLD)
        if bench.now()["cause"] == 0:
            bench.swing()
        record = bench.wait_until(lambda record: record["cause"] != 0)
        bench.wait_until(lambda record: record["state"] == State.FAULT)
    cause = Cause(int(record["cause"]))
    assert bench.cause == cause.name
    return cause, Reaction(int(record["reaction"]))


def test_phase_faults_stop_live_bench_and_allow_recovery(tmp_path: Path) -> None:
    file = write_configuration(
        tmp_path,
        "phase",
        '[faults.cable]\nsignal = "wrist encoder"\nkind = "off"\nphase = "backswing"\nduration = 0.5\n'
        '[faults.sticking]\nsignal = "shoulder valve"\nkind = "stuck"\nvalue = 1.0\n'
        'phase = "follow_through"\nduration = 1.0\n',
    )
    with running_bench(file) as bench:
        assert stopped(bench) == (Cause.WRIST_ENCODER, Reaction.BLIND_BRAKE)
        assert stopped(bench) == (Cause.SHOULDER_AIR, Reaction.PASSIVE)
        bench.end()
        cycles, about = read_swing(bench.records[-1])
        assert about["outcome"] != "complete"
        assert about["configuration"]["faults"]["sticking"]["signal"] == "shoulder valve"
        assert Cause.SHOULDER_AIR in cycles["cause"]


def test_fault_at_joint_angle_stops_bench(tmp_path: Path) -> None:
    door = '[faults.door]\nsignal = "guard closed"\nkind = "off"\njoint = "shoulder"\nangle = -0.15\n'
    file = write_configuration(tmp_path, "angle", PATIENT.format(driver="sim") + door + "duration = 0.5\n")
    with running_bench(file) as bench:
        assert stopped(bench) == (Cause.GUARD, Reaction.BRAKE)
        assert stopped(bench) == (Cause.SHOULDER_AIR, Reaction.PASSIVE)


@pytest.mark.release
def test_canopen_node_fault_reports_shoulder_following(tmp_path: Path) -> None:
    file = write_configuration(
        tmp_path,
        "nodes",
        f'{PATIENT.format(driver="canopen")}[canopen]\ninterface = "local_socket"\n'
        f'channel = "{tmp_path / "bus"}"\nsdo_timeout = 2.0\nheartbeat = 0.1\ninterlock_period = 0.1\n',
    )
    with played_nodes(file), running_bench(file) as bench:
        assert stopped(bench) == (Cause.SHOULDER_FOLLOWING, Reaction.PASSIVE)


def test_reset_without_valid_encoder_is_refused(tmp_path: Path) -> None:
    file = write_configuration(
        tmp_path,
        "cable",
        f'{PATIENT.format(driver="canopen")}[canopen]\ninterface = "local_socket"\n'
        f'channel = "{tmp_path / "bus"}"\nsdo_timeout = 2.0\nheartbeat = 0.1\ninterlock_period = 0.1\n'
        '[faults.cable]\nsignal = "wrist encoder"\nkind = "off"\n',
    )
    with played_nodes(file), running_bench(file) as bench, bench.client.lease("test"):
        record = bench.wait_until(lambda record: not record["encoder_valid"].all())
        assert record["encoder_valid"].tolist() == [1, 1, 0]
        with pytest.raises(CommandRefused, match="an encoder yields no valid readings"):
            bench.client.reset()
