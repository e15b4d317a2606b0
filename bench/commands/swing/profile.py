"""`golfbench profile ...`: list, show, simulate, check and design profiles; nothing here moves a robot."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Console

from bench.base.errors import BenchError, Refused
from bench.base.interrupt import deferred_interrupt
from bench.commands.common.options import (
    ClubName,
    ClusterAddress,
    Json,
    Plot,
    Processes,
    ProfileName,
    argument,
    flag,
    known_profiles,
    option,
    require_picture,
    sweep_engine,
)
from bench.commands.common.output import console_of
from bench.commands.common.progress import progress_bar, progress_of, progress_of_steps
from bench.commands.common.session import Session, exit_unless, show_json

if TYPE_CHECKING:
    from bench.config import Configuration
    from bench.design.designer import SwingDemand
    from bench.golfer.comparison import MotionDeviation
    from bench.golfer.golfer_file import GolferSwing
    from bench.swing.golfers import Golfer
    from bench.swing.profile import Profile
    from sim.plant import PlantParameters

app = typer.Typer(help="List, show, simulate, check and design swing profiles.", no_args_is_help=True)

Name = Annotated[str, argument("PROFILE", "Name or path of a profile.", complete=known_profiles)]


@app.command("list")
def list_profiles(json_: Json = False) -> None:
    """Show the profiles that come with golfbench."""
    from bench.commands.swing.profile_tables import listing
    from bench.swing.library import THESIS, find_profile, profile_names
    from bench.swing.profile import load_profile

    profiles = [(name, load_profile(find_profile(name))) for name in profile_names()]
    if json_:
        keys = ("text", "golfer", "club", "period", "impact_time", "duration", "delivery", "limits")
        found = [{"name": name} | {key: getattr(profile, key) for key in keys} for name, profile in profiles]
        return show_json(found)
    console = Console()
    console.print(listing(profiles) if profiles else "No profiles here yet.")
    console.print(f"Also: golfbench profile simulate {THESIS}, the thesis' own experiment.", highlight=False)


@app.command()
def show(
    context: typer.Context,
    profile: Name,
    plot: Plot = None,
    table: Annotated[
        bool, flag("--table", "Print all of it as one TOML file with its tables, to read or edit.")
    ] = False,
) -> None:
    """Show a profile: phases and times, planned delivery, limits."""
    from bench.commands.swing.profile_tables import details, draw
    from bench.swing.library import find_profile
    from bench.swing.profile import load_profile, profile_text

    require_picture(plot)
    path = find_profile(profile)
    swing = load_profile(path)
    if table:
        typer.echo(profile_text(swing), nl=False)
        return
    plant = context.ensure_object(Session).configuration().plant
    console = Console()
    console.print(details(swing, path, plant), highlight=False)
    if plot is not None:
        draw(swing, plant, plot)
        console.print(f"Picture: {plot}", highlight=False)


@app.command()
def simulate(
    context: typer.Context,
    profile: Annotated[
        str,
        argument(
            "PROFILE",
            'Name or path of a profile, or "thesis" for the thesis experiment.',
            complete=known_profiles,
        ),
    ],
    output: Annotated[
        Path | None, option("Folder for pictures and records.", "DIR", shown="DATA_DIR/simulations/NAME")
    ] = None,
    club: ClubName = None,
    ball: Annotated[str | None, option("Ball of the configuration.", "NAME")] = None,
    json_: Json = False,
) -> None:
    """Simulate one swing and show the result.

    Exits with 1 if the shot is invalid.
    """
    from bench.swing.library import THESIS

    configuration = context.ensure_object(Session).configuration()
    if output is None:
        output = configuration.bench.data_dir / "simulations" / Path(profile).stem
    if profile == THESIS:
        from bench.commands.swing.thesis_report import simulate_thesis

        simulate_thesis(output, json_)
        return
    _simulate(configuration, profile, club, ball, output, json_)


def _simulate(
    configuration: Configuration, name: str, club: str | None, ball: str | None, output: Path, json_: bool
) -> None:

    from bench.design.swing_result import outcome_record, outcome_table, write_outcome
    from bench.records.shot.recorded_shot import FlightConditions
    from bench.simulation.simulated_bench import SimulatedBench, simulate_swing
    from bench.supervisor.readiness import assess_bench

    ready = assess_bench(configuration, datetime.now(UTC), name, club=club)
    ready.require_possible()
    swing, configuration = ready.profile, ready.configuration
    plant = configuration.plant_with(ball=ball)
    around = FlightConditions(configuration.air, configuration.wind, configuration.turf)
    bench = SimulatedBench(
        swing, plant, configuration.control, configuration.envelope, configuration.estimator, around
    )
    console = Console()
    waiting = nullcontext() if json_ else console.status(f"swinging {swing.name}")
    with deferred_interrupt() as asked, waiting:
        result = simulate_swing(bench, stop=asked.is_made)
        record = outcome_record(result, datetime.now(UTC))
        files = write_outcome(output, result, bench.metadata(record | result.replay_metadata()))
    if json_:
        show_json(record | {"files": [str(file) for file in files]})
    else:
        console.print(outcome_table(result, plant, record))
        console.print("Files: " + ", ".join(map(str, files)), highlight=False)
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

    Each reaction, each valve stuck open or shut, a silent bench, a missing ball and a fat shot, against the
    ratings of stops and chambers. Exits with 1 if any of them ends unsafe.
    """
    from bench.commands.swing.profile_tables import check_record, check_table
    from bench.design.stop_verification import SwingCheck, summarise
    from bench.supervisor.readiness import assess_bench

    configuration = context.ensure_object(Session).configuration()
    ready = assess_bench(configuration, datetime.now(UTC), profile, club=club)
    ready.require_possible()
    swing, configuration = ready.profile, ready.configuration
    bench = SwingCheck(
        configuration.plant, swing, configuration.control, configuration.envelope, configuration.estimator
    )
    with progress_of(f"checking {swing.name}") as part:
        outcomes = bench.outcomes(spacing=spacing, progress=part)
    summaries = summarise(outcomes)
    if json_:
        show_json(check_record(swing.name, outcomes, summaries))
    else:
        Console().print(check_table(swing.name, outcomes, summaries))
    exit_unless(not any(summary.unsafe for summary in summaries))


Output = Annotated[
    Path | None,
    argument("FILE", "Profile to write, .toml, with its table next to it.", shown="CLUB-SPEEDmps.toml"),
]
GolferName = Annotated[
    str | None, option("Golfer to imitate: a built-in one or a measured NAME.golfer.toml.", "NAME")
]
Follow = Annotated[
    Literal["body", "club"],
    option("Motion taken from a measured golfer: shoulders, arm and club, or the club alone, ball on ball."),
]
HeadSpeed = Annotated[
    float | None,
    option("Head speed at the ball.", "M_PER_S", low=5.0, high=60.0, shown="45, or the golfer's"),
]
Attack = Annotated[
    float | None,
    option("Attack angle, + up.", "DEG", low=-8.0, high=8.0, shown="0, or that of a measured golfer"),
]
Lean = Annotated[
    float | None,
    option(
        "Shaft lean at the ball, in the swing plane; negative with leading hands.",
        "DEG",
        low=-12.0,
        high=3.0,
        shown="the easiest within 1.5 deg; on turf up to 10 deg of leading hands",
    ),
]
Strike = Annotated[float, option("Ball off the face's centre, + up the plane.", "MM", low=-20.0, high=20.0)]
BeforeStop = Annotated[
    float, option("Least time from the ball to where the wrist meets its stop.", "MS", low=0.0, high=5.0)
]
Margin = Annotated[float, option("Share of each valve reserved for feedback.", "PERCENT", low=0.0, high=50.0)]
Backswing = Annotated[
    float | None, option("Duration of the backswing.", "S", low=0.5, high=3.0, shown="0.85, or the golfer's")
]
Downswing = Annotated[
    float | None,
    option(
        "Duration of the downswing up to the ball, within 5 ms.",
        "S",
        low=0.15,
        high=0.5,
        shown="0.15 to 0.25, or about that of the swing that is followed",
    ),
]
Highest = Annotated[bool, flag("--highest", "Only show the highest head speed and what limits it.")]
Nearest = Annotated[
    bool,
    flag(
        "--nearest",
        "If out of reach, design the nearest swing and show the deviations: downswing time, "
        "attack angle, head speed.",
    ),
]
Start = Annotated[
    str | None,
    option(
        'Swing to start the optimization from, or "nothing".',
        "PROFILE",
        shown="the configuration's",
        names="--from",
    ),
]
Near = Annotated[str | None, option("Keep near the downswing of this swing.", "PROFILE", names="--near")]


_ASK_FOR_LESS = (
    "Ask for less --speed, a steeper --attack angle or a longer --backswing; --highest shows the highest "
    "speed, --nearest gives way, --before-stop 0 lets the wrist meet its stop at the ball."
)
"""Action after a failed design."""


@app.command()
def design(
    context: typer.Context,
    output: Output = None,
    club: ClubName = None,
    golfer: GolferName = None,
    follow: Follow = "body",
    near: Near = None,
    speed: HeadSpeed = None,
    attack: Attack = None,
    lean: Lean = None,
    strike: Strike = 0.0,
    before_stop: BeforeStop = 1.2,
    margin: Margin = 15.0,
    backswing: Backswing = None,
    downswing: Downswing = None,
    highest: Highest = False,
    nearest: Nearest = False,
    start: Start = None,
    processes: Processes = 0,
    cluster: ClusterAddress = "",
) -> None:
    """Design a swing for the configured plant: the head's speed, angles and strike point at the ball.

    Deterministic. A demand out of reach is refused with its limit; --nearest designs the nearest swing and
    shows the deviations. A swing that `golfbench check` would refuse is not written.
    """
    from bench.design.designer import DesignFailed, SwingDemand
    from bench.design.requirements import require_planned_openings

    configuration = context.ensure_object(Session).configuration().with_club(club)
    require_planned_openings(configuration.control)
    plant = configuration.plant
    whose = _golfer_followed(plant, golfer, follow)
    demand = SwingDemand(
        head_speed=45.0 if speed is None else speed,
        attack=math.radians(attack or 0.0),
        lean=None if lean is None else math.radians(lean),
        strike=strike / 1e3,
        before_stop=before_stop / 1e3,
        margin=margin / 100,
        nearest=nearest,
    )
    asked = speed, None if attack is None else math.radians(attack)
    demand = _with_motion(demand, plant, whose, near, asked, (backswing, downswing))
    begin = None if start == "nothing" else start or near or configuration.swing.profile
    title = (whose.name if whose else plant.robot.club.name) + ("-club" if follow == "club" else "")
    path = output or Path(f"{title}-{demand.head_speed:g}mps.toml")
    try:
        if highest:
            return _show_highest_speed(configuration, demand, begin, (processes, cluster))
        _save_design(configuration, demand, begin, path, whose)
    except DesignFailed as failure:
        raise BenchError(
            "profile design", str(failure), "a swing that this plant can do", _ASK_FOR_LESS
        ) from None
    typer.echo(f"Next: golfbench profile check {path}" + (f" --club {club}" if club else ""))


def _golfer_followed(plant: PlantParameters, name: str | None, follow: str) -> Golfer | GolferSwing | None:
    """Return the golfer called `name` with the angles that are followed; None without a name."""
    from bench.golfer.comparison import golfer_named, with_club_held
    from bench.golfer.golfer_file import GolferSwing

    golfer = None if name is None else golfer_named(name)
    if follow == "body":
        return golfer
    if not isinstance(golfer, GolferSwing):
        action = "Name a file of golfbench golfer import, or leave --follow out."
        raise BenchError("--follow", "club", "also --golfer NAME.golfer.toml", action)
    return with_club_held(plant, golfer)


def _show_deviation(plant: PlantParameters, row: MotionDeviation) -> None:
    """Print the deviation of a design from its golfer, and the golfer's excess beyond the robot's ranges."""
    from bench.commands.swing.golfer_tables import PIPED_WIDTH, beyond_text, comparison_table
    from bench.golfer.comparison import beyond_ranges

    console = console_of(PIPED_WIDTH)
    console.print(comparison_table([row]), highlight=False)
    moving = row.reference.angle[row.reference.in_downswing]
    console.print(beyond_text(beyond_ranges(plant, moving)), highlight=False, soft_wrap=True)


def _with_motion(
    demand: SwingDemand,
    plant: PlantParameters,
    golfer: Golfer | GolferSwing | None,
    near: str | None,
    asked: tuple[float | None, float | None],
    times: tuple[float | None, float | None],
) -> SwingDemand:
    """Return `demand` as `golfer` would swing, or near the profile `near`.

    The speed (m/s) and attack (rad) in `asked` and the `times` of backswing and downswing (s) override those
    of golfer and profile.
    """
    from bench.design.golfer_tracking import TEMPO, demand_like, demand_measured, demand_near
    from bench.swing.golfers import Golfer, human_downswing
    from bench.swing.library import find_profile
    from bench.swing.profile import load_profile

    if golfer is not None and near is not None:
        raise Refused(
            "profile design", "--golfer and --near", "one of the two", "Leave out --golfer or --near."
        )
    if isinstance(golfer, Golfer):
        demand = demand_like(plant, golfer, human_downswing(plant, golfer), demand, asked[0])
    elif golfer is not None:
        demand = demand_measured(plant, golfer, demand, *asked)
    if near is not None:
        demand = demand_near(plant, load_profile(find_profile(near)), demand)
    backswing, downswing = times
    if downswing is not None:
        demand = replace(demand, downswing_time=(downswing - TEMPO, downswing + TEMPO))
    return demand if backswing is None else replace(demand, backswing_time=backswing)


def _profile_named(name: str | None) -> Profile | None:
    from bench.swing.library import find_profile
    from bench.swing.profile import load_profile

    return None if name is None else load_profile(find_profile(name))


def _show_highest_speed(
    configuration: Configuration,
    demand: SwingDemand,
    begin: str | None,
    workers: tuple[int, str],
) -> None:
    """Print the highest head speed, its limit, and what would raise it; `workers`: processes or cluster."""
    from bench.design.highest_speed import TOGETHER, DownswingStudy, highest_speed

    study = DownswingStudy(configuration, demand, _profile_named(begin))
    with sweep_engine(configuration, *workers, TOGETHER) as engine, progress_bar() as bar:
        task = bar.add_task("", total=None)
        found = highest_speed(study, engine, lambda what: bar.update(task, description=what))
    typer.echo(
        f"At most {found.plan.speed:.1f} m/s at the ball, {100 * demand.margin:g} % of each valve left to "
        "feedback, cushions kept when the ball is missed or the bench falls silent;\n"
        f"{found.limit}."
    )
    for name, gain in list(found.plan.binding.items())[:5]:
        typer.echo(f"  one per cent more of {name}: {gain:+.3f} m/s")


def _save_design(
    configuration: Configuration,
    demand: SwingDemand,
    begin: str | None,
    path: Path,
    golfer: Golfer | GolferSwing | None,
) -> None:
    """Design a swing, save it at `path`, print its delivery, cushions and deviation from `golfer`."""
    from bench.design.designer import design_swing
    from bench.design.golfer_tracking import gave_way
    from bench.golfer.comparison import compare_motions, followed_golfer, golfer_motion, robot_motion
    from bench.golfer.golfer_file import GolferSwing
    from bench.swing.profile import save_profile

    start = _profile_named(begin)
    with progress_of_steps() as progress:
        made = design_swing(
            configuration,
            demand,
            path.stem,
            golfer="robot" if golfer is None else golfer.name,
            text="" if golfer is None else f"as close to a golfer as the robot can: {golfer.text}",
            start=start,
            progress=progress,
        )
    given = gave_way(demand, made.profile)
    swing = replace(made.profile, text="; ".join([made.profile.text, *given]))
    plant = configuration.plant
    row = None
    if golfer is not None:
        row = compare_motions(golfer_motion(plant, golfer), robot_motion(plant, swing))
        if isinstance(golfer, GolferSwing):
            swing = replace(swing, followed=followed_golfer(golfer, row))
    save_profile(path, swing)
    delivery, limits = swing.delivery, swing.limits
    typer.echo(
        f"{path}: in closed loop {delivery['head_speed_mps']:.2f} m/s, "
        f"attack {delivery['attack_angle_deg']:+.2f} deg, lean {delivery['shaft_lean_deg']:+.2f} deg, "
        f"strike {delivery['in_plane_error_mm']:+.2f} mm."
    )
    typer.echo(
        f"Cushions at most: {100 * limits['stop_share']:.0f} % struck, "
        f"{100 * limits['stop_share_missed']:.0f} % missed, {100 * limits['stop_share_silent']:.0f} % silent."
    )
    typer.echo("Possible on this machine: it passes the checks of `golfbench check`.")
    if given:
        typer.echo("Gave way: " + "; ".join(given) + ".")
    if row is not None:
        _show_deviation(plant, row)


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
    from bench.simulation.series import Bench
    from bench.supervisor.readiness import assess_bench
    from bench.swing.library import PROFILES

    c = context.ensure_object(Session).configuration()
    ready = assess_bench(c, datetime.now(UTC), profile, club=club)
    ready.require_possible()
    swing, path, plant = ready.profile, ready.file, ready.configuration.plant
    beside, stored = c.limits_files(path)
    file = output or (stored if path.parent == PROFILES else beside)
    bench = Bench(plant, swing, c.control, c.envelope, c.estimator)
    with sweep_engine(c, processes, cluster, draws) as engine, progress_of(f"swinging {swing.name}") as part:
        made = make_limits(bench, draws, part, engine)
    file.parent.mkdir(parents=True, exist_ok=True)
    save_limits(file, made)
    Console().print(f"{file}: limits from {draws} known robots", highlight=False)


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
    from bench.swing.library import find_profile
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
