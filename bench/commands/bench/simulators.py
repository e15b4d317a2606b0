"""`golfbench nodes`, `golfbench launch-monitor`: simulated hardware of a bench."""

from __future__ import annotations

import math
import signal
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bench.base.errors import BenchError, ExitCode, Refused
from bench.base.interrupt import stop_on_signals
from bench.commands.common import Session, flag, option
from bench.records.telemetry.encoder_preset import CalibratedShifts, moved_zero
from bench.supervisor.ownership import bench_folder
from drivers.base import DriverError, Launch

if TYPE_CHECKING:
    from bench.config import Configuration
    from drivers.canopen.scan import ScannedNode
    from sim.nodes.personality import Personality
    from sim.nodes.wall_plant import NodesPlan
    from sim.simulated_monitor import MonitorParameters


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
    scan: Annotated[
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
    if scan:
        show_scan(configuration)
        return
    if dbc is not None:
        from bench.commands.common import write_text
        from drivers.canopen.frames import dbc_text

        c = configuration
        write_text(dbc_text(c.canopen, 1.0 / c.loop.rate, c.driver.watchdog), dbc)
        typer.echo(f"{dbc}: the frames of channel {c.canopen.channel}")
        return
    _require_free(configuration)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        _run_nodes(nodes_plan(configuration, folder, encoder, io))
    else:
        with tempfile.TemporaryDirectory(prefix="golfbench-nodes-") as made:
            _run_nodes(nodes_plan(configuration, Path(made), encoder, io))


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
    _at_nodes(folder, location, lambda there: act_in_simulation(there, ACTS[key]))


def _at_nodes(folder: Path | None, location: str, act: Callable[[Path], None]) -> None:
    """Do `act` at the simulated nodes with their files in `folder`; raises Refused where none are."""
    from bench.commissioning.machine.inputs import RegulatorNotTurned
    from drivers.base.shared_memory import SharedMemoryError

    if folder is None:
        raise Refused(location, "no --folder", "the folder of running nodes", "Start them with --folder DIR.")
    try:
        act(folder)
    except (RegulatorNotTurned, SharedMemoryError) as error:
        raise Refused(location, str(error), "running nodes", f"Start them with --folder {folder}.") from error


def _require_free(configuration: Configuration) -> None:
    """Refuse a bus on which nodes with these numbers answer: valves would follow the twins' readings.

    Raises:
        Refused: some answer.
    """
    from drivers.canopen.scan import scan as scan_bus

    bus = configuration.canopen
    if bus.interface == "local_socket":  # of this machine only
        return
    with suppress(DriverError):  # the nodes report a bus that does not open
        found = scan_bus(bus, configuration.plant.encoders.counts_per_revolution)
        there = ", ".join(str(node.number) for node in found if node.role and node.device)
        if there:
            action = "List them: golfbench nodes --scan. Simulated ones need another bus: --config local_can."
            where = f"nodes on {bus.interface} {bus.channel}"
            raise Refused(where, f"node {there} answers already", "free node numbers", action)


def show_scan(configuration: Configuration) -> None:
    """Print the nodes on the bus of `configuration`.

    Raises:
        BenchError: the configuration has no CANopen nodes, or the bus cannot be opened.
        Refused: a configured node is missing or would be refused.
    """
    from bench.calibration.archive import calibration_of
    from drivers.canopen.scan import scan as scan_bus

    if (name := configuration.driver.name) != "canopen":
        action = f"Omit the scan: driver {name!r} has no CANopen nodes. Or name another file with --config."
        raise BenchError("driver.name", repr(name), "'canopen'", action)
    bus = configuration.canopen
    where = f"nodes --scan on {bus.interface} {bus.channel}"
    try:
        found = scan_bus(bus, configuration.plant.encoders.counts_per_revolution)
    except DriverError as error:
        action = "Bring the interface up, as ip link set can0 up, then retry."
        expected, code = "an open CAN interface", ExitCode.DEVICE
        raise BenchError(where, str(error), expected, action, code=code) from error
    calibrated = calibration_of(configuration, datetime.now(UTC)).shifts
    found = [_compared(node, configuration, calibrated) for node in found]
    for node in found:
        typer.echo("\n".join(_scan_lines(node)))
    refused = [str(node.number) for node in found if node.role and not node.taken]
    if refused:
        found_refused = f"node {', '.join(refused)} missing or refused"
        raise Refused(where, found_refused, "every configured node taken", "Follow the text at each node.")


def _compared(
    node: ScannedNode, configuration: Configuration, calibrated: CalibratedShifts | None
) -> ScannedNode:
    """Return `node`, marked as refused if its encoder zero differs from the calibrated one."""
    numbers = configuration.canopen.encoders.nodes
    if calibrated is None or not node.taken or node.number not in numbers:
        return node
    moved = moved_zero(numbers.index(node.number), node.zero_shift, calibrated)
    return node._replace(taken=False, verdict=moved) if moved else node


def _scan_lines(node: ScannedNode) -> list[str]:
    lines = [f"node {node.number}: {node.role or 'not configured'}"]
    lines += [f"  {text}" for text in (node.device, node.properties, node.zero_shift) if text]
    return [*lines, f"  {'taken' if node.taken else 'refused:'} {node.verdict}".rstrip()]


def _run_nodes(plan: NodesPlan) -> None:
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
        expected, action = "an open CAN interface", "Bring it up, or take --config local_can: it needs none."
        raise BenchError(f"nodes on {where}", str(error), expected, action, code=ExitCode.DEVICE) from error


# The launch monitor ----------------------------------------------------------------------------------

_PERIOD = 0.005
"""Period of reading the plant (s)."""
_ATTACH_PERIOD = 0.5
"""Period of looking for a plant (s)."""


def launch_monitor(
    context: typer.Context,
    seed: Annotated[int, option("Seed of noise and faults.", low=0)] = 1,
    drop: Annotated[
        list[int] | None, option("Drop the message of the N-th ball; repeatable.", "N", low=1)
    ] = None,
    misread: Annotated[float, option("Fraction of balls with one wrong value.", low=0.0, high=1.0)] = 0.0,
    double: Annotated[float, option("Fraction of balls measured and sent twice.", low=0.0, high=1.0)] = 0.0,
    club: Annotated[bool, flag("--club", "Also send club speed and attack angle.")] = False,
    folder: Annotated[
        Path | None,
        option(
            "Folder of the plant's shared records (golfbench nodes --folder).", "DIR", shown="the bench's"
        ),
    ] = None,
) -> None:
    """Simulate a launch monitor for a simulated bench until Ctrl-C or SIGTERM.

    It measures the plant's balls with noise and faults, and sends them to the bench
    over Open Connect, as a real one does. The bench needs [launch_monitor] enabled = true.
    """
    from sim.simulated_monitor import MonitorParameters

    c = context.ensure_object(Session).configuration()
    parameters = MonitorParameters(
        dropped=tuple(drop or ()), misread=misread, double=double, club=club, seed=seed
    )
    settings = c.launch_monitor
    if not settings.enabled:
        typer.echo("[launch_monitor] is not enabled here; the running bench may have it on", err=True)
    _run_monitor(parameters, c, folder or bench_folder(c.bench.id), (settings.address, settings.port))


def _run_monitor(
    parameters: MonitorParameters, c: Configuration, folder: Path, address: tuple[str, int]
) -> None:
    """Simulate the launch monitor of the plant in `folder` until SIGTERM or Ctrl-C."""
    from drivers.base.shared_memory import SharedMemoryError
    from sim.exchange import ContactMonitor, warm_up
    from sim.simulated_monitor import ClubMotion, SimulatedMonitor

    def say(text: str) -> None:
        typer.echo(text, err=True)

    plant = c.plant
    warm_up()
    _carry(Launch(60.0, 0.2, 0.0, 250.0, 0.0), folder, c)
    watch, monitor = ContactMonitor(folder), SimulatedMonitor(parameters, *address)
    where = f"{address[0]} port {address[1]}"
    place = plant.site.ball_x, plant.site.ball_y
    balls, attach_at = 0, -1.0
    told: tuple[bool, bool] | None = None
    try:
        with stop_on_signals() as wish:
            while not wish.wait(_PERIOD):
                now = time.monotonic()
                if now >= attach_at:
                    watch.attach()
                    attach_at = now + _ATTACH_PERIOD
                if (contact := watch.look()) is not None:
                    balls += 1
                    launch = contact.launch
                    came = contact.delivery(plant.robot, place)
                    carry = _carry(launch, folder, c)
                    monitor.see(launch, now, ClubMotion(came.speed, came.attack_angle), carry)
                    outcome = "reported" if monitor.waiting else "not reported"
                    say(f"ball {balls}: {launch.speed:.2f} m/s, {outcome}")
                monitor.step(now)
                if (standing := (watch.attached, monitor.connected)) != told:
                    told = standing
                    say(
                        f"{'sees' if watch.attached else 'waits for'} the plant in {folder}, "
                        f"{'connected to' if monitor.connected else 'not connected to'} the bench at {where}"
                    )
    except SharedMemoryError as error:
        raise BenchError(*error.args, code=ExitCode.DEVICE) from error
    finally:
        monitor.close()
        watch.close()


def _carry(launch: Launch, folder: Path, c: Configuration) -> float | None:
    """Return the carry of the ball on the plant's tee with `launch`, None if it does not fly."""
    from drivers.base.shared_memory import SharedMemoryError
    from sim.exchange import chosen_ball
    from sim.flight import fly

    try:
        ball = chosen_ball(folder) or c.plant.ball
    except SharedMemoryError:
        ball = c.plant.ball
    try:
        return fly(launch, c.air, ball, c.wind, c.turf).carry
    except ValueError:
        return None
