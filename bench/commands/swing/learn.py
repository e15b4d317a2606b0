"""`golfbench learn`: repeat a swing, correct it by its delivery, and store the correction."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import Progress
from rich.table import Table

from bench.base.errors import BenchError
from bench.base.lifecycle import CAUSE_TEXT
from bench.commands.common import (
    ClubName,
    Json,
    Session,
    argument,
    discard_typed,
    exit_unless,
    flag,
    known_profiles,
    option,
    paused,
    plain_table,
    progress_bar,
    require_folder,
    show_result,
)
from bench.swing.correction_terms import Source
from drivers.base.ranges import read_number

if TYPE_CHECKING:
    from bench.config import Configuration
    from bench.learning.learn import LearningProblem, LearningResult, Swinger
    from bench.learning.store import Learned
    from bench.simulation.simulated_bench import Bench
    from sim.plant import PlantParameters

_FACE = 60.0
"""mm from its centre, beyond which no mark is read."""

SwingName = Annotated[str, argument("SWING", "Name or path of a profile.", complete=known_profiles)]
Simulated = Annotated[bool, flag("--sim", "Simulate the robot in lock-step, without a running bench.")]
Robot = Annotated[
    Path | None,
    option("Configuration of the robot that really swings; the bench still assumes --config.", "FILE"),
]
Draw = Annotated[
    int | None, option("Or seed of a random robot within 10 % of the configured one.", "SEED", low=0)
]
DeliverySource = Annotated[
    Source | None, option("Source of the delivery on a running bench.", shown="encoders+model")
]
Swings = Annotated[int, option("Max number of swings.", low=1, high=100)]
Output = Annotated[
    Path | None, option("Also write the corrected profile, .toml, with its table next to it.", "FILE")
]


def learn(
    context: typer.Context,
    profile: SwingName,
    sim: Simulated = False,
    robot: Robot = None,
    draw: Draw = None,
    club: ClubName = None,
    source: DeliverySource = None,
    swings: Swings = 12,
    output: Output = None,
    json_: Json = False,
) -> None:
    """Learn a swing by repeating it on the running bench, or with --sim; store the correction.

    The target is the delivery that the profile plans. Exits with 1 if it is not reached.
    """
    from bench.config import database_url
    from bench.design.optimal_control import require_planned_openings
    from bench.learning.store import Conditions, keep, stored
    from bench.simulation.simulated_bench import Bench
    from bench.store.database import open_database
    from bench.supervisor.readiness import assess_bench
    from bench.swing.profile import save_profile

    elsewhere = {"--robot": robot, "--draw": draw, "--club": club}
    require_folder("--output", output)
    _require_usable({"--source": source} if sim else elsewhere, sim)
    configuration = context.ensure_object(Session).configuration()
    require_planned_openings(configuration.control)
    ready = assess_bench(configuration, datetime.now(UTC), profile, club=club)
    ready.require_possible()
    swing, configuration = ready.profile, ready.configuration
    plant = configuration.plant
    truth = _robot(plant, robot, draw, club)
    bench = Bench.of(configuration, swing)
    measured, settings = source or "encoders+model", configuration.bench
    with open_database(database_url(settings.database, settings.data_dir)):
        pass  # refused before the robot swings
    if sim:
        result, simulated = _learn_in_lock_step(bench, truth, swings), True
    else:
        result, simulated = _learn_live(configuration, bench, measured, swings)
    now = datetime.now(UTC)
    conditions = Conditions.of(swing, plant, configuration.air.temperature, truth if simulated else None)
    entry = stored(result, settings.id, swing.name, conditions, measured, now, simulated=simulated)
    with open_database(database_url(settings.database, settings.data_dir), now) as database:
        version = keep(database, entry)
    if output is not None:
        save_profile(output, result.correction.applied_to(swing))
    words = _table(result, entry.profile), _verdict(result, entry, version)
    show_result(json_, entry.record | {"version": version}, *words)
    exit_unless(result.within)


def _require_usable(options: Mapping[str, object], sim: bool) -> None:
    """Refuse any of `options` that is given: they belong to the other kind of bench than `sim`."""
    for given in (name for name, value in options.items() if value is not None):
        expected = f"{'with' if not sim else 'without'} --sim only"
        action = "Leave it out: a bench is " + (
            "the robot it is." if not sim else "read by its encoders here."
        )
        raise BenchError("learn", given, expected, action)


def _robot(plant: PlantParameters, file: Path | None, draw: int | None, club: str | None) -> PlantParameters:
    """Return the robot that swings in simulation: that of `file` or else `plant`, varied by seed `draw`.

    It swings the club called `club`, as `plant` does.
    """
    from bench.config import load_configuration
    from bench.simulation.plant_variation import drawn

    robot = plant if file is None else load_configuration(file).with_club(club).plant
    return robot if draw is None else drawn(draw, robot).applied_to(robot)


def _learn_in_lock_step(bench: Bench, robot: PlantParameters, swings: int) -> LearningResult:
    from bench.learning.learn import on_series
    from bench.simulation.simulated_bench import Series

    with progress_bar() as bar:
        problem = _problem(bench, bar)
        return _result(problem, on_series(problem, Series(bench, robot)), swings, bar)


def _learn_live(
    configuration: Configuration, bench: Bench, source: Source, swings: int
) -> tuple[LearningResult, bool]:
    """Learn on the running bench, set the correction there, and return whether its robot is simulated."""
    from bench.learning.live import LiveSwinger, require_bench
    from bench.network.client import BenchClient

    def say(text: str) -> None:
        bar.console.print(text, highlight=False)

    def ask_person(todo: str) -> None:
        say(f"{todo}, then learning continues; Ctrl-C ends it")

    def ask_mark() -> tuple[float, float] | None:
        with paused(bar):
            return mark_from_person()

    with progress_bar() as bar, BenchClient.connect(configuration) as client:
        require_bench(client.status(), bench.profile, source)
        problem = _problem(bench, bar)
        with LiveSwinger(client, problem, source, say, ask_mark, ask_person=ask_person) as live:
            result = _result(problem, live, swings, bar)
            live.correct(result.weights)
        return result, live.simulated


def _problem(bench: Bench, bar: Progress) -> LearningProblem:
    from bench.learning.learn import prepare

    task = bar.add_task("the model's response", total=1.0)
    problem = prepare(bench, lambda part: bar.update(task, completed=part))
    bar.update(task, completed=1.0)
    return problem


def _result(problem: LearningProblem, swinger: Swinger, swings: int, bar: Progress) -> LearningResult:
    from bench.learning.learn import learn as learned

    task = bar.add_task("learning swings", total=swings + 1)
    return learned(problem, swinger, swings, on_attempt=lambda attempt: bar.update(task, advance=1))


def mark_from_person() -> tuple[float, float] | None:
    """Ask for the ball's mark on the face; None if it cannot be read."""
    while True:
        discard_typed()
        text = typer.prompt(
            "mark on the face, mm towards the toe and mm up (empty: none)", default="", err=True
        )
        if not text.strip():
            return None
        try:
            toe, high = map(read_number, text.replace(",", " ").split())
        except ValueError:
            toe = high = float("nan")
        if abs(toe) <= _FACE and abs(high) <= _FACE:
            return toe, high
        typer.echo(f"{text!r}: two numbers are wanted, each within {_FACE:g} mm, such as: 3.5 -2", err=True)


def _table(result: LearningResult, name: str) -> Table:
    table = plain_table(title=f"{name}: delivery of each swing")
    units = ("strike\nmm", "head\nm/s", "lean\n°", "attack\n°", "path\nmrad", "limit\n%")
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
        note = attempt.cause.name if attempt.cause else "kept" if number == result.chosen else ""
        error = result.path_error(attempt)
        path = "" if isnan(error) else f"{1e3 * error:.1f}"
        row(str(number), attempt.figures.shown, path, f"{100 * attempt.saturated:.0f}", note)
    return table


def _verdict(result: LearningResult, entry: Learned, version: int) -> str:
    causes = dict.fromkeys(attempt.cause for attempt in result.attempts if attempt.cause)
    stops = "".join(f"{cause.name}: {CAUSE_TEXT[cause]}\n" for cause in causes)
    kept = f"Kept as version {version} of {entry.profile} for {entry.conditions.text}."
    if result.within:
        return f"{stops}Within the tolerances after {result.chosen} learning swings. {kept}"
    return (
        f"{stops}Not within the tolerances after {result.used} learning swings: the nearest is kept. {kept}\n"
        "A share of saturation that stays high says that the robot has not enough air for this swing."
    )
