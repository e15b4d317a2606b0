"""Values of options that need no conversion: defaults and texts.

The command line converts every value with pydantic, also a default, and importing pydantic takes longer than
all else of `golfbench stop`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from typer.core import TyperCommand, TyperGroup


def pass_plain_values(command: TyperCommand | TyperGroup) -> None:
    """Convert no value of `command` that is a default, or a text that stays one."""
    for parameter in command.get_params(typer.Context(command)):  # with --help
        if not (parameter.required or parameter.multiple or parameter.nargs != 1):
            _pass_plain(parameter)


def _pass_plain(parameter: Any) -> None:
    convert, callback = parameter.process_value, parameter.callback
    is_text = parameter.type_descriptor.annotation is str

    def process_value(context: Any, value: Any) -> Any:
        if value is not parameter.default and not (is_text and isinstance(value, str)):
            return convert(context, value)
        return value if callback is None else callback(context, parameter, value)

    parameter.process_value = process_value
