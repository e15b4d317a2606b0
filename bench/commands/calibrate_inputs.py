"""`golfbench calibrate inputs`: each day's check that interlocks, buttons and switches do what they say."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated

import typer

from bench.commands.calibrate_aerodynamics import user_name
from bench.commands.options import flag, option
from bench.commands.session import Session, at_terminal
from bench.errors import BenchError

if TYPE_CHECKING:
    from bench.calibration.calibration import Entry
    from bench.calibration.values import SeenInputs
    from bench.commissioning.driver_machine import SimulatedMachine
    from bench.commissioning.inputs_check import WatchedMachine
    from bench.commissioning.live_robot import Hands
    from bench.config import Configuration

SIMULATED_PATIENCE = 2.0
"""s in which simulated hands have acted."""


def inputs(
    context: typer.Context,
    sim: Annotated[bool, flag("--sim", "Simulate robot and hands in lock-step; nothing is stored.")] = False,
    by: Annotated[str | None, option("Who checks.", "NAME", shown="the user's name")] = None,
) -> None:
    """Check each interlock, button and switch, and the supply's sensor beside its gauge.

    Takes the place of golfbench run for about five minutes, and says what to do by hand. On a machine it is
    due each day: ARM is refused without it, and after one that found something wrong.
    """
    from bench.commissioning.inputs_check import check_inputs, raise_findings

    configuration = context.ensure_object(Session).configuration()
    simulated = sim or configuration.driver.name == "sim"
    with _simulated(configuration) if simulated else _live(configuration) as (machine, hands):
        seen, findings = check_inputs(machine, hands, configuration, lambda what: typer.echo(what, err=True))
    if not simulated:
        entry = keep_inputs(configuration, seen, user_name() if by is None else by)
        typer.echo(f"{entry.name} of bench {entry.bench}; expires {entry.expires:%Y-%m-%d %H:%M} UTC")
    raise_findings(findings)
    typer.echo(f"{len(seen.seen)} inputs seen to change: {', '.join(seen.seen)}.")
    typer.echo(f"Supply sensor {1e-5 * seen.gauge:+z.2f} bar beside the gauge.")


def inputs_in_force(configuration: Configuration, now: datetime) -> str | None:
    """Return the name of the check in force, empty if it is due; None with a simulated robot."""
    from bench.calibration.archive import calibration_of
    from bench.calibration.values import CalibrationKind, SeenInputs, is_rewired

    if configuration.driver.name == "sim":
        return None
    entry = calibration_of(configuration, now).of(CalibrationKind.INPUTS)
    if entry is None or entry.expired(now) or not isinstance(entry.values, SeenInputs):
        return ""
    wrong = entry.values.findings or is_rewired(entry.values, configuration)
    return "" if wrong else entry.name


def keep_inputs(configuration: Configuration, seen: SeenInputs, by: str) -> Entry:
    """Store a check of the inputs.

    Raises:
        BenchError: it cannot be stored.
    """
    from bench.calibration.archive import keep_calibration

    return keep_calibration(configuration, seen, datetime.now(UTC), by=by, method="each acted on by hand")


def simulated_hands(machine: SimulatedMachine) -> Hands:
    """Return the hands at a robot simulated in lock-step."""
    from bench.commissioning.live_robot import Hands

    return Hands(
        machine.set_supply,
        lambda text: None,
        act=machine.act,
        gauge=machine.gauge,
        patience=SIMULATED_PATIENCE,
    )


def gauge_from_person() -> float:
    """Ask what the gauge behind the regulator shows; Pa over the atmosphere."""
    while True:
        text = typer.prompt("bar on the gauge behind the regulator", err=True)
        try:
            bar = float(text.replace(",", "."))
        except ValueError:
            bar = math.nan
        if 0.0 <= bar <= 20.0:
            return 1e5 * bar
        typer.echo(f"{text!r}: a number from 0 to 20 is wanted, such as: 2.9", err=True)


def ask_person(text: str) -> None:
    """Say what to do, and wait until it is done."""
    typer.prompt(f"{text}, then press Enter", default="", show_default=False, err=True)


@contextmanager
def _simulated(configuration: Configuration) -> Iterator[tuple[WatchedMachine, Hands]]:
    from bench.commissioning.driver_machine import SimulatedMachine

    c = configuration
    with SimulatedMachine(c.plant, c.plant, tuple(c.faults.values()), inputs_only=True) as machine:
        yield machine, simulated_hands(machine)


@contextmanager
def _live(configuration: Configuration) -> Iterator[tuple[WatchedMachine, Hands]]:
    """Take the bench's place."""
    from bench.commissioning.inputs import by_person, turned_once
    from bench.commissioning.live_robot import Hands, live_robot
    from bench.processes.ownership import take_bench

    if not at_terminal():
        action = "Run it in a terminal beside the machine."
        raise BenchError("calibrate inputs", "no terminal", "a person who acts and reads", action)

    def say(text: str) -> None:
        typer.echo(text, err=True)

    supply = configuration.plant.supply
    turn = turned_once(by_person(ask_person, supply.pressure, supply.atmosphere))
    with take_bench(configuration.bench.id) as owner:
        hands = Hands(turn, say, act=saying(say), gauge=gauge_from_person)
        with live_robot(configuration, owner, hands, inputs_only=True) as robot:
            yield robot, hands


def saying(say: Callable[[str], None]) -> Callable[..., None]:
    """Return hands that act on words; the inputs show when it is done."""
    return lambda act: say(f"{act.text}.")
