"""Commissioning of robots drawn over the whole range, and of wrong machines: `... commissioning [--draws N]`.

Prints each robot's parameters: truth, estimate, standard error; then what was said of each wrong machine. The
range is that of `tests/bench/commissioning/drawn_robots.py`. Judged: the share of values whose 95 % interval
covers the truth, loads, and wrong machines that are named.
"""

from __future__ import annotations

import argparse
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console
from rich.table import Table

from bench.commissioning.commissioning import begin, commission
from bench.commissioning.driver_machine import SimulatedMachine
from bench.commissioning.known_robot import KnownRobot, value_at
from bench.config import Configuration, load_configuration, shipped_configuration
from bench.errors import Refused
from bench.simulation.safety import RunEnd, SafetyLimits, dangers
from sim.faults import Fault
from sim.plant import PlantParameters
from tests.bench.commissioning.drawn_robots import drawn_robot, gap_of
from tests.bench.commissioning.wrong_machines import wrong_machines
from tests.benchmarks.row import Row

NAME = "commissioning"


def run(arguments: list[str]) -> list[Row]:
    """Commission drawn robots and wrong machines."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks commissioning", description=__doc__)
    parser.add_argument("--draws", type=int, default=20, metavar="N", help="robots (default: 20)")
    parser.add_argument("--first", type=int, default=1, metavar="SEED", help="first seed (default: 1)")
    parser.add_argument("--wrong", action="store_true", help="wrong machines, too")
    options = parser.parse_args(arguments)
    configuration, console = load_configuration(shipped_configuration()), Console(width=120)
    covered, unsafe, seconds = list[bool](), list[str](), list[float]()
    for seed in range(options.first, options.first + options.draws):
        truth = drawn_robot(seed, configuration.plant)
        known, said, loads, time = _commissioned(configuration, truth)
        if said:
            console.print(f"robot {seed}: {said}")
        covered += _table(console, seed, truth, known)
        unsafe += [f"robot {seed}: {text}" for text in loads]
        seconds.append(time)
    rows = [
        Row(NAME, "values whose 95 % interval covers the truth", _share(covered), "%", "", at_least=90.0),
        Row(NAME, "unsafe robots", len(unsafe), "", "; ".join(unsafe), at_most=0),
        Row(NAME, "longest commissioning", max(seconds, default=0.0) / 60.0, "min of the bench"),
    ]
    if options.wrong:
        rows += _wrong(console, configuration)
    return rows


def _share(covered: list[bool]) -> float:
    return 100.0 * sum(covered) / max(len(covered), 1)


def _commissioned(
    configuration: Configuration, truth: PlantParameters, faults: tuple[Fault, ...] = ()
) -> tuple[KnownRobot, str, list[str], float]:
    """Return what is known after all steps, what ended it, why its loads are unsafe, and its time (s)."""
    with TemporaryDirectory() as folder:
        state = begin(Path(folder), configuration, simulated=True, resume=False)
        said = ""
        try:
            machine = SimulatedMachine(truth, configuration.plant, faults)
        except Refused as error:
            return KnownRobot(configuration.plant), str(error), [], 0.0
        with machine:
            try:
                commission(state, configuration.plant, machine, lambda: datetime.now(UTC))
            except Refused as error:
                said = str(error)
            unsafe = dangers(RunEnd(machine.loads), SafetyLimits())
            return KnownRobot(configuration.plant, state.values), said, unsafe, machine.time


def _table(console: Console, seed: int, truth: PlantParameters, known: KnownRobot) -> list[bool]:
    """Print truth and estimate of robot `seed`; return which intervals cover the truth."""
    table = Table("parameter", title=f"robot {seed}", title_justify="left")
    for column in ("truth", "estimate", "standard error", "errors off"):
        table.add_column(column, justify="right")
    covered = []
    for key, found in known.found.items():
        gap = gap_of(found, truth)
        off = abs(gap) / found.error if found.error else float(gap != 0.0) * 99.0
        covered.append(off <= 1.96)
        true = float(value_at(truth, key))
        table.add_row(key, f"{true:.5g}", f"{found.value:.5g}", f"{found.error:.2g}", f"{off:.1f}")
    console.print(table)
    return covered


def _wrong(console: Console, configuration: Configuration) -> list[Row]:
    """Commission wrong machines; print what was said."""
    rows = []
    cases = wrong_machines(drawn_robot(4, configuration.plant))
    for name, case in cases.items():
        _, said, unsafe, _ = _commissioned(configuration, case.robot, case.faults)
        named = case.words in said and case.place in said
        console.print(f"{name}: {said or 'nothing'} {'; '.join(unsafe)}\n", highlight=False)
        rows.append(Row(NAME, name, float(named and not unsafe), "", "named and safe", at_least=1.0))
    return rows
