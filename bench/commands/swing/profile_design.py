"""`golfbench profile design`: a swing for the configured robot."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from bench.base.errors import BenchError, Refused
from bench.commands.common import (
    ClubName,
    ClusterAddress,
    Processes,
    Session,
    argument,
    console_of,
    flag,
    option,
    progress_bar,
    progress_of_steps,
    require_folder,
    sweep_engine,
)
from bench.swing.library import find_profile

if TYPE_CHECKING:
    from bench.config import Configuration
    from bench.design.optimal_control import SwingDemand
    from bench.golfer.comparison import MotionDeviation
    from bench.golfer.golfer_file import GolferSwing
    from bench.swing.golfers import Golfer
    from bench.swing.profile import Profile
    from sim.plant import PlantParameters

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
    from bench.design.designer import DesignFailed
    from bench.design.optimal_control import SwingDemand, require_planned_openings

    require_folder("FILE", output)
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
    from bench.commands.swing.golfer import PIPED_WIDTH, beyond_text, comparison_table
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
        "feedback, absorber limits kept with a missed ball and after loss of communication;\n"
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
    """Design a swing, save it at `path`, print its delivery, absorber loads and deviation from `golfer`."""
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
    given = gave_way(demand, made)
    swing = replace(made, text="; ".join([made.text, *given]))
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
        f"Max absorber load: {100 * limits['stop_share']:.0f} % with the ball struck, "
        f"{100 * limits['stop_share_missed']:.0f} % with the ball missed, "
        f"{100 * limits['stop_share_silent']:.0f} % after loss of communication."
    )
    typer.echo("Feasible on this machine: all checks of `golfbench check` passed.")
    if given:
        typer.echo("Relaxed requirements: " + "; ".join(given) + ".")
    if row is not None:
        _show_deviation(plant, row)
