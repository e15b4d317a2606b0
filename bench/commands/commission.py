"""`golfbench commission`: from an unknown robot to its first learned swing, step by step."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.commands.session import Session

if TYPE_CHECKING:
    from datetime import datetime

    from bench.commissioning.commissioning import Commissioning
    from bench.commissioning.driver_machine import SimulatedMachine
    from bench.commissioning.steps import NamedStep
    from bench.config import Configuration
    from sim.plant import PlantParameters

Simulated = Annotated[bool, typer.Option("--sim", help="Simulate the robot in lock-step.")]
Robot = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Configuration of the robot that really moves, with its faults; the bench assumes --config.",
    ),
]
Output = Annotated[Path, typer.Option(metavar="DIR", help="Folder of state, records, robot.toml and report.")]
Resume = Annotated[bool, typer.Option("--resume", help="Continue after the last step done in DIR.")]
Check = Annotated[
    bool, typer.Option("--check", help="Move nothing: check the files, and say what each step does.")
]
Json = Annotated[bool, typer.Option("--json", help="With --check: print JSON for a program to read.")]


def commission(
    context: typer.Context,
    output: Output,
    sim: Simulated = False,
    robot: Robot = None,
    resume: Resume = False,
    check: Check = False,
    json_: Json = False,
) -> None:
    """Measure an unknown robot in five bounded steps, design its swing, and learn it.

    Writes robot.toml, with standard errors, its profile, also as learned, and a report to sign. If the
    machine is wrong it says what to do. Exits with 0 once the swing is learned within the tolerances.
    """
    from bench.commissioning.commissioning import begin
    from bench.commissioning.driver_machine import SimulatedMachine
    from bench.config import load_configuration
    from bench.design.casadi_package import load_casadi
    from bench.errors import BenchError

    if not sim:
        cure = "Add --sim: commissioning of a running bench is not part of golfbench yet."
        raise BenchError("commission", "no --sim", "a simulated robot", cure)
    configuration = context.ensure_object(Session).configuration()
    truth = configuration if robot is None else load_configuration(robot)
    state = begin(output, configuration, simulated=True, resume=resume)
    state.robot = "" if robot is None else str(robot.resolve())
    if check:
        with SimulatedMachine(truth.plant, configuration.plant):
            _show_steps(state, json_=json_)
        return
    load_casadi()  # a missing package must fail before the long part
    _commission(state, configuration, truth)
    _show(state)


def _commission(state: Commissioning, configuration: Configuration, truth: Configuration) -> None:
    """Do the steps that are left on the simulated `truth`; write state, report, robot.toml and profiles."""
    from datetime import UTC, datetime

    from bench.commands.progress import progress_bar
    from bench.commissioning.commissioning import (
        ALL_STEPS,
        commission,
        commission_swings,
        known_with_swing,
    )
    from bench.commissioning.driver_machine import SimulatedMachine
    from bench.commissioning.folder_lock import folder_lock
    from bench.commissioning.robot_file import robot_file
    from bench.commissioning.swung_robot import SimulatedRobot
    from bench.config import load_configuration
    from bench.telemetry.whole_file import whole_file

    nominal, faults = configuration.plant, tuple(truth.faults.values())

    def now() -> datetime:
        return datetime.now(UTC)

    def on_step(step: NamedStep) -> None:
        bar.update(task, description=step.title, completed=len(state.done))
        _write_report(state, nominal, now())

    file = state.folder / "robot.toml"
    with folder_lock(state.folder), progress_bar() as bar:
        state.save()
        task = bar.add_task(ALL_STEPS[0].title, total=len(ALL_STEPS), completed=len(state.done))
        try:
            with SimulatedMachine(truth.plant, nominal, faults) as machine:
                known = commission(
                    state, nominal, machine, now, observe=lambda: (_loads(machine),), on_step=on_step
                )

            def write_robot(following: Mapping[str, tuple[float, float, float]]) -> None:
                made = now().date()
                text = robot_file(known, state.configuration, made, configuration.envelope, following)
                with whole_file(file) as stream:
                    stream.write(text.encode())

            write_robot({})
            commission_swings(
                state,
                load_configuration(file),
                SimulatedRobot(truth.plant, faults),
                now,
                on_step=on_step,
                progress=lambda what: bar.update(task, description=what),
            )
            write_robot(known_with_swing(load_configuration(file), state.folder).envelope.following)
            bar.update(task, completed=len(state.done))
        finally:
            _write_report(state, nominal, now())


def _show_steps(state: Commissioning, *, json_: bool) -> None:
    """Print the steps, their bounds, and which are done."""
    import json

    from rich.console import Console

    from bench.commissioning.commissioning import ALL_STEPS

    done = {step.name for step in state.done}
    if json_:
        steps = [
            {"name": step.name, "title": step.title, "bounds": step.bounds_text, "done": step.name in done}
            for step in ALL_STEPS
        ]
        found = {"folder": str(state.folder), "robot": state.robot, "simulated": state.simulated}
        typer.echo(json.dumps(found | {"steps": steps}, indent=2))
        return
    console = Console()
    console.print(
        f"Robot, simulated: {state.robot or 'as configured'}. Folder: {state.folder}.",
        highlight=False,
        markup=False,
    )
    for number, step in enumerate(ALL_STEPS, start=1):
        word = "done" if step.name in done else "left"
        console.print(
            f"{number}. {step.title} ({word})\n   {step.bounds_text}", highlight=False, markup=False
        )


def _loads(machine: SimulatedMachine) -> str:
    """Return the simulated robot's loads since it was switched on, in words."""
    loads = machine.loads
    return (
        f"simulated loads so far: {100 * loads.stop_share:.0f} % of a cushion's rated energy ({loads.stop}), "
        f"{100 * loads.pressure_share:.0f} % of a chamber's, head {1e3 * loads.lowest_clearance:.0f} mm "
        f"above the ground, {loads.peak_head_speed:.1f} m/s"
    )


def _write_report(state: Commissioning, nominal: PlantParameters, made: datetime) -> None:
    """Write the report of what was done so far."""
    from bench.commissioning.report import commissioning_report
    from bench.telemetry.whole_file import whole_file

    with whole_file(state.folder / "report.html") as stream:
        stream.write(commissioning_report(state, nominal, made).encode())


def _show(state: Commissioning) -> None:
    """Print what was found."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False, title="Commissioned robot")
    for column in ("step", "value", "found", "standard error", "unit"):
        right = column in ("found", "standard error")
        table.add_column(column, justify="right" if right else "left", overflow="fold")
    for value in {value.key: value for value in state.values}.values():
        table.add_row(value.step, value.key, f"{value.value:.6g}", f"{value.error:.2g}", value.unit)
    console = Console()
    console.print(table)
    for step in state.done:
        for note in step.notes:
            console.print(f"{step.name}: {note}", highlight=False)
    robot, learned = state.folder / "robot.toml", state.folder / "learned.toml"
    console.print(
        f"Written: {robot}, swing.toml, learned.toml and report.html.\n"
        f"Swing it: golfbench --config {robot} swing simulate {learned}",
        highlight=False,
        markup=False,
    )
