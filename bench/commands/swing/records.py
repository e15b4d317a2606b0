"""`golfbench export`, `compare`, `replay`: recorded swings for other programs, compared, and repeated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from importlib.metadata import version
from math import isfinite, isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.text import Text

from bench.base.configuration_files import variant_names
from bench.base.errors import BenchError, Refused
from bench.base.from_toml import read_toml
from bench.commands.common import (
    Json,
    Plot,
    Session,
    argument,
    console_of,
    exit_unless,
    finite,
    flag,
    option,
    plain_table,
    progress_bar,
    progress_of,
    require_picture,
    show_json,
)
from bench.swing.library import find_profile

if TYPE_CHECKING:
    from rich.table import Table

    from bench.config import Configuration
    from bench.records.shot.overlay import SwingCourse
    from bench.records.telemetry.record_file import SwingRecord
    from bench.simulation.replay import Difference, Replay


# Export ----------------------------------------------------------------------------------------------


class Format(StrEnum):
    """Output format."""

    CSV = "csv"
    RRD = "rrd"
    MCAP = "mcap"
    MAT = "mat"


def export(
    records: Annotated[list[Path], argument("RECORD...", "Records of swings, .parquet, or folders of them.")],
    format_: Annotated[Format, option("Output format.", names="--format")],
    output: Annotated[
        Path | None, option("File for one record, folder for several.", "PATH", shown="next to each")
    ] = None,
    force: Annotated[bool, flag("--force", "Replace files that exist.")] = False,
) -> None:
    """Write records of swings for other programs, with the unit of every column.

    csv stores its units in NAME.csv-metadata.json; rrd is for Rerun, mcap for Foxglove (with a layout file;
    extra `mcap`), mat for MATLAB.
    """
    from bench.records.telemetry.record_file import SwingRecord, read_swing, record_files

    targets = planned_exports(record_files(records), format_, output, force)
    write = _writer(format_)
    with progress_bar() as progress:
        task = progress.add_task("exporting", total=len(targets))
        for source, target in targets:
            written = write(target, SwingRecord(source, *read_swing(source)))
            progress.advance(task)
            typer.echo("\n".join(map(str, written)))


def planned_exports(
    sources: list[Path], format_: Format, output: Path | None, force: bool
) -> list[tuple[Path, Path]]:
    """Return each record with the file it is written to.

    Raises:
        Refused: a file exists, and `force` is not given.
        BenchError: two records would be written to one file.
    """
    suffix = f".{format_.value}"
    if output is not None and len(sources) == 1 and not output.is_dir():
        targets = [(sources[0], output)]
    else:
        if output is not None:
            output.mkdir(parents=True, exist_ok=True)
        targets = [(s, (output or s.parent) / f"{s.stem}{suffix}") for s in sources]
    names = [target for _, target in targets]
    for target in names:
        if names.count(target) > 1:
            found = "several records of that name"
            raise BenchError(str(target), found, "a file for each record", "Export them one by one.")
        if target.exists() and not force:
            raise Refused(
                str(target), "a file", "a name that is free", "Name another --output, or add --force."
            )
    return targets


def _writer(format_: Format) -> Callable[[Path, SwingRecord], list[Path]]:
    """Return what writes `format_`; only its own library is imported."""
    if format_ is Format.RRD:
        from bench.viewer.rerun_recording import write_rrd

        return write_rrd
    from bench.viewer import export_files as to

    return {Format.CSV: to.write_csv, Format.MCAP: to.write_mcap, Format.MAT: to.write_mat}[format_]


# Compare ---------------------------------------------------------------------------------------------

_ACTION = "Give two records, profiles or configurations."
_WIDTH = 130
"""Columns in a file or pipe."""

First = Annotated[str, argument("A", "Record (.parquet), profile by name or path, or configuration.")]
Second = Annotated[str, argument("B", "Compared with it.")]


def compare(
    context: typer.Context, first: First, second: Second, plot: Plot = None, json_: Json = False
) -> None:
    """Compare two swings, recorded or planned, or two configurations: where they differ.

    Swings: delivery, tracking errors, angles, openings and pressures up to impact, at which both clocks are
    aligned. A record may be compared with a profile.
    """
    require_picture(plot)
    places = (first, second)
    settings = [_settings(location) for location in places]
    if settings[0] is not None and settings[1] is not None:
        if plot is not None:
            action = "Leave --plot out: it draws two swings."
            raise BenchError("--plot", "two configurations", "two swings", action)
        return _show_keys(places, _keys(settings[0]), _keys(settings[1]), json_)
    for location, found, other in zip(places, settings, reversed(places), strict=True):
        if found is not None:
            other_kind = f"a configuration, compared with {other}"
            action = "Compare two configurations, or two records or profiles."
            raise BenchError(location, other_kind, "a record or a profile", action)
    from bench.records.shot.overlay import clocks, differences

    configuration = context.ensure_object(Session).configuration()
    courses = _course(first, configuration), _course(second, configuration)
    rows = differences(*courses)
    at_ball = clocks(*courses)[2]
    if plot is not None:
        from bench.records.shot.overlay import overlay_plot
        from bench.records.shot.plot_style import save_picture

        save_picture(overlay_plot(*courses), plot)
    if json_:
        shown = [{name: finite(value) for name, value in row._asdict().items()} for row in rows]
        return show_json({"first": first, "second": second, "aligned_at_ball": at_ball, "differences": shown})
    console = console_of(_WIDTH)
    figures = (courses[0].name, courses[1].name, "difference", "RMS of differences")
    cells = ((row.name, row.unit, *map(_number, row[2:])) for row in rows)
    console.print(plain_table("figure", "unit", *figures, right=figures, rows=cells), highlight=False)
    aligned = "the ball" if at_ball else "the start, as one of them did not come to the ball"
    typer.echo(f"RMS: root mean square from the start to the ball. Clocks are aligned at {aligned}.")
    if plot is not None:
        typer.echo(f"Picture: {plot}")


def _settings(location: str) -> Configuration | None:
    """Return the configuration at `location`, None if it names something else."""
    from bench.config import load_configuration

    path = Path(location)
    if path.is_dir():
        raise BenchError(location, "a folder", "a record, a profile or a configuration", "Name a file in it.")
    if path.suffix == ".toml" and "schema" not in read_toml(path, "a configuration or a profile", _ACTION):
        return load_configuration(path)
    return load_configuration(path) if location in variant_names() else None


def _course(location: str, configuration: Configuration) -> SwingCourse:
    from bench.records.shot.overlay import course_of_profile, course_of_record
    from bench.records.shot.recorded_shot import read_shot
    from bench.swing.profile import load_profile

    if location.endswith(".parquet"):
        name = "/".join(Path(location).with_suffix("").parts[-2:])
        course = course_of_record(name, read_shot(Path(location)))
        if not len(course.time):
            action = "Name a record in which the robot swung."
            raise BenchError(location, "no swing in the record", "a record of a swing", action)
        return course
    return course_of_profile(configuration.plant, load_profile(find_profile(location)))


def _number(value: float) -> str:
    return "" if isnan(value) else f"{value:.4g}" if abs(value) >= 1000 else f"{value:.3f}"


def _keys(configuration: Configuration) -> dict[str, str]:
    """Return all keys of `configuration` with their values as texts; not the files it was read from."""
    from bench.campaign.report.report_format import flat

    groups = flat(configuration.effective())
    return {f"{group}.{key}": text for group, keys in groups if group for key, text in keys}


def _show_keys(places: tuple[str, str], first: dict[str, str], second: dict[str, str], json_: bool) -> None:
    names = [name for name in {**first, **second} if first.get(name) != second.get(name)]
    rows: list[dict[str, Any]] = [
        {"key": name, "first": first.get(name), "second": second.get(name)} for name in names
    ]
    if json_:
        return show_json({"first": places[0], "second": places[1], "differences": rows})
    if not rows:
        return typer.echo("The configurations are equal in all keys.")
    cells = ([Text(row[part] or "") for part in ("key", "first", "second")] for row in rows)
    console_of(_WIDTH).print(plain_table("key", *map(escape, places), rows=cells), highlight=False)


# Replay ----------------------------------------------------------------------------------------------


def replay(
    record: Annotated[Path, argument("RECORD", "Record of a swing, .parquet.")],
    json_: Json = False,
) -> None:
    """Replay a record's readings through the present controller and compare all fields.

    Exits with 1 if a field differs.
    """
    from bench.records.telemetry.record_file import read_swing
    from bench.simulation.replay import replay_cycles

    cycles, metadata = read_swing(record)
    with progress_of(f"replaying {record.name}", len(cycles)) as show:
        replayed = replay_cycles(cycles, metadata, str(record), lambda done, total: show(done))
    differences = replayed.differences()
    equal = not any(difference.ticks for difference in differences)
    if json_:
        show_json(replay_json(replayed, differences, metadata))
        return exit_unless(equal)
    console = Console()
    same = [d.field for d in differences if d.greatest == 0.0]
    if len(same) < len(differences):
        console.print(replay_table(differences))
    console.print(f"the same bit for bit: {', '.join(same) or 'no field'}", highlight=False)
    console.print(replay_summary(replayed, metadata), highlight=False)
    first = min((d for d in differences if d.ticks), key=lambda d: d.tick or 0, default=None)
    if first is None:
        console.print("Equal: today's controller repeats the record.", style="green", highlight=False)
    else:
        told = f"Different: first in tick {first.tick}, {first.field}."
        console.print(told, style="red", highlight=False)
    exit_unless(equal)


def replay_table(differences: Sequence[Difference]) -> Table:
    """Return a table of the fields that are not the same bit for bit; those within the tolerance are dim."""
    figures = ("greatest", "ticks", "from tick", "recorded", "replayed")
    table = plain_table("field", *figures, right=figures)
    for d in differences:
        if d.greatest == 0.0:
            continue
        name, greatest = f"{d.field} {d.component}".strip(), f"{d.greatest:.2g}"
        if not d.ticks:
            table.add_row(name, greatest, "0", "", "", "", style="dim")
            continue
        values = _shown(d.field, d.recorded), _shown(d.field, d.replayed)
        table.add_row(Text(name, "red"), greatest, str(d.ticks), f"{d.tick}", *values)
    return table


def replay_summary(replay: Replay, metadata: Mapping[str, Any]) -> str:
    """Return the extent of the replay, and the settings and versions that may explain differences."""
    from bench.simulation.replay import TOLERANCE

    ticks = replay.recorded["tick"]
    lines = [
        f"{len(ticks)} ticks, {ticks[0]} to {ticks[-1]}, through today's cycle; "
        f"equal means within {TOLERANCE:g} + {TOLERANCE:g} times the value, codes exactly"
    ]
    if replay.defaults:
        lines.append(f"older than these settings, taken by default: {', '.join(replay.defaults)}")
    if changed := changed_versions(metadata):
        told = ", ".join(f"{name} {old} (now {new})" for name, (old, new) in changed.items())
        lines.append(f"written with {told}")
    return "\n".join(lines)


def changed_versions(metadata: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Return the packages that the record was written with in another version: name -> (then, now)."""
    recorded = metadata.get("versions")
    found = {}
    for name in ("golfbench", "numpy", "numba"):
        old = str(recorded.get(name, "unknown")) if isinstance(recorded, Mapping) else "unknown"
        if old != version(name):
            found[name] = (old, version(name))
    return found


def replay_json(
    replay: Replay, differences: Sequence[Difference], metadata: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the same for a program; a value that is no number, or infinite, is null."""
    from bench.simulation.replay import INPUTS, MEASURED, TOLERANCE

    ticks = replay.recorded["tick"]
    return {
        "version": 1,
        "equal": not any(d.ticks for d in differences),
        "ticks": len(ticks),
        "first_tick": int(ticks[0]),
        "last_tick": int(ticks[-1]),
        "tolerance": TOLERANCE,
        "fields": [
            {key: finite(value) for key, value in d._asdict().items()}
            if d.ticks
            else {"field": d.field, "greatest": finite(d.greatest), "ticks": 0}
            for d in differences
        ],
        "inputs": sorted(INPUTS),
        "not_compared": sorted(MEASURED),
        "default_settings": list(replay.defaults),
        "changed_versions": changed_versions(metadata),
    }


def _shown(field: str, value: float) -> str:
    from bench.records.telemetry.cycle_record import ENUMERATIONS

    names = ENUMERATIONS.get(field)
    return names.get(str(int(value)), str(int(value))) if names and isfinite(value) else f"{value:.6g}"
