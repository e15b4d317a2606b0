"""`golfbench wear`, `golfbench identify`: what recorded swings show about their robot."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from bench.base.errors import BenchError, Refused
from bench.commands.common import (
    Json,
    Plot,
    Session,
    argument,
    exit_unless,
    finite,
    option,
    plain_table,
    progress_of,
    require_picture,
    show_json,
    show_result,
)

if TYPE_CHECKING:
    from bench.commissioning.swings.wear import PartWear
    from bench.network.bench_service import WearFinding
    from bench.simulation.replay import Margin

Records = Annotated[list[Path], argument("RECORD...", "Parquet files of swings, or folders of them.")]

_PARTS = {
    "air": "valve, chamber sensors or supply of the {joint}",
    "flow": "dead band, centre or leakage of the {joint} valve, or a chamber sensor",
    "velocity": "friction of the {joint}, or the supply",
    "jump": "encoder of the {joint}: coupling, cable, latency",
    "effort": "head and shaft, or scale of the {joint} encoder",
}
"""Sources of a residual, by comparison."""
_CLEAR = 0.5
"""Share of the worn change from which a part is reported as the source of its joint's residual."""
_SHOWN = 0.25
"""Share of the worn change from which a part has its line."""


def wear(context: typer.Context, records: Records, plot: Plot = None, json_: Json = False) -> None:
    """Show what wears on the robot of recorded swings, by part, with the trend; draw it with --plot.

    The second table has the largest residuals as shares of the limits of the model-based check. Exits with 1
    if a part is worn, a residual near its limit, or a trend reaches it within as many swings again (at most
    200).
    """
    import numpy as np

    from bench.records.telemetry.record_file import read_swing, record_files
    from bench.simulation.replay import AHEAD, margins, residual_shares

    require_picture(plot)
    settings = context.ensure_object(Session).address().bench
    files = record_files(records)
    swings = []
    with progress_of("replaying swings", len(files)) as show:
        for done, file in enumerate(files):
            cycles, metadata = read_swing(file)
            time = str(metadata.get("time_utc", file.name))
            shares = residual_shares(cycles, metadata, str(file))
            swings.append((time, file, shares, metadata.get("bench")))
            show(done + 1)
    swings.sort(key=lambda swing: swing[0])
    parts = _worn_parts([file for _, file, *_ in swings], plot)
    found = margins(np.array([shares for _, _, shares, _ in swings]))
    near = [one for one in found if one.near]
    ahead = min(AHEAD, len(swings))
    due = [one for one in parts if one.is_worn or one.left <= ahead]
    worn_texts = {f"{one.value.part}, {one.value.name}": _worn_text(one) for one in due}
    near_texts = {f"{one.joint} {one.kind}": _near_text(one, parts) for one in near}
    try:
        benches = sorted({str(bench or "no bench") for *_, bench in swings})
        _store(settings.data_dir, settings.id, benches, swings[-1][0], worn_texts | near_texts)
    except BenchError as error:
        Console(stderr=True).print(str(error), style="yellow", highlight=False)
    if json_:
        rows = [{name: finite(value) for name, value in one._asdict().items()} for one in found]
        worn = {"parts": [_as_json(one) for one in parts], "worn": bool(due)}
        show_json({"swings": len(swings), **worn, "margins": rows, "near": bool(near)})
    else:
        _print(parts, list(worn_texts.values()), found, list(near_texts.values()), len(swings))
    exit_unless(not near and not due)


def _store(data_dir: Path, bench: str, benches: list[str], time_utc: str, texts: dict[str, str]) -> None:
    """Store findings of `bench` by swings of `benches` up to `time_utc`; `texts` by part.

    Raises:
        BenchError: they are swings of another bench, an analysis has later ones, or the file is not written.
    """
    from bench.supervisor.status import StoredWear, read_wear, wear_file, write_wear

    location = f"wear of bench {bench}, not stored"
    if benches != [bench]:
        action = "For the status of a bench analyse its swings alone, with its --config."
        raise Refused(location, f"swings of {', '.join(benches)}", f"swings of {bench}", action)
    file = wear_file(data_dir, bench)
    try:
        stored = read_wear(file).time_utc
    except BenchError:
        stored = ""  # an invalid file is replaced
    if stored > time_utc:
        action = "Analyse newer swings too."
        raise Refused(location, f"swings until {time_utc}", f"none older than {stored}, as stored", action)
    findings: list[WearFinding] = [
        {"part": part, "text": text, "time_utc": time_utc} for part, text in texts.items()
    ]
    write_wear(file, StoredWear(time_utc, findings))


def _worn_text(one: PartWear) -> str:
    soon = "" if one.is_worn else f" within {max(2, ceil(one.left))} more swings at this rate"
    return f"{one.value.part}, {one.value.name}: worn{soon}. {one.value.action}"


def _near_text(one: Margin, parts: list[PartWear]) -> str:
    changed = (
        f"{part.value.part}, {part.value.name}"
        for part in parts
        if part.value.part.startswith(one.joint) and abs(part.latest) >= _CLEAR * part.value.most
    )
    where = next(changed, _PARTS[one.kind].format(joint=one.joint))
    action = "Look at it; if nothing is broken, measure the robot again with golfbench commission."
    return f"{one.joint} {one.kind} is near its limit: {where}. {action}"


def _print(parts: list[PartWear], worn: list[str], found: list[Margin], near: list[str], swings: int) -> None:
    """Print both tables, each with the findings `worn` or `near` below it."""
    console = Console()
    shown = [one for one in parts if abs(one.latest) >= _SHOWN * one.value.most]
    if shown:
        console.print(_part_table(shown, len(parts) - len(shown)))
    elif parts:
        console.print(f"None of {len(parts)} values has changed by a quarter of what counts as worn.")
    for text in worn:
        console.print(text, style="yellow", highlight=False)
    console.print(_margin_table(found, f"{swings} swings: largest residuals, % of their limits"))
    for text in near:
        console.print(text, style="yellow", highlight=False)


def _worn_parts(files: Sequence[Path], plot: Path | None) -> list[PartWear]:
    """Return the parts' wear over records, oldest first, and draw it; none without chamber sensors."""
    from bench.commissioning.swings.wear import MAX_FITTED, fitted_parts, wear_plot, worn_parts
    from bench.records.shot.plot_style import save_picture

    try:
        with progress_of("fitting parts", min(len(files), MAX_FITTED)) as show:
            swings, numbers = fitted_parts(files, show)
    except BenchError as error:
        Console(stderr=True).print(str(error), style="yellow", highlight=False)
        return []
    if plot is not None:
        save_picture(wear_plot(swings, numbers), plot)
    return worn_parts(swings)


def _as_json(one: PartWear) -> dict[str, Any]:
    value, scale = one.value, one.value.scale
    return {
        "part": value.part,
        "value": value.name,
        "unit": value.unit,
        "before": scale * one.before,
        "latest": scale * one.latest,
        "error": scale * one.error,
        "growth": finite(scale * one.growth),
        "most": scale * value.most,
        "worn": one.is_worn,
        "swings_left": finite(one.left),
    }


def _part_table(parts: list[PartWear], others: int) -> Table:
    figures = ("first", "latest", "error", "per 100", "worn from")
    title = f"parts: change against the configuration; {others} others hardly differ"
    table = plain_table("part", "value", *figures, "unit", right=figures, title=title)
    for one in parts:
        scale = one.value.scale
        growth = _trend(one.growth, f"{100 * scale * one.growth:+.2g}")
        row = (f"{scale * one.before:+.2f}", f"{scale * one.latest:+.2f}", f"{scale * one.error:.2f}")
        most = f"{scale * one.value.most:.2g}"
        style = "yellow" if one.is_worn else None
        table.add_row(one.value.part, one.value.name, *row, growth, most, one.value.unit, style=style)
    return table


def _margin_table(found: list[Margin], title: str) -> Table:
    figures = ("first swings", "latest", "per 100 swings")
    table = plain_table("joint", "comparison", *figures, right=figures, title=title)
    for one in found:
        growth = _trend(one.growth, f"{1e4 * one.growth:+.1f}")
        values: tuple[Any, ...] = (f"{100 * one.before:.0f}", f"{100 * one.latest:.0f}", growth)
        table.add_row(one.joint, one.kind, *values, style="yellow" if one.near else None)
    return table


def _trend(growth: float, shown: str) -> str:
    """Return `shown`, the text of `growth`, or the reason to show no figure."""
    if isnan(growth):
        return "few swings"
    return shown if growth else "no trend"


# The identified robot --------------------------------------------------------------------------------


SwingRecords = Annotated[list[Path], argument("RECORD...", "Parquet files of swings of one profile.")]
Output = Annotated[Path | None, option("Write the identified robot as a configuration, .toml.", "FILE")]


def identify(
    context: typer.Context, records: SwingRecords, output: Output = None, json_: Json = False
) -> None:
    """Identify friction, valve flow, dead volumes, supply, vane, club and latency from recorded swings.

    Use swings made with the control of --config, none of them the first after arming.
    """
    from bench.learning.identify import NAMES, read_recorded, variation_of, write_plant_file
    from bench.learning.identify import identify as identified
    from bench.simulation.simulated_bench import Bench

    configuration = context.ensure_object(Session).configuration()
    profile, swings = read_recorded(records)
    bench = Bench.of(configuration, profile)
    with progress_of("simulated robots") as show:
        found = identified(bench, swings, progress=show)
    if output is not None:
        robot = variation_of(found.values, bench).applied_to(bench.plant)
        write_plant_file(output, robot, found, configuration)
    columns = NAMES, found.values.tolist(), found.error.tolist(), found.known.tolist()
    fields, figures = ("name", "value", "standard_error", "identified"), ("value", "standard error")
    rows = [*zip(*columns, strict=True)]
    parameters = [dict(zip(fields, row, strict=True)) for row in rows]
    title = f"identified from {len(swings)} swings"
    table = plain_table("parameter", *figures, "", right=figures, title=title)
    for name, value, error, known in rows:
        value_form, error_form = ("{:+.2f} ms", "{:.2f} ms") if name == NAMES[-1] else ("{:.3f}", "{:.3f}")
        note = "" if known else "not identified"
        table.add_row(name, value_form.format(value), error_form.format(error), note)
    words = (
        f"Factors on the configured robot. Simulated swings were off by {found.before:.1f} times what swings "
        f"alike differ by, and are by {found.after:.1f} times now."
    )
    record = {"parameters": parameters, "before": found.before, "after": found.after}
    show_result(json_, record, table, words)
