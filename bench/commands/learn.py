"""`golfbench learn`: repeat a swing, correct it by what it delivered, and keep the correction."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.commands.session import Session
from bench.learning.source import Source

if TYPE_CHECKING:
    from rich.table import Table

    from bench.learning.learn import LearningResult
    from bench.learning.store import Learned


_FACE = 60.0
"""mm from its centre, beyond which no mark is read."""


def learn(
    context: typer.Context,
    profile: Annotated[str, typer.Argument(metavar="SWING", help="Name or path of a profile.")],
    sim: Annotated[
        bool, typer.Option("--sim", help="Simulate the robot in lock-step, without a running bench.")
    ] = False,
    robot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Configuration of the robot that really swings; the bench still assumes --config.",
        ),
    ] = None,
    draw: Annotated[
        int | None,
        typer.Option(
            metavar="SEED", min=0, help="Or seed of a random robot within 10 % of the configured one."
        ),
    ] = None,
    identified: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Output of golfbench identify: start from what was learned on that robot in simulation.",
        ),
    ] = None,
    records: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="RECORD",
            help="Record it was identified from, repeatable: corrects what identification missed.",
        ),
    ] = None,
    source: Annotated[
        Source | None,
        typer.Option(help="Source of the delivery on a running bench.", show_default="encoders+model"),
    ] = None,
    swings: Annotated[int, typer.Option(min=1, max=100, help="Max number of swings.")] = 12,
    output: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Also write the corrected profile, .toml, with its table beside it."
        ),
    ] = None,
    json_: Annotated[bool, typer.Option("--json", help="Print JSON for a program to read.")] = False,
) -> None:
    """Learn a swing by repeating it on the running bench, or with --sim; store the correction.

    The target is the profile's delivery on the configured plant. Exits with 1 if it is not reached.
    """
    import json
    from datetime import UTC, datetime

    from rich.console import Console

    from bench.commands.progress import progress_bar
    from bench.config import database_url, load_configuration
    from bench.design.planned_openings import require_planned_openings
    from bench.design.validate import require_possible
    from bench.errors import BenchError, ExitCode
    from bench.learning.beginning import begun_on
    from bench.learning.learn import learn as learned
    from bench.learning.learn import on_series, prepare
    from bench.learning.learner import LearningSettings
    from bench.learning.live import LiveSwinger, require_bench
    from bench.learning.recorded import read_recorded
    from bench.learning.store import Conditions, keep, stored
    from bench.network.client import BenchClient
    from bench.simulation.series import Bench, Series
    from bench.simulation.variation import drawn
    from bench.store.database import open_database
    from bench.swing.library import find_profile
    from bench.swing.profile import load_profile, save_profile

    only = {"--robot": robot, "--draw": draw} if not sim else {"--source": source}
    for option in (name for name, value in only.items() if value is not None):
        raise BenchError(
            "learn",
            option,
            f"{'with' if not sim else 'without'} --sim only",
            "Leave it out: a bench is " + ("the robot it is." if not sim else "read by its encoders here."),
        )

    if records and identified is None:
        raise BenchError(
            "learn", "--records", "with --identified only", "Name the robot that they identified."
        )
    recorded = read_recorded(records or [])

    def say(text: str) -> None:
        bar.console.print(text, highlight=False)

    def ask_mark() -> tuple[float, float] | None:
        bar.stop()
        try:
            return _mark_from_person()
        finally:
            bar.start()

    configuration = context.ensure_object(Session).configuration()
    require_planned_openings(configuration.control)
    path = find_profile(profile)
    swing, plant = load_profile(path), configuration.plant
    require_possible(swing, plant, configuration.envelope, str(path))
    truth = plant if robot is None else load_configuration(robot).plant
    truth = truth if draw is None else drawn(draw, truth).applied_to(truth)
    bench = Bench(plant, swing, configuration.control, configuration.envelope, configuration.estimator)
    measured = source or "encoders+model"
    with ExitStack() as stack, progress_bar() as bar:
        client = None if sim else stack.enter_context(BenchClient.connect(configuration))
        if client is not None:
            require_bench(client.status(), swing, measured)
        task = bar.add_task("the model's response", total=1.0)
        problem = prepare(bench, lambda part: bar.update(task, completed=part))
        bar.update(task, completed=1.0)
        if identified is not None:
            task = bar.add_task("the identified robot learns", total=None)
            problem = begun_on(problem, load_configuration(identified).plant, recorded)
            bar.update(task, total=1.0, completed=1.0)
        task = bar.add_task("learning swings", total=swings + 1)
        live = None
        if client is not None:
            live = stack.enter_context(LiveSwinger(client, problem, measured, say, ask_mark))
        swinger = live or on_series(problem, Series(bench, truth))
        result = learned(
            problem,
            swinger,
            LearningSettings(swings=swings),
            on_attempt=lambda attempt: bar.update(task, advance=1),
        )
        if live is not None:
            live.correct(result.weights)
    settings, now = configuration.bench, datetime.now(UTC)
    simulated = live is None or live.simulated
    temperature = configuration.air.temperature
    conditions = Conditions.of(swing, plant, temperature, truth if simulated else None)
    entry = stored(result, settings.id, swing.name, conditions, measured, now, simulated=simulated)
    with open_database(database_url(settings.database, settings.data_dir), now) as database:
        version = keep(database, entry)
    if output is not None:
        save_profile(output, result.correction.applied_to(swing))
    if json_:
        typer.echo(json.dumps(entry.record | {"version": version}, indent=2))
    else:
        console = Console()
        console.print(_table(result, swing.name))
        console.print(_verdict(result, entry, version), highlight=False)
    if not result.within:
        raise typer.Exit(ExitCode.REFUSED)


def _mark_from_person() -> tuple[float, float] | None:
    """Ask for the ball's mark on the face; None if it cannot be read."""
    while True:
        text = typer.prompt(
            "mark on the face, mm towards the toe and mm up (empty: none)", default="", err=True
        )
        if not text.strip():
            return None
        try:
            toe, high = map(float, text.replace(",", " ").split())
        except ValueError:
            toe = high = float("nan")
        if abs(toe) <= _FACE and abs(high) <= _FACE:
            return toe, high
        typer.echo(f"{text!r}: two numbers are wanted, each within {_FACE:g} mm, such as: 3.5 -2", err=True)


def _table(result: LearningResult, name: str) -> Table:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from bench.lifecycle import CAUSE_TEXT

    table = Table(box=SIMPLE_HEAD, pad_edge=False, title=f"{name}: what each swing delivered")
    units = ("strike mm", "head m/s", "lean °", "attack °", "path mrad", "at limit %")
    for column in ("swing", *units, ""):
        table.add_column(column, justify="right" if column != "" else "left", no_wrap=True)

    def row(first: str, figures: dict[str, float | None], *rest: str) -> None:
        forms = ("{:+.2f}", "{:.2f}", "{:+.2f}", "{:+.2f}")
        values = [
            "" if value is None else form.format(value)
            for form, value in zip(forms, figures.values(), strict=True)
        ]
        table.add_row(first, *values, *rest)

    row("target", result.target.shown, "", "", "")
    for number, attempt in enumerate(result.attempts):
        note = CAUSE_TEXT[attempt.cause] if attempt.cause else "kept" if number == result.chosen else ""
        path = "" if attempt.path_error != attempt.path_error else f"{1e3 * attempt.path_error:.1f}"
        row(str(number), attempt.figures.shown, path, f"{100 * attempt.saturated:.0f}", note)
    return table


def _verdict(result: LearningResult, entry: Learned, version: int) -> str:
    kept = f"Kept as version {version} of {entry.profile} for {entry.conditions.text}."
    if result.within:
        return f"Within the tolerances after {result.chosen} learning swings. {kept}"
    return (
        f"Not within the tolerances after {result.used} learning swings: the nearest is kept. {kept}\n"
        "A share of saturation that stays high says that the robot has not enough air for this swing."
    )
