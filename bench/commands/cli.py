"""The command line: names all commands, maps errors to messages and exit codes.

The module of a command is imported when the command is called, and heavy packages inside the commands that
need them: a stop does not wait for the imports of a simulation.
"""

from __future__ import annotations

import codecs
import errno
import json
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import suppress
from functools import cache, partial
from importlib import import_module
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TypeAlias, cast, get_args

import typer
from typer.core import TyperGroup
from typer.exceptions import TyperException
from typer.models import CommandInfo, TyperInfo

from bench.base.errors import FOR_PROGRAMS, BenchError, ExitCode
from bench.base.interrupt import Terminated, has_closed_pipe, leave, watch_pipes
from bench.commands.common import Session, flag

if TYPE_CHECKING:
    from typer.core import TyperCommand

    _Command: TypeAlias = TyperCommand | TyperGroup

HELP = "A bench for golf clubs and balls: the swing robot, its control, and its simulation."

EXIT_CODES: Mapping[ExitCode, tuple[str, str]] = {
    ExitCode.OK: ("done", ""),
    ExitCode.REFUSED: (
        "refused, or the answer is no: a check failed, the lease is missing",
        "read the reason",
    ),
    ExitCode.BAD_INPUT: (
        "wrong usage, or invalid configuration, profile or file",
        "correct the value that the message states",
    ),
    ExitCode.DEVICE: ("a device or service does not work", "check cable, power, driver, port"),
    ExitCode.INTERNAL: ("internal error of golfbench", "report it with the output of `golfbench --debug`"),
    ExitCode.FILE: ("a file, folder or pipe cannot be read or written", "check path, rights, disk space"),
    ExitCode.NO_ANSWER: (
        "no answer from the bench: not running, or access denied",
        "start it; check `[network]` and the certificate",
    ),
    ExitCode.INTERRUPTED: ("interrupted by Ctrl-C", ""),
    ExitCode.TERMINATED: ("a campaign ended by SIGTERM (`systemctl stop`, `kill`)", "`campaign resume`"),
}
"""Meaning and action of each exit code."""

_EPILOG = "\n".join(
    ("[bold]Exit codes[/bold]", *(f"{code:4}  {meaning}" for code, (meaning, _) in EXIT_CODES.items()))
)

_OPERATE = "bench.commands.bench.operate:app"

COMMANDS: Mapping[str, str] = {
    "run": "bench.commands.bench.run:run",
    "nodes": "bench.commands.bench.simulators:nodes",
    "launch-monitor": "bench.commands.bench.simulators:launch_monitor",
    "commission": "bench.commands.machine.commission:commission",
    "learn": "bench.commands.swing.learn:learn",
    "identify": "bench.commands.machine.wear:identify",
    "wear": "bench.commands.machine.wear:wear",
    "tune": "bench.commands.machine.tune:tune",
    "view": "bench.commands.bench.view:view",
    "page": "bench.commands.bench.run:page",
    "console": "bench.commands.cli:console",
    "export": "bench.commands.swing.records:export",
    "draw": "bench.commands.machine.size:draw",
    "size": "bench.commands.machine.size:size",
    "schema": "bench.commands.bench.run:schema",
    "certificates": "bench.commands.bench.run:certificates",
    "cluster": "bench.commands.bench.run:cluster",
    "doctor": "bench.commands.machine.doctor_bench:doctor",
    "demo": "bench.commands.campaign.campaign_run:demo",
    "check": "bench.commands.bench.run:check",
    "replay": "bench.commands.swing.records:replay",
    "compare": "bench.commands.swing.records:compare",
    "profile": "bench.commands.swing.profile:app",
    "golfer": "bench.commands.swing.golfer:app",
    **dict.fromkeys(
        ("status", "home", "arm", "swing", "disarm", "access", "tee", "stop", "estop", "reset", "lease"),
        _OPERATE,
    ),
    "calibrate": "bench.commands.machine.calibrate:app",
    "campaign": "bench.commands.campaign.campaign_run:app",
    "faults": "bench.commands.machine.faults:app",
}
"""Commands by name: module and attribute, a function, or a Typer app that is the command or has it."""


class _Commands(Mapping[str, "_Command"]):
    """All commands by name; each is loaded at its first use."""

    def __init__(self) -> None:
        self._loaded: dict[str, _Command] = {}

    def __getitem__(self, name: str) -> _Command:
        if name not in self._loaded:
            module, _, attribute = COMMANDS[name].partition(":")
            command = _command(getattr(import_module(module), attribute), name)
            self._loaded[name] = _prepared(command)
        return self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        return iter(COMMANDS)

    def __len__(self) -> int:
        return len(COMMANDS)


def _command(found: typer.Typer | Callable[..., Any], name: str) -> Any:
    """Return the command called `name`: a function, an app, or one of the commands of an app."""
    style: dict[str, Any] = {"pretty_exceptions_short": True, "rich_markup_mode": "rich"}
    if not isinstance(found, typer.Typer):
        return typer.main.get_command_from_info(CommandInfo(name, callback=found), **style)
    for info in found.registered_commands:
        if name in (info.name, typer.main.get_command_name(getattr(info.callback, "__name__", ""))):
            return typer.main.get_command_from_info(info, **style)
    groups = [info for info in found.registered_groups if info.name == name]
    group = groups[0] if groups else TyperInfo(found, name=name)
    return typer.main.get_group_from_info(group, suggest_commands=True, **style)


def _prepared(command: _Command) -> _Command:
    _make_plain(command)
    below = getattr(command, "commands", {})
    for one in below.values() if isinstance(below, dict) else ():  # of the others when they are loaded
        _prepared(one)
    return command


def _make_plain(command: TyperCommand | TyperGroup) -> None:
    """Prepare `command` so that its help is shown as written and its plain values need no conversion.

    The command line prints help as markup: it would swallow `[launch_monitor]` and `[default: 3]` as style
    tags, break paragraphs where the source breaks them, and show a flag as an option that takes a value. It
    converts every value with pydantic, also a default, and importing pydantic takes longer than all else of
    `golfbench stop`.
    """
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
        _pass_plain(parameter)


def _literal(text: str) -> str:
    """Return markup that shows `text` itself."""
    return text.replace("[", r"\[")


def _pass_plain(parameter: Any) -> None:
    convert, callback = parameter.process_value, parameter.callback
    is_single = not (parameter.required or parameter.multiple or parameter.nargs != 1)
    annotation = parameter.type_descriptor.annotation
    is_text, is_path = is_single and annotation is str, annotation in (Path, list[Path])
    is_number = {int, float}.issuperset(get_args(annotation) or [annotation])

    def process_value(context: Any, value: Any) -> Any:
        given = value if isinstance(value, list | tuple) else [value]
        if is_path and "-" in given:
            action = "Name a file, or omit it for the default; ./- is a file of this name."
            raise BenchError(parameter.opts[0], "'-'", "a file or folder", action)
        if is_single and (value is parameter.default or (is_text and isinstance(value, str))):
            return value if callback is None else callback(context, parameter, value)
        if is_number and any(isinstance(one, str) and "_" in one for one in given):  # 1_5 would be 15
            raise typer.BadParameter(f"{value!r} has an underscore", ctx=context, param=parameter)
        try:
            return convert(context, value)
        except typer.BadParameter as error:
            error.message = error.message.removeprefix("Value error, ")
            raise

    parameter.process_value = process_value


class _Lazy(TyperGroup):
    """The whole command line."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = cast("MutableMapping[str, Any]", _Commands())


app = typer.Typer(
    cls=_Lazy,
    help=HELP,
    epilog=_EPILOG,
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"golfbench {version('golfbench')}")
        raise typer.Exit


@app.callback()
def options(
    ctx: typer.Context,
    config: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            envvar="GOLFBENCH_CONFIG",
            help="Configuration, a TOML file or a variant's name.",
        ),
    ] = None,
    debug: Annotated[bool, flag("--debug", "Print the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Read the global options, which precede the command."""
    session = ctx.ensure_object(Session)
    session.config, session.debug = None if config is None else Path(config), debug


def console(context: typer.Context) -> None:
    """Enter commands on one connection, with the state in view and a key that stops the robot.

    Needs a terminal; scripts use single commands.
    """
    from bench.commands.bench.console import run_console

    run_console(context.ensure_object(Session), command_line(), report_errors)


@cache
def command_line() -> TyperGroup:
    """Return all commands as one."""
    return cast("TyperGroup", _prepared(cast("TyperGroup", typer.main.get_command(app))))


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line with `arguments` (those of the process by default) and exit with its code."""
    accept_any_text()
    watch_pipes()
    session = Session()
    line = partial(command_line().main, args=arguments, prog_name="golfbench", obj=session)
    leave(report_errors(partial(line, standalone_mode=not _for_programs()), session))


def report_errors(work: Callable[[], object], session: Session) -> int:
    """Do the `work` of a command; print its error, and return its exit code."""
    code: object = ExitCode.OK
    try:
        code = work()
    except SystemExit as ended:
        # At a closed pipe the packages of commands and tables exit with 1, without a word.
        code = ExitCode.FILE if ended.code == 1 and has_closed_pipe() else ended.code
    except KeyboardInterrupt:
        code = ExitCode.INTERRUPTED
    except Terminated:
        code = ExitCode.TERMINATED
    except Exception as error:
        if session.debug:
            traceback.print_exception(error)
        texts, code = explain(error)
        with suppress(BrokenPipeError):
            print(*texts, sep="\n", file=sys.stderr)
    return code if isinstance(code, int) else ExitCode.OK


def _for_programs() -> bool:
    return os.environ.get(FOR_PROGRAMS) == "json"


def explain(error: Exception) -> tuple[list[str], ExitCode]:
    """Return the messages for `error`, of a group those of its errors and its own, and the exit code."""
    if isinstance(error, ExceptionGroup):
        parts = [explain(part) for part in error.exceptions]
        all_texts = [text for texts, _ in parts for text in texts]
        if not _for_programs():
            all_texts.append(f"{len(parts)} error{'s' * (len(parts) > 1)}: {error.message}")
        return all_texts, max(code for _, code in parts)
    fault = _fault(error)
    record = fault.record()
    if _for_programs():
        return [json.dumps(record)], fault.exit_code
    found, expected, action = (f"  {f'{key}:':9} {record[key]}" for key in ("found", "expected", "action"))
    return ["\n".join((f"error: {fault.location}", found, expected, action))], fault.exit_code


def _fault(error: Exception) -> BenchError:
    """Return any `error` as one with place, found, expected and action."""
    from drivers.base import DriverError

    match error:
        case BenchError():
            return error
        case TyperException():
            found = error.format_message() or "no command"
            return BenchError("command line", found, "valid usage", "See golfbench COMMAND --help.")
        case DriverError():
            expected, action = "a device that works", "Check cable, power, driver and port."
            return BenchError("device", str(error), expected, action, code=ExitCode.DEVICE)
        case FileNotFoundError() if not _has_working_directory():
            expected, action = "a folder that exists", "Change to a folder that exists."
            return BenchError("working directory", "it was deleted", expected, action, code=ExitCode.FILE)
        case OSError(filename=str() | bytes() | Path()):
            return _unusable(os.fsdecode(error.filename), error)
        case OSError(errno=errno.ENOSPC | errno.EDQUOT | errno.EIO | errno.EROFS):
            return _unusable("standard output or a file", error)
    found, action = f"{type(error).__name__}: {error}", "Report it with the output of golfbench --debug."
    return BenchError("internal error", found, "no error", action, code=ExitCode.INTERNAL)


def _unusable(location: str, error: OSError) -> BenchError:
    expected, action = "a file or folder that can be used", "Check path, rights and disk space."
    return BenchError(location, error.strerror or str(error), expected, action, code=ExitCode.FILE)


def _has_working_directory() -> bool:
    try:
        os.getcwd()
    except FileNotFoundError:
        return False
    return True


_PLAIN = {"°": " deg", "±": "+-", "µ": "u", "×": "x", "²": "^2", "³": "^3", "·": "*"}
_PLAIN |= {"–": "-", "—": "-", "…": "..."}
_PLAIN |= {"−": "-", "→": "->", "←": "<-", "≤": "<=", "≥": ">=", "∞": "inf", "θ": "theta", "β": "beta"}
_PLAIN |= {"✓": "ok", "✗": "x", "●": "*", "○": "o", "’": "'", "“": '"', "”": '"'}
_PLAIN |= dict(zip("▁▂▃▄▅▆▇█▏", "__..-=+#|", strict=True))
"""Replacements for characters that a terminal's encoding lacks; all others become "?"."""

_HANDLER = "golfbench.plain"


def _plain(error: UnicodeError) -> tuple[str, int]:
    """Return plain characters for those that cannot be encoded, and the position after them."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    return "".join(_PLAIN.get(character, "?") for character in lacking), error.end


def accept_any_text() -> None:
    """Let standard output and errors take any text, whatever the encoding of the terminal."""
    codecs.register_error(_HANDLER, _plain)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors=_HANDLER)
