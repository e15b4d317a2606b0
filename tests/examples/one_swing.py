"""Make one swing on a running bench and print what the club and the ball did.

.venv/bin/golfbench run                           # terminal 1: a bench with the simulated robot
.venv/bin/python tests/examples/one_swing.py      # terminal 2; with a configuration: one_swing.py bench.toml
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from bench.config import load_configuration
from bench.network.client import BenchClient
from bench.network.live_swing import ShotNews, tee_up
from bench.shot.recorded_shot import read_shot
from bench.shot.shot import Shot


def swing_once(configuration: Path | None) -> Shot:
    """Bring the bench to its address, swing at a ball and return the shot of the stored record."""
    with BenchClient.connect(load_configuration(configuration)) as bench, bench.lease("example"):
        while not bench.status()["support_ready"]:  # recorder and publisher start after the loop
            time.sleep(0.1)
        if bench.status()["state"] in ("ESTOP", "FAULT"):
            bench.reset()  # enables, moves nothing
        if not bench.status()["homed"]:
            bench.home()
        bench.wait_for("READY")
        bench.arm()
        bench.wait_until_armed()
        tee_up(bench, lambda: time.sleep(0.05))
        with bench.shots() as next_message:
            begun = bench.status()["tick"]
            bench.swing()
            record = ShotNews(next_message).record_since(begun)
    if record is None:
        raise SystemExit("The bench stored no record of this swing; see golfbench status.")
    print(f"record     {record.path}")
    return read_shot(record.path).record.shot


if __name__ == "__main__":
    shot = swing_once(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
    print(f"club speed {shot.club_speed_mps or 0:.2f} m/s")
    print(f"ball speed {shot.ball_speed_mps or 0:.2f} m/s")
    print(f"carry      {shot.carry_m or 0:.1f} m, {shot.carry_source}")
