"""`golfbench tune`: gains of the three PIDs, with their margins."""

from __future__ import annotations

from dataclasses import replace
from math import degrees, isfinite, pi
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from bench.commands.progress import progress_bar
from bench.commands.session import Json, ProfileName, Session, show_json
from bench.errors import ExitCode

if TYPE_CHECKING:
    from bench.control.linear_loop import Estimator
    from bench.control.linear_plant import Frozen
    from bench.control.machine_gains import MachineGains
    from bench.simulation.series import Bench
    from bench.tuning.along_swing import Judged
    from bench.tuning.proof import Proof
    from bench.tuning.recipe import Recipe
    from sim.plant import PlantParameters

Method = Literal["machine", "thesis", "none"]


MethodName = Annotated[
    Method,
    typer.Option(
        help="machine: by pose, from the robot's linearised loops; thesis: its recipe, P until overshoot, "
        "D until it is gone, I until the static error is; none: show the margins of the configured gains."
    ),
]
Output = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Write a configuration with the gains, .toml.")
]


def tune(
    context: typer.Context,
    profile: ProfileName = None,
    method: MethodName = "machine",
    output: Output = None,
    json_: Json = False,
) -> None:
    """Tune the three PIDs on the simulated robot, and show the margins of their loops along a swing.

    Deterministic. Whole swings prove the gains, also on a worn robot. Exits with 1 and writes nothing if
    the configured robot does not swing with what was found.
    """
    from bench.design.validate import require_possible
    from bench.simulation.series import Bench
    from bench.swing.library import find_profile
    from bench.swing.profile import load_profile
    from bench.tuning.along_swing import gains_along, judge

    configuration = context.ensure_object(Session).configuration()
    path, plant = find_profile(profile or configuration.swing.profile), configuration.plant
    swing = load_profile(path)
    require_possible(swing, plant, configuration.envelope, str(path))
    bench = Bench(plant, swing, configuration.control, configuration.envelope, configuration.estimator)
    with progress_bar() as bar:
        task = bar.add_task("a swing, linearised", total=1.0)
        plants, estimator = _linearised(bench)
        bar.update(task, completed=1.0)
        tuned, recipe = _tuned(method, bench, bar)
        judged = judge(plants, estimator, gains_along(tuned), plant.tick)
        proofs = {} if method == "none" else _proofs(bench, tuned, bar)
    failed = bool(proofs) and bool(proofs["nominal"][1].failure)
    machine = _machine(tuned)
    if json_:
        show_json(_record(method, tuned, judged, proofs, recipe, machine))
    else:
        console = Console()
        console.print(margins_table(f"margins along {swing.name}", judged))
        judging = [frozen for frozen in plants if frozen.point.judged]
        old, new = (_worst(judge(judging, estimator, gains_along(one), plant.tick)) for one in (bench, tuned))
        for line in _story(recipe, proofs, (old, new), machine):
            console.print(line, highlight=False)
    if method != "none" and not failed and output is not None:
        _write_gains(output, tuned, configuration.files[-1], method, swing.name)
        if not json_:
            typer.echo(f"{output}: golfbench --config {output} swing simulate {profile or path.stem}")
    if failed:
        if not json_:
            typer.echo("Nothing is written: the configured robot does not swing with these gains.")
        raise typer.Exit(ExitCode.REFUSED)


def _linearised(bench: Bench) -> tuple[list[Frozen], Estimator]:
    """Return the plant at instants of the bench's swing, and its settled filters."""
    from bench.control.linear_loop import steady_estimator
    from bench.control.linear_plant import freeze
    from bench.control.settings import estimator_record
    from bench.tuning.along_swing import operating_points
    from sim.plant import build_plant

    plant = build_plant(bench.model)
    filters = estimator_record(bench.estimator, bench.model)
    estimator = steady_estimator(filters, bench.model.tick, bench.model.encoders.latency)
    return [freeze(plant, point) for point in operating_points(bench)], estimator


def _tuned(method: Method, bench: Bench, bar: Progress) -> tuple[Bench, Recipe | None]:
    """Return `bench` with the gains by `method`, and the thesis' recipe if they are by it."""
    from bench.tuning.gains import with_gains
    from bench.tuning.recipe import tune_by_recipe

    if method == "machine":
        return bench._replace(control=replace(bench.control, gains="machine")), None
    if method == "thesis":
        task = bar.add_task("steps", total=None)
        recipe = tune_by_recipe(bench, lambda trial: bar.update(task, advance=1))
        return bench._replace(control=with_gains(bench.control, recipe.gains)), recipe
    return bench, None


def _machine(bench: Bench) -> MachineGains | None:
    """Return the bench's gains by pose; None where they are set by hand."""
    from bench.control.machine_gains import machine_gains
    from bench.control.settings import estimator_record

    control = bench.control
    if control.gains != "machine":
        return None
    filters = estimator_record(bench.estimator, bench.model)
    return machine_gains(bench.model, filters, control.address_tolerance, control.move_timeout)


def _proofs(bench: Bench, tuned: Bench, bar: Progress) -> dict[str, tuple[Proof, Proof]]:
    """Return whole swings of the nominal and the worn robot, each as configured and tuned."""
    from bench.simulation.variation import WORN
    from bench.tuning.proof import proof

    task = bar.add_task("whole swings", total=4)

    def proven(truth: PlantParameters, tried: Bench) -> Proof:
        made = proof(tried, truth)
        bar.update(task, advance=1)
        return made

    robots = {"nominal": bench.model, "worn": WORN.applied_to(bench.model)}
    return {name: (proven(truth, bench), proven(truth, tuned)) for name, truth in robots.items()}


def _write_gains(output: Path, tuned: Bench, base: Path, method: Method, swing: str) -> None:
    """Write a configuration with the gains of `tuned` on top of `base`."""
    from bench.tuning.gains import gains_of
    from bench.tuning.gains_file import gains_file, machine_gains_file

    if method == "machine":
        text = machine_gains_file(base)
    else:
        text = gains_file(gains_of(tuned.control), base, f"tuned by the thesis' recipe for the swing {swing}")
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(text, encoding="utf-8")


def margins_table(title: str, judged: Judged) -> Table:
    """Return the table of the loops' margins, one row an instant and joint."""
    from drivers.base import JOINTS

    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), title=title, title_justify="left")
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


def _story(
    recipe: Recipe | None,
    proofs: dict[str, tuple[Proof, Proof]],
    worst: tuple[str, str],
    machine: MachineGains | None,
) -> list[str]:
    """Return what to say below the table."""
    from drivers.base import JOINTS

    lines = [
        "Joints slide, spools are beyond their dead band, the motion is frozen at each instant. The top, "
        "where dry friction holds the joints, and the downswing are shown, but not judged."
    ]
    if machine is not None:
        lines += ["", *_by_pose(machine)]
    if not proofs:
        return lines
    lines += ["", f"Worst at address and in the backswing, as configured: {worst[0]}", f"tuned: {worst[1]}"]
    if recipe is not None:
        lines.append(f"{len(recipe.trials)} steps.")
        rules = ("no overshoot was achieved", "overshoot stays", "a static error stays")
        lines += [f"{JOINTS[joint]}: {rules[rule - 1]}." for joint, rule in recipe.missed]
    lines.append("")
    for name, (old, new) in proofs.items():
        for text, proof in (("as configured", old), ("tuned", new)):
            errors = f"{_milli(proof.backswing)} and {_milli(proof.downswing)} mrad"
            lines.append(f"{name} robot, {text}: {proof.failure or errors}")
    lines.append("Following errors, rms of shoulder·arm·wrist: up to the top, and in the downswing.")
    return lines


def _by_pose(machine: MachineGains) -> list[str]:
    """Return what gains by pose reach over the whole working range, and what limits them."""
    from bench.control.machine_gains import RequiredMargins
    from drivers.base import JOINTS

    required, worst = RequiredMargins(), machine.worst
    rates = ", ".join(
        f"{joint} {band.rate:.0f}/s behind {1e3 * delay:.1f} ms of spool, reading and tick"
        for joint, band, delay in zip(JOINTS, machine.bandwidths, machine.delay, strict=True)
    )
    pose = ", ".join(f"{degrees(angle):.0f}°" for angle in worst.angle)
    loop = f"of the {JOINTS[worst.joint]}'s loop" if worst.joint >= 0 else "of all loops"
    lines = [
        f"Gains by pose. Bandwidths: {rates}.",
        f"Asked for at every pose: gain {required.gain:.1f} times, phase {degrees(required.phase):.0f}°, "
        f"delay {1e3 * required.delay:.1f} ms, damping ratio {required.damping_ratio:.2f}.",
        f"Worst: {worst.name} {loop}, {100 * worst.share:.0f} % of the margin asked for, at {pose}.",
    ]
    if worst.share < 1.0:
        lines.append(
            "The machine forbids more: make the spools faster or the encoders' delay shorter, or accept it."
        )
    return lines


def _worst(judged: Judged) -> str:
    """Return the worst margins of all loops in words."""
    margins = [loop.margins for loop in judged.loops]
    gain, phase = min(m.gain for m in margins), degrees(min(m.phase for m in margins))
    delay, ratio = 1e3 * min(m.delay for m in margins), min(judged.damping_ratio.values())
    damped = f"damping ratio {ratio:.2f}" if ratio > 0 else "a mode grows"
    return f"gain {gain:.1f} times, phase {phase:.0f}°, delay {delay:.1f} ms, {damped}"


def _milli(values: Any) -> str:
    return "·".join(f"{1e3 * value:.0f}" for value in values)


def _record(
    method: str,
    tuned: Bench,
    judged: Judged,
    proofs: dict[str, tuple[Proof, Proof]],
    recipe: Recipe | None,
    machine: MachineGains | None,
) -> dict[str, Any]:

    from bench.control.gain_table import gains_at
    from drivers.base import JOINTS

    def known(value: float) -> float | None:
        return float(value) if isfinite(value) else None

    loops = [
        {"instant": loop.point, "joint": JOINTS[loop.joint]}
        | {name: known(value) for name, value in loop.margins._asdict().items()}
        for loop in judged.loops
    ]
    swings = {
        robot: {
            when: {
                "backswing_rms_rad": [known(v) for v in proof.backswing],
                "downswing_rms_rad": [known(v) for v in proof.downswing],
                "failure": proof.failure or None,
            }
            for when, proof in zip(("before", "after"), pair, strict=True)
        }
        for robot, pair in proofs.items()
    }
    gains = gains_at(tuned.controller().pid, tuned.profile.angle[0])
    return {
        "method": method,
        "source": tuned.control.gains,
        "gains_at_address": gains._asdict(),
        "bandwidths": None if machine is None else [band._asdict() for band in machine.bandwidths],
        "worst_share": None if machine is None else machine.worst.share,
        "margins": loops,
        "least_damping_ratio": judged.damping_ratio,
        "steps": None if recipe is None else len(recipe.trials),
        "swings": swings,
    }
