"""Commands whose help is shown as it is written, and whose plain values need no conversion.

The command line prints help as markup: it would swallow `[launch_monitor]` and `[default: 3]` as style tags,
break paragraphs where the source breaks them, and show a flag as an option that takes a value. It converts
every value with pydantic, also a default, and importing pydantic takes longer than all else of
`golfbench stop`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from typer.core import TyperCommand, TyperGroup


def make_plain(command: TyperCommand | TyperGroup) -> None:
    """Prepare help texts of `command`, but its epilog, and values: defaults, and texts that stay texts."""
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
        if not (parameter.required or parameter.multiple or parameter.nargs != 1):
            _pass_plain(parameter)


def _literal(text: str) -> str:
    """Return markup that shows `text` itself."""
    return text.replace("[", r"\[")


def _pass_plain(parameter: Any) -> None:
    convert, callback = parameter.process_value, parameter.callback
    is_text = parameter.type_descriptor.annotation is str

    def process_value(context: Any, value: Any) -> Any:
        if value is not parameter.default and not (is_text and isinstance(value, str)):
            return convert(context, value)
        return value if callback is None else callback(context, parameter, value)

    parameter.process_value = process_value
