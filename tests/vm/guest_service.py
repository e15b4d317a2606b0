"""The service under systemd in the guest: a killed loop with the club in motion, a frozen supervisor."""

from __future__ import annotations

import os
import signal
import time

from bench.base.lifecycle import Phase
from bench.network.client import BenchClient
from tests.benchmarks.row import Row
from tests.vm.guest import EMERGENCY, wait_until
from tests.vm.guest_bench import UNIT, GuestBench, journal, service
from tests.vm.guest_bus import Listener
from tests.vm.guest_faults import WATCHDOG

TITLE = "systemd"


def kill_and_freeze(bench: GuestBench) -> tuple[GuestBench, list[Row]]:
    """Kill the loop in the downswing, then freeze the supervisor; return the bench as it runs afterwards."""
    rows = []
    bench.take_address()
    time.sleep(0.5)
    loop = int(bench.client.status()["processes"]["loop"]["pid"])
    witness = Listener("can2", (EMERGENCY,))
    before = _restarts()
    bench.swing()
    bench.wait_phase(Phase.DOWNSWING)
    begun = time.monotonic()
    os.kill(loop, signal.SIGKILL)
    bench.close()
    bench = _await_restart(bench, before)
    took = time.monotonic() - begun
    told = [frame.time - begun for frame in witness.frames() if frame.data[:2] != b"\0\0"]
    witness.close()
    rows += [
        Row(
            TITLE,
            "loop killed, to centred valves",
            1e3 * told[0] if told else float("nan"),
            "ms",
            "by the valve node itself",
            at_most=WATCHDOG,
        ),
        Row(TITLE, "loop killed, to READY=1 again", took, "s", _state(bench)),
    ]
    begun, before = time.monotonic(), _restarts()
    os.kill(int(service("MainPID")), signal.SIGSTOP)
    bench.close()
    bench = _await_restart(bench, before)
    rows.append(
        Row(TITLE, "supervisor frozen, to READY=1 again", time.monotonic() - begun, "s", _state(bench))
    )
    struck = "Watchdog timeout" in journal()
    rows.append(Row(TITLE, "systemd's watchdog struck", float(struck), "", "WatchdogSec=5", at_least=1))
    return bench, rows


def _restarts() -> int:
    return int(service("NRestarts"))


def _await_restart(bench: GuestBench, before: int) -> GuestBench:
    wait_until(lambda: _restarts() > before, f"{UNIT} started anew")
    wait_until(lambda: service("ActiveState") == "active", f"{UNIT} ready")
    return GuestBench(bench.configuration)


def _state(bench: GuestBench) -> str:
    """Return where it came up, which must be ESTOP for a restart."""
    status = BenchClient.status(bench.client)
    cause = status["cause"]
    if status["state"] != "ESTOP" or cause is None or cause["name"] != "RESTART":
        raise RuntimeError(f"found {bench.words()} after a restart, expected ESTOP, RESTART")
    return "ESTOP, RESTART"
