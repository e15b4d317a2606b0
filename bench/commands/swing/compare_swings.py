"""`golfbench compare`: two records, profiles or configurations, and where they differ."""

from __future__ import annotations

from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bench.base.errors import BenchError
from bench.commands.common.options import Json, Plot, argument, require_picture
from bench.commands.common.output import console_of, finite, plain_table
from bench.commands.common.session import Session, show_json

if TYPE_CHECKING:
    from rich.table import Table

    from bench.config import Configuration
    from bench.records.shot.overlay import FigureDifference, SwingCourse

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
            raise BenchError(
                "--plot", "two configurations", "two swings", "Leave --plot out: it draws two swings."
            )
        return _show_keys(places, _keys(settings[0]), _keys(settings[1]), json_)
    for location, found, other in zip(places, settings, reversed(places), strict=True):
        if found is not None:
            action = "Compare two configurations, or two records or profiles."
            raise BenchError(
                location, f"a configuration, compared with {other}", "a record or a profile", action
            )
    from bench.records.shot.overlay import clocks, differences

    configuration = context.ensure_object(Session).configuration()
    courses = _course(first, configuration), _course(second, configuration)
    rows = differences(*courses)
    at_ball = clocks(*courses)[2]
    if plot is not None:
        from bench.records.shot.overlay import overlay_plot

        overlay_plot(*courses).savefig(plot, dpi=150)
    if json_:
        shown = [{name: finite(value) for name, value in row._asdict().items()} for row in rows]
        return show_json({"first": first, "second": second, "aligned_at_ball": at_ball, "differences": shown})
    console = console_of(_WIDTH)
    console.print(_table(rows, courses[0].name, courses[1].name), highlight=False)
    aligned = "the ball" if at_ball else "the start, as one of them did not come to the ball"
    typer.echo(f"RMS: root mean square from the start to the ball. Clocks are aligned at {aligned}.")
    if plot is not None:
        typer.echo(f"Picture: {plot}")


def _settings(location: str) -> Configuration | None:
    """Return the configuration at `location`, None if it names something else."""
    from bench.base.configuration_files import variant_names
    from bench.base.from_toml import read_toml
    from bench.config import load_configuration

    path = Path(location)
    if path.suffix == ".toml" and "schema" not in read_toml(path, "a configuration or a profile", _ACTION):
        return load_configuration(path)
    return load_configuration(path) if location in variant_names() else None


def _course(location: str, configuration: Configuration) -> SwingCourse:
    """Return the swing at `location`, a record or a profile."""
    from bench.records.shot.overlay import course_of_profile, course_of_record
    from bench.records.shot.recorded_shot import read_shot
    from bench.swing.library import find_profile
    from bench.swing.profile import load_profile

    if location.endswith(".parquet"):
        course = course_of_record(
            "/".join(Path(location).with_suffix("").parts[-2:]), read_shot(Path(location))
        )
        if not len(course.time):
            raise BenchError(
                location,
                "no swing in the record",
                "a record of a swing",
                "Name a record in which the robot swung.",
            )
        return course
    return course_of_profile(configuration.plant, load_profile(find_profile(location)))


def _table(rows: list[FigureDifference], first: str, second: str) -> Table:
    figures = (first, second, "difference", "RMS of differences")
    table = plain_table("figure", "unit", *figures, right=figures)
    for row in rows:
        table.add_row(row.name, row.unit, *map(_number, row[2:]))
    return table


def _number(value: float) -> str:
    return "" if isnan(value) else f"{value:.4g}" if abs(value) >= 1000 else f"{value:.3f}"


def _keys(configuration: Configuration) -> dict[str, str]:
    """Return all keys of `configuration` with their values as texts; not the files it was read from."""
    from bench.campaign.report.report_format import flat

    groups = flat(configuration.effective())
    return {f"{group}.{key}": text for group, keys in groups if group for key, text in keys}


def _show_keys(places: tuple[str, str], first: dict[str, str], second: dict[str, str], json_: bool) -> None:
    """Print the keys that differ between two configurations."""
    names = [name for name in {**first, **second} if first.get(name) != second.get(name)]
    rows: list[dict[str, Any]] = [
        {"key": name, "first": first.get(name), "second": second.get(name)} for name in names
    ]
    if json_:
        return show_json({"first": places[0], "second": places[1], "differences": rows})
    if not rows:
        return typer.echo("The configurations are equal in all keys.")
    table = plain_table("key", *places)
    for row in rows:
        table.add_row(row["key"], row["first"] or "", row["second"] or "")
    console_of(_WIDTH).print(table, highlight=False)
