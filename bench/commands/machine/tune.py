"""`golfbench tune`: gains of the three PIDs, with their margins."""

from __future__ import annotations

from math import degrees, isfinite, pi
from typing import TYPE_CHECKING, Any

import typer
from rich.progress import Progress
from rich.table import Table

from bench.commands.common import (
    Json,
    ProfileName,
    Session,
    exit_unless,
    finite,
    plain_table,
    progress_bar,
    show_result,
)
from bench.swing.library import find_profile
from drivers.base import JOINTS

if TYPE_CHECKING:
    from bench.control.law.gain_scheduling import MachineGains
    from bench.control.law.linear_loop import Estimator, LinearPlant
    from bench.learning.along_swing import LoopMargins, ValidationSwing
    from bench.simulation.simulated_bench import Bench


def tune(
    context: typer.Context,
    profile: ProfileName = None,
    json_: Json = False,
) -> None:
    """Show the three PIDs' gains, and the margins of their loops along a swing of the simulated robot.

    Deterministic. Whole swings verify the gains, also on a worn robot. Exits with 1 if the configured robot
    does not swing with them.
    """
    from bench.design.static_checks import require_possible
    from bench.learning.along_swing import gains_along, judge
    from bench.simulation.simulated_bench import Bench
    from bench.swing.profile import load_profile

    configuration = context.ensure_object(Session).configuration()
    path, plant = find_profile(profile or configuration.swing.profile), configuration.plant
    swing = load_profile(path)
    require_possible(swing, plant, configuration.envelope, str(path))
    bench = Bench.of(configuration, swing)
    with progress_bar() as bar:
        task = bar.add_task("a swing, linearised", total=1.0)
        plants, estimator = _linearised(bench)
        bar.update(task, completed=1.0)
        judged = judge(plants, estimator, gains_along(bench), plant.tick)
        proofs = _proofs(bench, bar)
    machine = _machine(bench)
    judging = [frozen for frozen in plants if frozen.point.judged]
    worst = _worst(judge(judging, estimator, gains_along(bench), plant.tick))
    table = margins_table(f"margins along {swing.name}", judged)
    show_result(json_, _record(bench, judged, proofs, machine), table, *_story(proofs, worst, machine))
    exit_unless(not proofs["nominal"].failure)


def _linearised(bench: Bench) -> tuple[list[LinearPlant], Estimator]:
    """Return the plant at instants of the bench's swing, and its settled filters."""
    from bench.control.law.linear_loop import linearize, steady_estimator
    from bench.control.settings import estimator_record
    from bench.learning.along_swing import operating_points
    from sim.plant import build_plant

    plant = build_plant(bench.plant)
    filters = estimator_record(bench.estimator, bench.plant)
    estimator = steady_estimator(filters, bench.plant.tick, bench.plant.encoders.latency)
    return [linearize(plant, point) for point in operating_points(bench)], estimator


def _machine(bench: Bench) -> MachineGains | None:
    """Return the bench's gains by pose; None where they are set by hand."""
    from bench.control.law.gain_scheduling import machine_gains
    from bench.control.settings import estimator_record

    control = bench.control
    if control.gains != "machine":
        return None
    filters = estimator_record(bench.estimator, bench.plant)
    return machine_gains(bench.plant, filters, control.address_tolerance, control.move_timeout)


def _proofs(bench: Bench, bar: Progress) -> dict[str, ValidationSwing]:
    from bench.learning.along_swing import proof
    from bench.simulation.plant_variation import WORN

    robots = {"nominal": bench.plant, "worn": WORN.applied_to(bench.plant)}
    return {
        name: proof(bench, truth) for name, truth in bar.track(robots.items(), description="whole swings")
    }


def margins_table(title: str, judged: LoopMargins) -> Table:
    """Return the table of the loops' margins, one row an instant and joint."""
    table = plain_table(title=title, padding=(0, 1, 0, 0), title_justify="left")
    table.add_column("instant\n", no_wrap=True)
    table.add_column("joint\n", no_wrap=True)
    names = ("gain", "phase", "delay", "1 + L", "cross", "damping")
    for name, unit in zip(names, ("times", "°", "ms", "least", "Hz", "least"), strict=True):
        table.add_column(f"{name}\n{unit}", justify="right", no_wrap=True)

    def number(value: float, form: str) -> str:
        return form.format(value) if isfinite(value) else "∞"

    last = ""
    for loop in judged.loops:
        m, new = loop.margins, loop.point != last
        ratio = judged.damping_ratio[loop.point]
        table.add_row(
            loop.point if new else "",
            JOINTS[loop.joint],
            number(m.gain, "{:.1f}") if m.gain < 100 else "∞",
            number(degrees(m.phase), "{:.0f}"),
            number(1e3 * m.delay, "{:.1f}"),
            f"{m.modulus:.2f}",
            f"{m.crossover / (2 * pi):.1f}",
            ("grows" if ratio <= 0 else f"{ratio:.2f}") if new else "",
        )
        last = loop.point
    return table


def _story(proofs: dict[str, ValidationSwing], worst: str, machine: MachineGains | None) -> list[str]:
    lines = [
        "Joints slide, spools are beyond their dead band, the motion is frozen at each instant. The top, "
        "where dry friction holds the joints, and the downswing are shown, but not judged.",
    ]
    if machine is not None:
        lines += ["", *_by_pose(machine)]
    lines += ["", f"Worst at address and in the backswing: {worst}", ""]
    for name, proof in proofs.items():
        errors = f"{_milli(proof.backswing)} and {_milli(proof.downswing)} mrad"
        lines.append(f"{name} robot: {proof.failure or errors}")
    lines.append("Following errors, rms of shoulder·arm·wrist: up to the top, and in the downswing.")
    if proofs["nominal"].failure:
        lines.append("The configured robot does not swing with these gains.")
    return lines


def _by_pose(machine: MachineGains) -> list[str]:
    """Return what gains by pose reach over the whole working range, and what limits them."""
    from bench.control.law.gain_scheduling import RequiredMargins

    required, worst = RequiredMargins(), machine.worst
    rates = ", ".join(
        f"{joint} {band.rate:.0f}/s behind {1e3 * delay:.1f} ms of spool, reading and tick"
        for joint, band, delay in zip(JOINTS, machine.bandwidths, machine.delay, strict=True)
    )
    pose = ", ".join(f"{degrees(angle):.0f}°" for angle in worst.angle)
    loop = f"the {JOINTS[worst.joint]}'s loop" if worst.joint >= 0 else "all loops"
    lines = [
        f"Gains by pose. Bandwidths: {rates}.",
        f"Required at every pose: gain {required.gain:.1f} times, phase {degrees(required.phase):.0f}°, "
        f"delay {1e3 * required.delay:.1f} ms, damping ratio {required.damping_ratio:.2f}.",
        f"Worst: {worst.name} of {loop}, {100 * worst.share:.0f} % of the required margin, at {pose}.",
    ]
    if worst.share < 1.0:
        lines.append(
            "The machine forbids more: make the spools faster or the encoders' delay shorter, or accept it."
        )
    return lines


def _worst(judged: LoopMargins) -> str:
    margins = [loop.margins for loop in judged.loops]
    gain, phase = min(m.gain for m in margins), degrees(min(m.phase for m in margins))
    delay, ratio = 1e3 * min(m.delay for m in margins), min(judged.damping_ratio.values())
    damped = f"damping ratio {ratio:.2f}" if ratio > 0 else "a mode grows"
    return f"gain {gain:.1f} times, phase {phase:.0f}°, delay {delay:.1f} ms, {damped}"


def _milli(values: Any) -> str:
    return "·".join(f"{1e3 * value:.0f}" for value in values)


def _record(
    bench: Bench, judged: LoopMargins, proofs: dict[str, ValidationSwing], machine: MachineGains | None
) -> dict[str, Any]:
    from bench.control.law.gain_table import gains_at

    loops = [
        {"instant": loop.point, "joint": JOINTS[loop.joint]}
        | {name: finite(value) for name, value in loop.margins._asdict().items()}
        for loop in judged.loops
    ]
    swings = {
        robot: {
            "backswing_rms_rad": [finite(float(v)) for v in proof.backswing],
            "downswing_rms_rad": [finite(float(v)) for v in proof.downswing],
            "failure": proof.failure or None,
        }
        for robot, proof in proofs.items()
    }
    gains = gains_at(bench.controller().pid, bench.profile.angle[0])
    return {
        "source": bench.control.gains,
        "gains_at_address": gains._asdict(),
        "bandwidths": None if machine is None else [band._asdict() for band in machine.bandwidths],
        "worst_share": None if machine is None else machine.worst.share,
        "margins": loops,
        "least_damping_ratio": judged.damping_ratio,
        "swings": swings,
    }
