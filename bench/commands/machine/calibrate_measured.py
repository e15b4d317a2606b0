"""`golfbench calibrate aerodynamics` and `inputs`: drag and lift from measured flights; the inputs tried."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, date, datetime, timedelta
from math import pi, radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.base.errors import BenchError
from bench.commands.common.command import (
    Json,
    Session,
    argument,
    at_terminal,
    flag,
    option,
    show_json,
    user_name,
)
from drivers.base.ranges import read_number

if TYPE_CHECKING:
    from bench.calibration.ball_aerodynamics import BallAerodynamics, FlightUncertainty
    from bench.calibration.calibration import Entry, SeenInputs
    from bench.commissioning.machine.driver_machine import SimulatedMachine
    from bench.commissioning.machine.inputs import OperatorIO
    from bench.commissioning.machine.machine_process import LiveRobot
    from bench.config import Configuration


BallName = Annotated[str, argument("BALL", "Ball model, as plans name it.")]
FlightTable = Annotated[
    Path,
    argument(
        "FLIGHTS",
        "CSV, one row per flight, or an export of TrackMan or Foresight: ball_speed_mps (_mph, _kmh), "
        "launch_angle_deg, spin_rpm, and the measured ones of carry_m (_yd, _ft), apex_m (_yd, _ft), time_s; "
        "optional direction_deg, spin_axis_deg, air_temperature_k (_c, _f), air_pressure_pa (_hpa), "
        "relative_humidity, wind_mps, cross_wind_mps.",
    ),
]
Source = Annotated[str, option("Device and place: full-flight monitor, indoor range.", "TEXT")]
PointTable = Annotated[
    Path | None,
    option(
        "CSV of trajectories: flight, time_s, distance_m, height_m; FLIGHTS then needs a column flight.",
        "FILE",
    ),
]
Mass = Annotated[float, option("Mass of the ball.", "G")]
Diameter = Annotated[float, option("Diameter of the ball.", "MM")]
_SCATTER = {"speed": 0.3, "angle": 0.2, "spin": 100.0, "carry": 1.0, "apex": 0.5, "time": 0.05, "point": 0.01}
"""Default standard deviations of a device: m/s, deg, rpm, m, m, s, m."""
Scatter = Annotated[
    list[str] | None,
    option(
        "SD of the device from flight to flight; repeatable. NAME: speed (m/s), angle (deg), spin (rpm), "
        "carry, apex (m), time (s), point (m; coordinates of a trajectory).",
        "NAME=VALUE",
        shown=" ".join(f"{name}={value:g}" for name, value in _SCATTER.items()),
    ),
]
Uncertainty = Annotated[
    list[str] | None,
    option("Standard uncertainty of its calibration, with the same names.", "NAME=VALUE", shown="0"),
]
Day = Annotated[str | None, option("Day of the measurement, YYYY-MM-DD.", "DATE", shown="today")]
By = Annotated[str, option("Person who measured.", "NAME", shown="user@host")]
_FIRST_DAY = date(2000, 1, 1)
"""Earliest plausible day of a measurement."""
Store = Annotated[bool, flag("--store/--no-store", "Store the result, or only print it.")]


def aerodynamics(
    context: typer.Context,
    ball: BallName,
    flights: FlightTable,
    source: Source,
    points: PointTable = None,
    mass_g: Mass = 45.93,
    diameter_mm: Diameter = 42.67,
    scatter: Scatter = None,
    uncertainty: Uncertainty = None,
    measured: Day = None,
    by: By = "",
    store: Store = True,
    json_: Json = False,
) -> None:
    """Fit drag and lift of a ball model to measured flights, with standard uncertainties.

    Campaigns with carry = "measured" fly every launch with the newest coefficients of its ball. The scatter
    of the device weights the figures; the uncertainty of its calibration is common to all flights and added.
    """
    _require_ball(ball, context.ensure_object(Session).configuration().balls)
    spread = _uncertainty("--scatter", scatter or (), _SCATTER)
    common = _uncertainty("--uncertainty", uncertainty or (), dict.fromkeys(_SCATTER, 0.0))
    day = _day(measured)
    values = _fitted(ball, flights, points, spread, common, mass_g / 1e3, diameter_mm / 2e3)
    _keep(context, values, day, source, by or user_name(), store=store, json_=json_)


def _require_ball(name: str, configured: Iterable[str]) -> None:
    """Refuse an empty name and another spelling of a `configured` one; warn of a new name."""
    known = list(configured)
    meant = [one for one in known if one != name and one.casefold() == name.strip().casefold()]
    if not name.strip() or name != name.strip() or (meant and name not in known):
        action = f"Did you mean {meant[0]}?" if meant else "Name the ball as plans and the configuration do."
        expected = f"a name such as {', '.join(known)}"
        raise BenchError("calibrate aerodynamics: BALL", repr(name), expected, action)
    if name not in known:
        typer.echo(f"warning: the configuration has no ball {name}; plans must name it like this.", err=True)


def _fitted(
    ball: str,
    flights: Path,
    points: Path | None,
    scatter: FlightUncertainty,
    calibration: FlightUncertainty,
    mass: float,
    radius: float,
) -> BallAerodynamics:
    """Return the fit to the flights in the files; BenchError when they do not determine it."""
    from bench.calibration.ball_aerodynamics import fit_aerodynamics
    from bench.calibration.flight_table import read_flights
    from sim.ball import Ball

    try:
        Ball(ball, mass, radius)
    except ValueError as error:
        location = "calibrate aerodynamics: --mass-g, --diameter-mm"
        action = "Give the mass in g and the diameter in mm, such as 45.93 and 42.67."
        raise BenchError(location, str(error), "those of a golf ball", action) from None
    table = read_flights(flights, points)
    for note in table.notes:
        typer.echo(f"Not used, {flights}: {note}", err=True)
    try:
        return fit_aerodynamics(ball, table.flights, scatter, calibration, mass=mass, radius=radius)
    except ValueError as error:
        raise BenchError(
            str(flights),
            str(error),
            "flights that determine drag and lift",
            "Measure more of them; check the table's notes and the stated scatter.",
        ) from None


def _keep(
    context: typer.Context,
    values: BallAerodynamics,
    date: datetime,
    source: str,
    by: str,
    *,
    store: bool,
    json_: bool,
) -> None:
    """Store the fit unless `store` is false, and print it."""
    from bench.calibration.archive import add_aerodynamics
    from bench.calibration.ball_aerodynamics import AerodynamicsEntry
    from bench.config import database_url
    from bench.store.database import open_database

    bench = context.ensure_object(Session).configuration().bench
    entry = AerodynamicsEntry(0, date, source, by, values)
    if store:
        url = database_url(bench.database, bench.data_dir)
        with open_database(url, datetime.now(UTC)) as database:
            entry = add_aerodynamics(database, bench.id, values, date=date, source=source, by=by)
    if json_:
        return show_json(entry.record())
    typer.echo(f"{values.ball}: {entry.text}{'' if store else '; not stored'}")
    if values.chi_square > 2.0:
        typer.echo(
            f"The flights scatter {values.chi_square**0.5:.1f} times as much as stated: the errors are "
            "widened by that. Check the table for wrong rows, and the stated scatter."
        )


def _uncertainty(option: str, given: Sequence[str], default: Mapping[str, float]) -> FlightUncertainty:
    """Return the uncertainties by the texts NAME=VALUE that are `given`, else by `default`."""
    from bench.calibration.ball_aerodynamics import FlightUncertainty

    values = dict(default)
    for text in given:
        name, _, number = text.partition("=")
        try:
            value = read_number(number)
        except ValueError:
            value = math.nan
        if name not in default or not 0.0 <= value < math.inf:
            expected = f"NAME=VALUE of at least 0, with one of {', '.join(default)}"
            raise BenchError(f"calibrate aerodynamics: {option}", repr(text), expected, f"Correct {option}.")
        values[name] = value
    angle, spin = radians(values.pop("angle")), values.pop("spin") * pi / 30
    return FlightUncertainty(launch_angle=angle, spin=spin, **values)


def _day(text: str | None) -> datetime:
    """Return noon (UTC) of the day in `text`, now at the latest; now without one."""
    now = datetime.now(UTC)
    if text is None:
        return now
    try:
        day = datetime.strptime(text, "%Y-%m-%d").replace(hour=12, tzinfo=UTC)
    except ValueError:
        day = None
    tomorrow = now.date() + timedelta(days=1)  # it may be tomorrow east of here
    if day is None or not _FIRST_DAY <= day.date() <= tomorrow:
        raise BenchError(
            "calibrate aerodynamics: --measured",
            repr(text),
            f"a day from {_FIRST_DAY} to today, {now:%Y-%m-%d}",
            "Give the day of the measurement as --measured YYYY-MM-DD.",
        )
    return min(day, now)


def inputs(
    context: typer.Context,
    sim: Annotated[bool, flag("--sim", "Simulate robot and hands in lock-step; nothing is stored.")] = False,
    by: By = "",
) -> None:
    """Check each interlock, button and switch, and compare the supply's sensor with its gauge.

    Takes the place of golfbench run for about five minutes, and says what to do by hand. On a machine it is
    due each day: ARM is refused without it, and after one that found something wrong.
    """
    from bench.commissioning.steps.inputs_check import check_inputs, raise_findings

    configuration = context.ensure_object(Session).configuration()
    simulated = sim or configuration.driver.name == "sim"
    with _simulated(configuration) if simulated else _live(configuration) as (machine, hands):
        seen, findings = check_inputs(machine, hands, configuration, lambda what: typer.echo(what, err=True))
    if not simulated:
        entry = keep_inputs(configuration, seen, by or user_name())
        typer.echo(f"{entry.name} of bench {entry.bench}; expires {entry.expires:%Y-%m-%d %H:%M} UTC")
    raise_findings(findings)
    typer.echo(f"{len(seen.seen)} inputs seen to change: {', '.join(seen.seen)}.")
    typer.echo(f"Supply sensor {1e-5 * seen.gauge:+z.2f} bar off the gauge.")


def inputs_in_force(configuration: Configuration, now: datetime) -> str | None:
    """Return the name of the check in force, empty if it is due; None with a simulated robot."""
    from bench.calibration.archive import calibration_of
    from bench.calibration.calibration import CalibrationKind, SeenInputs, is_rewired

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


def gauge_from_person() -> float:
    """Prompt for the reading of the gauge behind the regulator; Pa above the atmosphere."""
    while True:
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
    typer.prompt(f"{text}, then press Enter", default="", show_default=False, err=True)


@contextmanager
def _simulated(configuration: Configuration) -> Iterator[tuple[SimulatedMachine, OperatorIO]]:
    from bench.commissioning.machine.driver_machine import SimulatedMachine

    c = configuration
    with SimulatedMachine(c.plant, c.plant, tuple(c.faults.values()), inputs_only=True) as machine:
        yield machine, machine.hands


@contextmanager
def _live(configuration: Configuration) -> Iterator[tuple[LiveRobot, OperatorIO]]:
    """Take the bench's place."""
    from bench.commissioning.machine.inputs import OperatorIO, by_person, turned_once
    from bench.commissioning.machine.machine_process import live_robot
    from bench.supervisor.ownership import take_bench

    if not at_terminal():
        action = "Run it in a terminal next to the machine."
        raise BenchError("calibrate inputs", "no terminal", "a person who acts and reads", action)

    def say(text: str) -> None:
        typer.echo(text, err=True)

    supply = configuration.plant.supply
    turn = turned_once(by_person(ask_person, supply.pressure, supply.atmosphere))
    with take_bench(configuration.bench.id) as owner:
        hands = OperatorIO(turn, say, act=saying(say), gauge=gauge_from_person)
        with live_robot(configuration, owner, hands, inputs_only=True) as robot:
            yield robot, hands


def saying(say: Callable[[str], None]) -> Callable[..., None]:
    """Return hands that act on words; the inputs show when it is done."""
    return lambda act: say(f"{act.text}.")
