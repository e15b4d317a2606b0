"""`golfbench status`, `home`, `arm`, ... `lease`: operate a running bench."""

from __future__ import annotations

import getpass
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.commands.session import Session

if TYPE_CHECKING:
    from bench.network.bench_service import BenchStatus
    from bench.network.client import BenchClient
    from bench.network.command import CommandAnswer

    WaitForIt = Callable[[BenchClient, Callable[[BenchStatus], None]], BenchStatus]

PANEL = "A running bench"

app = typer.Typer()
lease_app = typer.Typer(
    help="Hold the bench: moving it needs its lease, stopping it does not.", no_args_is_help=True
)
app.add_typer(lease_app, name="lease", rich_help_panel=PANEL)

Wait = Annotated[bool, typer.Option("--wait", help="Wait until it is done; the lease is renewed meanwhile.")]
Timeout = Annotated[
    float, typer.Option(metavar="S", min=1.0, max=600.0, help="Longest time to wait with --wait.")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for a program to read.")]

_SPARE = 1000
"""Sequence numbers reserved for one command, so that the next one does not reuse those of a killed one."""


@app.command(rich_help_panel=PANEL)
def status(
    context: typer.Context,
    watch: Annotated[bool, typer.Option("--watch", help="Keep watching until Ctrl-C.")] = False,
    json_: Json = False,
) -> None:
    """Show the state of the bench: once, or live.

    With --watch and --json: one line for each published state.
    """
    import json

    with _client(context) as bench:
        if json_:
            typer.echo(json.dumps(bench.status(), indent=None if watch else 2))
            for heard in bench.states(1.0) if watch else ():
                if heard is not None:
                    typer.echo(json.dumps(heard.status))
            return
        from rich.console import Console

        from bench.commands.status_table import status_table, watch_status

        if watch:
            watch_status(bench, Console())
        Console().print(status_table(bench.status(), 0.0))


@app.command(rich_help_panel=PANEL)
def home(context: typer.Context, wait: Wait = False, timeout: Timeout = 60.0) -> None:
    """Home the robot: prove the encoders' zeros; needs the lease.

    With --wait: exits with 1 if the bench is not READY in time.
    """
    _ask_as_holder(
        context,
        lambda bench: bench.home(),
        (lambda bench, watch: bench.wait_for("READY", timeout=timeout, watch=watch)) if wait else None,
    )


@app.command(rich_help_panel=PANEL)
def arm(context: typer.Context, wait: Wait = False, timeout: Timeout = 60.0) -> None:
    """Warn, switch the air on and go to the address; needs the lease.

    With --wait: returns when the robot rests at its address, ready to swing; exits with 1 if not in time.
    Ctrl-C then ends only the waiting, not the arming: use golfbench disarm.
    """
    _ask_as_holder(
        context,
        lambda bench: bench.arm(),
        (lambda bench, watch: bench.wait_until_armed(timeout=timeout, watch=watch)) if wait else None,
    )


@app.command(rich_help_panel=PANEL)
def disarm(context: typer.Context) -> None:
    """Disarm: vent if at rest, otherwise brake first."""
    _ask(context, lambda bench: bench.disarm())


@app.command(rich_help_panel=PANEL)
def access(
    context: typer.Context,
    end: Annotated[bool, typer.Option("--end", help="End the access: lock the guard.")] = False,
) -> None:
    """Unlock the guard of a vented bench, to change club or ball; needs the lease."""
    _ask_as_holder(context, lambda bench: bench.secure() if end else bench.access())


@app.command(rich_help_panel=PANEL)
def tee(context: typer.Context) -> None:
    """Raise the next ball; needs the lease."""
    _ask_as_holder(context, lambda bench: bench.tee())


@app.command(rich_help_panel=PANEL)
def stop(context: typer.Context) -> None:
    """Stop the robot; needs no lease."""
    _ask(context, lambda bench: bench.stop())


@app.command(rich_help_panel=PANEL)
def estop(context: typer.Context) -> None:
    """Stop the robot and latch ESTOP; needs no lease. A convenience, not a safety function."""
    _ask(context, lambda bench: bench.emergency_stop())


@app.command(rich_help_panel=PANEL)
def reset(context: typer.Context) -> None:
    """Leave ESTOP or FAULT once the cause is cleared; never moves the robot; needs the lease."""
    _ask_as_holder(context, lambda bench: bench.reset())


def swing_when_armed(context: typer.Context) -> None:
    """Swing, if the bench is ARMED and this user holds its lease: `golfbench swing`."""
    from bench.errors import Refused

    def ask(bench: BenchClient) -> CommandAnswer:
        state = bench.status()["state"]
        if state != "ARMED":
            cure = "golfbench arm --wait"
            raise Refused(f"swing of bench {bench.bench}", f"state {state}", "state ARMED", cure)
        return bench.swing()

    _ask_as_holder(context, ask)


# The lease -------------------------------------------------------------------------------------------

Seconds = Annotated[
    float | None,
    typer.Option(
        metavar="N", min=5.0, max=600.0, help="Duration of the lease, s.", show_default="30, or as before"
    ),
]


@lease_app.command("take")
def take_lease(
    context: typer.Context,
    holder: Annotated[
        str | None, typer.Option(metavar="NAME", help="Name of the holder.", show_default="user@host")
    ] = None,
    seconds: Seconds = None,
) -> None:
    """Take the lease; the commands that follow use and renew it."""
    from bench.commands.lease_file import open_lease_file
    from bench.network.client import CommandRefused
    from bench.network.lease import DEFAULT

    name = holder or f"{getpass.getuser()}@{socket.gethostname()}"
    with _client(context) as bench, open_lease_file(_folder(), bench.bench) as file:
        kept = file.read()
        if kept is not None and kept.holder == name:
            bench.held = kept
            file.write(replace(kept, sequence=kept.sequence + _SPARE))
            try:
                left = bench.renew_lease(seconds)
            except CommandRefused:
                pass  # it was over
            else:
                file.write(replace(kept, sequence=kept.sequence + _SPARE))
                typer.echo(f"bench {bench.bench}: {name} holds it for {left:g} s more")
                return
        held = bench.take_lease(name, DEFAULT if seconds is None else seconds)
        file.write(held)
        typer.echo(f"bench {bench.bench}: {name} holds it for {held.seconds:g} s")


@lease_app.command("renew")
def renew_lease(context: typer.Context, seconds: Seconds = None) -> None:
    """Renew the lease."""
    with _holding(context) as bench:
        left = bench.renew_lease(seconds)
        typer.echo(f"bench {bench.bench}: held for {left:g} s more")


@lease_app.command("release")
def release_lease(context: typer.Context) -> None:
    """Release the lease; an armed bench disarms."""
    with _holding(context) as bench:
        bench.release_lease()
        typer.echo(f"bench {bench.bench}: lease released")


@lease_app.command("show")
def show_lease(context: typer.Context, json_: Json = False) -> None:
    """Show who holds the bench."""
    import json

    with _client(context) as bench:
        held = bench.status()["lease"]
        if json_:
            typer.echo(json.dumps(held))
        elif held is None:
            typer.echo(f"bench {bench.bench}: lease not held")
        else:
            typer.echo(
                f"bench {bench.bench}: {held['holder']} holds it for {held['seconds_left']:.0f} s more"
            )


# Requests --------------------------------------------------------------------------------------------


def _client(context: typer.Context) -> BenchClient:
    from bench.network.client import BenchClient

    return BenchClient.connect(context.ensure_object(Session).configuration())


def _folder() -> Path:
    from bench.commands.lease_file import lease_folder

    return lease_folder(os.environ, Path.home())


@contextmanager
def _holding(context: typer.Context) -> Iterator[BenchClient]:
    """Yield a client with the stored lease; store the lease again at the end."""
    from bench.commands.lease_file import open_lease_file

    with _client(context) as bench, open_lease_file(_folder(), bench.bench) as file:
        kept = file.read()
        if kept is not None:
            bench.held = replace(kept)
            file.write(replace(kept, sequence=kept.sequence + _SPARE))
        try:
            yield bench
        finally:
            file.write(bench.held)


def _ask_as_holder(
    context: typer.Context, ask: Callable[[BenchClient], CommandAnswer], wait: WaitForIt | None = None
) -> None:
    from bench.network.client import CommandRefused

    with _holding(context) as bench:
        answer = ask(bench)
        _tell(bench, answer)
        if wait is not None:
            status = _wait_as_holder(bench, wait)
            typer.echo(f"bench {bench.bench}: {status['state']}, phase {status['phase']}")
        with suppress(CommandRefused):  # the command is done all the same
            bench.renew_lease()


def _wait_as_holder(bench: BenchClient, wait: WaitForIt) -> BenchStatus:
    """Wait with the bench's state on the screen, and renew the lease on the way."""
    from rich.console import Console

    from bench.network.client import CommandRefused

    console = Console(stderr=True)
    began = renewed = time.monotonic()
    with console.status("") if console.is_terminal else nullcontext() as line:

        def watch(status: BenchStatus) -> None:
            nonlocal renewed
            now = time.monotonic()
            if line is not None:
                line.update(f"{status['state']}, phase {status['phase']}, {now - began:.0f} s")
            if bench.held is not None and now - renewed > bench.held.seconds / 3.0:
                renewed = now
                with suppress(CommandRefused):  # lost: the bench disarms, which ends the waiting
                    bench.renew_lease()

        return wait(bench, watch)


def _ask(context: typer.Context, ask: Callable[[BenchClient], CommandAnswer]) -> None:
    with _client(context) as bench:
        _tell(bench, ask(bench))


def _tell(bench: BenchClient, answer: CommandAnswer) -> None:
    typer.echo(f"bench {bench.bench}: {answer.state}")
    if answer.note:
        typer.echo(answer.note)
