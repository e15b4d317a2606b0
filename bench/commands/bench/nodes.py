"""`golfbench nodes` at the command line."""

from __future__ import annotations

import math
import signal
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.base.errors import BenchError, ExitCode, Refused
from bench.commands.common.options import flag, option
from bench.commands.common.session import Session

if TYPE_CHECKING:
    from collections.abc import Callable

    from bench.config import Configuration
    from bench.records.telemetry.encoder_preset import CalibratedShifts
    from drivers.canopen.scan import ScannedNode
    from sim.nodes.personality import Personality
    from sim.nodes.wall_plant import NodesPlan


class NoBus(BenchError):
    """The bus of the simulated nodes cannot be opened."""

    exit_code = ExitCode.DEVICE


def nodes_plan(configuration: Configuration, folder: Path, encoder: str = "", io: str = "") -> NodesPlan:
    """Return the start parameters of the simulated nodes of `configuration`; their files go to `folder`.

    `encoder` and `io` name the device families that they play; empty for the plain devices.

    Raises:
        ExceptionGroup: BenchErrors, one for each fault that could never start.
        BenchError: no such device family.
    """
    from bench.config import unheard_phases
    from sim.nodes.personality import ENCODER, IO
    from sim.nodes.wall_plant import NodesPlan

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
        encoder_personality=_family(encoder, ENCODER),
        io_personality=_family(io, IO),
    )


def _family(name: str, role: str) -> Personality | None:
    from sim.nodes.personality import find_personality

    try:
        return find_personality(name, role) if name else None
    except ValueError as error:
        raise BenchError(f"nodes --{role}", f"{name!r}", f"{error}", "Choose a known one.") from error


def nodes(
    context: typer.Context,
    folder: Annotated[
        Path | None, option("Folder of the plant's shared records.", "DIR", shown="temporary")
    ] = None,
    dbc: Annotated[Path | None, option("Write a DBC file of all bus frames and exit.", "FILE")] = None,
    encoder: Annotated[str, option("Device family that the encoders play.", "FAMILY", shown="plain")] = "",
    io: Annotated[str, option("Device family that the valve node plays.", "FAMILY", shown="plain")] = "",
    look: Annotated[
        bool, flag("--scan", "List the nodes on the bus and whether they would be taken, and exit.")
    ] = False,
    turn: Annotated[
        str | None,
        option(
            "Turn the regulator of the nodes in --folder to bar absolute, or to 'service', and exit.",
            "BAR",
            names="--turn-regulator",
        ),
    ] = None,
    act: Annotated[
        str | None, option("Act at the inputs of the nodes in --folder and exit.", "ACT", names="--act")
    ] = None,
) -> None:
    """Run the simulated nodes on the CAN bus, with the simulated robot behind them, until stopped.

    Encoders, valves and interlocks as CANopen nodes, in real time. Without a CAN interface:
    `golfbench --config local_can nodes`, and in another terminal `golfbench --config local_can run`.
    """
    if turn is not None:
        turn_regulator(folder, turn)
        return
    if act is not None:
        act_at(folder, act)
        return
    configuration = context.ensure_object(Session).configuration()
    if look:
        show_scan(configuration)
        return
    if dbc is not None:
        write_dbc(configuration, dbc)
        return

    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        play(nodes_plan(configuration, folder, encoder, io))
    else:
        with tempfile.TemporaryDirectory(prefix="golfbench-nodes-") as made:
            play(nodes_plan(configuration, Path(made), encoder, io))


def write_dbc(c: Configuration, file: Path) -> None:
    """Write a DBC file of all frames on the bus of `c`."""
    from drivers.canopen.dbc import describe

    file.write_text(describe(c.canopen, 1.0 / c.loop.rate, c.driver.watchdog), encoding="ascii")
    typer.echo(f"{file}: the frames of channel {c.canopen.channel}")


def turn_regulator(folder: Path | None, bar: str) -> None:
    """Turn the pressure regulator of the simulated nodes with their files in `folder` to `bar`, absolute.

    Raises:
        Refused: no nodes are there, or `bar` is neither a pressure nor `service`.
    """
    from bench.commissioning.machine.inputs import SERVICE, of_simulation

    location = f"nodes --turn-regulator {bar}"
    try:
        pressure = math.inf if bar == SERVICE else 1e5 * float(bar)
    except ValueError:
        pressure = math.nan
    if not pressure > 0.0:
        raise Refused(location, repr(bar), f"bar absolute above 0, or {SERVICE!r}", "Give one of them.")
    _at_nodes(folder, location, lambda there: of_simulation(there)(pressure))


def act_at(folder: Path | None, key: str) -> None:
    """Act on an input of the simulated nodes as a person does; their files are in `folder`.

    Raises:
        Refused: no nodes run there, or no act is called `key`.
    """
    from bench.commissioning.machine.inputs import ACTS, act_in_simulation

    location = f"nodes --act {key}"
    if key not in ACTS:
        raise Refused(location, repr(key), f"one of {', '.join(ACTS)}", "Give one of them.")
    _at_nodes(folder, location, lambda there: act_in_simulation(there)(ACTS[key]))


def _at_nodes(folder: Path | None, location: str, act: Callable[[Path], None]) -> None:
    """Do `act` at the simulated nodes with their files in `folder`; raises Refused where none are."""
    from drivers.base.shared_memory import SharedMemoryError

    if folder is None:
        raise Refused(location, "no --folder", "the folder of running nodes", "Start them with --folder DIR.")
    try:
        act(folder)
    except SharedMemoryError as error:
        raise Refused(location, str(error), "running nodes", f"Start them with --folder {folder}.") from error


def show_scan(configuration: Configuration) -> None:
    """Print the nodes on the bus of `configuration`.

    Raises:
        NoBus: the bus cannot be opened.
        Refused: a configured node is missing or would be refused.
    """
    from bench.calibration.archive import calibration_of
    from drivers.base import DriverError
    from drivers.canopen.scan import scan

    bus = configuration.canopen
    where = f"{bus.interface} {bus.channel}"
    try:
        found = scan(bus, configuration.plant.encoders.counts_per_revolution)
    except DriverError as error:
        raise NoBus(
            f"nodes --scan on {where}",
            str(error),
            "an open CAN interface",
            "Bring the interface up, as ip link set can0 up, then retry.",
        ) from error
    calibrated = calibration_of(configuration, datetime.now(UTC)).shifts
    found = [_compared(node, configuration, calibrated) for node in found]
    for node in found:
        typer.echo("\n".join(_scan_lines(node)))
    refused = [str(node.number) for node in found if node.role and not node.taken]
    if refused:
        raise Refused(
            f"nodes --scan on {where}",
            f"node {', '.join(refused)} missing or refused",
            "every configured node taken",
            "Follow the text at each node.",
        )


def _compared(
    node: ScannedNode, configuration: Configuration, calibrated: CalibratedShifts | None
) -> ScannedNode:
    """Return `node`, refused if the zero of its encoder is not where it was calibrated."""
    from bench.records.telemetry.encoder_preset import moved_zero

    numbers = configuration.canopen.encoders.nodes
    if calibrated is None or not node.taken or node.number not in numbers:
        return node
    moved = moved_zero(numbers.index(node.number), node.zero_shift, calibrated)
    return node._replace(taken=False, verdict=moved) if moved else node


def _scan_lines(node: ScannedNode) -> list[str]:
    lines = [f"node {node.number}: {node.role or 'not configured'}"]
    lines += [f"  {text}" for text in (node.device, node.properties, node.zero_shift) if text]
    return [*lines, f"  {'taken' if node.taken else 'refused:'} {node.verdict}".rstrip()]


def play(plan: NodesPlan) -> None:
    """Run the simulated nodes of `plan` until SIGTERM or Ctrl-C.

    Raises:
        NoBus: the bus or the plant's files cannot be had.
    """
    import can

    from drivers.base.shared_memory import SharedMemoryError
    from sim.nodes.process import StopRequest, run_nodes

    typer.echo("starting", err=True)
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
