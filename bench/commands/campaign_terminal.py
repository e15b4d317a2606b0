"""The operator at a campaign's terminal: sees prompts and confirms them with Enter.

A load list may be confirmed with the number of loaded balls, which is compared with it.
"""

from __future__ import annotations

import select
import sys
import termios
from collections.abc import Iterator, Sequence
from contextlib import suppress

from rich.console import Group
from rich.markup import escape
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from bench.campaign.prompts import Numbered, PromptKind, balls_of, places, require_count
from bench.commands.campaign_keys import MarkKeys, in_foreground
from bench.commands.campaign_screen import CampaignBar
from bench.commands.session import user_name
from bench.errors import Refused
from bench.store.records import Prompt

_GUARD = "The chambers are vented and the guard is unlocked. Close it when everybody is out"
_BENCH = "Answer when it runs again"
_AFTER = {
    PromptKind.CLUB: f"{_GUARD}, then answer: the bench locks it, warns and arms.",
    PromptKind.BALLS: f"{_GUARD}, then answer: the bench locks it, warns and arms.",
    PromptKind.BENCH: f"{_BENCH}: the campaign takes the bench and goes on.",
}
_YES = frozenset({"", "y", "yes", "ok", "done"})
"""Lines that confirm."""
_COLUMNS = 4
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
        self._listening = sys.stdin is not None and sys.stdin.isatty()

    def show(self, prompt: Prompt) -> None:
        """Show a prompt and how to confirm it."""
        self._prompt = prompt
        if self._keys:
            self._keys.pause()
        self._bar.hide()
        command, balls = f"golfbench campaign answer {self._campaign}", balls_of(prompt)
        enter = "Enter, or the number of balls that you loaded and Enter" if balls else "Enter"
        how = f"{enter} (or {command})" if self._listening else command
        if self._listening and in_foreground(sys.stdin.fileno()):
            termios.tcflush(sys.stdin, termios.TCIFLUSH)  # what was typed before is no answer to this
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
        try:
            count = int(line)
        except ValueError:
            self._say(f"{line!r} is no answer: press Enter once it is done.")
            return False
        try:
            if self._prompt is not None:
                require_count(self._prompt, count)
        except Refused as wrong:
            self._say(f"Not confirmed: {wrong.found}, expected {wrong.expected}. {wrong.cure}")
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
    """Yield a load list as a table; nothing without balls."""
    if not balls:
        return
    table, cells = Table.grid(padding=(0, 3)), places(balls)
    for at in range(0, len(cells), _COLUMNS):
        table.add_row(*(Text(cell) for cell in cells[at : at + _COLUMNS]))
    yield table
