"""The operator at a campaign's terminal: sees prompts and confirms them with Enter."""

from __future__ import annotations

import getpass
import select
import socket
import sys
import termios
from contextlib import suppress

from rich.markup import escape
from rich.panel import Panel
from rich.progress import Progress

from bench.campaign.fitting import PromptKind
from bench.store.campaigns import Prompt

_GUARD = "The chambers are vented and the guard is unlocked. Close it when everybody is out"
_BENCH = "Answer when it runs again"
_AFTER = {
    PromptKind.CLUB: f"{_GUARD}, then answer: the bench locks it, warns and arms.",
    PromptKind.BALLS: f"{_GUARD}, then answer: the bench locks it, warns and arms.",
    PromptKind.BENCH: f"{_BENCH}: the campaign takes the bench and goes on.",
}


def user_name() -> str:
    """Return the default name of who answers, user@host."""
    return f"{getpass.getuser()}@{socket.gethostname()}"


class TerminalOperator:
    """Shows prompts above the progress bar; on a terminal, Enter confirms."""

    def __init__(self, bar: Progress, campaign: str, kinds: frozenset[PromptKind]) -> None:
        """`kinds` of prompts wait for the operator; others are answered automatically."""
        self.name, self.kinds = user_name(), kinds
        self._bar, self._campaign = bar, campaign
        self._listening = sys.stdin is not None and sys.stdin.isatty()

    def show(self, prompt: Prompt) -> None:
        """Show a prompt and how to confirm it."""
        self._bar.stop()
        command = f"golfbench campaign answer {self._campaign}"
        how = f"Enter (or {command})" if self._listening else command
        if self._listening:
            termios.tcflush(sys.stdin, termios.TCIFLUSH)  # what was typed before is no answer to this
        title = f"before shot {prompt.before_shot}"
        text = f"[bold]{escape(prompt.text)}[/]\n{_AFTER[PromptKind(prompt.kind)]}\nTo answer: {escape(how)}"
        self._bar.console.print(Panel(text, title=title, title_align="left", expand=False))

    def answered(self) -> bool:
        """Return whether Enter was pressed."""
        if not self._listening or not select.select([sys.stdin], [], [], 0)[0]:
            return False
        line = ""
        with suppress(OSError):
            line = sys.stdin.readline()
        self._listening = bool(line)  # an end of input is no answer
        return self._listening

    def hide(self) -> None:
        """Show the bar again."""
        self._bar.start()
