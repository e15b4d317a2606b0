"""`golfbench calibrate ...`: enter calibrations of this machine and show those in force."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from math import degrees, radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.base.errors import BenchError, Refused
from bench.commands.common.command import (
    Json,
    Session,
    argument,
    exit_unless,
    flag,
    option,
    show_json,
    user_name,
)
from bench.commands.common.output import plain_table
from bench.commands.machine.calibrate_measured import By, aerodynamics, inputs

if TYPE_CHECKING:
    from bench.calibration.calibration import (
        Calibration,
        CalibrationKind,
        EncoderZeros,
        Entry,
        ReplacedValues,
        UnreadableEntry,
    )
    from bench.config import Configuration
    from sim.plant import Encoders

app = typer.Typer(
    help="Enter calibrations of this machine. Nothing is overwritten: a newer one supersedes.",
    no_args_is_help=True,
)

Three = tuple[float, float, float]

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
Method = Annotated[str, option("Method and tool of the measurement.", "TEXT")]
Note = Annotated[str, option("Remark.", "TEXT")]


AngleUncertainty = Annotated[
    float, option("Standard uncertainty of each angle zero.", "DEG", low=0.0, high=5.0)
]
ZeroCounts = Annotated[Three | None, option("Counts at joint angle zero.", "SHOULDER ARM WRIST")]
LockedPose = Annotated[
    Three | None,
    option("Angles (deg) at which the robot is locked, at its mechanical reference.", "SHOULDER ARM WRIST"),
]
Counts = Annotated[
    tuple[int, int, int] | None,
    option("Encoder counts at that pose.", "SHOULDER ARM WRIST", shown="read from the running bench"),
]
Signs = Annotated[
    tuple[int, int, int] | None,
    option(
        "Sign of each encoder: -1 if its count falls as the angle rises.",
        "SHOULDER ARM WRIST",
        shown="as in force",
    ),
]
Remounted = Annotated[
    bool, flag("--remounted", "Accept zeros far from those in force: an encoder was mounted again.")
]


@app.command()
def encoders(
    context: typer.Context,
    uncertainty_deg: AngleUncertainty,
    zero_counts: ZeroCounts = None,
    from_pose: LockedPose = None,
    counts: Counts = None,
    sign: Signs = None,
    remounted: Remounted = False,
    method: Method = "",
    by: By = "",
    expires_days: Days = None,
    note: Note = "",
    json_: Json = False,
) -> None:
    """Set the encoder zeros: counts at angle zero, or the pose in which the robot is locked now."""
    from bench.calibration.archive import calibration_of
    from bench.calibration.calibration import CalibrationKind, EncoderZeros, precedes_commissioning
    from bench.calibration.calibration import zero_counts as zeros_at

    location = "calibrate encoders"
    configuration = context.ensure_object(Session).configuration()
    here = configuration.plant.encoders
    # Not by `apply`: the calibration in force may belong to other encoders.
    entry = calibration_of(configuration, datetime.now(UTC)).of(CalibrationKind.ENCODERS)
    known: EncoderZeros | Encoders = here
    if entry is not None and not precedes_commissioning(entry, configuration):
        known = entry.values if isinstance(entry.values, EncoderZeros) else here
    sign = sign or known.sign
    content: dict[str, Any] = {
        "sign": sign,
        "counts_per_revolution": here.counts_per_revolution,
        "uncertainty": radians(uncertainty_deg),
        "zero_shift": _zero_shifts(configuration),
    }
    if (zero_counts is None) == (from_pose is None) or (counts is not None and from_pose is None):
        raise BenchError(
            location,
            "--zero-counts and --from-pose" if zero_counts and from_pose else "no measurement",
            "--zero-counts, or --from-pose with or without --counts",
            "Give one of the two.",
        )
    if zero_counts is None:
        angles = tuple(map(radians, from_pose or ()))
        _require_pose(configuration, angles)
        method = method or "locked at the mechanical reference, counts " + ("entered" if counts else "read")
        counts = counts or _live_counts(configuration)
        _require_counts(counts, here.counts_per_revolution)
        a, b, c = angles
        content["zero_count"] = zeros_at(counts, (a, b, c), sign, here.counts_per_revolution)
    else:
        content["zero_count"] = zero_counts
    if not remounted:
        _require_known_zeros(content["zero_count"], sign, configuration, known)
    _add(
        context, CalibrationKind.ENCODERS, content, method or "counts entered", by, expires_days, note, json_
    )


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
    """Set the position of the ball's centre on its tee, in the swing plane."""
    from bench.calibration.calibration import CalibrationKind

    content = {"x": x, "y": y, "uncertainty": uncertainty_mm / 1e3}
    _add(context, CalibrationKind.BALL, content, method, by, expires_days, note, json_)


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
    from bench.calibration.calibration import CalibrationKind

    content = {
        "club": name or context.ensure_object(Session).configuration().swing.club,
        "length_to_face": length,
        "loft": radians(loft_deg),
        "lie": radians(lie_deg),
        "length_uncertainty": length_uncertainty_mm / 1e3,
        "angle_uncertainty": radians(angle_uncertainty_deg),
    }
    _add(context, CalibrationKind.CLUB, content, method, by, expires_days, note, json_)


@app.command()
def valves(
    context: typer.Context,
    centre: Annotated[Three, option("Commands (-1 to 1) that centre the spools.", "SHOULDER ARM WRIST")],
    dead_band: Annotated[Three, option("Overlap to either side of the centre.", "SHOULDER ARM WRIST")],
    uncertainty: Annotated[float, option("Standard uncertainty of both.", "OPENING")],
    method: Method = "values entered",
    by: By = "",
    expires_days: Days = None,
    note: Note = "",
    json_: Json = False,
) -> None:
    """Set the valves' centres and dead bands."""
    from bench.calibration.calibration import CalibrationKind

    content = {"centre": centre, "dead_band": dead_band, "uncertainty": uncertainty}
    _add(context, CalibrationKind.VALVES, content, method, by, expires_days, note, json_)


app.command()(inputs)
app.command()(aerodynamics)


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
    if entries:
        Console().print(listing(entries, calibration_of(configuration, now), now))
    else:
        typer.echo(
            f"bench {bench.id} was never calibrated: all values are nominal, as the configuration has them"
        )
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
    if json_:
        show_json(calibration.record() | {"problems": problems, "replaced": [one.text for one in replaced]})
    else:
        console = Console()
        console.print(f"bench {calibration.bench}, club {calibration.club}", highlight=False)
        console.print(overview(calibration, now))
        for one in replaced:
            console.print(Text(one.text), soft_wrap=True)
        for problem in problems:
            console.print(Text(f"arming blocked: {problem}", "red"), soft_wrap=True)
    exit_unless(not problems)


def _add(
    context: typer.Context,
    kind: CalibrationKind,
    content: dict[str, Any],
    method: str,
    by: str,
    expires_days: int | None,
    note: str,
    json_: bool,
) -> None:
    """Check `content` against its ranges and this bench, store it, and say so."""
    from bench.calibration.archive import keep_calibration
    from bench.calibration.calibration import in_words, require_plausible, values_of

    values = values_of(kind, content, f"calibrate {kind}")
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


def _require_pose(configuration: Configuration, angles: tuple[float, ...]) -> None:
    """Raise BenchError when a joint cannot be at its angle."""
    from bench.control.settings import angle_travel
    from drivers.base import JOINTS

    for name, angle, (low, high) in zip(JOINTS, angles, angle_travel(configuration.plant), strict=True):
        if not low <= angle <= high:
            location, found = f"calibrate encoders: --from-pose, {name}", f"{degrees(angle):g} deg"
            expected = f"{degrees(low):.1f} to {degrees(high):.1f} deg, between its stops"
            raise BenchError(location, found, expected, "Give the angle of the mechanical reference.")


def _require_counts(counts: tuple[int, int, int], counts_per_revolution: int) -> None:
    for i, count in enumerate(counts):
        if not 0 <= count < counts_per_revolution:
            location, expected = f"calibrate encoders: --counts[{i}]", f"0 to {counts_per_revolution - 1}"
            raise BenchError(location, str(count), expected, "Give the count that the encoder shows.")


def _require_known_zeros(
    zeros: Three, sign: tuple[int, int, int], c: Configuration, known: EncoderZeros | Encoders
) -> None:
    """Raise BenchError if `zeros` are far from the `known` ones; those of other encoders are unknown."""
    from drivers.base import JOINTS
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


def _live_counts(configuration: Configuration) -> tuple[int, int, int]:
    """Return the counts of the running bench; Refused when none runs here or the robot moves."""
    from bench.calibration.calibration import standing_counts
    from bench.records.telemetry.ring import NoRing
    from bench.supervisor.ownership import bench_folder

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
    from bench.records.telemetry.encoder_preset import read_shifts
    from bench.supervisor.ownership import bench_folder

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
        return Text("other club" if entry.subject not in {"", in_force.club} else "superseded", "dim")
    return Text("expired", "bold red") if entry.expired(now) else Text("in force", "green")
