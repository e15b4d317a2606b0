"""`golfbench faults ...`: inject faults and judge the outcomes."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from bench.base.atomic_file import write_whole
from bench.base.errors import BenchError
from bench.base.interrupt import deferred_interrupt
from bench.commands.common import (
    ClusterAddress,
    Json,
    Processes,
    ProfileName,
    Session,
    argument,
    console_of,
    exit_unless,
    flag,
    option,
    progress_of,
    sweep_engine,
    write_text,
)

if TYPE_CHECKING:
    from bench.faults.matrix import FaultStudy, MatrixPlan
    from bench.simulation.sweep import Engine

app = typer.Typer(no_args_is_help=True)

_PIPED_WIDTH = 150
"""Columns of tables in a file or pipe."""


@app.callback()
def faults() -> None:
    """Inject faults into every signal and part in every phase on the simulated robot; judge the outcomes."""


Output = Annotated[Path | None, option("Folder of results.", "DIR", shown="DATA_DIR/faults")]
Signals = Annotated[list[str] | None, option("Only faults whose name contains this; repeatable.", "TEXT")]
Phases = Annotated[list[str] | None, option("Only faults in this phase; repeatable.", "PHASE")]
ModelCheck = Annotated[bool, flag("--model-check/--no-model-check", "Run with the model-based check.")]
Families = Annotated[
    list[str] | None,
    option(
        "Only 'one fault', 'during a stop', 'from the start', 'latent pair', 'access'; repeatable.", "FAMILY"
    ),
]
Every = Annotated[int, option("A sample: one case of N.", "N", low=1)]
Quick = Annotated[bool, flag("--quick", "One instant per phase only.")]


@app.command()
def run(
    context: typer.Context,
    profile: ProfileName = None,
    output: Output = None,
    signal: Signals = None,
    phase: Phases = None,
    family: Families = None,
    every: Every = 1,
    model_check: ModelCheck = True,
    quick: Quick = False,
    processes: Processes = 0,
    cluster: ClusterAddress = "",
    json_: Json = False,
) -> None:
    """Run the fault matrix; results of earlier runs with the same sources are reused.

    Writes matrix.html, matrix.json and cases.jsonl. Exits with 1 if a case ends unsafe.
    """
    from bench.faults.catalogue import FAMILIES
    from bench.faults.matrix import fault_study, plan_matrix
    from bench.faults.summary import PHASES, summary_text

    _must_be_known("--phase", phase or (), PHASES)
    _must_be_known("--family", family or (), FAMILIES)
    configuration = context.ensure_object(Session).configuration()
    study = fault_study(configuration, profile or configuration.swing.profile, model_check=model_check)
    folder = output or configuration.bench.data_dir / "faults"
    folder.mkdir(parents=True, exist_ok=True)
    plan = plan_matrix(
        study.profile,
        model_check=model_check,
        signals=signal or (),
        phases=phase or (),
        families=family or (),
        one_instant=quick,
        every=every,
    )
    with sweep_engine(configuration, processes, cluster, len(plan.cases)) as engine:
        summary = _matrix(study, folder, plan, engine)
    _write(folder, summary)
    unsafe = summary["verdicts"]["unsafe"]
    if json_:
        typer.echo(summary_text(summary), nl=False)
    else:
        console = console_of(_PIPED_WIDTH)
        console.print(matrix_table(summary))
        if unsafe:
            console.print(reasons_table(summary))
        typer.echo(str(folder / "matrix.html"))
    exit_unless(not unsafe)


def _write(folder: Path, summary: dict[str, Any]) -> None:
    from bench.faults.summary import summary_text

    page = matrix_page(summary)
    for name, text in {"matrix.json": summary_text(summary), "matrix.html": page}.items():
        write_whole(folder / name, text)


def _must_be_known(option: str, given: Sequence[str], known: Sequence[str]) -> None:
    if unknown := sorted(set(given) - set(known)):
        raise BenchError(
            option, ", ".join(unknown), f"one of {', '.join(known)}", f"Give {option} one of these."
        )


def _matrix(study: FaultStudy, folder: Path, plan: MatrixPlan, engine: Engine) -> dict[str, Any]:
    from bench.faults.matrix import matrix_store, run_matrix
    from bench.faults.summary import origin_of, summarise

    store = matrix_store(folder / "cases.jsonl", study)
    text = f"breaking {study.profile.name}" + ("" if study.model_check else ", no model check")
    with deferred_interrupt() as asked, progress_of(text, len(plan.cases)) as show:
        outcomes = run_matrix(plan, study, store, engine, progress=show, stop=asked.is_made)
    return summarise(
        outcomes,
        plan.skipped,
        model_check=study.model_check,
        profile=study.profile.name,
        seconds=store.seconds,
        origin=origin_of(study.configuration, study.profile, datetime.now(UTC)) | {"every": plan.every},
    )


_MARKS = {
    "irrelevant": "·",
    "harmless": "○",
    "safe": "●",
    "undetected": "?",
    "unsafe": "[bold red]✗[/bold red]",
}


def matrix_table(summary: dict[str, Any]) -> Table:
    """Return one row a fault and one column a phase, the worst verdict of each."""
    from bench.faults.summary import PHASES

    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in summary["verdicts"].items())
    table = Table(
        title=f"{summary['cases']} cases: {verdicts}; {summary['left_out_by_rule']} pairs left out by rule",
        caption="● detected and safe  ○ harmless  ? undetected, another shot or pose  "
        "✗ unsafe  · left out by rule",
    )
    table.add_column("fault")
    for phase in PHASES:
        table.add_column(phase.replace("-", "\n"), justify="center")
    for heading in ("ticks", "most energy"):
        table.add_column(heading, justify="right")
    for row in summary["rows"]:
        ticks = row["detection_ticks"]
        table.add_row(
            row["breakage"],
            *(_MARKS[row["phases"].get(phase, {}).get("verdict", "irrelevant")] for phase in PHASES),
            f"{ticks[0]}-{ticks[-1]}" if ticks else "",
            f"{100 * row['worst_stop']:.0f} %" if row["worst_stop"] else "",
        )
    return table


def reasons_table(summary: dict[str, Any]) -> Table:
    """Return the faults that end unsafe, with instants and reasons."""
    table = Table("fault", "unsafe", "reasons", title="Unsafe ends", box=None)
    for row in summary["rows"]:
        if unsafe := row["verdicts"].get("unsafe", 0):
            table.add_row(row["breakage"], str(unsafe), "\n".join(row["reasons"][:4]))
    return table


def matrix_page(summary: dict[str, Any]) -> str:
    """Return the page: one file without external resources."""
    import jinja2

    from bench.faults.summary import PHASES, next_swing_text

    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string((files("bench.faults") / "page.html.j2").read_text(encoding="utf-8"))
    return template.render(summary=summary, next_swing=next_swing_text(summary), phases=PHASES)


@app.command()
def table(
    matrix: Annotated[Path, argument("MATRIX", "Result of faults run, matrix.json.")],
    output: Annotated[Path | None, option("File to write.", "FILE", shown="standard output")] = None,
) -> None:
    """Write the hazard table of a fault matrix, one row for each part, as in sim/FAULTS.md."""
    from bench.faults.summary import hazard_table

    write_text(_from_matrix(matrix, hazard_table), output)


@app.command("file")
def hazard_file_of(
    matrix: Annotated[Path, argument("MATRIX", "Result of faults run, matrix.json.")],
    output: Annotated[Path | None, option("File to write.", "FILE", shown="standard output")] = None,
) -> None:
    """Write the hazard file: failure modes, safety functions and hazards to people, as in sim/HAZARDS.md."""
    from bench.faults.summary import hazard_file

    write_text(_from_matrix(matrix, hazard_file), output)


def _from_matrix(matrix: Path, document: Callable[[dict[str, Any]], str]) -> str:
    try:
        return document(json.loads(matrix.read_text(encoding="utf-8")))
    except (ValueError, KeyError, TypeError):
        found, action = "not a matrix", "Run `golfbench faults run` and name its matrix.json."
        raise BenchError(str(matrix), found, "a matrix.json of `golfbench faults run`", action) from None
