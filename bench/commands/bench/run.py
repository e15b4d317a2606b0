"""`golfbench run`, `check`, `page`, `schema`, `certificates`, `cluster`: start a bench and serve it."""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import AsyncExitStack
from dataclasses import replace
from datetime import UTC, datetime
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from bench.base.address import PAGE_PORT, IdentityFiles, identity_files
from bench.base.errors import BenchError
from bench.commands.common import Session, argument, flag, option, plain_table, show_json

if TYPE_CHECKING:
    from rich.table import Table

    from bench.config import Configuration
    from bench.design.static_checks import Check


def run(
    context: typer.Context,
    driver: Annotated[str | None, option("Driver of the robot.", "NAME", shown="the configuration's")] = None,
    profile: Annotated[
        str | None, option("Profile to swing.", "PROFILE", shown="the configuration's")
    ] = None,
    series: Annotated[
        bool,
        flag(
            "--series",
            "After a swing hold the address for the next one, as campaigns need it; without it the "
            "bench vents.",
        ),
    ] = False,
    read_only: Annotated[
        bool, flag("--read-only", "Observe only: send nothing but the passive command.")
    ] = False,
) -> None:
    """Run the bench until Ctrl-C or SIGTERM: loop, recorder, publisher, and commands over the network.

    It starts in ESTOP. Continue in another terminal: golfbench lease take, reset, home, arm, swing.
    """
    from bench.config import contradictions, unheard_phases
    from bench.supervisor.daemon import Daemon

    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.INFO)
    logging.getLogger("numexpr").setLevel(logging.WARNING)  # python-can loads it with the extra `export`
    configuration = context.ensure_object(Session).configuration()
    settings = configuration.driver
    if driver is not None:
        settings = replace(settings, name=driver)
    swing = configuration.swing
    if profile is not None:
        swing = replace(swing, profile=profile)
    lifecycle = configuration.lifecycle
    if series:
        lifecycle = replace(lifecycle, hold_between_swings=True)
    configuration = replace(configuration, swing=swing, lifecycle=lifecycle).with_driver(settings)
    if mistakes := contradictions(configuration) + unheard_phases(configuration):
        raise ExceptionGroup("invalid configuration", mistakes)
    daemon = Daemon(configuration, read_only=read_only)
    daemon.run(
        lambda: logging.info("bench %s answers at %s", configuration.bench.id, configuration.network.endpoint)
    )


# The check -------------------------------------------------------------------------------------------


def check(
    context: typer.Context,
    profile: Annotated[str | None, argument("PROFILE", "Name or path.", shown="the configuration's")] = None,
    defaults: Annotated[
        bool, flag("--defaults", "Print the shipped configuration with every key, its meaning and bounds.")
    ] = False,
) -> None:
    """Check configuration and swing before anything moves; print the checks.

    Exits with 2 and lists all mistakes.
    """
    from bench.config import load_configuration, shipped_configuration
    from bench.config.files import configuration_text
    from bench.supervisor.readiness import assess_bench

    if defaults:
        typer.echo(configuration_text(load_configuration(shipped_configuration())), nl=False)
        return
    console, now = Console(markup=False, emoji=False, highlight=False), datetime.now(UTC)
    configuration = context.ensure_object(Session).configuration()
    console.print(_summary(configuration))
    found = assess_bench(configuration, now, profile, running=True)
    calibration = found.calibration
    console.print(f"calibration of bench {calibration.bench}: {calibration.summary()}")
    for replaced in found.replaced:
        console.print(f"  {replaced.text}", soft_wrap=True)
    console.print(
        f"swing {found.file}: readable, {len(found.profile.angle)} samples, all finite and in range"
    )
    if found.limits:
        console.print(f"limits of the model-based check: {found.limits}", soft_wrap=True)
    for warning in found.warnings:
        console.print(f"warning: {warning}", style="yellow", soft_wrap=True)
    console.print(_check_table(found.checks))
    if blocks := [*found.faults, *calibration.problems(now)]:
        reasons = f"{len(blocks)} reason{'s' * (len(blocks) > 1)}"
        console.print(f"Arming blocked for {reasons}: this bench does not swing.", style="red")
        raise ExceptionGroup(f"{found.file} cannot be swung here", blocks)
    if count := len(found.warnings):
        warned = f"{count} warning{'s' * (count > 1)}"
        console.print(f"Nothing blocks arming; {warned}, see above.", style="yellow")
    else:
        console.print("Everything holds: this swing may be tried on this bench.", style="green")


def _summary(c: Configuration) -> str:
    files = " over ".join(str(file) for file in reversed(c.files))
    return (
        f"configuration {files}: every key known and in its physical range\n"
        f"  bench {c.bench.id}, driver {c.driver.name}, loop {c.loop.rate:g} Hz, real time {c.loop.realtime}"
        f", records in {c.bench.data_dir}\n"
        f"  clubs {', '.join(c.clubs)}; balls {', '.join(c.balls)}; "
        f"mounted: {c.swing.club} and {c.swing.ball}"
    )


def _check_table(checks: Sequence[Check]) -> Table:

    marks = {True: Text("wrong", "bold red"), False: Text("ok", "green")}
    rows = ((marks[bool(one.faults)], *map(Text, (one.name, one.found, one.allowed))) for one in checks)
    return plain_table("", "checked", "found", "allowed", rows=rows)


# The network -----------------------------------------------------------------------------------------


def page(
    context: typer.Context,
    host: Annotated[
        str, option("IP address to listen at; 0.0.0.0: all of this machine.", "ADDRESS")
    ] = "127.0.0.1",
    port: Annotated[int, option("Port to listen at.", low=1, high=65535)] = PAGE_PORT,
    identity: Annotated[str, option("Certificate and key for TLS, without ending.", "PATH")] = "",
    tokens: Annotated[
        Path | None, option("Tokens to sign in with, one a line: operator TOKEN.", "FILE")
    ] = None,
) -> None:
    """Serve the bench's page: its state, and its commands, in a browser.

    On this machine only, unless --host names an address for others, which needs --identity. Ctrl-C ends it;
    the bench does not notice.
    """
    from bench.web.page_access import PageAddress
    from bench.web.page_server import serve_page

    def ready(url: str, _: object) -> None:
        typer.echo(f"{url}  Ctrl-C ends the page")

    session = context.ensure_object(Session)
    given = ("--config", str(session.config)) if session.config else ()
    golfbench = (sys.executable, "-P", "-m", "bench", *given)
    serve_page(session.configuration(), PageAddress(host, port, identity, tokens), golfbench, ready)


def schema(context: typer.Context) -> None:
    """Print the messages of a bench for other programs: keys, JSON Schemas, columns, units; as JSON.

    A running bench answers the same on golfbench/BENCH/schema.
    """
    from bench.network.messages import wire_contract

    bench = context.ensure_object(Session).configuration().bench.id
    show_json(wire_contract(bench))


def certificates(
    folder: Annotated[Path, argument("DIR", "Folder of the certificates, created if absent.")],
    names: Annotated[list[str], argument("NAME...", "Names of people, benches and routers.")],
    addresses: Annotated[
        list[str] | None,
        option("IP address or host name where NAME listens; may be repeated.", "HOST", names="--address"),
    ] = None,
    days: Annotated[float, option("Days of validity.", low=0.01, high=3650.0)] = 365.0,
) -> None:
    """Make a certificate for each NAME, to reach the bench from other machines.

    The first call also makes the authority that signs them. Each side gets its NAME.pem and NAME.key and
    authority.pem; authority.key stays where it is. A bench or router needs --address. Ends with 1 when there
    is a certificate of that name.
    """
    from bench.config import NAME
    from bench.network.certificates import (
        AUTHORITY,
        make_authority,
        make_certificate,
        read_identity,
        write_identity,
    )

    for name in names:
        if not NAME.fullmatch(name) or name == AUTHORITY:
            expected = f"letters, digits, ., - and _, at most 63, and not {AUTHORITY}"
            raise BenchError("NAME", repr(name), expected, "Choose another name, e.g. bench1.")
    now = datetime.now(UTC)
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not (folder / f"{AUTHORITY}.pem").exists():
        write_identity(folder, AUTHORITY, make_authority(now))
        typer.echo(f"{folder / AUTHORITY}.pem: the authority")
    authority = read_identity(folder, AUTHORITY)
    for name in names:
        identity = make_certificate(authority, name, addresses or (), now, days)
        write_identity(folder, name, identity)
        until = identity.certificate.not_valid_after_utc
        typer.echo(f"{folder / name}.pem: valid until {until:%Y-%m-%d %H:%M} UTC")


# Sweeps on other machines ----------------------------------------------------------------------------

_ALLOWED_DEATHS = 10
"""Workers that may die under one batch before dask gives it up: most die of something else."""

_CONFIGURATION = {
    "distributed.scheduler.allowed-failures": _ALLOWED_DEATHS,
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    "distributed.nanny.pre-spawn-environ.DASK_LOGGING__DISTRIBUTED": "warning",
    # By default each process looks at itself up to 100 times per second, for pages that are not served here.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.worker.memory.monitor-interval": "1s",
    # With dask's thresholds malloc returns memory all the time: 40 times the page faults, 5 % of the time.
    # Malloc's own adaptation ends at the thresholds below.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 2**27,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 2**25,
}
"""Dask's configuration of scheduler, nannies and workers."""


def cluster(
    context: typer.Context,
    host: Annotated[str, option("IP address to listen at.", "ADDRESS")] = "127.0.0.1",
    port: Annotated[int, option("Port of the scheduler; 0: any.", low=0, high=65535)] = 8786,
    workers: Annotated[int | None, option("Number of workers.", low=0, shown="one per core")] = None,
    join: Annotated[str, option("Scheduler that the workers join, in place of one here.", "ADDRESS")] = "",
) -> None:
    """Start a scheduler and workers for `--cluster`, until Ctrl-C.

    Beyond this machine only with certificates (`network.identity`): who reaches a worker can run anything
    on it.
    """
    import asyncio

    from bench.simulation.cluster_engine import load_distributed

    load_distributed()
    identity = context.ensure_object(Session).configuration().network.identity
    files = identity_files(identity) if identity else None
    joined = join.partition("://")[2].rpartition(":")[0].strip("[]")
    beyond = [location for location in (host, joined) if location and not _is_loopback(location)]
    if files is None and beyond:
        found = f"{beyond[0]} without a certificate"
        action = "Make one with `golfbench certificates` and name it in network.identity."
        raise BenchError("golfbench cluster", found, "127.0.0.1, or a certificate of this machine", action)
    count = len(os.sched_getaffinity(0)) if workers is None else workers
    asyncio.run(_serve(host, port, count, join, files))


async def _serve(host: str, port: int, workers: int, join: str, files: IdentityFiles | None) -> None:
    import asyncio

    import dask
    from distributed import Nanny, Scheduler

    from bench.simulation.cluster_engine import security_of

    # Pages over HTTP would be open to everybody: none is served, the port is a free one of the loopback.
    settings: dict[str, Any] = {
        "protocol": "tls" if files else "tcp",
        "dashboard": False,
        "dashboard_address": "127.0.0.1:0",
    }
    if files:
        settings["security"] = security_of(files)
    dask.config.set(_CONFIGURATION)
    logging.getLogger("distributed").setLevel(logging.WARNING)
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    async with AsyncExitStack() as stack:
        address = join
        if not join:
            scheduler = Scheduler(host=host, port=port, **settings)
            address = (await stack.enter_async_context(scheduler)).address
            typer.echo(f"scheduler at {address}")
        nannies = [Nanny(address, nthreads=1, host=host, **settings) for _ in range(workers)]

        async def close_all() -> None:
            await asyncio.gather(*(nanny.close() for nanny in nannies))  # each takes seconds

        stack.push_async_callback(close_all)
        await asyncio.gather(*nannies)
        typer.echo(f"{workers} workers; Ctrl-C ends. Use it: golfbench faults run --cluster {address}")
        await stop.wait()


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
