"""Campaigns at the terminal: progress and list, prompts confirmed with Enter, and the key that marks a shot.

A load list may be confirmed with the number of loaded balls, which is compared with it. While the
series runs, a key marks a shot, with a comment typed below the progress bar. Keys are read in a thread of
their own, from a terminal in the foreground only: neither a pipe nor a background process loses a byte or
stops.
"""

from __future__ import annotations

import codecs
import os
import re
import select
import sys
import termios
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from threading import Event, Lock, Thread
from typing import Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.markup import escape
from rich.panel import Panel
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Column, Table
from rich.text import Text

from bench.base.errors import BenchError, Refused
from bench.campaign.interruptions import duration_text
from bench.commands.common import at_terminal, discard_typed, user_name
from bench.records.shot.shot import ShotStatus
from bench.store.rows import (
    ENDED,
    MAX_COMMENT_LENGTH,
    CampaignEntry,
    CampaignState,
    Numbered,
    Prompt,
    PromptKind,
    ShotNote,
    Standing,
    places,
    state_text,
)

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


# Marks -----------------------------------------------------------------------------------------------

HINT = "m: mark the last shot"
_LOOK = 0.1
"""Max time until a key is seen, s."""
_SEQUENCE = re.compile(r"\x1b(\[[0-9;?]*[ -/]*[@-~]|O.)")
"""Sequences that a terminal sends for arrows and function keys."""
_DELETE, _CLEAR, _CANCEL, _DONE = "\x7f\b", "\x15", "\x1b", "\r\n"


def in_foreground(terminal: int) -> bool:
    """Return whether this process may read from `terminal`; one in the background would be stopped."""
    try:
        return os.tcgetpgrp(terminal) == os.getpgrp()
    except OSError:  # not the controlling terminal: it stops no process
        return True


class MarkLine:
    """A comment on a shot, typed key by key."""

    def __init__(self, by: str) -> None:
        self.by = by
        self._open: ShotNote | None = None

    @property
    def shown(self) -> str:
        """The line for the terminal."""
        note = self._open
        return HINT if note is None else f"mark shot {note.shot} (Enter: store, Esc: cancel): {note.text}▏"

    def feed(self, keys: str, last: int, now: datetime) -> list[ShotNote]:
        """Take `keys`, typed `now` with `last` as the last shot (0: none yet); return the finished marks."""
        done = []
        for key in _SEQUENCE.sub("", keys):
            if self._open is None:
                if key in "mM" and last:
                    self._open = ShotNote(last, now, self.by, "")
            elif key in _DONE:
                done += self.finish()
            elif key == _CANCEL:
                self._open = None
            else:
                self._open = self._open._replace(text=_edited(self._open.text, key))
        return done

    def finish(self) -> list[ShotNote]:
        """Return the unfinished mark that is being typed, if any."""
        note, self._open = self._open, None
        return [] if note is None else [note._replace(text=note.text.strip())]


def _edited(text: str, key: str) -> str:
    if key in _DELETE:
        return text[:-1]
    if key == _CLEAR:
        return ""
    return text + key if key.isprintable() and len(text) < MAX_COMMENT_LENGTH else text


class MarkKeys:
    """Reads the keys of the terminal and stores the marks; pauses while a prompt reads lines."""

    def __init__(
        self,
        bar: CampaignBar,
        by: str,
        progress: Callable[[], Mapping[str, Any]],
        store: Callable[[ShotNote], None],
    ) -> None:
        """`progress` returns the campaign's; `store` raises BenchError if a mark cannot be stored yet."""
        self._bar, self._progress, self._store = bar, progress, store
        self._line, self._kept = MarkLine(by), deque[ShotNote]()
        self._decoder = codecs.getincrementaldecoder("utf-8")("ignore")
        self._lock, self._paused, self._closing = Lock(), False, Event()
        self._before: list[Any] | None = None
        """Settings of the terminal before its keys were read singly."""
        self._thread = Thread(target=self._work, name="keys", daemon=True)
        self._thread.start()

    def _last(self) -> int:
        """Return the last shot, 0 before the first."""
        shot = self._progress()["last_shot"]
        return shot["shot"] if shot else 0

    def mark(self, text: str) -> None:
        """Mark the last shot with a comment that was typed elsewhere."""
        if last := self._last():
            self._kept.append(ShotNote(last, datetime.now(UTC), self._line.by, text[:MAX_COMMENT_LENGTH]))

    def pause(self) -> None:
        """Give the terminal back for lines; a mark that is being typed is stored as it is."""
        with self._lock:
            self._paused = True
            self._kept += self._line.finish()
            self._restore()

    def resume(self) -> None:
        """Read keys again."""
        with self._lock:
            self._paused = False

    def close(self) -> None:
        """End; store the typed text, and report a mark that cannot be stored."""
        self._closing.set()
        self._thread.join()
        self.pause()
        self._bar.key_line = None
        self._store_kept()
        for note in self._kept:
            self._print(f"The mark of shot {note.shot} was not stored: {note.text}")

    def _work(self) -> None:
        while not self._closing.is_set():
            with self._lock:
                heard = not self._paused and self._listen()
            shown = heard and self._last()  # the first shot is the first that can be marked
            self._bar.key_line = Text(self._line.shown, style="dim") if shown else None
            self._store_kept()
            if not heard:
                self._closing.wait(_LOOK)

    def _listen(self) -> bool:
        """Read the keys that were pressed; return whether this process may read the terminal."""
        with suppress(OSError, termios.error):
            terminal = sys.stdin.fileno()
            if not in_foreground(terminal):
                self._before = None
                return False
            self._read_singly(terminal)
            if select.select([terminal], [], [], _LOOK)[0]:
                if not (found := os.read(terminal, 1024)):
                    self._closing.set()
                keys = self._decoder.decode(found)
                self._kept += self._line.feed(keys, self._last(), datetime.now(UTC))
            return True
        self._closing.set()  # no terminal any more
        return False

    def _read_singly(self, terminal: int) -> None:
        """Get keys without Enter and without echo; Ctrl-C stays a signal."""
        now, lines = termios.tcgetattr(terminal), termios.ICANON | termios.ECHO
        if now[3] & lines or self._before is None:
            # Off already: a killed command left it so, and could not restore it.
            flags = now[3] if now[3] & lines else now[3] | lines
            self._before = [*now[:3], flags, *now[4:6], list(now[6])]
        if now[3] & lines:
            now[3] &= ~lines
            termios.tcsetattr(terminal, termios.TCSADRAIN, now)

    def _restore(self) -> None:
        before, self._before = self._before, None
        with suppress(OSError, termios.error, ValueError):
            terminal = sys.stdin.fileno()
            if before is not None and in_foreground(terminal):
                termios.tcsetattr(terminal, termios.TCSADRAIN, before)

    def _store_kept(self) -> None:
        """Store the marks whose shots are stored; the others are tried again."""
        while self._kept:
            note = self._kept[0]
            try:
                self._store(note)
            except BenchError:
                return
            self._kept.popleft()
            self._print(f"shot {note.shot} marked{f': {note.text}' if note.text else ''}")

    def _print(self, text: str) -> None:
        self._bar.console.print(Text(text), highlight=False)


@contextmanager
def mark_keys(
    bar: CampaignBar, by: str, progress: Callable[[], Mapping[str, Any]], store: Callable[[ShotNote], None]
) -> Iterator[MarkKeys | None]:
    """Read the key that marks while `bar` shows progress; None without a terminal."""
    if bar.disable or not at_terminal():
        yield None
        return
    keys = MarkKeys(bar, by, progress, store)
    try:
        yield keys
    finally:
        keys.close()


# Prompts ---------------------------------------------------------------------------------------------

_GUARD = (
    "The chambers are vented and the guard is unlocked. Remove the pin, shut hand valves, close it when "
    "everybody is out"
)
_SHUT = (
    "If the supply was shut without a request for gauges, first run golfbench campaign pause ID in another "
    "terminal. Then answer: "
    "the bench locks the guard, warns and arms, or pauses until the supply is open."
)
_BENCH = "Answer when it runs again"
_AFTER = {
    PromptKind.CLUB: f"{_GUARD}. {_SHUT}",
    PromptKind.BALLS: f"{_GUARD}. {_SHUT}",
    PromptKind.BENCH: f"{_BENCH}: the campaign takes the bench and continues.",
}
_YES = frozenset({"", "y", "yes", "ok", "done"})
"""Lines that confirm."""
_PLACES = 4
"""Number of places of a load list in a line."""


class TerminalOperator:
    """Shows prompts above the progress bar; on a terminal, Enter confirms."""

    def __init__(
        self, bar: CampaignBar, campaign: str, kinds: frozenset[PromptKind], keys: MarkKeys | None = None
    ) -> None:
        """`kinds` of prompts wait for the operator; others are answered automatically."""
        self.name, self.kinds = user_name(), kinds
        self._bar, self._campaign, self._keys = bar, campaign, keys
        self._prompt: Prompt | None = None
        self._listening = at_terminal()

    def show(self, prompt: Prompt) -> None:
        """Show a prompt and how to confirm it."""
        self._prompt = prompt
        if self._keys:
            self._keys.pause()
        self._bar.hide()
        command, balls = f"golfbench campaign answer {self._campaign}", prompt.balls
        enter = "Enter, or the number of balls that you loaded and Enter" if balls else "Enter"
        how = f"{enter} (or {command})" if self._listening else command
        if self._listening and in_foreground(sys.stdin.fileno()):
            discard_typed()
        if self._listening and self._keys:
            how += "; to mark the last shot: m COMMENT"
        text = f"{_AFTER[PromptKind(prompt.kind)]}\nTo answer: {how}"
        content = Group(Text(prompt.text, style="bold"), *_load_table(balls), Text(text))
        title = f"before shot {prompt.before_shot}"
        self._bar.console.print(Panel(content, title=title, title_align="left", expand=False))

    def answered(self) -> bool:
        """Return whether the prompt was confirmed; a wrong answer is refused in words."""
        if not self._listening or not in_foreground(sys.stdin.fileno()):
            return False
        if not select.select([sys.stdin], [], [], 0)[0]:
            return False
        line = ""
        with suppress(OSError):
            line = sys.stdin.readline()
        self._listening = bool(line)  # an end of input is no answer
        return self._listening and self._confirms(line.strip())

    def _confirms(self, line: str) -> bool:
        word, _, comment = line.partition(" ")
        if word in {"m", "M"} and self._keys:
            self._keys.mark(comment.strip())
            return False
        if line.lower() in _YES:
            return True
        if not line.removeprefix("-").isdecimal():
            self._say(f"{line!r} is no answer: press Enter once it is done.")
            return False
        try:
            if self._prompt is not None:
                self._prompt.require_count(int(line))
        except Refused as wrong:
            self._say(f"Not confirmed: {wrong.found}, expected {wrong.expected}. {wrong.action}")
            return False
        return True

    def _say(self, text: str) -> None:
        self._bar.console.print(escape(text), highlight=False)

    def hide(self) -> None:
        """Show the bar again."""
        self._bar.show()
        if self._keys:
            self._keys.resume()


def _load_table(balls: Sequence[Numbered]) -> Iterator[Table]:
    if not balls:
        return
    table, cells = Table.grid(padding=(0, 3)), places(balls)
    for at in range(0, len(cells), _PLACES):
        table.add_row(*(Text(cell) for cell in cells[at : at + _PLACES]))
    yield table
