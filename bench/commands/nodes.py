"""`golfbench nodes` at the command line."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.commands.session import Session
from bench.errors import BenchError, ExitCode

if TYPE_CHECKING:
    from bench.config import Configuration
    from sim.nodes.plan import NodesPlan


class NoBus(BenchError):
    """The bus of the simulated nodes cannot be opened."""

    exit_code = ExitCode.DEVICE


def nodes_plan(configuration: Configuration, folder: Path) -> NodesPlan:
    """Return what the simulated nodes of `configuration` are started with; their files go to `folder`.

    Raises:
        ExceptionGroup: of BenchErrors, one for each fault that would never begin.
    """
    from bench.config import unheard_phases
    from sim.nodes.plan import NodesPlan

    if mistakes := unheard_phases(configuration):
        raise ExceptionGroup("invalid configuration", mistakes)
    c, bus = configuration, configuration.canopen
    return NodesPlan(
        interface=bus.interface,
        channel=bus.channel,
        bitrate=bus.bitrate,
        encoders=bus.encoders.nodes,
        valve_node=bus.valve_node.node,
        plant=c.plant,
        folder=folder,
        priority=c.loop.priority - 1 if c.loop.realtime != "off" else 0,
        faults=tuple(c.faults.values()),
    )


def nodes(
    context: typer.Context,
    folder: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of the plant's shared records.", show_default="temporary"),
    ] = None,
    dbc: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write a DBC file of all bus frames and exit."),
    ] = None,
) -> None:
    """Run the simulated nodes on the CAN bus, with the simulated robot behind them, until stopped.

    Encoders, valves and interlocks as CANopen nodes, in real time. Without a CAN interface:
    `golfbench --config local_can nodes`, and in another terminal `golfbench --config local_can run`.
    """
    configuration = context.ensure_object(Session).configuration()
    if dbc is not None:
        from drivers.canopen.dbc import describe

        c = configuration
        dbc.write_text(describe(c.canopen, 1.0 / c.loop.rate, c.driver.watchdog), encoding="ascii")
        typer.echo(f"{dbc}: the frames of channel {c.canopen.channel}")
        return
    import tempfile

    if folder is not None:
        play(nodes_plan(configuration, folder))
    else:
        with tempfile.TemporaryDirectory(prefix="golfbench-nodes-") as made:
            play(nodes_plan(configuration, Path(made)))


def play(plan: NodesPlan) -> None:
    """Run the simulated nodes of `plan` until SIGTERM or Ctrl-C.

    Raises:
        NoBus: the bus or the plant's files cannot be had.
    """
    import signal

    import can

    from drivers.base.shared_record import SharedMemoryError
    from sim.nodes.process import StopRequest, run_nodes

    typer.echo("starting; the first start compiles for about half a minute", err=True)
    wish = StopRequest(signal.SIGTERM, signal.SIGINT)
    numbers = ", ".join(map(str, (*plan.encoders, plan.valve_node)))
    where = f"{plan.interface} {plan.channel}"
    try:
        run_nodes(plan, lambda how: typer.echo(f"nodes {numbers} live on {where} ({how})", err=True), wish)
    except (OSError, can.CanError, SharedMemoryError) as error:
        raise NoBus(
            f"nodes on {where}",
            str(error),
            "a CAN interface that can be opened",
            "Bring it up, or take --config local_can, which needs none.",
        ) from error
