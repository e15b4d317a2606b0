"""Make one swing on a running bench and print the motion of club and ball.

.venv/bin/golfbench run                           # terminal 1: a bench with the simulated robot
.venv/bin/python tests/examples/one_swing.py      # terminal 2; with a configuration: one_swing.py bench.toml
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from bench.base.address import load_address
from bench.network.client import BenchClient
from bench.records.shot.shot_message import ShotPublication


def swing_once(configuration: Path | None) -> ShotPublication:
    """Bring the bench to its address, swing at a ball and return the shot."""
    with BenchClient.connect(load_address(configuration)) as bench, bench.lease("example"):
        while not bench.status()["support_ready"]:  # recorder and publisher start after the loop
            time.sleep(0.1)
        if bench.status()["state"] in ("ESTOP", "FAULT"):
            bench.reset()  # enables, moves nothing
        if not bench.status()["homed"]:
            bench.home()
        bench.wait_for("READY")
        bench.arm()
        bench.wait_until_armed()
        bench.tee()
        while not bench.status()["ball_present"]:
            time.sleep(0.05)
        return bench.swing_through()


if __name__ == "__main__":
    message = swing_once(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
    shot = message["shot"] or {}
    print(f"record     {message['record']}")
    print(f"club speed {shot.get('club_speed_mps') or 0:.2f} m/s")
    print(f"ball speed {shot.get('ball_speed_mps') or 0:.2f} m/s")
    print(f"carry      {shot.get('carry_m') or 0:.1f} m, {shot.get('carry_source')}")
