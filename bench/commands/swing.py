"""`golfbench swing ...`: show, simulate, check and design profiles."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import TaskID

from bench.commands.compare import compare
from bench.commands.picture import Plot, require_picture
from bench.commands.progress import progress_bar
from bench.commands.session import ClubName, Json, ProfileName, Session, show_json
from bench.commands.sweep_engine import ClusterAddress, Processes, sweep_engine
from bench.errors import BenchError, ExitCode, Refused
from bench.interrupt import deferred_interrupt

if TYPE_CHECKING:
    from bench.config import Configuration
    from bench.design.designer import SwingDemand
    from bench.golfer import GolferSwing
    from bench.swing.golfers import Golfer
    from bench.swing.profile import Profile
    from sim.plant import PlantParameters

app = typer.Typer(invoke_without_command=True)
app.command()(compare)

Name = Annotated[str, typer.Argument(metavar="PROFILE", help="Name or path of a profile.")]


@app.callback()
def swing(
    context: typer.Context,
    no_wait: Annotated[
        bool, typer.Option("--no-wait", help="Return once the swing has begun, without its delivery.")
    ] = False,
    timeout: Annotated[
        float, typer.Option(metavar="S", min=1.0, max=600.0, help="Longest time to wait for its record.")
    ] = 60.0,
) -> None:
    """Swing, if the bench is ARMED, and print the delivery; or show, simulate, check and design profiles."""
    if context.invoked_subcommand is None:
        from bench.commands.operate import swing_when_armed

        swing_when_armed(context, not no_wait, timeout)


@app.command("list")
def list_profiles(json_: Json = False) -> None:
    """Show the profiles that come with golfbench."""
    from bench.commands.swing_tables import listing
    from bench.swing.library import THESIS, find_profile, profile_names
    from bench.swing.profile import load_profile

    profiles = [(name, load_profile(find_profile(name))) for name in profile_names()]
    if json_:
        keys = ("text", "golfer", "club", "period", "impact_time", "duration", "delivery", "limits")
        found = [{"name": name} | {key: getattr(profile, key) for key in keys} for name, profile in profiles]
        show_json(found)
        return
    console = Console()
    console.print(listing(profiles) if profiles else "No profiles here yet.")
    console.print(f"Also: golfbench swing simulate {THESIS}, the thesis' own experiment.", highlight=False)


@app.command()
def show(
    context: typer.Context,
    profile: Name,
    plot: Plot = None,
    table: Annotated[
        bool,
        typer.Option("--table", help="Print all of it as one TOML file with its tables, to read or edit."),
    ] = False,
) -> None:
    """Show a profile: phases and times, planned delivery, limits."""
    from bench.commands.swing_tables import details, draw
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
        typer.Argument(
            metavar="PROFILE", help='Name or path of a profile, or "thesis" for the thesis experiment.'
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder for pictures and records.", show_default="DATA_DIR/simulations/NAME"
        ),
    ] = None,
    club: ClubName = None,
    ball: Annotated[str | None, typer.Option(metavar="NAME", help="Ball of the configuration.")] = None,
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
        from bench.commands.thesis_report import simulate_thesis

        simulate_thesis(output, json_)
        return
    _simulate(configuration, profile, club, ball, output, json_)


def _simulate(
    configuration: Configuration, name: str, club: str | None, ball: str | None, output: Path, json_: bool
) -> None:

    from bench.design.outcome import outcome_record, outcome_table, write_outcome
    from bench.readiness import assess_bench
    from bench.shot.recorded_shot import FlightConditions
    from bench.simulation.simulated_bench import SimulatedBench, simulate_swing

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
    if result.reason:
        raise typer.Exit(ExitCode.REFUSED)


@app.command()
def check(
    context: typer.Context,
    profile: ProfileName = None,
    club: ClubName = None,
    spacing: Annotated[int, typer.Option(min=1, help="Ticks between tested instants.")] = 20,
    json_: Json = False,
) -> None:
    """Check on the simulated plant how every stop ends, from every instant of a swing.

    Each reaction, each valve stuck open or shut, a silent bench, a missing ball and a fat shot, against the
    ratings of stops and chambers. Exits with 1 if any of them ends unsafe.
    """
    from bench.commands.check_table import check_record, check_table
    from bench.design.check import SwingCheck, summarise
    from bench.readiness import assess_bench

    configuration = context.ensure_object(Session).configuration()
    ready = assess_bench(configuration, datetime.now(UTC), profile, club=club)
    ready.require_possible()
    swing, configuration = ready.profile, ready.configuration
    bench = SwingCheck(
        configuration.plant, swing, configuration.control, configuration.envelope, configuration.estimator
    )
    with progress_bar() as bar:
        task = bar.add_task(f"checking {swing.name}", total=1.0)
        outcomes = bench.outcomes(spacing=spacing, progress=lambda part: bar.update(task, completed=part))
        bar.update(task, completed=1.0)
    summaries = summarise(outcomes)
    if json_:
        show_json(check_record(swing.name, outcomes, summaries))
    else:
        Console().print(check_table(swing.name, outcomes, summaries))
    if any(summary.unsafe for summary in summaries):
        raise typer.Exit(ExitCode.REFUSED)


Output = Annotated[
    Path | None,
    typer.Argument(
        metavar="FILE",
        help="Profile to write, .toml, with its table beside it.",
        show_default="CLUB-SPEEDmps.toml",
    ),
]
GolferName = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Golfer to imitate: a built-in one or a measured NAME.golfer.toml."),
]
Follow = Annotated[
    str,
    typer.Option(
        metavar="body|club",
        help="Of a measured golfer: angles of shoulders, arm and club, or the club alone, ball on ball.",
    ),
]
HeadSpeed = Annotated[
    float | None,
    typer.Option(
        metavar="M_PER_S",
        min=5.0,
        max=60.0,
        help="Head speed at the ball.",
        show_default="45, or the golfer's",
    ),
]
Attack = Annotated[
    float | None,
    typer.Option(
        metavar="DEG",
        min=-8.0,
        max=8.0,
        help="Attack angle, + up.",
        show_default="0, or that of a measured golfer",
    ),
]
Lean = Annotated[
    float | None,
    typer.Option(
        metavar="DEG",
        min=-12.0,
        max=3.0,
        help="Shaft lean at the ball, in the swing plane; negative with leading hands.",
        show_default="the easiest within 1.5 deg; on turf up to 10 deg of leading hands",
    ),
]
Strike = Annotated[
    float, typer.Option(metavar="MM", min=-20.0, max=20.0, help="Ball off the face's centre, + up the plane.")
]
BeforeStop = Annotated[
    float,
    typer.Option(
        metavar="MS", min=0.0, max=5.0, help="Least time from the ball to where the wrist meets its stop."
    ),
]
Margin = Annotated[
    float,
    typer.Option(metavar="PERCENT", min=0.0, max=50.0, help="Share of each valve reserved for feedback."),
]
Backswing = Annotated[
    float | None,
    typer.Option(
        metavar="S", min=0.5, max=3.0, help="Duration of the backswing.", show_default="0.85, or the golfer's"
    ),
]
Downswing = Annotated[
    float | None,
    typer.Option(
        metavar="S",
        min=0.15,
        max=0.5,
        help="Duration of the downswing up to the ball, within 5 ms.",
        show_default="0.15 to 0.25, or about that of the swing that is followed",
    ),
]
Highest = Annotated[
    bool, typer.Option("--highest", help="Only show the highest head speed and what limits it.")
]
Nearest = Annotated[
    bool,
    typer.Option(
        "--nearest",
        help="If out of reach, design the nearest swing and show the deviations: downswing time, "
        "attack angle, head speed.",
    ),
]
Start = Annotated[
    str | None,
    typer.Option(
        "--from",
        metavar="PROFILE",
        help='Swing to start the optimization from, or "nothing".',
        show_default="the configuration's",
    ),
]
Near = Annotated[
    str | None, typer.Option("--near", metavar="PROFILE", help="Keep near the downswing of this swing.")
]


_TEMPO = 0.004
"""Freedom of a demanded duration of the downswing either way, s; the plant adds a tick."""
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
    from bench.design.planned_openings import require_planned_openings

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
    path = output or Path(f"{whose.name if whose else plant.robot.club.name}-{demand.head_speed:g}mps.toml")
    try:
        if highest:
            return _show_highest_speed(configuration, demand, begin, (processes, cluster))
        swing = _save_design(configuration, demand, begin, path, whose)
    except DesignFailed as failure:
        raise BenchError(
            "swing design", str(failure), "a swing that this plant can do", _ASK_FOR_LESS
        ) from None
    if whose is not None:
        _show_deviations(plant, whose, swing)
    typer.echo(f"Next: golfbench swing check {path}" + (f" --club {club}" if club else ""))


def _golfer_followed(plant: PlantParameters, name: str | None, follow: str) -> Golfer | GolferSwing | None:
    """Return the golfer called `name` with the angles that are followed; None without a name."""
    from bench.golfer import GolferSwing, with_club_held

    if follow not in ("body", "club"):
        raise BenchError("--follow", follow[:40], "body or club", "Correct --follow.")
    golfer = None if name is None else _golfer_named(name)
    if follow == "body":
        return golfer
    if not isinstance(golfer, GolferSwing):
        cure = "Name a file of golfbench golfer import, or leave --follow out."
        raise BenchError("--follow", "club", "--golfer NAME.golfer.toml beside it", cure)
    return with_club_held(plant, golfer)


def _golfer_named(name: str) -> Golfer | GolferSwing:
    """Return the built-in golfer `name`, or the measured one in the file of that name."""
    from bench.golfer import SUFFIX, load_golfer
    from bench.swing.golfers import find_golfer

    return load_golfer(Path(name)) if name.endswith(SUFFIX) else find_golfer(name)


def _show_deviations(plant: PlantParameters, golfer: Golfer | GolferSwing, swing: Profile) -> None:
    """Print the deviation of `swing` from that of `golfer`, and the excess beyond the robot's ranges."""
    from bench.commands.golfer_tables import beyond_text, comparison_table
    from bench.golfer import beyond_ranges, compare_motions, measured_motion, model_motion, robot_motion
    from bench.swing.golfers import Golfer

    model = model_motion(plant, golfer) if isinstance(golfer, Golfer) else measured_motion(golfer)
    console = Console()
    console.print(comparison_table([compare_motions(model, robot_motion(plant, swing))]), highlight=False)
    moving = model.angle[model.in_downswing]
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
    from bench.design.follow import demand_like, demand_measured, demand_near
    from bench.swing.golfers import Golfer, human_downswing
    from bench.swing.library import find_profile
    from bench.swing.profile import load_profile

    if golfer is not None and near is not None:
        raise Refused("swing design", "--golfer and --near", "one of them", "Leave one out.")
    if isinstance(golfer, Golfer):
        demand = demand_like(plant, golfer, human_downswing(plant, golfer), demand, asked[0])
    elif golfer is not None:
        demand = demand_measured(plant, golfer, demand, *asked)
    if near is not None:
        demand = demand_near(plant, load_profile(find_profile(near)), demand)
    backswing, downswing = times
    if downswing is not None:
        demand = replace(demand, downswing_time=(downswing - _TEMPO, downswing + _TEMPO))
    return demand if backswing is None else replace(demand, backswing_time=backswing)


def _profile_named(name: str | None) -> Profile | None:
    from bench.swing.library import find_profile
    from bench.swing.profile import load_profile

    return None if name is None else load_profile(find_profile(name))


@contextmanager
def _design_progress() -> Iterator[Callable[[str, float], None]]:
    """Yield a function that shows the finished part (0 to 1) of a step of the design."""
    with progress_bar() as bar:
        tasks: dict[str, TaskID] = {}

        def show(step: str, part: float) -> None:
            if step not in tasks:
                tasks[step] = bar.add_task(step, total=1.0)
            bar.update(tasks[step], completed=part)

        yield show


def _show_highest_speed(
    configuration: Configuration,
    demand: SwingDemand,
    begin: str | None,
    workers: tuple[int, str],
) -> None:
    """Print the highest head speed, its limit, and what would raise it; `workers`: processes, cluster."""
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
) -> Profile:
    """Design a swing, save it at `path`, print its delivery and cushions, and return it."""
    from bench.design.designer import design_swing
    from bench.design.follow import gave_way
    from bench.swing.profile import save_profile

    start = _profile_named(begin)
    with _design_progress() as progress:
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
    return swing


@app.command()
def limits(
    context: typer.Context,
    profile: Name,
    output: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="File to write.",
            show_default="beside the profile; of one that comes with golfbench DATA_DIR/limits",
        ),
    ] = None,
    club: ClubName = None,
    draws: Annotated[int, typer.Option(min=30, help="Robots drawn; half as many more to learn on.")] = 300,
    processes: Processes = 0,
    cluster: ClusterAddress = "",
) -> None:
    """Make the limits of the model-based check for a profile on the configured plant.

    Draws robots within their tolerances, swings and stops each without a fault, and sets the limits above all
    their deviations. Minutes.
    """
    from bench.control.model_limits import save_limits
    from bench.design.model_limits import make_limits
    from bench.readiness import assess_bench
    from bench.simulation.series import Bench
    from bench.swing.library import PROFILES

    c = context.ensure_object(Session).configuration()
    ready = assess_bench(c, datetime.now(UTC), profile, club=club)
    ready.require_possible()
    swing, path, plant = ready.profile, ready.file, ready.configuration.plant
    beside, stored = c.limits_files(path)
    file = output or (stored if path.parent == PROFILES else beside)
    with sweep_engine(c, processes, cluster, draws) as engine, progress_bar() as bar:
        task = bar.add_task(f"swinging {swing.name}", total=1.0)
        bench = Bench(plant, swing, c.control, c.envelope, c.estimator)
        made = make_limits(bench, draws, lambda part: bar.update(task, completed=part), engine)
    file.parent.mkdir(parents=True, exist_ok=True)
    save_limits(file, made)
    Console().print(f"{file}: limits from {draws} known robots", highlight=False)


@app.command()
def address(
    context: typer.Context,
    profile: Name,
    output: Annotated[Path, typer.Option(metavar="FILE", help="Profile to write; its table goes beside it.")],
    club: ClubName = None,
) -> None:
    """Plan the chamber pressures at the address of a profile, for the configured plant.

    The bench brings the chambers to them before it permits a swing, so that a swing does not depend on how
    the robot came to its address.
    """
    from bench.control.planned_air import with_planned_air
    from bench.swing.library import find_profile
    from bench.swing.profile import load_profile, save_profile

    plant = context.ensure_object(Session).configuration().with_club(club).plant
    path = find_profile(profile)
    try:
        planned = with_planned_air(load_profile(path), plant)
    except ValueError as error:
        cure = "Check the plant, or design another address."
        raise BenchError(str(path), str(error), "an address that the plant can hold", cure) from None
    save_profile(output, planned)
    pressures = ", ".join(f"{pressure / 1e5:.2f}" for pressure in planned.air)
    typer.echo(f"{output}: chambers at {pressures} bar absolute, supply {planned.air_supply / 1e5:.2f} bar.")
