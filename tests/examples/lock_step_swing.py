"""Swing the simulated robot once in lock-step, and plot the head's speed as estimated and as it is.

.venv/bin/python tests/examples/lock_step_swing.py swing.png
"""

from __future__ import annotations

import sys
from pathlib import Path

from matplotlib.figure import Figure

from bench.simulation.simulated_bench import Bench, simulate_swing
from bench.swing.actuator_motion import head_speed
from bench.swing.library import find_profile
from bench.swing.profile import load_profile


def main(picture: Path) -> None:
    """Write the plot of a swing of the profile "default" to `picture`."""
    bench = Bench(load_profile(find_profile("default")))
    cycles = simulate_swing(bench).cycles
    axes = (figure := Figure(layout="constrained")).subplots()
    estimated = head_speed(bench.plant.robot, cycles["angle"], cycles["velocity"])
    axes.plot(cycles["time"], estimated, label="estimated from the encoders")
    axes.plot(cycles["time"], cycles["plant_head_speed"], "--", label="simulated robot")
    axes.set(xlabel="time, s", ylabel="head speed, m/s")
    axes.legend()
    figure.savefig(picture)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    main(Path(sys.argv[1]))
