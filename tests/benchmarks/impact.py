"""Impact: ball speed, launch and spin of the bag against published averages; gear effect.

`--fit` fits restitution, its slope and the loss factor again to every other tour row and prints them.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import cos, degrees, radians, sin
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bench.config import load_configuration
from drivers.base import Launch
from sim.impact import strike
from sim.robot import Club
from tests.benchmarks.row import Row
from tests.sim.deliveries import delivery_from_angles
from tests.sim.tour_averages import (
    BALL,
    MPH,
    ODD_ROW,
    RPM,
    Average,
    Error,
    Fitted,
    club_of,
    error_of,
    fit,
    lofted_averages,
    rms,
    stiffness_of,
    tour_averages,
)

NAME = "impact"


def _print_table(table: Table) -> None:
    """Print `table` as wide as it needs: a pipe counts as 80 columns."""
    needed = Console(width=400).measure(table).maximum
    Console(width=max(needed, Console().width)).print(table, highlight=False)


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold")
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number == 0 else "right")
    return table


def _errors(title: str, averages: Sequence[Average], bag: Mapping[str, Club]) -> tuple[Table, list[Error]]:
    table = _table(title, "average", "", "mph", "attack", "loft", "ball mph", "launch", "rpm", "smash")
    errors = []
    for a in averages:
        error = error_of(a, club_of(a.club, bag))
        errors.append(error)
        table.add_row(
            a.name,
            "held out" if a.held_out else "fitted",
            f"{a.speed / MPH:.0f}",
            f"{degrees(a.attack):+.1f}",
            f"{degrees(a.loft):.1f}",
            f"{a.ball_speed / MPH:.0f} {100 * error.ball_speed:+.1f} %",
            f"{degrees(a.launch):.1f} {error.launch:+.1f}",
            f"{a.spin / RPM:.0f} {100 * error.spin:+.0f} %",
            f"{a.ball_speed * (1 + error.ball_speed) / a.speed:.3f}",
        )
    return table, errors


def _rms_rows(title: str, errors: Sequence[Error], asked: bool) -> list[Row]:
    found, note = rms(errors), f"{len(errors)} rows"
    return [
        Row(
            NAME, f"{title}: ball speed", 100 * found.ball_speed, "% rms", note, None, 1.5 if asked else None
        ),
        Row(NAME, f"{title}: launch", found.launch, "deg rms", note, None, 0.7 if asked else None),
        Row(NAME, f"{title}: spin", 100 * found.spin, "% rms", note, None, 10.0 if asked else None),
    ]


def _fitted(values: Fitted) -> Table:
    table = _table("fitted to every other row", "value", "")
    for name in ("driver", "fairway", "solid"):
        e = getattr(values, name)
        table.add_row(
            f"restitution, {name}", f"{e:.4f}; stiffness across {stiffness_of(e, values.solid):.3f}"
        )
    table.add_row("its slope", f"{values.slope:.5f} s/m")
    table.add_row("loss factor", f"{values.loss:.3f}")
    return table


# --- Over the face ----------------------------------------------------------------------------------


def _struck(club: Club, x: float, y: float) -> Launch:
    """Return the launch of a 100 mph drive at (x, y) mm from the face's centre, the loft 13 degrees."""
    delivery = delivery_from_angles(100 * MPH, 0.0, 0.0, 0.0, radians(13.0), x / 1e3, y / 1e3)
    return strike(delivery, club, BALL)


def _parts(launch: Launch) -> tuple[float, float, float, float, float]:
    """Return ball speed (mph), launch and direction (deg), back and side spin (rpm)."""
    return (
        launch.speed / MPH,
        degrees(launch.launch_angle),
        degrees(launch.direction),
        launch.spin * cos(launch.spin_axis) / RPM,
        launch.spin * sin(launch.spin_axis) / RPM,
    )


def _gear_rows(club: Club) -> list[Row]:
    """Return gear-effect spin relative to Tutelman's rules, and the off-centre loss of ball speed."""
    flat = replace(club, bulge_radius=1e6, roll_radius=1e6)
    centre = _parts(_struck(flat, 0, 0))
    side = _parts(_struck(flat, 10, 0))[4] - centre[4]
    back = (_parts(_struck(flat, 0, -10))[3] - _parts(_struck(flat, 0, 10))[3]) / 2
    depth, inertia = club.head_depth / 0.0254, club.head_inertia_horizontal * 1e7
    lost = 1 - _parts(_struck(club, 12.7, 0))[0] / centre[0]
    return [
        Row(
            NAME,
            "horizontal gear effect over the ideal gear's",
            -side / (58_830 * centre[0] * depth * (10 / 25.4) / inertia),
            "",
            "Tutelman 58,830 V C x / I; flat face",
            0.6,
            0.9,
        ),
        Row(NAME, "the same, rule of thumb 16.4 V x", -side / (16.4 * centre[0] * 10 / 25.4), ""),
        Row(
            NAME,
            "vertical gear effect over the rule 25 V y",
            back / (25 * centre[0] * 10 / 25.4),
            "",
            "Tutelman; flat face",
            0.6,
            1.0,
        ),
        Row(
            NAME, "ball speed lost half an inch off centre", 100 * lost, "%", "Maltby: 7 % of distance, woods"
        ),
    ]


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Print the tables and return the figures."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks impact", description=__doc__)
    parser.add_argument("--fit", action="store_true", help="fit again, and print the values")
    given = parser.parse_args(arguments)
    bag = load_configuration(Path("bag")).clubs
    averages = tour_averages()
    tours, errors = _errors(
        "tour averages 2023, loft from spin; published, error of the model", averages, bag
    )
    lofted, with_loft = _errors("averages with a published loft", lofted_averages(), bag)
    for table in (tours, lofted):
        _print_table(table)
    if given.fit:
        _print_table(_fitted(fit(averages, bag)))
    pairs = list(zip(averages, errors, strict=True))
    return [
        *_rms_rows("held out", [e for a, e in pairs if a.held_out], True),
        *_rms_rows(
            f"held out but {' '.join(ODD_ROW)}",
            [e for a, e in pairs if a.held_out and (a.group, a.club) != ODD_ROW],
            False,
        ),
        *_rms_rows("fitted", [e for a, e in pairs if not a.held_out], False),
        *_rms_rows("published loft", with_loft, False),
        *_gear_rows(bag["wood1"]),
    ]
