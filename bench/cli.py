"""The command line: registers all commands, maps errors to messages and exit codes.

Heavy packages are imported inside the commands that need them, so that `--help` and completion stay
quick.
"""

from __future__ import annotations

import errno
import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NoReturn, cast

import typer

from bench.commands.any_terminal import accept_any_text
from bench.commands.calibrate import app as calibration_app
from bench.commands.campaign import app as campaign_app
from bench.commands.certificates import certificates
from bench.commands.cluster import cluster
from bench.commands.commission import commission
from bench.commands.compare import compare
from bench.commands.draw import draw
from bench.commands.export import export
from bench.commands.faults import app as faults_app
from bench.commands.identify import identify
from bench.commands.launch_monitor import launch_monitor
from bench.commands.learn import learn
from bench.commands.nodes import nodes
from bench.commands.operate import app as control_app
from bench.commands.page import page
from bench.commands.plain_help import show_plainly
from bench.commands.run import run
from bench.commands.schema import schema
from bench.commands.session import Session
from bench.commands.size import size
from bench.commands.swing import app as swing_app
from bench.commands.tune import tune
from bench.commands.view import view
from bench.errors import BenchError, ExitCode
from bench.interrupt import Terminated, leave

if TYPE_CHECKING:
    from typer.core import TyperGroup

HELP = "A bench for golf clubs and balls: the swing robot, its control, and its simulation."

EXIT_CODES = """[bold]Exit codes[/bold]
   0  done
   1  refused, or the answer is no
   2  wrong usage, or an invalid configuration, profile or file
  69  a device or service cannot do its work
  70  an error of golfbench itself
  74  a file or folder cannot be read or written
  75  no answer from the bench: denied or not running
 130  interrupted by Ctrl-C
 143  a campaign: ended by SIGTERM, as tidily as by Ctrl-C
"""

app = typer.Typer(
    help=HELP,
    epilog=EXIT_CODES,
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
)
app.command()(run)
app.command()(nodes)
app.command()(launch_monitor)
app.command()(commission)
app.command()(learn)
app.command()(identify)
app.command()(tune)
app.command()(view)
app.command()(page)
app.command()(export)
app.command()(draw)
app.command()(size)
app.command()(schema)
app.command()(certificates)
app.command()(cluster)
swing_app.command()(compare)
app.add_typer(swing_app, name="swing")
app.add_typer(control_app)
app.add_typer(calibration_app, name="calibrate")
app.add_typer(campaign_app, name="campaign")
app.add_typer(faults_app, name="faults")


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"golfbench {version('golfbench')}")
        raise typer.Exit


@app.callback()
def options(
    ctx: typer.Context,
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            envvar="GOLFBENCH_CONFIG",
            help="Configuration, a TOML file or a variant's name.",
        ),
    ] = None,
    debug: Annotated[bool, typer.Option("--debug", help="Print the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Read the global options, which precede the command."""
    session = ctx.ensure_object(Session)
    session.config, session.debug = config, debug


@app.command()
def doctor(
    context: typer.Context,
    json_: Annotated[bool, typer.Option("--json", help="Print JSON for a program to read.")] = False,
    data_dir: Annotated[
        Path | None,
        typer.Option(metavar="PATH", help="Folder of records.", show_default="data_dir of the configuration"),
    ] = None,
) -> None:
    """Check this machine: packages, real time, memory, CAN, tools.

    With hardware in the configuration also its CAN link, clock, interrupt thread and core.
    Exits with 1 if something is missing that the simulation needs.
    """
    import json

    from rich.console import Console

    from bench.commands.doctor import examine, report, table, usable
    from bench.commands.doctor_bench import all_probes
    from bench.commands.progress import progress_bar

    planned = all_probes(context.ensure_object(Session).configuration, data_dir)
    findings = []
    with progress_bar() as progress:
        task = progress.add_task(f"examining {planned[0].group}", total=len(planned))
        for finding, following in zip(examine(planned), (*planned[1:], planned[-1]), strict=True):
            findings.append(finding)
            progress.update(task, advance=1, description=f"examining {following.group}")
    if json_:
        typer.echo(json.dumps(report(findings), indent=2))
    else:
        Console().print(table(findings))
    if not usable(findings):
        raise typer.Exit(ExitCode.REFUSED)


@app.command()
def demo(
    context: typer.Context,
    output: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="New or empty folder for the files.", show_default="DATA_DIR/demo-TIME"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the shot-to-shot scatter.")] = 1,
    swings: Annotated[int, typer.Option(min=1, max=200, help="Number of swings.")] = 10,
    engine: Annotated[
        Literal["bench", "compiled"],
        typer.Option(
            help="bench: a running bench in real time; compiled: lock-step in this process, within seconds."
        ),
    ] = "bench",
) -> None:
    """Compare two balls on the simulated robot: live table, report and records.

    Exits with 1 if the test was not completed.
    """
    configuration = context.ensure_object(Session).configuration()
    if engine == "bench":
        from bench.commands.demo.live import run_live_demo

        valid = run_live_demo(configuration, output, swings, seed)
    else:
        from bench.commands.demo.lock_step import run_lock_step_demo

        valid = run_lock_step_demo(configuration, output, swings, seed)
    if not valid:
        raise typer.Exit(ExitCode.REFUSED)


@app.command()
def check(
    context: typer.Context,
    profile: Annotated[
        str | None,
        typer.Argument(metavar="PROFILE", help="Name or path.", show_default="the configuration's"),
    ] = None,
    defaults: Annotated[
        bool,
        typer.Option(
            "--defaults", help="Print the shipped configuration with every key, its meaning and bounds."
        ),
    ] = False,
) -> None:
    """Check configuration and swing before anything moves; print the checks.

    Exits with 2 and lists all mistakes.
    """
    from rich.console import Console

    from bench.commands.check import check_all, shipped_text

    if defaults:
        typer.echo(shipped_text(), nl=False)
        return
    check_all(context.ensure_object(Session), profile, Console())


@app.command()
def replay(
    record: Annotated[Path, typer.Argument(metavar="RECORD", help="Record of a swing, .parquet.")],
    tolerance: Annotated[
        float, typer.Option(min=0.0, help="Absolute and relative tolerance; codes must be equal.")
    ] = 1e-9,
    json_: Annotated[bool, typer.Option("--json", help="Print JSON for a program to read.")] = False,
) -> None:
    """Replay a record's readings through the present controller and compare all fields.

    Exits with 1 if a field differs.
    """
    from bench.commands.replay import replay_command

    if not replay_command(record, tolerance, json_):
        raise typer.Exit(ExitCode.REFUSED)


def command_line() -> TyperGroup:
    """Return all commands as one."""
    command = cast("TyperGroup", typer.main.get_command(app))
    show_plainly(command)
    return command


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the command line with `arguments` (those of the process by default) and exit with its code."""
    accept_any_text()
    session = Session()
    code: int | str | None = ExitCode.OK
    try:
        command_line().main(args=arguments, prog_name="golfbench", obj=session)
    except SystemExit as ended:
        code = ended.code
    except KeyboardInterrupt:
        code = ExitCode.INTERRUPTED
    except Terminated:
        code = ExitCode.TERMINATED
    except Exception as error:
        if session.debug:
            traceback.print_exception(error)
        texts, code = explain(error)
        print(*texts, sep="\n", file=sys.stderr)
    leave(int(code or 0))


def explain(error: Exception) -> tuple[list[str], ExitCode]:
    """Return the messages for `error`, one for each error of a group, and the exit code."""
    from drivers.base import DriverError

    match error:
        case ExceptionGroup():
            parts = [explain(part) for part in error.exceptions]
            return [text for texts, _ in parts for text in texts], max(code for _, code in parts)
        case BenchError():
            lines = (f"error: {error.place}", f"  found:    {error.found}", f"  expected: {error.expected}")
            return ["\n".join((*lines, f"  to do:    {error.cure}"))], error.exit_code
        case DriverError():
            return [f"error: {error}"], ExitCode.DEVICE
        case FileNotFoundError() if not _has_working_directory():
            text = "error: working directory: it was deleted\n  to do:    cd to a folder that exists"
            return [text], ExitCode.FILE
        case OSError(filename=str() | bytes() | Path()):
            return [f"error: {error.filename!s}: {error.strerror}"], ExitCode.FILE
        case OSError(errno=errno.ENOSPC | errno.EDQUOT | errno.EIO | errno.EROFS):
            return [f"error: standard output or a file: {error.strerror}"], ExitCode.FILE
        case _:
            cause = f"internal error: {type(error).__name__}: {error}"
            return [
                f"{cause}\n  to do:    report it with the output of golfbench --debug ..."
            ], ExitCode.INTERNAL


def _has_working_directory() -> bool:
    try:
        os.getcwd()
    except FileNotFoundError:
        return False
    return True
