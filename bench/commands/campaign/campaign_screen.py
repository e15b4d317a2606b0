"""Campaigns at the terminal: the progress of a running one, the list of stored ones."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Column, Table
from rich.text import Text

from bench.campaign.interruptions import duration_text
from bench.records.shot.shot import ShotStatus
from bench.store.records import ENDED, CampaignEntry, CampaignState, Standing, state_text

_SELDOM = 2.0
"""Min time between plain lines for valid shots, s."""
_FIGURES = (
    ("club_speed_mps", "club", 2, "m/s"),
    ("ball_speed_mps", "ball", 2, "m/s"),
    ("launch_angle_deg", "launch", 1, "°"),
    ("spin_rpm", "spin", 0, "rpm"),
    ("carry_m", "carry", 1, "m"),
)


class CampaignBar(Progress):
    """A progress bar with lines of text below it."""

    lines: Sequence[Text] = ()
    key_line: Text | None = None
    """Line of the keys, the last one."""
    _hidden = False

    def hide(self) -> None:
        """Give the terminal to a prompt.

        The bar is emptied before it stops: it would erase as many lines of the prompt when it starts again.
        """
        self._hidden = True
        self.refresh()
        self.stop()

    def show(self) -> None:
        """Resume the bar below the prompt."""
        self._hidden = False
        self.start()

    def get_renderables(self) -> Iterator[RenderableType]:
        """Yield the bar, then the lines."""
        if self._hidden:
            return
        yield self.make_tasks_table(self.tasks)
        yield from self.lines
        if (line := self.key_line) is not None:
            yield line


def campaign_bar() -> CampaignBar:
    """Return a bar on standard error; without a terminal it shows nothing, see `ProgressScreen`."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    return CampaignBar(*columns, console=console, transient=True, disable=not console.is_terminal)


class ProgressScreen:
    """Shows the messages of a campaign's progress: a bar with lines, or plain lines without a terminal."""

    def __init__(self, bar: CampaignBar) -> None:
        self._bar = bar
        self._task = bar.add_task("warming up", total=None)
        self._printed = -_SELDOM
        self._shots = 0
        self._event: object = None
        self._standing: object = None

    def follow(self, message: Mapping[str, Any]) -> None:
        """Show `message`, with its event and its reason above the bar if they are new."""
        self.show(message)
        event, standing = message["event"], (message["state"], message["reason"])
        if event != self._event and event:
            self._say(event["text"])
        if standing != self._standing and message["reason"]:
            self._say(state_text(*standing))
        self._event, self._standing = event, standing

    def show(self, message: Mapping[str, Any]) -> None:
        """Show `message`; a plain line for a new shot, of many in a second only some and all invalid ones."""
        if not self._bar.disable:
            block = f"block {message['block']}/{message['blocks']}" if message["block"] else "warming up"
            self._bar.update(
                self._task, completed=message["done"], total=message["planned"], description=block
            )
            self._bar.lines = [Text(line, overflow="fold") for line in progress_lines(message)]
            return
        shot, now = message["last_shot"], time.monotonic()
        if shot is None or message["shots"] == self._shots:
            return
        self._shots = message["shots"]
        if shot["status"] == ShotStatus.VALID and now - self._printed < _SELDOM:
            return
        self._printed = now
        left = _left(message)
        typer.echo(
            f"{shot['time_utc'][:19]}Z {message['done']}/{message['planned']} {shot_line(shot)}"
            f"{f'; {left}' if left else ''}",
            err=True,
        )

    def _say(self, text: str) -> None:
        """Print above the bar, or as a plain line with its time."""
        if self._bar.disable:
            typer.echo(f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%S}Z {text}", err=True)
        else:
            self._bar.console.print(escape(text), highlight=False)


def progress_lines(message: Mapping[str, Any]) -> list[str]:
    """Return the lines of `message` for a person: time, balls, last shot, next work by hand."""
    lines = []
    if left := _left(message):
        lines.append(left)
    if shot := message["last_shot"]:
        lines.append(f"last: {shot_line(shot)}")
    balls = [f"{name} {n['valid']}/{n['planned']}" for name, n in message["balls"].items()]
    invalid = message["shots"] - message["valid"]
    lines.append(f"valid: {', '.join(balls)}" + (f"; {invalid} invalid" if invalid else ""))
    if work := message["next_work"]:
        when = "now" if not work["shots"] else f"after {work['shots']} more shots"
        if work["shots"] and work["seconds"] is not None:
            when += f", in about {duration_text(work['seconds'])}"
        lines.append(f"next by hand: {work['text']} {when}")
    if message["state"] != CampaignState.RUNNING:
        lines.append(state_text(message["state"], message["reason"]))
    return lines


def shot_line(shot: Mapping[str, Any]) -> str:
    """Return a shot of a message with its figures, and the reason unless it is valid."""
    figures = [
        f"{word} {shot[name]:.{digits}f} {unit}"
        for name, word, digits, unit in _FIGURES
        if shot[name] is not None
    ]
    ball = f"{shot['ball']} {shot['sample']}" if shot["sample"] else shot["ball"]
    reason = f" {shot['reason']}" if shot["reason"] else ""
    return f"shot {shot['shot']}, {ball}, {shot['status']}{reason}: {', '.join(figures) or 'not measured'}"


def _left(message: Mapping[str, Any]) -> str:
    if message["seconds_left"] is None or message["state"] in ENDED:
        return ""
    end = datetime.now().astimezone() + timedelta(seconds=message["seconds_left"])
    return f"{duration_text(message['seconds_left'])} left, until {end:%H:%M}"


# The list --------------------------------------------------------------------------------------------

Listed = Sequence[tuple[CampaignEntry, Standing, Counter[str]]]


def listing(found: Listed, console: Console) -> Table:
    """Return the campaigns as a table for `console`, wider than it where whole ids do not fit."""
    longest = max((len(entry.id) for entry, _, _ in found), default=0)
    bench = max((len(entry.bench) for entry, _, _ in found), default=0)
    identity = Column("campaign", width=longest, no_wrap=True), Column("bench", min_width=bench, no_wrap=True)
    others = (Column("start, UTC", min_width=10), Column("state", min_width=9), "shots", "valid", "excluded")
    table = Table(*identity, *others, box=SIMPLE_HEAD)
    for entry, standing, counts in found:
        reason = [Text(standing.reason, style="dim", no_wrap=False)] if standing.reason else []
        table.add_row(
            Group(Text(entry.id), *reason),
            Text(entry.bench),
            f"{entry.date:%Y-%m-%d %H:%M}",
            f"{standing.state}{' (sim)' if entry.simulated else ''}",
            str(sum(counts.values())),
            str(counts[ShotStatus.VALID]),
            str(counts[ShotStatus.EXCLUDED]),
        )
    whole = console.measure(table, options=console.options.update(max_width=1000)).minimum
    table.width = max(console.width, whole)
    return table


def listing_record(found: Listed) -> list[dict[str, Any]]:
    """Return the campaigns for a program to read."""
    return [
        {
            "id": entry.id,
            "bench": entry.bench,
            "name": entry.name,
            "date": entry.date.isoformat(),
            "simulated": entry.simulated,
            "seed": entry.seed,
            "plan": entry.digest,
            "state": str(standing.state),
            "reason": standing.reason,
            "shots": {str(status): counts[status] for status in ShotStatus},
        }
        for entry, standing, counts in found
    ]
