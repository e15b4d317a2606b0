"""`golfbench status`, `home`, `arm`, ... `lease`: operate a running bench."""

from __future__ import annotations

import fcntl
import json
import os
import stat
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from bench.base.errors import BenchError, Refused
from bench.base.lifecycle import MOVING, Reaction, Refusal, State
from bench.commands.common import Json, Session, exit_unless, flag, option, show_json, user_name
from bench.network.lease import DEFAULT_SECONDS, MAX_SECONDS, MIN_SECONDS
from bench.network.status_words import REACTION_WORDS, state_line

if TYPE_CHECKING:
    from bench.network.bench_service import BenchStatus, CommandAnswer
    from bench.network.client import BenchClient, HeldLease
    from bench.records.shot.shot_message import ShotPublication

PANEL = "A running bench"

app = typer.Typer()
lease_app = typer.Typer(
    help="Hold the bench: moving it needs its lease, stopping it does not.", no_args_is_help=True
)
app.add_typer(lease_app, name="lease", rich_help_panel=PANEL)

Wait = Annotated[bool, flag("--wait", "Wait until it is done; the lease is renewed meanwhile.")]
Timeout = Annotated[float, option("Longest time to wait with --wait.", "S", low=1.0, high=600.0)]

SETTLING_TIMEOUT = 10.0
"""Time for which a command without --wait is retried while the robot sways or chambers vent, s."""

_MIN_MARGIN = 1000
"""Sequence numbers reserved for one command, so that the next one does not reuse those of a killed one."""


@app.command(rich_help_panel=PANEL)
def status(
    context: typer.Context,
    watch: Annotated[bool, flag("--watch", "Keep watching until Ctrl-C.")] = False,
    json_: Json = False,
) -> None:
    """Show the state of the bench: once, or live.

    With --watch and --json: one line for each published state.
    """
    with _client(context) as bench:
        if json_:
            typer.echo(json.dumps(bench.status(), indent=None if watch else 2))
            for heard in bench.states(1.0) if watch else ():
                if heard is not None:
                    typer.echo(json.dumps(heard))
            return
        from rich.console import Console

        from bench.commands.bench.status_table import status_table, watch_status

        if watch:
            watch_status(bench, Console())
        Console().print(status_table(bench.status(), 0.0))


@app.command(rich_help_panel=PANEL)
def home(context: typer.Context, wait: Wait = False, timeout: Timeout = 60.0) -> None:
    """Home the robot: prove the encoders' zeros; needs the lease.

    With --wait: exits with 1 if the bench is not READY in time.
    """
    with _holding(context) as bench:
        with _waiting(bench) as watch:
            bench.home(timeout if wait else SETTLING_TIMEOUT, watch)
            if wait:
                bench.wait_for("READY", timeout=timeout, watch=watch)
        _tell(bench)


@app.command(rich_help_panel=PANEL)
def arm(context: typer.Context, wait: Wait = False, timeout: Timeout = 60.0) -> None:
    """Warn, switch the air on and go to the address; needs the lease.

    With --wait: returns when the robot rests at its address, ready to swing; exits with 1 if not in time.
    Ctrl-C then ends only the waiting, not the arming: use golfbench disarm.
    """
    with _holding(context) as bench:
        with _waiting(bench) as watch:
            bench.arm(timeout if wait else SETTLING_TIMEOUT, watch)
            if wait:
                bench.wait_until_armed(timeout=timeout, watch=watch)
        _tell(bench)


@app.command(rich_help_panel=PANEL)
def disarm(context: typer.Context) -> None:
    """Disarm: vent if at rest, otherwise brake first."""
    from bench.network.client import CommandRefused

    with _client(context) as bench:
        try:
            bench.disarm()
        except CommandRefused as refused:
            if refused.refusal is not Refusal.STATE or refused.answer.state not in ("SAFE", "READY"):
                raise
            typer.echo(f"bench {bench.bench}: {refused.answer.state}. Disarmed already.")
        else:
            _tell(bench)


@app.command(rich_help_panel=PANEL)
def access(
    context: typer.Context,
    end: Annotated[bool, flag("--end", "End the access: lock the guard.")] = False,
) -> None:
    """Unlock the guard of a vented bench, to change club or ball; needs the lease."""
    _ask_as_holder(context, lambda bench: bench.secure() if end else bench.access())


@app.command(rich_help_panel=PANEL)
def tee(context: typer.Context) -> None:
    """Raise the next ball; needs the lease."""
    _ask_as_holder(context, lambda bench: bench.tee())


@app.command(rich_help_panel=PANEL)
def stop(context: typer.Context) -> None:
    """Stop the robot; needs no lease. Returns when it stands."""
    _stop(context, lambda bench: bench.stop())


@app.command(rich_help_panel=PANEL)
def estop(context: typer.Context) -> None:
    """Stop the robot and latch ESTOP; needs no lease. A convenience, not a safety function.

    Returns when the robot stands.
    """
    _stop(context, lambda bench: bench.emergency_stop())


@app.command(rich_help_panel=PANEL)
def reset(context: typer.Context) -> None:
    """Leave ESTOP or FAULT once the cause is cleared; never moves the robot; needs the lease."""
    _ask_as_holder(context, lambda bench: bench.reset())


@app.command(rich_help_panel=PANEL, context_settings={"allow_extra_args": True})
def swing(
    context: typer.Context,
    no_wait: Annotated[
        bool, flag("--no-wait", "Return once the swing has started, without its delivery.")
    ] = False,
    timeout: Annotated[
        float, option("Longest time to wait for its record.", "S", low=1.0, high=600.0)
    ] = 60.0,
) -> None:
    """Swing, if the bench is ARMED, and print the delivery; needs the lease.

    Exits with 1 if the swing did not complete. Profiles: golfbench profile.
    """
    from bench.network.client import action_of

    if context.args:  # a slip for `golfbench profile ...` must not move the robot
        found, action = f'argument "{context.args[0]}"', "Profiles: golfbench profile --help."
        raise BenchError("golfbench swing", found, "no argument, as it moves the robot", action)
    message: ShotPublication | None = None
    with _holding(context) as bench:
        status = bench.status()
        if status["state"] != "ARMED":
            found = f"{status['state']}{': ' + status['cause']['text'] if status['cause'] else ''}"
            raise Refused(f"swing of bench {bench.bench}", found, "state ARMED", action_of(status))
        with _waiting(bench) as watch:
            if no_wait:
                bench.swing(watch=watch)
            else:
                message = bench.swing_through(timeout=timeout, watch=watch)
        if message is not None:
            typer.echo("\n".join(shot_lines(message)))
        _tell(bench)
    exit_unless(message is None or message["cause"] in (None, "NONE"))


# The lease -------------------------------------------------------------------------------------------

Seconds = Annotated[
    float | None,
    option(
        *("Duration of the lease, s.", "N"),
        low=MIN_SECONDS,
        high=MAX_SECONDS,
        shown=f"{DEFAULT_SECONDS:g}, or unchanged",
    ),
]


@lease_app.command("take")
def take_lease(
    context: typer.Context,
    holder: Annotated[str | None, option("Name of the holder.", "NAME", shown="user@host")] = None,
    seconds: Seconds = None,
) -> None:
    """Take the lease; the commands that follow use and renew it."""
    from bench.network.client import CommandRefused

    name = holder or user_name()
    with _client(context) as bench, _stored_lease(bench) as file:
        kept = file.read()
        if kept is not None and kept.holder == name:
            bench.held = kept
            file.write(replace(kept, sequence=kept.sequence + _MIN_MARGIN))
            try:
                left = bench.renew_lease(seconds)
            except CommandRefused:
                pass  # it was over
            else:
                file.write(replace(kept, sequence=kept.sequence + _MIN_MARGIN))
                typer.echo(f"bench {bench.bench}: {name} holds it for {left:g} s more")
                return
        held = bench.take_lease(name, seconds or DEFAULT_SECONDS)
        file.write(held)
        typer.echo(
            f"bench {bench.bench}: {name} holds it for {held.seconds:g} s; each command renews it, "
            "without one an armed bench disarms"
        )


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
    with _client(context) as bench:
        held = bench.status()["lease"]
        if json_:
            return show_json(held)
        words = (
            f"{held['holder']} holds it for {held['seconds_left']:.0f} s more" if held else "lease not held"
        )
        typer.echo(f"bench {bench.bench}: {words}")


def lease_folder(environment: Mapping[str, str], home: Path) -> Path:
    """Return the folder of stored leases: in the login session's folder, or else the user's state folder."""
    if runtime := environment.get("XDG_RUNTIME_DIR"):
        return Path(runtime) / "golfbench"
    state = environment.get("XDG_STATE_HOME")
    return (Path(state) if state else home / ".local" / "state") / "golfbench"


class LeaseFile:
    """The open and locked lease file of one bench; its lease may have expired."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file

    def read(self) -> HeldLease | None:
        """Return the stored lease; None if there is none or it is unreadable."""
        from bench.network.client import HeldLease

        self._file.seek(0)
        try:
            match json.loads(self._file.read(4096) or "null"):
                case {
                    "version": 1,
                    "holder": str(holder),
                    "key": str(key),
                    "seconds": float(seconds),
                    "sequence": int(sequence),
                }:
                    return HeldLease(holder, key, seconds, sequence)
        except ValueError:
            pass
        return None

    def write(self, lease: HeldLease | None) -> None:
        """Store `lease`, or none."""
        self._file.seek(0)
        self._file.truncate()
        if lease is not None:
            json.dump({"version": 1, **asdict(lease)}, self._file)
        self._file.flush()


@contextmanager
def open_lease_file(folder: Path, bench: str) -> Iterator[LeaseFile]:
    """Yield the file of `bench` in `folder`, made if needed; a second command waits until this one is done.

    Raises:
        BenchError: the file is not its user's alone.
        OSError: it cannot be made or written.
    """
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    path = folder / f"lease-{bench}.json"
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    with os.fdopen(descriptor, "r+", encoding="utf-8") as file:
        status = os.fstat(descriptor)
        if status.st_uid != os.geteuid() or stat.S_IMODE(status.st_mode) & 0o077:
            found = f"mode {stat.S_IMODE(status.st_mode):o} of user {status.st_uid}"
            expected = "mode 600 of this user: it holds the key to the bench"
            raise BenchError(str(path), found, expected, "Remove the file and take the lease again.")
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield LeaseFile(file)


# Requests --------------------------------------------------------------------------------------------


def _client(context: typer.Context, *, stopping: bool = False) -> AbstractContextManager[BenchClient]:
    return context.ensure_object(Session).connect(stopping=stopping)


def _stored_lease(bench: BenchClient) -> AbstractContextManager[LeaseFile]:
    return open_lease_file(lease_folder(os.environ, Path.home()), bench.bench)


@contextmanager
def _holding(context: typer.Context) -> Iterator[BenchClient]:
    """Yield a client with the stored lease; renew the lease at the end, and store it again."""
    from bench.network.client import CommandRefused

    with _client(context) as bench, _stored_lease(bench) as file:
        kept = file.read()
        if kept is not None:
            bench.held = replace(kept)
            file.write(replace(kept, sequence=kept.sequence + _MIN_MARGIN))
        try:
            yield bench
            if bench.held is not None:
                with suppress(CommandRefused):  # the command is done all the same
                    bench.renew_lease()
        finally:
            file.write(bench.held)


def _ask_as_holder(context: typer.Context, ask: Callable[[BenchClient], CommandAnswer]) -> None:
    with _holding(context) as bench:
        ask(bench)
        _tell(bench)


@contextmanager
def _waiting(bench: BenchClient) -> Iterator[Callable[[BenchStatus], None]]:
    """Yield a function that shows a state while a command waits, and renews the lease.

    Ctrl-C ends only the waiting; a message states that the robot continues.
    """
    from bench.network.client import CommandRefused

    began = renewed = time.monotonic()
    newest = ""
    with _status_line() as show:

        def watch(status: BenchStatus) -> None:
            nonlocal renewed, newest
            now = time.monotonic()
            newest = f"{status['state']}, phase {status['phase']}"
            show(f"{newest}, {now - began:.0f} s")
            if bench.held is not None and now - renewed > bench.held.seconds / 3.0:
                renewed = now
                with suppress(CommandRefused):  # lost: the bench disarms, which ends the waiting
                    bench.renew_lease()

        try:
            yield watch
        except KeyboardInterrupt:
            seen = f" ({newest})" if newest else ""
            typer.echo(
                f"\nbench {bench.bench}: only the waiting ended, the robot continues{seen}. "
                "To stop it: golfbench stop",
                err=True,
            )
            raise


@contextmanager
def _status_line() -> Iterator[Callable[[str], object]]:
    """Yield a function that shows a text in a status line, on a terminal only."""
    if not sys.stderr.isatty():
        yield lambda text: None
        return
    with Console(stderr=True).status("") as line:
        yield line.update


def _stop(context: typer.Context, ask: Callable[[BenchClient], CommandAnswer]) -> None:
    from bench.network.zenoh_session import NoAnswer

    with _client(context, stopping=True) as bench:
        answer = ask(bench)
        if answer.note:
            typer.echo(answer.note)
        try:
            status = bench.status()
        except NoAnswer:  # a role may stop that may not read the state
            typer.echo(f"bench {bench.bench}: the stop is accepted; its state cannot be read from here")
            return
        if State[status["state"]] in MOVING:
            how = REACTION_WORDS[Reaction[status["reaction"]]]
            typer.echo(f"bench {bench.bench}: stopping{': ' if how else ''}{how}")
            with _waiting(bench) as watch:
                bench.wait_for_stop(watch=watch)
        _tell(bench)


def _tell(bench: BenchClient) -> None:
    typer.echo(state_line(bench.status()))


_MPH, _YARD = 0.44704, 0.9144
_CLUB_FIGURES = (
    ("club_speed_mps", "{0:.2f} m/s ({1:.1f} mph) at the ball", _MPH),
    ("attack_angle_deg", "attack {0:+.2f}°", 1.0),
    ("strike_x_mm", "strike {0:+.1f} mm to the toe", 1.0),
    ("strike_y_mm", "{0:+.1f} mm up", 1.0),
)
_BALL_FIGURES = (
    ("ball_speed_mps", "{0:.2f} m/s ({1:.1f} mph)", _MPH),
    ("launch_angle_deg", "launch {0:.1f}°", 1.0),
    ("spin_rpm", "spin {0:.0f} rpm", 1.0),
    ("carry_m", "carry {0:.1f} m ({1:.1f} yd)", _YARD),
)
"""Figures of a shot by name: text of the value and of its quotient by a unit."""


def shot_lines(message: ShotPublication) -> list[str]:
    """Return the results of the shot in `message`: a line each for club, ball and reason of a failure."""
    shot, number = message["shot"] or {}, message["number"]

    def joined(figures: tuple[tuple[str, str, float], ...]) -> str:
        known = [(form, shot[name], unit) for name, form, unit in figures if shot.get(name) is not None]
        return ", ".join(form.format(value, value / unit) for form, value, unit in known)

    ball, source = joined(_BALL_FIGURES), shot.get("carry_source")
    lines = [f"swing{'' if number is None else f' {number}'}: {joined(_CLUB_FIGURES) or 'no delivery'}"]
    if ball:
        lines.append(f"ball: {ball}{f' by {source}' if source and shot.get('carry_m') is not None else ''}")
    if reason := message["reason"] or str(shot.get("reason") or ""):
        lines.append(reason)
    return lines
