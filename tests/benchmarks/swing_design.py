"""How long a swing of `--speed` and `--attack` takes to design, and whether it comes out twice the same.

From the starting swing, then from it again, then from nothing. Times are the processor's, all threads
together: on two free cores it takes no longer, and what else a machine does is not counted. Compiling is done
before the clock starts. With `--quick` only the first.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from math import degrees, radians
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

from bench.commands.progress import progress_bar
from bench.config import load_configuration
from bench.design.designer import DesignFailed, SwingDemand, design_swing
from bench.simulation.simulated_bench import SimulatedBench, simulate_swings
from bench.swing.library import find_profile
from bench.swing.profile import load_profile, save_profile
from tests.benchmarks.row import Row

_NAME = "swing_design"


def run(arguments: list[str]) -> list[Row]:
    """Return the benchmark's rows."""
    options = _options(arguments)
    c = load_configuration(options.config)
    demand = SwingDemand(head_speed=options.speed, attack=radians(options.attack))
    begin = load_profile(find_profile(options.begin))
    bench = SimulatedBench(begin, c.plant, c.control, c.envelope, c.estimator)
    list(simulate_swings(bench, [None]))  # compiles, or loads what was compiled
    rows = []
    with TemporaryDirectory() as folder, progress_bar() as bar:
        runs = [("from a swing", begin, 60.0), ("again", begin, 60.0), ("from nothing", None, 600.0)]
        files: list[Path] = []
        for what, start, longest in runs[: 1 if options.quick else None]:
            task = bar.add_task(what, total=None)
            clock = process_time()
            try:
                made = design_swing(
                    c.plant,
                    demand,
                    "design",
                    control=c.control,
                    envelope=c.envelope,
                    estimator=c.estimator,
                    start=start,
                )
            except DesignFailed as failure:
                rows.append(Row(_NAME, f"{what}, designed", 0.0, "", str(failure), at_least=1.0))
                continue
            took = process_time() - clock
            bar.update(task, total=1.0, completed=1.0)
            files.append(Path(folder) / f"{len(files)}.toml")
            save_profile(files[-1], made.profile)
            rows.append(
                Row(_NAME, f"{what}, processor time", took, "s", f"{made.rounds} rounds", at_most=longest)
            )
            rows += _swung(what, replace(bench, profile=load_profile(files[-1])), demand)
        if len(files) > 1:
            same = files[0].read_bytes() == files[1].read_bytes()
            rows.append(Row(_NAME, "twice the same bytes", float(same), "", "", at_least=1.0))
    return rows


def _swung(what: str, bench: SimulatedBench, demand: SwingDemand) -> list[Row]:
    """Return what the simulated bench delivers, and what a missed ball does to the cushions."""
    struck = next(iter(simulate_swings(bench, [bench.plant.ball])))
    (missed,) = simulate_swings(bench, [None])
    if struck.delivery is None:
        return [Row(_NAME, f"{what}, struck", 0.0, "", struck.reason, at_least=1.0)]
    speed = struck.delivery.speed - (demand.head_speed or 0.0)
    attack, strike = struck.delivery.attack_angle - demand.attack, abs(struck.delivery.in_plane_error)
    return [
        Row(_NAME, f"{what}, head speed less demand", speed, "m/s", at_least=-0.1, at_most=0.1),
        Row(_NAME, f"{what}, attack less demand", degrees(attack), "°", at_least=-0.1, at_most=0.1),
        Row(_NAME, f"{what}, strike off", 1e3 * strike, "mm", at_most=1.0),
        Row(_NAME, f"{what}, cushions, ball missed", 100 * missed.loads.stop_share, "%", at_most=100.0),
    ]


def _options(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks swing_design", description=__doc__)
    parser.add_argument("--config", type=Path, default=None, help="configuration or variant")
    parser.add_argument(
        "--from", dest="begin", default="default", metavar="PROFILE", help="swing to begin with"
    )
    parser.add_argument("--speed", type=float, default=45.0, help="m/s")
    parser.add_argument("--attack", type=float, default=1.1, help="degrees")
    parser.add_argument("--quick", action="store_true", help="only from the starting swing, once")
    return parser.parse_args(arguments)
