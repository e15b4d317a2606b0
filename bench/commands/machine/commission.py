"""`golfbench commission`: from an unknown robot to its first learned swing; `golfbench calibrate inputs`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer
from rich.console import Console
from rich.progress import Progress

from bench.base.atomic_file import write_whole
from bench.base.errors import BenchError
from bench.commands.common import (
    Session,
    at_terminal,
    discard_typed,
    flag,
    option,
    paused,
    plain_table,
    progress_bar,
    show_json,
    user_name,
)
from bench.supervisor.ownership import take_bench
from drivers.base.ranges import read_number

if TYPE_CHECKING:
    from bench.calibration.calibration import Entry, SeenInputs
    from bench.commissioning.commissioning import Commissioning
    from bench.commissioning.machine.commissioning_step import Arm, NamedStep, RobotEstimate
    from bench.commissioning.machine.driver_machine import SimulatedMachine
    from bench.commissioning.machine.inputs import OperatorIO
    from bench.commissioning.machine.machine_process import LiveRobot
    from bench.config import Configuration
    from bench.control.settings import EnvelopeSettings
    from sim.exchange import ContactMonitor
    from sim.plant import PlantParameters

Simulated = Annotated[bool, flag("--sim", "Simulate the robot in lock-step.")]
Robot = Annotated[
    Path | None,
    option(
        "Configuration of the robot that really moves, with its faults; the bench assumes --config.", "FILE"
    ),
]
Output = Annotated[Path, option("Folder of state, records, robot.toml and report.", "DIR")]
Turn = Annotated[
    str | None,
    option(
        "Program that turns the pressure regulator, called with bar absolute or 'service'.",
        "PROGRAM",
        shown="a person is asked",
        names="--regulator",
    ),
]
Resume = Annotated[
    bool,
    flag("--resume", "Continue after the last step done in DIR, after a fault or repair from the first."),
]
Repaired = Annotated[
    str,
    option(
        "With --resume: parts repaired, replaced or adjusted since, or 'nothing'.", "TEXT", shown="prompt"
    ),
]
Check = Annotated[bool, flag("--check", "Move nothing: check the files, and say what each step does.")]
Json = Annotated[bool, flag("--json", "With --check: print JSON.")]


def commission(
    context: typer.Context,
    output: Output,
    sim: Simulated = False,
    robot: Robot = None,
    regulator: Turn = None,
    resume: Resume = False,
    repaired: Repaired = "",
    check: Check = False,
    json_: Json = False,
) -> None:
    """Check the inputs, measure an unknown robot in five bounded steps, design its swing, and learn it.

    Takes the place of golfbench run meanwhile; with --sim the robot is simulated in lock-step. Writes
    robot.toml, with standard errors, its profile, also as learned, and a report to sign. If the machine is
    wrong it says what to do. Exits with 0 once the swing is learned within the tolerances.
    """
    from bench.commissioning.commissioning import begin
    from bench.commissioning.machine.driver_machine import SimulatedMachine
    from bench.config import load_configuration
    from bench.design.optimal_control import load_casadi

    configuration = context.ensure_object(Session).configuration()
    simulated = sim or configuration.driver.name == "sim"
    _require_possible(configuration, robot, regulator, simulated=simulated)
    truth = configuration if robot is None else load_configuration(robot)
    stated = _stated_repair(repaired.strip(), resume=resume)
    state = begin(output, configuration, simulated=simulated, repaired=stated)
    state.robot = "" if robot is None else str(robot.resolve())
    load_casadi()  # a missing package must fail before the long part
    if check:
        if simulated:
            with SimulatedMachine(truth.plant, configuration.plant):
                pass  # a robot that it refuses is refused before anything begins
        _show_steps(state, json_=json_)
        return
    if not (simulated or regulator is not None or at_terminal()):
        action = "Name a program that turns the pressure regulator, or run the command in a terminal."
        raise BenchError("commission --regulator", "neither a program nor a terminal", "one of them", action)
    _commission(state, configuration, truth, live=not sim, regulator=regulator)
    _show(state)


def _stated_repair(repaired: str, *, resume: bool) -> str | None:
    """Return the statement of repaired parts that continues a commissioning; None for a new one."""
    if not resume:
        if repaired:
            action = "Add --resume, or leave it out."
            raise BenchError("commission --repaired", "a new commissioning", "one to resume", action)
        return None
    if not (repaired or at_terminal()):
        action = "Name the parts repaired, replaced or adjusted since the interruption, or state: nothing."
        expected = "--repaired TEXT, or --repaired nothing"
        raise BenchError("commission --resume", "no statement of repairs", expected, action)
    while not repaired:
        text = "Parts repaired, replaced or adjusted since the interruption (or: nothing)"
        repaired = typer.prompt(text, err=True).strip()
    return repaired


def _require_possible(
    configuration: Configuration, robot: Path | None, regulator: str | None, *, simulated: bool
) -> None:
    """Refuse encoders that are not absolute, --robot without a simulated robot, and --regulator with one."""
    driver = configuration.driver.name
    if configuration.homing.method != "absolute" or configuration.plant.encoders.incremental:
        action = "Measure by hand and enter the values with golfbench calibrate."
        raise BenchError("homing.method", "encoders with an index", "absolute encoders", action)
    if robot is not None and not simulated:
        action = "Leave it out: the robot behind the driver is the one that it is."
        raise BenchError("commission --robot", f"driver {driver!r}", "a simulated robot", action)
    if regulator is not None and simulated:
        action = "Leave it out: the simulated regulator is turned without it."
        raise BenchError("commission --regulator", "a simulated robot", "a real one", action)


def _commission(
    state: Commissioning,
    configuration: Configuration,
    truth: Configuration,
    *,
    live: bool,
    regulator: str | None,
) -> None:
    """Do the steps that are left; write state, report, robot.toml and profiles.

    On the robot of the configured driver if `live`, else on the simulated `truth` in lock-step.
    """
    from bench.commissioning.commissioning import (
        ALL_STEPS,
        ROBOT_FILE,
        commission,
        commission_swings,
        folder_lock,
        known_with_swing,
        safe_after_error,
    )
    from bench.commissioning.machine.inputs import await_local_reset
    from bench.config import load_configuration

    nominal = configuration.plant

    def show(what: str) -> None:
        bar.update(task, description=what)

    def on_step(step: NamedStep) -> None:
        bar.update(task, description=step.title, completed=len(state.done))
        _write_report(state, nominal)

    file = state.folder / ROBOT_FILE
    with (
        folder_lock(state.folder),
        progress_bar() as bar,
        _live(configuration, truth, regulator, bar) if live else _simulated(configuration, truth) as machine,
    ):
        state.save()
        task = bar.add_task(ALL_STEPS[0].title, total=len(ALL_STEPS), completed=len(state.done))
        try:
            _see_inputs(state, configuration, machine, on_step, show)
            measured, observe = machine.measured, machine.observe
            permit = partial(await_local_reset, measured, machine.hands)
            known = commission(
                state, nominal, measured, permit=permit, observe=observe, on_step=on_step, progress=show
            )
            _write_robot(file, state, known, configuration.envelope)
            robot = load_configuration(file)
            with safe_after_error(measured, nominal):
                commission_swings(state, robot, machine.arm, on_step=on_step, progress=show)
            swung = known_with_swing(load_configuration(file), state.folder).envelope
            _write_robot(file, state, known, configuration.envelope, swung.max_following_error)
            bar.update(task, completed=len(state.done))
        except KeyboardInterrupt:
            bar.console.print("Stopped: the machine is passive. Continue with --resume.")
            raise
        finally:
            _write_report(state, nominal)


def _see_inputs(
    state: Commissioning,
    configuration: Configuration,
    machine: _Machine,
    on_step: Callable[[NamedStep], None],
    progress: Callable[[str], None],
) -> None:
    """Do the step before all others; on hardware its result is a calibration."""
    from bench.commissioning.commissioning import see_inputs

    interrupted = state.resumed[-1].interrupted if state.resumed else ""
    in_force = None if state.simulated else inputs_in_force(configuration, datetime.now(UTC), interrupted)

    def keep(seen: SeenInputs) -> None:
        if in_force is not None:
            keep_inputs(configuration, seen, user_name())

    see_inputs(
        state,
        configuration,
        machine.measured,
        machine.hands,
        in_force=in_force,
        keep=keep,
        on_step=on_step,
        progress=progress,
    )


def _write_robot(
    file: Path,
    state: Commissioning,
    known: RobotEstimate,
    envelope: EnvelopeSettings,
    following: Mapping[str, tuple[float, float, float]] | None = None,
) -> None:
    """Write robot.toml, with the limits of `following` errors and the learned swing once they are known."""
    from bench.commissioning.commissioning import require_unedited, robot_file
    from bench.commissioning.machine.commissioning_step import LEARNED_FILE

    require_unedited(file)
    measured = max((step.date for step in state.done if step.values), default=None)
    made = datetime.fromisoformat(measured) if measured else datetime.now(UTC)
    learned = file.with_name(LEARNED_FILE)
    profile = learned if following and learned.exists() else None
    write_whole(file, robot_file(known, state.configuration, made, envelope, following, profile, file))


def inputs_in_force(configuration: Configuration, now: datetime, interrupted: str) -> str | None:
    """Return the name of the check in force, empty if it is due; None with a simulated robot.

    It is due if it is not newer than `interrupted` (ISO date), empty without an interruption.
    """
    from bench.calibration.archive import calibration_of
    from bench.calibration.calibration import CalibrationKind, SeenInputs, is_rewired

    if configuration.driver.name == "sim":
        return None
    entry = calibration_of(configuration, now).of(CalibrationKind.INPUTS)
    if entry is None or entry.expired(now) or not isinstance(entry.values, SeenInputs):
        return ""
    older = interrupted and entry.date <= datetime.fromisoformat(interrupted)
    wrong = older or entry.values.findings or is_rewired(entry.values, configuration)
    return "" if wrong else entry.name


def keep_inputs(configuration: Configuration, seen: SeenInputs, by: str) -> Entry:
    """Store a check of the inputs; raises BenchError: it cannot be stored."""
    from bench.calibration.archive import keep_calibration

    return keep_calibration(configuration, seen, datetime.now(UTC), by=by, method="each acted on by hand")


def gauge_from_person() -> float:
    """Prompt for the reading of the gauge behind the regulator; Pa above the atmosphere."""
    while True:
        discard_typed()
        text = typer.prompt("bar on the gauge behind the regulator", err=True)
        try:
            bar = read_number(text.replace(",", "."))
        except ValueError:
            bar = math.nan
        if 0.0 <= bar <= 20.0:
            return 1e5 * bar
        typer.echo(f"{text!r}: a number from 0 to 20 is wanted, such as: 2.9", err=True)


def ask_person(text: str) -> None:
    """Say what to do, and wait until it is done."""
    discard_typed()
    typer.prompt(f"{text}, then press Enter", default="", show_default=False, err=True)


class _Machine(NamedTuple):
    """A robot in the forms that the steps take."""

    measured: SimulatedMachine | LiveRobot
    arm: Arm
    hands: OperatorIO
    observe: Callable[[], tuple[str, ...]]
    """Returns notes after a measuring step."""


@contextmanager
def _simulated(
    configuration: Configuration, truth: Configuration, *, inputs_only: bool = False
) -> Iterator[_Machine]:
    from bench.commissioning.machine.commissioning_step import SimulatedSeries
    from bench.commissioning.machine.driver_machine import SimulatedMachine

    faults = tuple(truth.faults.values())
    local_reset = configuration.lifecycle.local_reset
    with SimulatedMachine(
        truth.plant, configuration.plant, faults, inputs_only=inputs_only, local_reset=local_reset
    ) as machine:
        yield _Machine(
            machine,
            lambda bench: SimulatedSeries(bench, truth.plant, faults),
            machine.hands,
            lambda: (_loads(machine),),
        )


@contextmanager
def _live(
    configuration: Configuration,
    truth: Configuration,
    regulator: str | None,
    bar: Progress,
    *,
    inputs_only: bool = False,
) -> Iterator[_Machine]:
    """Take the bench's place and yield its robot, in real time; `truth` moves where it is simulated."""
    from bench.commissioning.machine.inputs import in_simulation
    from bench.commissioning.machine.machine_process import live_robot
    from sim.exchange import ContactMonitor

    def say(text: str) -> None:
        bar.console.print(text, highlight=False)

    c, supply = configuration, configuration.plant.supply
    with take_bench(c.bench.id) as owner:
        if c.driver.name == "sim":
            marks = ContactMonitor(owner.folder)
            hands = in_simulation(owner.folder, supply.pressure, supply.atmosphere)
            hands = hands._replace(say=say, look=lambda: _mark_in(marks, truth.plant))
            moving = live_robot(c, owner, hands, truth)
        else:
            hands = _hands_of_person(c, regulator, bar, say)
            moving = live_robot(c, owner, hands, inputs_only=inputs_only)
        with moving as robot:
            yield _Machine(robot, robot.series, hands, tuple)


def _hands_of_person(
    configuration: Configuration, regulator: str | None, bar: Progress, say: Callable[[str], None]
) -> OperatorIO:
    """Return the hands of the person at the terminal, `regulator` being the program that turns it, if any."""
    from bench.commands.swing.learn import mark_from_person
    from bench.commissioning.machine.inputs import OperatorIO, by_person, by_program, turned_once

    def ask(text: str) -> None:
        with paused(bar):
            ask_person(text)

    def ask_mark() -> tuple[float, float] | None:
        with paused(bar):
            typer.echo(
                "The guard is released: lock the supply, pin the shoulder, look at the ball's mark on the "
                "face, wipe it off.",
                err=True,
            )
            mark = mark_from_person()
            ask_person("Remove the pin, leave and close the guard")
        return mark

    def ask_gauge() -> float:
        with paused(bar):
            return gauge_from_person()

    supply = configuration.plant.supply
    turn = by_person(ask, supply.pressure, supply.atmosphere) if regulator is None else by_program(regulator)
    person, gauge = (ask_mark, ask_gauge) if at_terminal() else (None, None)
    return OperatorIO(turned_once(turn), say, ask, person, act=lambda act: say(f"{act.text}."), gauge=gauge)


def _mark_in(contacts: ContactMonitor, truth: PlantParameters) -> tuple[float, float] | None:
    """Return the mark of the newest of the simulated `contacts` on the club of `truth`."""
    from bench.commissioning.machine.commissioning_step import read_mark

    contacts.attach()
    contact, site = contacts.look(), truth.site
    return None if contact is None else read_mark(contact.delivery(truth.robot, (site.ball_x, site.ball_y)))


def _show_steps(state: Commissioning, *, json_: bool) -> None:
    from bench.commissioning.commissioning import ALL_STEPS

    done = {step.name for step in state.done}
    if json_:
        steps = [
            {"name": step.name, "title": step.title, "bounds": step.bounds_text, "done": step.name in done}
            for step in ALL_STEPS
        ]
        found = {"folder": str(state.folder), "robot": state.robot, "simulated": state.simulated}
        return show_json(found | {"steps": steps})
    kind = ", simulated" if state.simulated else ""
    typer.echo(f"Robot{kind}: {state.robot or 'as configured'}. Folder: {state.folder}.")
    for number, step in enumerate(ALL_STEPS):
        word = "done" if step.name in done else "left"
        typer.echo(f"{number}. {step.title} ({word})\n   {step.bounds_text}")


def _loads(machine: SimulatedMachine) -> str:
    """Return the simulated robot's loads since it was switched on, in words."""
    loads = machine.loads
    return (
        f"simulated loads so far: {100 * loads.stop_share:.0f} % of an absorber's rated energy "
        f"({loads.stop}), {100 * loads.pressure_share:.0f} % of a chamber's, "
        f"head {1e3 * loads.lowest_clearance:.0f} mm above the ground, {loads.peak_head_speed:.1f} m/s"
    )


def _write_report(state: Commissioning, nominal: PlantParameters) -> None:
    from bench.commissioning.commissioning import commissioning_report

    write_whole(state.folder / "report.html", commissioning_report(state, nominal, datetime.now(UTC)))


def _show(state: Commissioning) -> None:
    figures = ("found", "standard error")
    latest = {one.key: one for one in state.values}.values()
    rows = ((one.step, one.key, f"{one.value:.6g}", f"{one.error:.2g}", one.unit) for one in latest)
    columns = ("step", "value", *figures, "unit")
    Console().print(plain_table(*columns, rows=rows, right=figures, title="Commissioned robot"))
    for step in state.done:
        for note in step.notes:
            typer.echo(f"{step.name}: {note}")
    robot, learned = state.folder / "robot.toml", state.folder / "learned.toml"
    typer.echo(
        f"Written: {robot}, swing.toml, learned.toml and report.html.\n"
        f"Swing it: golfbench --config {robot} profile simulate {learned}"
    )


# The inputs alone ------------------------------------------------------------------------------------


def inputs(
    context: typer.Context,
    sim: Annotated[bool, flag("--sim", "Simulate robot and hands in lock-step; nothing is stored.")] = False,
    by: Annotated[str, option("Person who measured.", "NAME", shown="user@host")] = "",
) -> None:
    """Check each interlock, button and switch, and compare the supply's sensor with its gauge.

    Takes the place of golfbench run for about five minutes, and says what to do by hand. On a machine it is
    due each day: ARM is refused without it, and after one that found something wrong.
    """
    from bench.commissioning.steps.inputs_check import check_inputs, raise_findings

    c = context.ensure_object(Session).configuration()
    simulated = sim or c.driver.name == "sim"
    if not simulated and not at_terminal():
        action = "Run it in a terminal next to the machine."
        raise BenchError("calibrate inputs", "no terminal", "a person who acts and reads", action)
    with (
        progress_bar() as bar,
        _simulated(c, c, inputs_only=True) if simulated else _live(c, c, None, bar, inputs_only=True) as one,
    ):
        seen, findings = check_inputs(one.measured, one.hands, c, lambda what: typer.echo(what, err=True))
    if not simulated:
        entry = keep_inputs(c, seen, by or user_name())
        typer.echo(f"{entry.name} of bench {entry.bench}; expires {entry.expires:%Y-%m-%d %H:%M} UTC")
    raise_findings(findings)
    typer.echo(f"{len(seen.seen)} inputs seen to change: {', '.join(seen.seen)}.")
    typer.echo(f"Supply sensor {1e-5 * seen.gauge:+z.2f} bar off the gauge.")
