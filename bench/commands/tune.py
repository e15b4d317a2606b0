"""`golfbench tune`: gains of the three PIDs, with their margins."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from bench.commands.session import Session

if TYPE_CHECKING:
    from rich.progress import Progress
    from rich.table import Table

    from bench.simulation.series import Bench
    from bench.tuning.gains import Gains
    from bench.tuning.linear_loop import Estimator, Frozen, Judged
    from bench.tuning.proof import Proof
    from bench.tuning.recipe import Recipe
    from sim.plant import PlantParameters

Method = Literal["margins", "thesis", "none"]


ProfileName = Annotated[
    str | None,
    typer.Argument(metavar="PROFILE", help="Profile to tune for.", show_default="the configuration's"),
]
MethodName = Annotated[
    Method,
    typer.Option(
        help="margins: the stiffest loops that keep their margins; thesis: its recipe, P until "
        "overshoot, D until it is gone, I until the static error is; none: only show the margins."
    ),
]
Output = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Write a configuration with the gains, .toml.")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for a program to read.")]


def tune(
    context: typer.Context,
    profile: ProfileName = None,
    method: MethodName = "margins",
    output: Output = None,
    json_: Json = False,
) -> None:
    """Tune the three PIDs on the simulated robot, and show the margins of their loops along a swing.

    Deterministic. Whole swings prove the gains, also on a worn robot. Exits with 1 and writes nothing if
    the configured robot does not swing with what was found.
    """
    import json

    from rich.console import Console

    from bench.commands.progress import progress_bar
    from bench.design.validate import require_possible
    from bench.errors import ExitCode
    from bench.simulation.series import Bench
    from bench.swing.library import find_profile
    from bench.swing.profile import load_profile
    from bench.tuning.gains import Gains
    from bench.tuning.linear_loop import freeze, judge, operating_points, steady_estimator
    from sim.plant import build_plant

    configuration = context.ensure_object(Session).configuration()
    path, plant = find_profile(profile or configuration.swing.profile), configuration.plant
    swing, before = load_profile(path), Gains.of(configuration.control)
    require_possible(swing, plant, configuration.envelope, str(path))
    bench = Bench(plant, swing, configuration.control, configuration.envelope, configuration.estimator)
    with progress_bar() as bar:
        task = bar.add_task("a swing, linearised", total=1.0)
        built, period = build_plant(plant), plant.tick
        plants = [freeze(built, point) for point in operating_points(bench)]
        estimator = steady_estimator(plant, configuration.estimator)
        bar.update(task, completed=1.0)
        gains, recipe = _tuned(method, bench, plants, estimator, bar)
        judged = judge(plants, estimator, gains, period)
        proofs = {} if method == "none" else _proofs(bench, gains, bar)
    failed = bool(proofs) and bool(proofs["nominal"][1].failure)
    if json_:
        typer.echo(json.dumps(_record(method, gains, judged, proofs, recipe), indent=2))
    else:
        console = Console()
        console.print(margins_table(f"margins along {swing.name}", judged))
        judging = [frozen for frozen in plants if frozen.point.judged]
        old, new = (_worst(judge(judging, estimator, tried, period)) for tried in (before, gains))
        for line in _story(before, gains, recipe, proofs, (old, new)):
            console.print(line, highlight=False)
    if method != "none" and not failed and output is not None:
        _write_gains(output, gains, configuration.files[-1], method, swing.name)
        if not json_:
            typer.echo(f"{output}: golfbench --config {output} swing simulate {profile or path.stem}")
    if failed:
        if not json_:
            typer.echo("Nothing is written: the configured robot does not swing with these gains.")
        raise typer.Exit(ExitCode.REFUSED)


def _tuned(
    method: Method, bench: Bench, plants: list[Frozen], estimator: Estimator, bar: Progress
) -> tuple[Gains, Recipe | None]:
    """Return the gains by `method`, and the thesis' recipe if they are by it."""
    from bench.tuning.by_margins import tune_by_margins
    from bench.tuning.gains import Gains
    from bench.tuning.recipe import tune_by_recipe

    if method == "margins":
        task = bar.add_task("gains", total=1.0)
        found = tune_by_margins(
            plants,
            estimator,
            bench.model,
            bench.control,
            progress=lambda part: bar.update(task, completed=part),
        )
        return found.gains, None
    if method == "thesis":
        task = bar.add_task("steps", total=None)
        recipe = tune_by_recipe(bench, lambda trial: bar.update(task, advance=1))
        return recipe.gains, recipe
    return Gains.of(bench.control), None


def _proofs(bench: Bench, gains: Gains, bar: Progress) -> dict[str, tuple[Proof, Proof]]:
    """Return whole swings of the nominal and the worn robot, each as configured and with `gains`."""
    from bench.simulation.variation import WORN
    from bench.tuning.gains import Gains
    from bench.tuning.proof import proof

    task = bar.add_task("whole swings", total=4)

    def proven(truth: PlantParameters, tried: Gains) -> Proof:
        made = proof(bench, truth, tried)
        bar.update(task, advance=1)
        return made

    before, plant = Gains.of(bench.control), bench.model
    robots = {"nominal": plant, "worn": WORN.applied_to(plant)}
    return {name: (proven(truth, before), proven(truth, gains)) for name, truth in robots.items()}


def _write_gains(output: Path, gains: Gains, base: Path, method: Method, swing: str) -> None:
    """Write a configuration with `gains` on top of `base`."""
    from bench.tuning.gains_file import gains_file

    how = {"margins": "by margins", "thesis": "by the thesis' recipe"}[method]
    text = gains_file(gains, base, f"tuned {how} for the swing {swing}")
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(text, encoding="utf-8")


def margins_table(title: str, judged: Judged) -> Table:
    """Return the table of the loops' margins, one row an instant and joint."""
    from math import degrees, isfinite, pi

    from rich.box import SIMPLE_HEAD
    from rich.table import Table

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
    before: Gains,
    after: Gains,
    recipe: Recipe | None,
    proofs: dict[str, tuple[Proof, Proof]],
    worst: tuple[str, str],
) -> list[str]:
    """Return what to say below the table."""
    from drivers.base import JOINTS

    lines = [
        "Joints slide, spools are beyond their dead band, the motion is frozen at each instant. At the top, "
        "where dry friction holds the joints, and in the downswing that is told, but nothing is tuned by it.",
    ]
    if not proofs:
        return lines
    lines += [""] + [
        f"{name:12s} {_triple(old)} -> {_triple(new)}"
        for name, old, new in zip(before._fields, before, after, strict=True)
    ]
    lines += ["", f"Worst at address and in the backswing, as configured: {worst[0]}", f"tuned: {worst[1]}"]
    if recipe is None:
        lines.append(_asked_for())
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


def _worst(judged: Judged) -> str:
    """Return the worst margins of all loops in words."""
    from math import degrees

    margins = [loop.margins for loop in judged.loops]
    gain, phase = min(m.gain for m in margins), degrees(min(m.phase for m in margins))
    delay, ratio = 1e3 * min(m.delay for m in margins), min(judged.damping_ratio.values())
    damped = f"damping ratio {ratio:.2f}" if ratio > 0 else "a mode grows"
    return f"gain {gain:.1f} times, phase {phase:.0f}°, delay {delay:.1f} ms, {damped}"


def _asked_for() -> str:
    from math import degrees

    from bench.tuning.by_margins import Wanted

    w = Wanted()
    return (
        f"asked for: gain {w.gain:.1f} times, phase {degrees(w.phase):.0f}°, delay {1e3 * w.delay:.1f} ms, "
        f"damping ratio {w.damping_ratio:.2f}; where they cannot be had, as near as can be"
    )


def _triple(values: Any) -> str:
    return "[" + ", ".join(f"{value:.4g}" for value in values) + "]"


def _milli(values: Any) -> str:
    return "·".join(f"{1e3 * value:.0f}" for value in values)


def _record(
    method: str, gains: Gains, judged: Judged, proofs: dict[str, tuple[Proof, Proof]], recipe: Recipe | None
) -> dict[str, Any]:
    from math import isfinite

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
    return {
        "method": method,
        "gains": {name: [float(v) for v in values] for name, values in gains._asdict().items()},
        "margins": loops,
        "least_damping_ratio": judged.damping_ratio,
        "steps": None if recipe is None else len(recipe.trials),
        "swings": swings,
    }
