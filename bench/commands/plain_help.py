"""Help pages that show every help text as it is written.

The command line prints help as markup: it would swallow `[launch_monitor]` and `[default: 3]` as style tags,
break paragraphs where the source breaks them, and show a flag as an option that takes a value.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from typer.core import TyperCommand, TyperGroup


def show_plainly(command: TyperCommand | TyperGroup) -> None:
    """Prepare the help texts of `command`. Its epilog stays markup."""
    if command.help:
        command.help = "\n\n".join(
            _literal(" ".join(paragraph.split())) for paragraph in command.help.split("\n\n")
        )
    for parameter in command.get_params(typer.Context(command)):  # with --help
        text = getattr(parameter, "help", None)
        if text:
            parameter.help = _literal(text)  # type: ignore[attr-defined]  # options and arguments have one
        if getattr(parameter, "is_flag", False):
            parameter.metavar = ""


def _literal(text: str) -> str:
    """Return markup that shows `text` itself."""
    return text.replace("[", r"\[")
