"""`golfbench calibrate ...`: enter calibrations of this machine and show those in force."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, date, datetime, timedelta
from math import degrees, inf, nan, pi, radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.base.errors import BenchError, Refused
from bench.commands.common import (
    Json,
    Session,
    argument,
    exit_unless,
    flag,
    option,
    plain_table,
    show_json,
    user_name,
)
from bench.commands.machine.commission import inputs
from bench.records.telemetry.encoder_preset import read_shifts
from bench.supervisor.ownership import bench_folder
from drivers.base import JOINTS
from drivers.base.ranges import read_number

if TYPE_CHECKING:
    from bench.calibration.ball_aerodynamics import BallAerodynamics, FlightUncertainty
    from bench.calibration.calibration import (
        Calibration,
        EncoderZeros,
        Entry,
        ReplacedValues,
        UnreadableEntry,
    )
    from bench.config import Configuration
    from sim.ball import Ball
    from sim.plant import Encoders

app = typer.Typer(
    help="Enter calibrations of this machine. Nothing is overwritten: a newer one supersedes.",
    no_args_is_help=True,
)

Three = tuple[float, float, float]
Whole = tuple[int, int, int]
_JOINTS = "SHOULDER ARM WRIST"

Days = Annotated[
    int | None,
    option(
        "Days until it expires.",
        low=1,
        high=3650,
        shown="encoders 365, ball 30, club 90, valves 180",
        names="--expires-days",
    ),
]
By = Annotated[str, option("Person who measured.", "NAME", shown="user@host")]
Method = Annotated[str, option("Method and tool of the measurement.", "TEXT")]
Note = Annotated[str, option("Remark.", "TEXT")]


@app.command()
def encoders(
    context: typer.Context,
    uncertainty_deg: Annotated[
        float, option("Standard uncertainty of each angle zero.", "DEG", low=0.0, high=5.0)
    ],
    zero_counts: Annotated[Three | None, option("Counts at joint angle zero.", _JOINTS)] = None,
    from_pose: Annotated[
        Three | None,
        option("Angles (deg) at which the robot is locked, at its mechanical reference.", _JOINTS),
    ] = None,
    counts: Annotated[
        Whole | None,
        option("Encoder counts at that pose.", _JOINTS, shown="read from the running bench"),
    ] = None,
    sign: Annotated[
        Whole | None,
        option(
            "Sign of each encoder: -1 if its count falls as the angle rises.", _JOINTS, shown="as in force"
        ),
    ] = None,
    remounted: Annotated[
        bool, flag("--remounted", "Accept zeros far from those in force: an encoder was mounted again.")
    ] = False,
    method: Method = "",
    by: By = "",
    expires_days: Days = None,
    note: Note = "",
    json_: Json = False,
) -> None:
    """Set the encoder zeros: counts at angle zero, or the pose in which the robot is locked now."""
    configuration = context.ensure_object(Session).configuration()
    known = _known_zeros(configuration)
    sign = sign or known.sign
    if (zero_counts is None) == (from_pose is None) or (counts is not None and from_pose is None):
        found = "--zero-counts and --from-pose" if zero_counts and from_pose else "no measurement"
        expected = "--zero-counts, or --from-pose with or without --counts"
        raise BenchError("calibrate encoders", found, expected, "Give one of the two.")
    if from_pose is not None:
        method = method or "locked at the mechanical reference, counts " + ("entered" if counts else "read")
        zero_counts = _zeros_at(configuration, from_pose, counts, sign)
    content = {
        "sign": sign,
        "counts_per_revolution": configuration.plant.encoders.counts_per_revolution,
        "uncertainty": radians(uncertainty_deg),
        "zero_shift": _zero_shifts(configuration),
        "zero_count": zero_counts,
    }
    if zero_counts is not None and not remounted:
        _require_known_zeros(zero_counts, sign, configuration, known)
    _add(context, "encoders", content, method or "counts entered", by, expires_days, note, json_)


@app.command()
def ball(
    context: typer.Context,
    x: Annotated[float, option("Ball's centre towards the target, from R1.", "M", low=-3.0, high=3.0)],
    y: Annotated[float, option("Ball's centre up the swing plane, from R1.", "M", low=-3.0, high=3.0)],
    uncertainty_mm: Annotated[float, option("Standard uncertainty of both.", "MM", low=0.0, high=50.0)],
    method: Method = "position entered",
    by: By = "",
    expires_days: Days = None,
    note: Note = "",
    json_: Json = False,
) -> None:
    """Set the position of the ball's centre on its tee, in the swing plane, for the configured club."""
    mounted = context.ensure_object(Session).configuration().swing.club
    content = {"x": x, "y": y, "uncertainty": uncertainty_mm / 1e3, "club": mounted}
    _add(context, "ball", content, method, by, expires_days, note, json_)


@app.command()
def club(
    context: typer.Context,
    length: Annotated[float, option("Wrist axis R3 to the centre of the face.", "M", low=0.3, high=1.5)],
    loft_deg: Annotated[float, option("Loft in the mount.", "DEG", low=0.0, high=70.0)],
    lie_deg: Annotated[float, option("Lie in the mount.", "DEG", low=35.0, high=80.0)],
    length_uncertainty_mm: Annotated[
        float, option("Standard uncertainty of the length.", "MM", low=0.0, high=50.0)
    ],
    angle_uncertainty_deg: Annotated[
        float, option("Standard uncertainty of the angles.", "DEG", low=0.0, high=5.0)
    ],
    name: Annotated[
        str | None, argument("CLUB", "Club of the configuration.", shown="the mounted one")
    ] = None,
    method: Method = "values entered",
    by: By = "",
    expires_days: Days = None,
    note: Note = "",
    json_: Json = False,
) -> None:
    """Set a club's length to the face, loft and lie as it sits in the mount.

    Standard uncertainties: --length-uncertainty-mm and --angle-uncertainty-deg.
    """
    content = {
        "club": name or context.ensure_object(Session).configuration().swing.club,
        "length_to_face": length,
        "loft": radians(loft_deg),
        "lie": radians(lie_deg),
        "length_uncertainty": length_uncertainty_mm / 1e3,
        "angle_uncertainty": radians(angle_uncertainty_deg),
    }
    _add(context, "club", content, method, by, expires_days, note, json_)


@app.command()
def valves(
    context: typer.Context,
    centre: Annotated[Three, option("Commands (-1 to 1) that centre the spools.", _JOINTS)],
    dead_band: Annotated[Three, option("Overlap to either side of the centre.", _JOINTS)],
    uncertainty: Annotated[float, option("Standard uncertainty of both.", "OPENING")],
    method: Method = "values entered",
    by: By = "",
    expires_days: Days = None,
    note: Note = "",
    json_: Json = False,
) -> None:
    """Set the valves' centres and dead bands."""
    content = {"centre": centre, "dead_band": dead_band, "uncertainty": uncertainty}
    _add(context, "valves", content, method, by, expires_days, note, json_)


app.command()(inputs)


@app.command("list")
def list_all(context: typer.Context, json_: Json = False) -> None:
    """Show all calibrations of this bench, also superseded ones."""
    from bench.calibration.archive import calibration_of, list_aerodynamics, list_calibrations
    from bench.calibration.ball_aerodynamics import AerodynamicsEntry
    from bench.calibration.calibration import Entry, UnreadableEntry
    from bench.config import database_url
    from bench.store.database import is_there, open_database

    configuration, now = context.ensure_object(Session).configuration(), datetime.now(UTC)
    bench = configuration.bench
    entries, balls = list[Entry | UnreadableEntry](), list[AerodynamicsEntry | UnreadableEntry]()
    if is_there(url := database_url(bench.database, bench.data_dir)):
        with open_database(url, now) as database:
            entries = list_calibrations(database, bench.id)
            balls = list_aerodynamics(database, bench.id)
    if json_:
        records = [entry.record() for entry in entries]
        records += [{"kind": "aerodynamics", "subject": e.subject, **e.record()} for e in balls]
        return show_json(records)
    nominal = f"bench {bench.id} was never calibrated: all values are nominal values of the configuration"
    if entries:
        Console().print(listing(entries, calibration_of(configuration, now), now))
    else:
        typer.echo(nominal)
    for one in sorted(balls, key=lambda one: one.subject):
        typer.echo(f"aerodynamics of {one.subject}: {one.text}")


@app.command()
def show(context: typer.Context, json_: Json = False) -> None:
    """Show the calibrations in force, and which have expired.

    Exits with 1 if the bench cannot be armed for lack of calibration.
    """
    from bench.calibration.archive import calibration_of
    from bench.calibration.calibration import outdated, replaced_values

    configuration, now = context.ensure_object(Session).configuration(), datetime.now(UTC)
    calibration = calibration_of(configuration, now)
    problems = [problem.text for problem in calibration.problems(now)]
    replaced: tuple[ReplacedValues, ...] = ()
    try:
        replaced = replaced_values(calibration, configuration)
    except BenchError as error:
        problems.append(str(error))
    if configuration.is_machine:
        problems += map(str, filter(None, (outdated(one, configuration) for one in replaced)))
    texts = [one.text for one in replaced]
    if json_:
        show_json(calibration.record() | {"problems": problems, "replaced": texts})
    else:
        console = Console()
        console.print(f"bench {calibration.bench}, club {calibration.club}", highlight=False)
        console.print(overview(calibration, now))
        for text in (*texts, *(Text(f"arming blocked: {problem}", "red") for problem in problems)):
            console.print(text, soft_wrap=True, markup=False, highlight=False)
    exit_unless(not problems)


def _add(
    context: typer.Context,
    kind: str,
    content: dict[str, Any],
    method: str,
    by: str,
    expires_days: int | None,
    note: str,
    json_: bool,
) -> None:
    """Check `content` against its ranges and this bench, store it, and say so."""
    from bench.calibration.archive import keep_calibration
    from bench.calibration.calibration import CalibrationKind, in_words, require_plausible, values_of

    values = values_of(CalibrationKind(kind), content, f"calibrate {kind}")
    configuration, now = context.ensure_object(Session).configuration(), datetime.now(UTC)
    require_plausible(values, configuration)
    entry = keep_calibration(
        configuration, values, now, by=by or user_name(), method=method, note=note, days=expires_days
    )
    if json_:
        show_json(entry.record())
    else:
        typer.echo(
            f"{entry.name} of bench {entry.bench}: {in_words(values)}; expires {entry.expires:%Y-%m-%d}"
        )
        typer.echo("A running bench checks it at its next arming; values other than before need a restart.")


def _known_zeros(configuration: Configuration) -> EncoderZeros | Encoders:
    """Return the zeros in force; not by `apply`, as their calibration may belong to other encoders."""
    from bench.calibration.archive import calibration_of
    from bench.calibration.calibration import CalibrationKind, EncoderZeros, precedes_commissioning

    entry = calibration_of(configuration, datetime.now(UTC)).of(CalibrationKind.ENCODERS)
    if entry and isinstance(entry.values, EncoderZeros) and not precedes_commissioning(entry, configuration):
        return entry.values
    return configuration.plant.encoders


def _zeros_at(c: Configuration, pose: Three, counts: Whole | None, sign: Whole) -> Three:
    """Return the counts at angle zero of a robot locked at `pose` (deg); its counts are read if not given."""
    from bench.calibration.calibration import zero_counts
    from bench.control.settings import angle_travel

    angles = radians(pose[0]), radians(pose[1]), radians(pose[2])
    for name, angle, (low, high) in zip(JOINTS, angles, angle_travel(c.plant), strict=True):
        if not low <= angle <= high:
            location, found = f"calibrate encoders: --from-pose, {name}", f"{degrees(angle):g} deg"
            expected = f"{degrees(low):.1f} to {degrees(high):.1f} deg, between its stops"
            raise BenchError(location, found, expected, "Give the angle of the mechanical reference.")
    turn = c.plant.encoders.counts_per_revolution
    counts = counts or _live_counts(c)
    for i, count in enumerate(counts):
        if not 0 <= count < turn:
            location, expected = f"calibrate encoders: --counts[{i}]", f"0 to {turn - 1}"
            raise BenchError(location, str(count), expected, "Give the count that the encoder shows.")
    return zero_counts(counts, angles, sign, turn)


def _require_known_zeros(zeros: Three, sign: Whole, c: Configuration, known: EncoderZeros | Encoders) -> None:
    """Raise BenchError if `zeros` are far from the `known` ones; those of other encoders are unknown."""
    from sim.plant import Encoders

    turn = c.plant.encoders.counts_per_revolution
    if known.zero_count == Encoders().zero_count or known.counts_per_revolution != turn:
        return
    for i, joint in enumerate(JOINTS):
        off = abs((zeros[i] - known.zero_count[i] + turn / 2) % turn - turn / 2) * 360.0 / turn
        most = degrees(c.homing.tolerance[i])
        if off > most or sign[i] != known.sign[i]:
            found = f"zero {off:.1f} deg from the present one, sign {sign[i]:+} ({known.sign[i]:+} in force)"
            expected = f"zero and sign in force, within {most:.1f} deg (homing.tolerance)"
            action = "Check pose, order and signs; if an encoder was mounted again, add --remounted."
            raise BenchError(f"calibrate encoders: {joint}", found, expected, action)


def _live_counts(configuration: Configuration) -> Whole:
    """Return the counts of the running bench; Refused when none runs here or the robot moves."""
    from bench.calibration.calibration import standing_counts
    from bench.records.telemetry.ring import NoRing

    ring: Path = bench_folder(configuration.bench.id) / "ring"
    try:
        return standing_counts(ring, configuration.plant.encoders.counts_per_revolution)
    except NoRing as error:
        location = "calibrate encoders --from-pose"
        found = f"no bench {configuration.bench.id} running on this machine ({error.found})"
        action = "Start `golfbench run --read-only`, or give the counts with --counts."
        raise Refused(location, found, "one that reads the encoders, or --counts", action) from error


def _zero_shifts(configuration: Configuration) -> tuple[str, str, str]:
    """Return preset and offset of the encoders of the running bench; warn if they are unknown."""
    found = read_shifts(bench_folder(configuration.bench.id))
    if found is None and configuration.driver.name == "canopen":
        typer.echo(
            "warning: no bench runs here, so presets of the encoders are unknown, and their devices will be "
            "refused. Start `golfbench run --read-only`, then enter this again.",
            err=True,
        )
    return found or ("", "", "")


def listing(entries: Sequence[Entry | UnreadableEntry], in_force: Calibration, now: datetime) -> Table:
    """Return all `entries`, the newest of each kind last, each with who, how and why."""
    from bench.calibration.calibration import CalibrationKind, UnreadableEntry, in_words

    table = Table.grid(padding=(0, 2, 1, 0))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    order = {kind.value: place for place, kind in enumerate(CalibrationKind)}
    for entry in sorted(entries, key=lambda one: (order.get(one.kind, len(order)), one.version)):
        title = Text.assemble(
            (" ".join(filter(None, (entry.kind, entry.subject))), "bold"), f"\nversion {entry.version}\n"
        )
        if isinstance(entry, UnreadableEntry):
            table.add_row(title.append("unreadable", "bold red"), Text(entry.text))
            continue
        title.append_text(_mark(entry, in_force, now))
        lines = (
            f"{entry.date:%Y-%m-%d %H:%M} to {entry.expires:%Y-%m-%d %H:%M} UTC, by {entry.by}",
            in_words(entry.values),
            "; ".join(filter(None, (entry.method, entry.note))),
        )
        table.add_row(title, Text("\n".join(lines)))
    return table


def overview(in_force: Calibration, now: datetime) -> Table:
    """Return a table of the calibrations in force, by kind."""
    from bench.calibration.calibration import CalibrationKind, in_words

    table = plain_table("kind", "version", "date (UTC)", "expires", "values", "")
    for kind in CalibrationKind:
        entry = in_force.of(kind)
        if entry is None:
            mark = Text("missing", "bold red") if in_force.required else Text("nominal", "dim")
            if any(bad.kind == kind for bad in in_force.unreadable):
                mark = Text("unreadable", "bold red")
            table.add_row(kind, "", "", "", "as the configuration has it", mark)
            continue
        table.add_row(
            *(" ".join(filter(None, (kind, entry.subject))), str(entry.version)),
            *(f"{entry.date:%Y-%m-%d %H:%M}", f"{entry.expires:%Y-%m-%d}"),
            *(in_words(entry.values), _mark(entry, in_force, now)),
        )
    return table


def _mark(entry: Entry, in_force: Calibration, now: datetime) -> Text:
    if in_force.of(entry.kind) != entry:
        other = entry.subject not in {"", in_force.club} or entry == in_force.moved
        return Text("other club" if other else "superseded", "dim")
    return Text("expired", "bold red") if entry.expired(now) else Text("in force", "green")


# Drag and lift from measured flights -----------------------------------------------------------------

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
_FIRST_DAY = date(2000, 1, 1)
"""Earliest plausible day of a measurement."""
Store = Annotated[bool, flag("--store/--no-store", "Store the result, or only print it.")]


@app.command()
def aerodynamics(
    context: typer.Context,
    ball: BallName,
    flights: FlightTable,
    source: Source,
    points: PointTable = None,
    scatter: Scatter = None,
    uncertainty: Uncertainty = None,
    measured: Day = None,
    by: By = "",
    store: Store = True,
    json_: Json = False,
) -> None:
    """Fit drag and lift of a ball model to measured flights, with standard uncertainties.

    Mass and radius are those of the configuration's ball of this name. Campaigns with carry = "measured" fly
    every launch with the newest coefficients of its ball. The scatter of the device weights the figures; the
    uncertainty of its calibration is common to all flights and added.
    """
    from bench.calibration.archive import add_aerodynamics
    from bench.calibration.ball_aerodynamics import AerodynamicsEntry
    from bench.config import database_url
    from bench.store.database import open_database

    configuration = context.ensure_object(Session).configuration()
    bench, model = configuration.bench, _ball_model(ball, configuration.balls)
    spread = _uncertainty("--scatter", scatter or (), _SCATTER)
    common = _uncertainty("--uncertainty", uncertainty or (), dict.fromkeys(_SCATTER, 0.0))
    day = _day(measured)
    values = _fitted(model, flights, points, spread, common)
    entry = AerodynamicsEntry(0, day, source, by or user_name(), values)
    if store:
        with open_database(database_url(bench.database, bench.data_dir), datetime.now(UTC)) as database:
            entry = add_aerodynamics(database, bench.id, values, date=day, source=source, by=entry.by)
    if json_:
        return show_json(entry.record())
    typer.echo(f"{values.ball}: {entry.text}{'' if store else '; not stored'}")
    if values.chi_square > 2.0:
        typer.echo(
            f"The flights scatter {values.chi_square**0.5:.1f} times as much as stated: the errors are "
            "widened by that. Check the table for wrong rows, and the stated scatter."
        )


def _ball_model(name: str, configured: Mapping[str, Ball]) -> Ball:
    """Return the ball called `name`; warn of a new name, refuse another spelling of a `configured` one."""
    from sim.ball import Ball

    known = list(configured)
    meant = [one for one in known if one != name and one.casefold() == name.strip().casefold()]
    if not name.strip() or name != name.strip() or (meant and name not in known):
        action = f"Did you mean {meant[0]}?" if meant else "Name the ball as plans and the configuration do."
        expected = f"a name such as {', '.join(known)}"
        raise BenchError("calibrate aerodynamics: BALL", repr(name), expected, action)
    if name not in known:
        typer.echo(f"warning: the configuration has no ball {name}; plans must name it like this.", err=True)
    return configured.get(name) or Ball(name)


def _fitted(
    ball: Ball,
    flights: Path,
    points: Path | None,
    scatter: FlightUncertainty,
    calibration: FlightUncertainty,
) -> BallAerodynamics:
    """Return the fit to the flights in the files; BenchError when they do not determine it."""
    from bench.calibration.ball_aerodynamics import fit_aerodynamics
    from bench.calibration.flight_table import read_flights

    table, size = read_flights(flights, points), {"mass": ball.mass, "radius": ball.radius}
    for note in table.notes:
        typer.echo(f"Not used, {flights}: {note}", err=True)
    try:
        return fit_aerodynamics(ball.name, table.flights, scatter, calibration, **size)
    except ValueError as error:
        expected = "flights that determine drag and lift"
        action = "Measure more of them; check the table's notes and the stated scatter."
        raise BenchError(str(flights), str(error), expected, action) from None


def _uncertainty(option: str, given: Sequence[str], default: Mapping[str, float]) -> FlightUncertainty:
    """Return the uncertainties by the texts NAME=VALUE that are `given`, else by `default`."""
    from bench.calibration.ball_aerodynamics import FlightUncertainty

    values = dict(default)
    for text in given:
        name, _, number = text.partition("=")
        try:
            value = read_number(number)
        except ValueError:
            value = nan
        if name not in default or not 0.0 <= value < inf:
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
        location, action = "calibrate aerodynamics: --measured", "Give the day as --measured YYYY-MM-DD."
        raise BenchError(location, repr(text), f"a day from {_FIRST_DAY} to today, {now:%Y-%m-%d}", action)
    return min(day, now)
