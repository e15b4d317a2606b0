"""What the demo prints in the end: a table of its shots and the result in words."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.campaign.display_units import MPH, YARD
from bench.campaign.findings import Findings
from bench.campaign.verdicts import robot_words
from bench.shot.shot import Shot, ShotStatus


class ScreenColumn(NamedTuple):
    """One column of the table."""

    head: str
    unit: str
    text: Callable[[Shot], str]


def _figure(name: str, form: str, scale: float = 1.0) -> Callable[[Shot], str]:
    """Return a function that writes one figure of a shot, divided by `scale`; "–" when there is none."""

    def text(shot: Shot) -> str:
        value = getattr(shot, name)
        return "–" if value is None else format(value / scale, form).replace("-", "−")

    return text


def _strike(shot: Shot) -> str:
    """Write where on the face the ball was struck."""
    return f"{_figure('strike_x_mm', '+.1f')(shot)} {_figure('strike_y_mm', '+.1f')(shot)}"


_COLUMNS = (
    ScreenColumn("shot", "", lambda shot: str(shot.shot)),
    ScreenColumn("ball", "", lambda shot: shot.ball),
    ScreenColumn("club", "mph", _figure("club_speed_mps", ".2f", MPH)),
    ScreenColumn("", "m/s", _figure("club_speed_mps", ".2f")),
    ScreenColumn("attack", "°", _figure("attack_angle_deg", "+.2f")),
    ScreenColumn("strike", "mm", _strike),
    ScreenColumn("ball", "mph", _figure("ball_speed_mps", ".1f", MPH)),
    ScreenColumn("launch", "°", _figure("launch_angle_deg", ".1f")),
    ScreenColumn("spin", "rpm", _figure("spin_rpm", ".0f")),
    ScreenColumn("carry", "yd", _figure("carry_m", ".1f", YARD)),
    ScreenColumn("", "m", _figure("carry_m", ".1f")),
)


def print_result(title: str, planned: int, shots: Sequence[Shot], ending: str, scatter: str) -> None:
    """Print the table of `shots` below `title`, how the demo ended, and what was varied.

    `ending`: why fewer than the `planned` shots were made, else empty; `scatter`: what differs by itself.
    """
    console = Console(highlight=False)
    console.print(_table(title, shots))
    left = planned - len(shots)
    if ending:
        console.print(f"{ending}, {left} swings not begun.", style="bold red")
    elif left > 0:
        console.print(f"{left} swings not begun: after a stop nothing arms by itself.", style="bold red")
    console.print(f"Everything is simulated. From shot to shot differ, {scatter}.\n")


def print_findings(found: Findings, files: Sequence[Path]) -> None:
    """Print the verdicts, and where the `files` are."""
    console = Console(highlight=False)
    for verdict in (verdict for section in found.verdicts for verdict in section):
        console.print(verdict.headline, style="bold")
        console.print(verdict.detail)
    console.print(f"{robot_words(found.repeatability)}\n")
    for path in files:
        console.print(_way_to_open(path), soft_wrap=True)


def _table(title: str, shots: Sequence[Shot]) -> Table:
    """Return the shots; below them why those that are not valid are not."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=0, title_justify="left")
    table.title = Text(title, "bold")
    for column in _COLUMNS:
        name = column.head == "ball" and not column.unit
        table.add_column(
            f"{column.head}\n[dim]{column.unit}[/]", justify="left" if name else "right", no_wrap=True
        )
    for shot in shots:
        style = None if shot.status is ShotStatus.VALID else "red"
        table.add_row(*(column.text(shot) for column in _COLUMNS), style=style)
    if reasons := [f"shot {shot.shot}, {shot.status}: {shot.reason}" for shot in shots if shot.reason]:
        table.caption = Text("\n".join(reasons), "red", justify="left")
        table.caption_justify = "left"
    return table


def _way_to_open(path: Path) -> str:
    """Return the file's path with what opens it."""
    match path.suffix:
        case ".html":
            return f"report     {path}   (opens in any browser)"
        case ".rrd":
            rerun = Path(sys.executable).with_name("rerun")
            shown = os.path.relpath(rerun) if rerun.is_relative_to(Path.cwd()) else rerun
            return f"recording  {path}\n           opens with: {shown} {path}"
        case ".csv":
            return f"shots      {path}"
        case _:
            return f"swings     {path}{os.sep}   (Parquet, a row a millisecond)"
