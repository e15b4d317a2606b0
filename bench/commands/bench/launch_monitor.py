"""`golfbench launch-monitor` at the command line."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bench.base.errors import BenchError, ExitCode
from bench.base.interrupt import stop_on_signals
from bench.commands.common.options import flag, option
from bench.commands.common.session import Session

if TYPE_CHECKING:
    from bench.records.shot.recorded_shot import FlightConditions
    from drivers.base import Launch
    from sim.launch_monitor import MonitorParameters
    from sim.plant import PlantParameters

_LOOK = 0.005
"""Period of reading the plant (s)."""
_ATTACH = 0.5
"""Period of looking for a plant (s)."""


def _share(of: str) -> Any:
    return typer.Option(min=0.0, max=1.0, metavar="SHARE", help=f"Share of {of}.")


class NoPlant(BenchError):
    """The simulated bench cannot be looked at."""

    exit_code = ExitCode.DEVICE


Seed = Annotated[int, option("Seed of noise and faults.", low=0)]
Drop = Annotated[list[int] | None, option("Drop the message of the N-th ball; repeatable.", "N", low=1)]
Missing = Annotated[float, _share("balls without a message")]
Misread = Annotated[float, _share("balls with one wrong value")]
Double = Annotated[float, _share("balls measured and sent twice")]
Repeated = Annotated[float, _share("messages sent again")]
NoSpin = Annotated[float, _share("balls without spin")]
Ghost = Annotated[float, _share("balls followed by a ghost ball")]
Club = Annotated[bool, flag("--club", "Also send club speed and attack angle.")]
Noise = Annotated[float, option("Noise relative to the default; 0: none.", "FACTOR", low=0.0, high=10.0)]
Delay = Annotated[float, option("Delay from impact to message.", "S", low=0.0, high=30.0)]
Folder = Annotated[
    Path | None,
    option("Folder of the plant's shared records (golfbench nodes --folder).", "DIR", shown="the bench's"),
]


def launch_monitor(
    context: typer.Context,
    seed: Seed = 1,
    drop: Drop = None,
    missing: Missing = 0.0,
    misread: Misread = 0.0,
    double: Double = 0.0,
    repeated: Repeated = 0.0,
    no_spin: NoSpin = 0.0,
    ghost: Ghost = 0.0,
    club: Club = False,
    noise: Noise = 1.0,
    delay: Delay = 0.6,
    folder: Folder = None,
) -> None:
    """Simulate a launch monitor for a simulated bench until Ctrl-C or SIGTERM.

    It measures the plant's balls with noise and faults, and sends them to the bench
    over Open Connect, as a real one does. The bench needs [launch_monitor] enabled = true.
    """
    from bench.records.shot.recorded_shot import FlightConditions
    from bench.supervisor.ownership import bench_folder
    from sim.launch_monitor import MonitorParameters

    c = context.ensure_object(Session).configuration()
    usual = MonitorParameters()
    parameters = MonitorParameters(
        speed_noise=noise * usual.speed_noise,
        angle_noise=noise * usual.angle_noise,
        spin_noise=noise * usual.spin_noise,
        axis_noise=noise * usual.axis_noise,
        carry_noise=noise * usual.carry_noise,
        delay=delay,
        missing=missing,
        dropped=tuple(drop or ()),
        misread=misread,
        double=double,
        repeated=repeated,
        no_spin=no_spin,
        club=club,
        ghost=ghost,
        seed=seed,
    )
    settings = c.launch_monitor
    address = (settings.address, settings.port)
    if not settings.enabled:
        typer.echo("[launch_monitor] is not enabled here; the running bench may have it on", err=True)
    play(
        parameters,
        c.plant,
        FlightConditions(c.air, c.wind, c.turf),
        folder or bench_folder(c.bench.id),
        address,
        lambda text: typer.echo(text, err=True),
    )


def play(
    parameters: MonitorParameters,
    plant: PlantParameters,
    around: FlightConditions,
    folder: Path,
    address: tuple[str, int],
    say: Callable[[str], None],
) -> None:
    """Simulate the launch monitor of the `plant` in `folder` until SIGTERM or Ctrl-C; report events to `say`.

    Raises:
        NoPlant: the plant there is of other code.
    """
    from drivers.base import Launch
    from drivers.base.shared_memory import SharedMemoryError
    from sim.launch_monitor import ClubMotion, SimulatedMonitor
    from sim.live.exchange import ContactMonitor, warm_up

    warm_up()
    _carry(Launch(60.0, 0.2, 0.0, 250.0, 0.0), folder, plant, around)
    watch, monitor = ContactMonitor(folder), SimulatedMonitor(parameters, *address)
    where = f"{address[0]} port {address[1]}"
    place = plant.site.ball_x, plant.site.ball_y
    balls, attach_at = 0, -1.0
    told: tuple[bool, bool] | None = None
    try:
        with stop_on_signals() as wish:
            while not wish.wait(_LOOK):
                now = time.monotonic()
                if now >= attach_at:
                    watch.attach()
                    attach_at = now + _ATTACH
                if (contact := watch.look()) is not None:
                    balls += 1
                    launch = contact.launch
                    came = contact.delivery(plant.robot, place)
                    carry = _carry(launch, folder, plant, around)
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
        raise NoPlant(*error.args) from error
    finally:
        monitor.close()
        watch.close()


def _carry(launch: Launch, folder: Path, plant: PlantParameters, around: FlightConditions) -> float | None:
    """Return the carry of the ball on the plant's tee with `launch`, None if it does not fly."""
    from drivers.base.shared_memory import SharedMemoryError
    from sim.flight import fly
    from sim.live.exchange import chosen_ball

    try:
        ball = chosen_ball(folder) or plant.ball
    except SharedMemoryError:
        ball = plant.ball
    try:
        return fly(launch, around.air, ball, around.wind, around.turf).carry
    except ValueError:
        return None
