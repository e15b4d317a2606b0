"""Commissioning of robots drawn over the whole range, and of wrong machines: `... commissioning [--draws N]`.

With `--swings` each robot is commissioned by the command itself, up to its learned swing and its limits; the
swing is evaluated by the plant's truth, its speed against the designer's optimum for the true plant.

Otherwise prints each robot's parameters: truth, estimate, standard error; then the report on each wrong
machine. The range is that of `tests/bench/commissioning/drawn_robots.py`. Judged: the share of values whose
95 % interval covers the truth, loads, and wrong machines identified.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from dataclasses import replace
from math import degrees, nan
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from bench.base.errors import Refused
from bench.commissioning.commissioning import begin, commission
from bench.commissioning.machine.commissioning_step import (
    LEARNED_FILE,
    SWING_FILE,
    RobotEstimate,
    SimulatedSeries,
)
from bench.commissioning.machine.driver_machine import SimulatedMachine
from bench.commissioning.swings.robot_swings import fastest_swing
from bench.commissioning.swings.speed_ramp import bench_of
from bench.commissioning.swings.swing_diagnosis import diagnose
from bench.config import Configuration, load_configuration, shipped_configuration
from bench.control.measured_plant import value_at
from bench.learning.delivery import figures_of
from bench.simulation.safety import RunEnd, SafetyLimits, unsafe_reasons
from bench.simulation.simulated_bench import ReturnFailed, Series
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.faults import Fault
from sim.plant import PlantParameters
from tests.bench.commissioning.drawn_robots import drawn_robot, drawn_robot_file, gap_of
from tests.bench.commissioning.wrong_machines import (
    measured_values,
    swung_wrongly,
    true_robot,
    wrong_machines,
)
from tests.benchmarks.row import Row

NAME = "commissioning"


def run(arguments: list[str]) -> list[Row]:
    """Commission drawn robots and wrong machines."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks commissioning", description=__doc__)
    parser.add_argument("--draws", type=int, default=20, metavar="N", help="robots (default: 20)")
    parser.add_argument("--first", type=int, default=1, metavar="SEED", help="first seed (default: 1)")
    parser.add_argument("--swings", action="store_true", help="up to the learned swing: minutes a robot")
    parser.add_argument("--wrong", action="store_true", help="also wrong machines")
    options = parser.parse_args(arguments)
    configuration, console = load_configuration(shipped_configuration()), Console(width=120)
    if options.swings:
        return _learned(range(options.first, options.first + options.draws), configuration, console)
    covered, unsafe, seconds = list[bool](), list[str](), list[float]()
    for seed in range(options.first, options.first + options.draws):
        truth = drawn_robot(seed, configuration.plant)
        known, said, loads, time = _commissioned(configuration, truth)
        if said:
            console.print(f"robot {seed}: {said}")
        covered += _table(console, seed, truth, known)
        unsafe += [f"robot {seed}: {text}" for text in loads]
        seconds.append(time)
    rows = list[Row]()
    if seconds:
        rows = [
            Row(NAME, "values whose 95 % interval covers the truth", _share(covered), "%", "", at_least=90.0),
            Row(NAME, "unsafe robots", len(unsafe), "", "; ".join(unsafe), at_most=0),
            Row(NAME, "longest commissioning", max(seconds) / 60.0, "min of the bench"),
        ]
    if options.wrong:
        rows += _wrong(console, configuration) + _swung_wrongly(console, configuration)
    return rows


class _LearnedRobot(NamedTuple):
    """Result of a robot."""

    exit_code: int
    off: str
    """Learned swing against the centre of the face and the designed delivery, by the plant's truth."""
    speed: float
    """m/s; NaN without a learned swing."""
    highest: float
    """Speed that the designer finds for the true plant, m/s; NaN where it was not looked for."""


def _learned(seeds: range, configuration: Configuration, console: Console) -> list[Row]:
    """Commission robots with the command, and look at the learned swing of each."""
    found = list[_LearnedRobot]()
    for seed in seeds:
        with TemporaryDirectory() as folder:
            found.append(_learned_robot(seed, Path(folder), configuration))
        one = found[-1]
        console.print(
            f"robot {seed}: exit {one.exit_code}, {one.speed:.2f} m/s of {one.highest:.1f} m/s; {one.off}",
            highlight=False,
        )
    learned = [one for one in found if one.exit_code == 0]
    shares = [one.speed / one.highest for one in learned]
    return [
        Row(NAME, "robots with a learned swing", len(learned), f"of {len(found)}", "", 0.9 * len(found)),
        Row(NAME, "least share of the designer's speed", 100.0 * min(shares, default=0.0), "%", "", 90.0),
    ]


def _learned_robot(seed: int, folder: Path, configuration: Configuration) -> _LearnedRobot:
    truth, robot, day = drawn_robot(seed, configuration.plant), folder / "robot.toml", folder / "day"
    robot.write_text(drawn_robot_file(truth, configuration))
    code = subprocess.run(
        [sys.executable, "-m", "bench", "commission", "--sim", "--robot", robot, "--output", day], check=False
    ).returncode
    if code:
        return _LearnedRobot(code, "", nan, nan)
    learned, planned = load_profile(day / LEARNED_FILE), load_profile(day / SWING_FILE).delivery
    made = Series(bench_of(load_configuration(day / "robot.toml"), learned), truth).swing(learned)
    f, highest = figures_of(made.delivery), fastest_swing(load_configuration(robot)).speed
    off = (
        f"strike {1e3 * f.strike:+.1f} mm, speed {100 * (f.speed / planned['head_speed_mps'] - 1):+.2f} %, "
        f"lean {degrees(f.lean) - planned['shaft_lean_deg']:+.2f} deg, "
        f"attack {degrees(f.attack) - planned['attack_angle_deg']:+.2f} deg"
    )
    return _LearnedRobot(code, off, f.speed, highest)


def _share(covered: list[bool]) -> float:
    return 100.0 * sum(covered) / max(len(covered), 1)


def _commissioned(
    configuration: Configuration, truth: PlantParameters, faults: tuple[Fault, ...] = ()
) -> tuple[RobotEstimate, str, list[str], float]:
    """Return the estimate after all steps, why it ended, why its loads are unsafe, and its time (s)."""
    with TemporaryDirectory() as folder:
        state = begin(Path(folder), configuration, simulated=True)
        said = ""
        try:
            machine = SimulatedMachine(truth, configuration.plant, faults)
        except Refused as error:
            return RobotEstimate(configuration.plant), str(error), [], 0.0
        with machine:
            try:
                commission(state, configuration.plant, machine)
            except Refused as error:
                said = str(error)
            unsafe = unsafe_reasons(RunEnd(machine.loads), SafetyLimits())
            return RobotEstimate(configuration.plant, state.values), said, unsafe, machine.time


def _table(console: Console, seed: int, truth: PlantParameters, known: RobotEstimate) -> list[bool]:
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
    """Commission wrong machines; print the reports."""
    rows = []
    cases = wrong_machines(drawn_robot(4, configuration.plant))
    for name, case in cases.items():
        _, said, unsafe, _ = _commissioned(configuration, case.robot, case.faults)
        named = case.words in said and case.location in said
        console.print(f"{name}: {said or 'nothing'} {'; '.join(unsafe)}\n", highlight=False)
        rows.append(Row(NAME, name, float(named and not unsafe), "", "named and safe", at_least=1.0))
    return rows


def _swung_wrongly(console: Console, configuration: Configuration) -> list[Row]:
    """Swing machines that become wrong after they were measured; print what each swing says."""
    c = configuration
    known = replace(c, control=replace(c.control, feed_forward="kane+pneumatic"))
    profile = load_profile(find_profile("default"))
    bench, found = bench_of(known, profile), measured_values(c.plant)
    rows = []
    for name, case in swung_wrongly(true_robot(c.plant, 1)).items():
        series = SimulatedSeries(bench, case.robot, case.faults)
        try:
            made = series.swing(profile)
        except ReturnFailed as error:
            made = error.swing
        said = diagnose(made.cycles, c.plant, found)
        unsafe = unsafe_reasons(RunEnd(series.loads()), SafetyLimits())
        console.print(f"{name}: {said.text} {'; '.join(unsafe)}\n", highlight=False)
        right = not unsafe and (said.named is None or case.is_named_by(said))
        text = "named, safe" if said.named is not None else "undecided, safe"
        rows.append(Row(NAME, name, float(right), "", text, at_least=1.0))
    return rows
