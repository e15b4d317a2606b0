"""`golfbench profile compare`: one swing, one robot, controllers from the thesis' PID to learning."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console
from rich.table import Table

from bench.base.lifecycle import CAUSE_TEXT
from bench.commands.common.options import ClubName, Json, ProfileName, option
from bench.commands.common.output import finite, plain_table
from bench.commands.common.progress import progress_bar
from bench.commands.common.session import Session, show_json

if TYPE_CHECKING:
    from bench.learning.compare import Compared
    from bench.learning.delivery import Figures
    from bench.simulation.series import Bench
    from sim.plant import PlantParameters


RobotName = Annotated[
    Literal["nominal", "worn", "both"],
    option(
        "The configured robot; or a worn one: friction +40 %, valve flow -8 %, supply -4 %, head "
        "+10 g, vane +3 %, encoders 1 ms later."
    ),
]
Draw = Annotated[
    int | None,
    option("Seed of a random robot within 10 % of the configured one, used instead.", "SEED", low=0),
]
Swings = Annotated[int, option("Swings with each controller.", low=1, high=100)]
Learning = Annotated[bool, option("Also compare with learned openings.")]


def compare(
    context: typer.Context,
    profile: ProfileName = None,
    robot: RobotName = "both",
    draw: Draw = None,
    club: ClubName = None,
    swings: Swings = 3,
    learning: Learning = True,
    json_: Json = False,
) -> None:
    """Compare controllers on one swing: PIDs alone, with feed-forward by the model, and with learning.

    Same swing, same simulated robot, same seeds; pressure sensors only where it is said.
    """
    from bench.design.static_checks import require_possible
    from bench.learning.delivery import planned_figures
    from bench.simulation.plant_variation import drawn
    from bench.simulation.series import Bench
    from bench.swing.library import find_profile
    from bench.swing.profile import load_profile

    configuration = context.ensure_object(Session).configuration().with_club(club)
    path, plant = find_profile(profile or configuration.swing.profile), configuration.plant
    swing = load_profile(path)
    require_possible(swing, plant, configuration.envelope, str(path))
    bench = Bench.of(configuration, swing)
    planned = planned_figures(bench)
    if draw is not None:
        robots = {f"drawn {draw}": drawn(draw, plant).applied_to(plant)}
    else:
        robots = _robots_named(robot, plant)
    rows = _compared_on(robots, bench, swings, learning)
    if json_:
        records = {name: [compared_record(row) for row in found] for name, found in rows.items()}
        record = {"profile": swing.name, "swings": swings, "planned": planned.shown, "robots": records}
        return show_json(record)
    console = Console()
    for name, found in rows.items():
        console.print(compared_table(f"{swing.name} on the {name} robot, mean of {swings} swings", found))
        console.print(*notes(found), "", sep="\n", highlight=False)
    console.print(_legend(planned), highlight=False)


def _robots_named(name: str, plant: PlantParameters) -> dict[str, PlantParameters]:
    """Return the nominal robot `plant`, the worn one, or both, by name."""
    from bench.simulation.plant_variation import WORN

    robots = {"nominal": plant, "worn": WORN.applied_to(plant)}
    return robots if name == "both" else {name: robots[name]}


def _compared_on(
    robots: Mapping[str, PlantParameters], bench: Bench, swings: int, learning: bool
) -> dict[str, list[Compared]]:
    """Swing each of `robots` with each controller; return the controllers' results by robot."""
    from bench.learning.compare import compare as compared
    from bench.learning.compare import controllers, problem_of

    rows: dict[str, list[Compared]] = {}
    with progress_bar() as bar:
        problem = None
        if learning:
            task = bar.add_task("the model's response", total=1.0)
            problem = problem_of(bench, lambda part: bar.update(task, completed=part))
        each = len(controllers(bench)) + bool(learning)
        for name, truth in robots.items():
            task = bar.add_task(name, total=each + 1)

            def show(controller: str, task: Any = task, name: str = name) -> None:
                bar.update(task, advance=1, description=f"{name}: {controller}")

            rows[name] = compared(bench, truth, swings, problem, show)
            bar.update(task, completed=each + 1)
    return rows


def compared_record(row: Compared) -> dict[str, Any]:
    """Return `row` for JSON; None where nothing is known."""
    from bench.learning.compare import LITRES
    from drivers.base import JOINTS

    error = row.error.shown
    error["head_speed_share"] = finite(row.error.speed)
    del error["head_speed_mps"]
    joints = zip(JOINTS, row.tracking, strict=True)
    return {
        "controller": row.controller,
        "delivery": row.figures.shown,
        "delivery_error": error,
        "tracking_rad": {joint: finite(float(value)) for joint, value in joints},
        "head_path_error_m": finite(row.path),
        "saturated_share": finite(row.saturated),
        "air_kg": finite(row.air),
        "air_litres_anr": finite(row.air * LITRES),
        "stopped_by": row.cause.name if row.cause else None,
        "following_error": None if row.strayed is None else [JOINTS[row.strayed[0]], row.strayed[1].name],
    }


def compared_table(title: str, rows: list[Compared]) -> Table:
    """Return the table of `rows`."""
    from bench.learning.compare import LITRES

    table = plain_table(title=title, padding=(0, 1, 0, 0), title_justify="left")
    table.add_column("controller", no_wrap=True)
    names = ("tracking", "head", "strike", "speed", "lean", "attack", "sat.", "air")
    units = ("mrad", "mm", "mm", "%", "°", "°", "%", "l")
    for name, unit in zip(names, units, strict=True):
        table.add_column(f"{name}\n{unit}", justify="right", no_wrap=True)
    for row in rows:
        figures = ("", "", "", "")
        if isfinite(row.error.speed):
            shown = row.error.shown
            values = (shown["strike_mm"], 100 * row.error.speed, shown["shaft_lean_deg"])
            strike, speed, lean = (f"{value:+.1f}" for value in values)
            figures = (strike, speed, lean, f"{shown['attack_angle_deg']:+.1f}")
        first, last = ("", ""), ("", "")
        if isfinite(row.air):
            tracking = "·".join(f"{1e3 * value:.0f}" for value in row.tracking)
            first = (tracking, f"{1e3 * row.path:.0f}") if isfinite(row.path) else first
            saturated = f"{100 * row.saturated:.0f}" if isfinite(row.saturated) else ""
            last = (saturated, f"{LITRES * row.air:.0f}")
        table.add_row(row.controller, *first, *figures, *last)
    return table


def notes(rows: list[Compared]) -> list[str]:
    """Return a line for each of `rows` that the bench would not have let swing."""
    return [f"{row.controller}: {note}" for row in rows if (note := _note(row))]


def _note(row: Compared) -> str:
    from drivers.base import JOINTS

    notes = [] if not row.cause else [f"stopped: {CAUSE_TEXT[row.cause]}"]
    if row.strayed is not None:
        joint, phase = row.strayed
        notes.append(f"follows too far off: {JOINTS[joint]}, {phase.name.lower().replace('_', ' ')}")
    return "; ".join(notes)


def _legend(planned: Figures) -> str:
    shown = planned.shown
    return (
        "Each row adds one thing to the one above; planned: the profile's own openings instead.\n"
        f"Planned: strike {shown['strike_mm']:+.1f} mm, {shown['head_speed_mps']:.2f} m/s, lean "
        f"{shown['shaft_lean_deg']:+.2f}°, attack {shown['attack_angle_deg']:+.2f}°; deviations of the "
        "delivery at the ball are relative to it.\n"
        "Tracking: rms of shoulder·arm·wrist in the downswing; head: the same of its way; sat.: ticks of the "
        "downswing with a valve at its limit; air: litres ANR a swing. Following errors stop no swing here; "
        "a note says where the bench would stop."
    )
