"""`golfbench learn`: repeat a swing, correct it by what it delivered, and keep the correction."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.session import Session

if TYPE_CHECKING:
    from rich.table import Table

    from bench.learning.learn import Lesson
    from bench.learning.store import Learned


def learn(
    context: typer.Context,
    profile: Annotated[str, typer.Argument(metavar="SWING", help="Name or path of a profile.")],
    sim: Annotated[bool, typer.Option("--sim", help="On the simulated robot, in lock-step.")] = False,
    robot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Configuration of the robot that is truly swung; the bench goes on believing in --config.",
        ),
    ] = None,
    draw: Annotated[
        int | None,
        typer.Option(metavar="SEED", min=0, help="Or a robot drawn within 10 % of the configured one."),
    ] = None,
    identified: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="What golfbench identify has written: learning begins where that robot ends in simulation.",
        ),
    ] = None,
    swings: Annotated[int, typer.Option(min=1, max=100, help="At most.")] = 12,
    output: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also write the corrected profile, .toml.")
    ] = None,
    json_: Annotated[bool, typer.Option("--json", help="Print JSON for a program to read.")] = False,
) -> None:
    """Learn a swing from its own repetitions, by encoders and model, and store the correction.

    The target is what the profile delivers on the configured plant. Ends with 1 when it is not reached.
    """
    import json
    from datetime import UTC, datetime

    from rich.console import Console

    from bench.config import load_configuration
    from bench.errors import BenchError, ExitCode
    from bench.learning.learn import by_encoders, prepare
    from bench.learning.learn import learn as learned
    from bench.learning.learner import LearningSettings
    from bench.learning.series import Bench, Series
    from bench.learning.store import Conditions, keep, stored
    from bench.learning.variation import drawn
    from bench.progress import progress_bar
    from bench.store.database import database_url, open_database
    from bench.swing.library import find_profile
    from bench.swing.planned_openings import require_planned_openings
    from bench.swing.profile import load_profile, save_profile
    from bench.swing.validate import require_possible

    if not sim:
        raise BenchError(
            "learn", "no --sim", "--sim: a running bench does not take another profile while it runs",
            "Learn with --sim on an identified plant, then run the profile of --output on the bench.",
        )  # fmt: skip
    configuration = context.ensure_object(Session).configuration()
    require_planned_openings(configuration.control)
    path = find_profile(profile)
    swing, plant = load_profile(path), configuration.plant
    require_possible(swing, plant, configuration.envelope, str(path))
    truth = plant if robot is None else load_configuration(robot).plant
    truth = truth if draw is None else drawn(draw, truth).applied_to(truth)
    bench = Bench(plant, swing, configuration.control, configuration.envelope, configuration.estimator)
    with progress_bar() as bar:
        task = bar.add_task("the model's response", total=1.0)
        lecture = prepare(bench, lambda part: bar.update(task, completed=part))
        bar.update(task, completed=1.0)
        begin = None
        if identified is not None:
            task = bar.add_task("the identified robot learns", total=None)
            twin = Series(bench, load_configuration(identified).plant)
            begin = learned(lecture, twin, by_encoders(lecture)).weights
            bar.update(task, total=1.0, completed=1.0)
        task = bar.add_task("learning swings", total=swings + 1)
        lesson = learned(
            lecture, Series(bench, truth), by_encoders(lecture), LearningSettings(swings=swings),
            told=lambda attempt: bar.update(task, advance=1), start=begin,
        )  # fmt: skip
    settings, now = configuration.bench, datetime.now(UTC)
    conditions = Conditions.of(swing, plant, configuration.air.temperature, truth)
    entry = stored(lesson, settings.id, swing.name, conditions, "encoders+model", now, simulated=True)
    with open_database(database_url(settings.database, settings.data_dir), now) as database:
        version = keep(database, entry)
    if output is not None:
        save_profile(output, lesson.correction.applied_to(swing))
    if json_:
        typer.echo(json.dumps(entry.record | {"version": version}, indent=2))
    else:
        console = Console()
        console.print(_table(lesson, swing.name))
        console.print(_verdict(lesson, entry, version), highlight=False)
    if not lesson.within:
        raise typer.Exit(ExitCode.REFUSED)


def _table(lesson: Lesson, name: str) -> Table:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from bench.lifecycle import CAUSE_TEXT

    table = Table(box=SIMPLE_HEAD, pad_edge=False, title=f"{name}: what each swing delivered")
    for column in ("swing", "strike", "head speed", "shaft lean", "attack angle", "path", "saturated", ""):
        table.add_column(column, justify="right" if column != "" else "left", no_wrap=True)

    def row(first: str, figures: dict[str, float | None], *rest: str) -> None:
        forms = ("{:+.2f} mm", "{:.2f} m/s", "{:+.2f}°", "{:+.2f}°")
        values = [
            "" if value is None else form.format(value)
            for form, value in zip(forms, figures.values(), strict=True)
        ]
        table.add_row(first, *values, *rest)

    row("target", lesson.target.shown, "", "", "")
    for number, attempt in enumerate(lesson.attempts):
        note = CAUSE_TEXT[attempt.cause] if attempt.cause else "kept" if number == lesson.chosen else ""
        path = "" if attempt.path_error != attempt.path_error else f"{1e3 * attempt.path_error:.1f} mrad"
        row(str(number), attempt.figures.shown, path, f"{100 * attempt.saturated:.0f} %", note)
    return table


def _verdict(lesson: Lesson, entry: Learned, version: int) -> str:
    kept = f"Kept as version {version} of {entry.profile} for {entry.conditions.text}."
    if lesson.within:
        return f"Within the tolerances after {lesson.chosen} learning swings. {kept}"
    return (
        f"Not within the tolerances after {lesson.used} learning swings: the nearest is kept. {kept}\n"
        "A share of saturation that stays high says that the robot has not enough air for this swing."
    )
