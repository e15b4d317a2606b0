"""`golfbench profile ...`: list, show, simulate, check and design profiles; nothing here moves a robot."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from bench.base.atomic_file import atomic_path
from bench.base.errors import BenchError
from bench.base.interrupt import deferred_interrupt
from bench.commands.common import (
    ClubName,
    ClusterAddress,
    Json,
    Processes,
    ProfileName,
    Session,
    argument,
    exit_unless,
    flag,
    known_profiles,
    option,
    plain_table,
    progress_of,
    show_result,
    sweep_engine,
)
from bench.commands.swing.profile_design import design
from bench.swing.library import PROFILES, find_profile, profile_names
from drivers.base import ACTUATORS, CHAMBERS

if TYPE_CHECKING:
    from bench.design.stop_verification import TrialOutcome, TrialSummary
    from bench.simulation.simulated_bench import SwingResult
    from bench.swing.profile import FollowedGolfer, Profile
    from sim.plant import PlantParameters

app = typer.Typer(help="List, show, simulate, check and design swing profiles.", no_args_is_help=True)

app.command()(design)

Name = Annotated[str, argument("PROFILE", "Name or path of a profile.", complete=known_profiles)]


@app.command("list")
def list_profiles(json_: Json = False) -> None:
    """Show the profiles that come with golfbench."""
    from bench.swing.profile import load_profile

    profiles = [(name, load_profile(find_profile(name))) for name in profile_names()]
    keys = ("text", "golfer", "club", "period", "impact_time", "duration", "delivery", "limits")
    found = [{"name": name} | {key: getattr(profile, key) for key in keys} for name, profile in profiles]
    show_result(json_, found, listing(profiles) if profiles else "No profiles here yet.")


@app.command()
def show(
    context: typer.Context,
    profile: Name,
    table: Annotated[
        bool, flag("--table", "Print all of it as one TOML file with its tables, to read or edit.")
    ] = False,
) -> None:
    """Show a profile: phases and times, planned delivery, limits."""
    from bench.swing.profile import load_profile, profile_text

    path = find_profile(profile)
    swing = load_profile(path)
    if table:
        typer.echo(profile_text(swing), nl=False)
        return
    plant = context.ensure_object(Session).configuration().plant
    Console().print(details(swing, path, plant), highlight=False)


@app.command()
def simulate(
    context: typer.Context,
    profile: Name,
    output: Annotated[
        Path | None, option("Folder for the record.", "DIR", shown="DATA_DIR/simulations/NAME")
    ] = None,
    club: ClubName = None,
    ball: Annotated[str | None, option("Ball of the configuration.", "NAME")] = None,
    json_: Json = False,
) -> None:
    """Simulate one swing and show the result.

    Exits with 1 if the shot is invalid.
    """
    from bench.records.telemetry.record_file import write_swing
    from bench.simulation.simulated_bench import Bench, simulate_swing
    from bench.supervisor.readiness import assess_bench

    configuration = context.ensure_object(Session).configuration()
    if output is None:
        output = configuration.bench.data_dir / "simulations" / Path(profile).stem
    ready = assess_bench(configuration, datetime.now(UTC), profile, club=club)
    ready.require_possible()
    swing, configuration = ready.profile, ready.configuration
    plant = configuration.plant_with(ball=ball)
    bench = Bench.of(replace(configuration, plant=plant), swing)
    waiting = nullcontext() if json_ else Console().status(f"swinging {swing.name}")
    with deferred_interrupt() as asked, waiting:
        result = simulate_swing(bench, stop=asked.is_made)
        record = _outcome_record(result, datetime.now(UTC))
        output.mkdir(parents=True, exist_ok=True)
        file = output / "swing.parquet"
        write_swing(file, result.cycles, bench.metadata(record | result.replay_metadata()))
    table = _outcome_table(result, plant, record)
    show_result(json_, record | {"files": [str(file)]}, table, f"Record: {file}")
    exit_unless(not result.reason)


@app.command()
def check(
    context: typer.Context,
    profile: ProfileName = None,
    club: ClubName = None,
    spacing: Annotated[int, option("Ticks between tested instants.", low=1)] = 20,
    json_: Json = False,
) -> None:
    """Check on the simulated plant how every stop ends, from every instant of a swing.

    Each reaction, each valve stuck open or shut, loss of communication, a missing ball and a fat shot,
    against the ratings of end stops and chambers. Exits with 1 if any of them ends unsafe.
    """
    from bench.design.stop_verification import SwingCheck, summarise
    from bench.simulation.simulated_bench import Bench
    from bench.supervisor.readiness import assess_bench

    configuration = context.ensure_object(Session).configuration()
    ready = assess_bench(configuration, datetime.now(UTC), profile, club=club)
    ready.require_possible()
    swing, configuration = ready.profile, ready.configuration
    checked = SwingCheck(Bench.of(configuration, swing))
    with progress_of(f"checking {swing.name}") as part:
        outcomes = checked.outcomes(spacing=spacing, progress=part)
    summaries = summarise(outcomes)
    shown = swing.name, outcomes, summaries
    show_result(json_, check_record(*shown), check_table(*shown))
    exit_unless(not any(summary.unsafe for summary in summaries))


@app.command()
def limits(
    context: typer.Context,
    profile: Name,
    output: Annotated[
        Path | None,
        option(
            "File to write.",
            "FILE",
            shown="next to the profile; DATA_DIR/limits for a built-in one",
        ),
    ] = None,
    club: ClubName = None,
    draws: Annotated[int, option("Robots drawn; half as many more to learn on.", low=30)] = 300,
    processes: Processes = 0,
    cluster: ClusterAddress = "",
) -> None:
    """Make the limits of the model-based check for a profile on the configured plant.

    Draws robots within their tolerances, swings and stops each without a fault, and sets the limits above all
    their deviations. Minutes.
    """
    from bench.control.residual_thresholds import save_limits
    from bench.design.threshold_generation import make_limits
    from bench.simulation.simulated_bench import Bench
    from bench.supervisor.readiness import assess_bench

    c = context.ensure_object(Session).configuration()
    ready = assess_bench(c, datetime.now(UTC), profile, club=club)
    ready.require_possible()
    swing, path, plant = ready.profile, ready.file, ready.configuration.plant
    beside, stored = c.limits_files(path)
    file = output or (stored if path.parent == PROFILES else beside)
    bench = Bench.of(replace(c, plant=plant), swing)
    with sweep_engine(c, processes, cluster, draws) as engine, progress_of(f"swinging {swing.name}") as part:
        made = make_limits(bench, draws, part, engine)
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(file) as partial:
        save_limits(partial, made)
    typer.echo(f"{file}: limits from {draws} known robots")


@app.command()
def address(
    context: typer.Context,
    profile: Name,
    output: Annotated[Path, option("Profile to write; its table is written next to it.", "FILE")],
    club: ClubName = None,
) -> None:
    """Plan the chamber pressures at the address of a profile, for the configured plant.

    The bench brings the chambers to them before it permits a swing, so that a swing does not depend on how
    the robot came to its address.
    """
    from bench.control.moves.pressure_plan import with_planned_air
    from bench.swing.profile import load_profile, save_profile

    plant = context.ensure_object(Session).configuration().with_club(club).plant
    path = find_profile(profile)
    try:
        planned = with_planned_air(load_profile(path), plant)
    except ValueError as error:
        action = "Check the plant, or design another address."
        raise BenchError(str(path), str(error), "an address that the plant can hold", action) from None
    save_profile(output, planned)
    pressures = ", ".join(f"{pressure / 1e5:.2f}" for pressure in planned.air)
    typer.echo(f"{output}: chambers at {pressures} bar absolute, supply {planned.air_supply / 1e5:.2f} bar.")


# Tables ----------------------------------------------------------------------------------------------

_BARS = " ▁▂▃▄▅▆▇█"
_WIDTH = 64
_UNITS = {"mps": "m/s", "deg": "°", "mm": "mm", "m": "m", "s": "s", "j": "J", "pa": "Pa"}


_YARD = 0.9144

_FIGURES = (
    ("club speed", "club_speed_mps", "{:.2f} m/s"),
    ("attack angle", "attack_angle_deg", "{:+.2f}°"),
    ("club path", "club_path_deg", "{:+.2f}°"),
    ("face angle", "face_angle_deg", "{:+.2f}°"),
    ("dynamic loft", "dynamic_loft_deg", "{:.2f}°"),
    ("strike, heel-toe", "strike_x_mm", "{:+.1f} mm"),
    ("strike, low-high", "strike_y_mm", "{:+.1f} mm"),
    ("ball speed", "ball_speed_mps", "{:.2f} m/s"),
    ("launch angle", "launch_angle_deg", "{:.2f}°"),
    ("direction", "direction_deg", "{:+.2f}°"),
    ("spin", "spin_rpm", "{:.0f} rpm"),
    ("spin axis", "spin_axis_deg", "{:+.2f}°"),
    ("carry", "carry_m", "{:.1f} m"),
    ("total", "total_m", "{:.1f} m"),
)
"""Name, field of Shot, form."""


def _outcome_record(result: SwingResult, time: datetime) -> dict[str, Any]:
    shot = asdict(result.shot(1, time_utc=time).shot)
    shot["time_utc"] = time.isoformat(timespec="seconds")
    return {
        "shot": shot,
        "cause": result.cause.name,
        "contact_time_s": result.contact_time,
        "peak_head_speed_mps": result.loads.peak_head_speed,
        "lowest_clearance_m": result.loads.lowest_clearance,
        "stop_energy_j": dict(zip(ACTUATORS, result.loads.stop_energy.max(axis=1).tolist(), strict=True)),
        "peak_pressure_pa": dict(zip(CHAMBERS, result.loads.peak_pressure.tolist(), strict=True)),
        "unsafe": result.unsafe,
    }


def _outcome_table(result: SwingResult, plant: PlantParameters, record: Mapping[str, Any]) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_header=False, title_justify="left")
    table.title = Text(result.reason or "a valid shot", "bold red" if result.reason else "bold green")
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    for name, field, form in _FIGURES:
        if (value := record["shot"][field]) is not None:
            yards = f"  ({value / _YARD:.1f} yd)" if field in ("carry_m", "total_m") else ""
            table.add_row(name, form.format(value) + yards)
    table.add_section()
    for actuator, energy, name in zip(
        plant.actuators, result.loads.stop_energy.max(axis=1), ACTUATORS, strict=True
    ):
        table.add_row(f"end stop, {name}", f"{energy:.1f} of {actuator.stop.rating:g} J")
    table.add_row("highest pressure", f"{result.loads.peak_pressure.max() / 1e5:.2f} bar absolute")
    table.add_row("sole over ground", f"at least {1e3 * result.loads.lowest_clearance:.1f} mm")
    for danger in result.unsafe:
        table.add_row("unsafe", Text(danger, "bold red"))
    return table


def listing(profiles: list[tuple[str, Profile]]) -> Table:
    """Return the table of `golfbench profile list`; pairs of name and profile.

    One line each, whatever the width: `golfbench profile show NAME` prints the whole text.
    """
    table = plain_table(expand=True)
    table.add_column("name", no_wrap=True)
    table.add_column("club", no_wrap=True)
    table.add_column("m/s", no_wrap=True, justify="right")
    table.add_column("attack °", no_wrap=True, justify="right")
    table.add_column("description", no_wrap=True, overflow="ellipsis", ratio=1)  # the only flexible column
    for name, profile in profiles:
        speed = _figure(profile, "head_speed_mps", ".1f")
        attack = _figure(profile, "attack_angle_deg", "+.1f")
        table.add_row(*map(Text, (name, profile.club, speed, attack, profile.text)))
    return table


def _figure(profile: Profile, key: str, form: str) -> str:
    value = profile.delivery.get(key)
    return "" if value is None else format(round(value, 1) + 0.0, form)


def details(profile: Profile, path: Path, plant: PlantParameters) -> Group:
    """Return everything `golfbench profile show` prints."""
    head = Text(f"{profile.name}", "bold")
    head.append(f"  {profile.text}\n{path}", "not bold")
    facts = _table("", "", title="")
    for name, value in (
        ("golfer", profile.golfer),
        ("club", profile.club),
        ("ball", f"x {profile.ball[0]:.3f} m, y {profile.ball[1]:.3f} m in the swing plane"),
        ("planned contact", f"{profile.impact_time:.4f} s"),
        ("no return after", f"{profile.begins[4] * profile.period:.3f} s"),
        ("samples", f"{len(profile.angle)} every {1e3 * profile.period:g} ms"),
        ("blind brakes", f"{len(profile.blind_brake)}, every {profile.blind_spacing} samples"),
    ):
        facts.add_row(name, Text(value))
    followed = [] if profile.followed is None else [_deviation(profile.followed)]
    return Group(head, facts, *followed, _phases(profile), _speed_line(profile, plant), *_groups(profile))


def _table(*columns: str, title: str) -> Table:
    table = plain_table(title=title or None, title_justify="left", title_style="bold")
    for i, column in enumerate(columns):
        table.add_column(column, justify="right" if i and column else "left", no_wrap=True)
    table.show_header = any(columns)
    return table


def _deviation(followed: FollowedGolfer) -> Group:
    """Return the deviation of a profile from the measured swing that it follows."""
    from bench.golfer.comparison import followed_texts

    table = _table("", "", title=f"Deviation from the golfer's {followed['follow']}")
    for row in zip(("shoulder", "arm", "wrist", "head"), followed_texts(followed), strict=True):
        table.add_row(*row)
    speed = f"Golfer's head speed at the ball: {followed['head_speed_mps']:.1f} m/s."
    source = f"SHA-256 of the golfer's file:\n{followed['sha256']}"
    return Group(table, Text(f"{followed['definition']}. {speed} {source}\n"))


def _phases(profile: Profile) -> Table:
    import numpy as np

    from bench.swing.actuator_motion import phase_times

    table = _table("phase", "begins, s", "lasts, s", "greatest speed, rad/s", title="Phases")
    for phase, begin, end in phase_times(profile):
        rows = slice(round(begin / profile.period), round(end / profile.period))
        speed = np.abs(profile.velocity[rows]).max(axis=0) if rows.stop > rows.start else np.zeros(3)
        fastest = " / ".join(f"{value:.1f}" for value in speed)
        table.add_row(phase.name.lower().replace("_", " "), f"{begin:.3f}", f"{end - begin:.3f}", fastest)
    return table


def _speed_line(profile: Profile, plant: PlantParameters) -> Text:
    """Return the head's speed over time as a row of bars, the column of the contact marked."""
    import numpy as np

    from bench.swing.actuator_motion import Motion

    speed = Motion(profile, plant).head_speed
    columns = np.array_split(speed, min(_WIDTH, len(speed)))
    heights = [int(np.ceil(part.max() / speed.max() * (len(_BARS) - 1))) for part in columns]
    contact = int(profile.impact_time / profile.duration * len(columns))
    line = Text(f"head, at most {speed.max():.1f} m/s\n", "bold")
    for column, height in enumerate(heights):
        line.append(_BARS[height], "bold red" if column == contact else "cyan")
    line.append(f"\n0 s{'':{len(columns) - 9}}{profile.duration:.2f} s   red: the ball", "not bold")
    return line


def _groups(profile: Profile) -> list[Table]:
    tables = []
    for title, values in (("Planned delivery", profile.delivery), ("Limits it was made for", profile.limits)):
        table = _table("", "value", "unit", title=title)
        table.columns[2].justify = "left"
        table.show_header = False
        for name, value in values.items():
            what, _, suffix = name.rpartition("_")
            known = suffix in _UNITS
            table.add_row((what if known else name).replace("_", " "), f"{value:.6g}", _UNITS.get(suffix, ""))
        tables.append(table)
    return tables


def check_table(name: str, outcomes: list[TrialOutcome], summaries: list[TrialSummary]) -> Table:
    """Return one row a fault: how many instants, the worst ends and when they began."""
    unsafe = sum(bool(outcome.unsafe) for outcome in outcomes)
    table = Table(
        title=f"{name}: {len(outcomes)} cases, {unsafe} end unsafe",
        caption="Shares are of the rating; instants are seconds from the start of the swing.",
    )
    table.add_column("fault")
    for heading in ("cases", "unsafe", "most energy in a stop", "highest pressure", "clearance mm"):
        table.add_column(heading, justify="right")
    table.add_column("at rest after s", justify="right")
    for summary in summaries:
        stop, pressure = summary.worst_stop, summary.worst_pressure
        lowest, slowest = summary.lowest, summary.slowest
        table.add_row(
            summary.fault,
            str(summary.instants),
            f"[red]{summary.unsafe}[/red]" if summary.unsafe else "0",
            f"{100 * stop.stop_share:.0f} % {stop.stop} @{stop.time:.2f}",
            f"{100 * pressure.pressure_share:.0f} % @{pressure.time:.2f}",
            f"{1e3 * lowest.clearance:.0f} @{lowest.time:.2f}",
            f"{slowest.rest_time:.2f} @{slowest.time:.2f}",
        )
    return table


def check_record(name: str, outcomes: list[TrialOutcome], summaries: list[TrialSummary]) -> dict[str, Any]:
    """Return all outcomes as a JSON-ready record; a time that never came is null."""

    def one(outcome: TrialOutcome) -> dict[str, Any]:
        record = {key: getattr(outcome, key) for key in outcome.__dataclass_fields__}
        rests = outcome.rest_time < float("inf")
        return record | {
            "phase": outcome.phase.name,
            "cause": outcome.cause.name,
            "rest_time": outcome.rest_time if rests else None,
            "unsafe": outcome.unsafe,
        }

    return {
        "schema_version": 1,
        "profile": name,
        "cases": len(outcomes),
        "unsafe": {summary.fault: summary.unsafe for summary in summaries},
        "outcomes": [one(outcome) for outcome in outcomes],
    }
