"""What the demo shows: a table that grows shot by shot beside a progress bar, then the result in words."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple, Self

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from bench.campaign.findings import Findings
from bench.campaign.reader_units import MPH, YARD
from bench.campaign.verdicts import robot_words
from bench.commands.progress import progress_bar
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


class Screen:
    """Use it as a context. Progress goes to standard error, the result to standard output.

    Args:
        title: what is done, in a line.
        swings: how many shots are expected.
    """

    def __init__(self, title: str, swings: int) -> None:
        self._title, self._swings = title, swings
        self._shots: list[Shot] = []
        self._progress = progress_bar()
        self._task = self._progress.add_task("", total=swings + 2)  # the report and the recording too
        self._live: Live | None = None
        self._open = ExitStack()

    def __enter__(self) -> Self:
        console = self._progress.console
        if console.is_terminal:
            live = Live(console=console, transient=True, get_renderable=self._drawing)
            self._live = self._open.enter_context(live)
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def say(self, doing: str) -> None:
        """Say beside the bar what is being done."""
        self._progress.update(self._task, description=doing)

    def step(self) -> None:
        """Move the bar on."""
        self._progress.advance(self._task)

    def add(self, shot: Shot) -> None:
        """Add a row to the table."""
        self._shots.append(shot)
        self.step()
        if self._live is not None:
            self._live.refresh()

    def finish(self, scatter: str, seed: int, files: Sequence[Path], stopped: str, found: Findings) -> None:
        """Print the result: table, what was varied, verdict, and where the `files` are.

        `stopped`: why it ended early, else empty.
        """
        self._open.close()
        console = Console(highlight=False)
        console.print(self._table())
        left = self._swings - len(self._shots)
        if stopped:
            console.print(f"{stopped}, {left} swings not begun.", style="bold red")
        elif left > 0:
            console.print(f"{left} swings not begun: after a stop nothing arms by itself.", style="bold red")
        console.print(
            f"Everything is simulated. From shot to shot differ, drawn from seed {seed}: {scatter}."
        )
        console.print()
        for verdict in (verdict for section in found.verdicts for verdict in section):
            console.print(verdict.headline, style="bold")
            console.print(verdict.detail)
        console.print(robot_words(found.repeatability))
        console.print()
        for path in files:
            console.print(_way_to_open(path), soft_wrap=True)

    def _drawing(self) -> Group:
        return Group(self._table(), self._progress.get_renderable())

    def _table(self) -> Table:
        """Return the shots so far; below them why those that are not valid are not."""
        table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=0, title_justify="left")
        table.title = Text(self._title, "bold")
        for column in _COLUMNS:
            name = column.head == "ball" and not column.unit
            table.add_column(
                f"{column.head}\n[dim]{column.unit}[/]", justify="left" if name else "right", no_wrap=True
            )
        for shot in self._shots:
            style = None if shot.status is ShotStatus.VALID else "red"
            table.add_row(*(column.text(shot) for column in _COLUMNS), style=style)
        reasons = [f"shot {shot.shot}, {shot.status}: {shot.reason}" for shot in self._shots if shot.reason]
        if reasons:
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
