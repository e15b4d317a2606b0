"""Results of the thesis' experiment: a picture, a table with the thesis' own statements, and JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from bench.commands.common.output import plain_table, write_text
from bench.records.shot.plot_style import save_picture
from bench.swing.thesis_experiment import (
    ADDRESS_ROD,
    DERIVATIVE,
    INTEGRAL,
    PROPORTIONAL,
    ExperimentSummary,
    ThesisExperiment,
    run_thesis_experiment,
    thesis_swing,
)
from drivers.base import JOINTS

_EFFORTS = ("shoulder torque, N·m", "right-arm force, N", "wrist torque, N·m")
_REFERENCE, _ACTUAL, _SATURATED, _BALL = "#7f7f7f", "#1f5fa8", "#d1495b", "#2a9d5c"


class Statement(NamedTuple):
    """A statement of the thesis and the experiment's finding."""

    what: str
    thesis: str
    found: str
    remark: str = ""


class Others(NamedTuple):
    """Outcomes of the experiment without friction and without actuator limits."""

    frictionless: ExperimentSummary
    unlimited: ExperimentSummary
    """Outcome with unlimited actuators."""


def simulate_thesis(output_folder: Path | str, as_json: bool = False) -> None:
    """Run the experiment, write `thesis.png`, `thesis.svg` and `thesis.json`, print the table or the JSON.

    Raises:
        OSError: the folder cannot be made or written.
    """
    experiment = run_thesis_experiment()
    others = Others(
        run_thesis_experiment(friction=0.0).summary, run_thesis_experiment(limit=(inf, inf, inf)).summary
    )
    folder = Path(output_folder)
    folder.mkdir(parents=True, exist_ok=True)
    pictures = (folder / "thesis.png", folder / "thesis.svg")
    for picture in pictures:
        draw(experiment, picture)
    text = json.dumps(as_record(experiment, others), indent=2, allow_nan=False, ensure_ascii=False)
    write_text(text + "\n", folder / "thesis.json")
    if as_json:
        print(text)
        return
    console = Console()
    grid = plain_table(title="The thesis' experiment, run again", title_justify="left", title_style="bold")
    for column in ("", "thesis", "found", "remark"):
        grid.add_column(column, no_wrap=column in ("", "thesis"))
    for row in statements(experiment, others):
        grid.add_row(*row)
    console.print(grid)
    for line in assumptions(experiment):
        console.print(Padding(Text(f"· {line}"), (0, 0, 0, 1)))
    print(f"\nPicture: {pictures[0]} and .svg · figures: {folder / 'thesis.json'}")


def statements(experiment: ThesisExperiment, others: Others) -> list[Statement]:
    """Return the thesis' statements on its experiment, compared with our figures."""
    s, free = experiment.summary, others.frictionless
    back_end = float(thesis_swing().shoulder.time[68])
    downswing = whole = height = speed = "never reaches the ball"
    side = ""
    if s.contact_time is not None and s.height_error is not None and s.club_speed is not None:
        downswing = f"{s.contact_time - back_end:.3f} s from the tables' {back_end:.2f} s"
        whole = f"{s.contact_time:.3f} s to the ball"
        height = f"{100 * s.height_error:+.1f} cm"
        above = "passes above; the thesis' action suits a head that is low"
        side = above if s.height_error > 0 else "passes below"
        speed = f"{s.club_speed:.1f} m/s"
    largest, busiest = int(np.argmax(s.largest_error)), int(np.argmax(s.saturated))
    worst = f"{JOINTS[largest]}, {s.largest_error[largest]:.2f} rad"
    most = (
        f"{JOINTS[busiest]}, {100 * s.saturated[busiest]:.0f} % of the time" if any(s.saturated) else "none"
    )
    shares = _of_three([100 * share for share in s.saturated], "{:.0f}")
    low, high = s.rod_range
    unlimited = f"{_of_three(others.unlimited.largest_error, '{:.2f}')} rad without limits"
    through = "" if free.stable else "the arm is driven through its stretched position"
    return [
        Statement("backswing", "0.68 s", f"{s.top_time:.3f} s until θ1 turns round"),
        Statement("downswing", "0.19 s", downswing),
        Statement("whole swing", "0.87 s", whole),
        Statement("error in y at the ball", "about 3 cm", height, side),
        Statement("club-head speed there", "not given", speed),
        Statement("largest error", "wrist", worst, f"{_of_three(s.largest_error, '{:.2f}')} rad"),
        Statement("most saturation", "wrist", most, f"{shares} %; the thesis has “a lot”"),
        Statement("stable with this PID", "yes", _yes(s.stable)),
        Statement("stable without friction", "no", _yes(free.stable), through),
        Statement(
            "rod without end stops",
            "not given",
            f"{low:.2f} to {high:.2f} m",
            f"its stroke: 0 to {experiment.robot.stroke:g} m",
        ),
        Statement(
            "stronger actuators",
            "much smaller errors",
            unlimited,
            "the arm stays soft: 1000 N/rad on a lever of 0.33 m",
        ),
    ]


def assumptions(experiment: ThesisExperiment) -> list[str]:
    """Return the settings used, a line each: those of the thesis and those it leaves open."""
    friction, limit = experiment.friction, experiment.limit
    taken = float(np.abs(experiment.velocity[:, 0]).max()) * friction
    return [
        f"From the thesis: tables of Appendix B, P = {PROPORTIONAL:g}, I = {INTEGRAL:g}, D = {DERIVATIVE:g} "
        "(D on the measured speed), head of 0.1 kg, no end stops.",
        f"Limits (assumed): {limit[0]:.0f} N·m, {limit[1]:.0f} N, {limit[2]:.0f} N·m, constant.",
        f"Friction (smallest with a stable swing and quarter-amplitude damping): {friction:g} N·m·s/rad. "
        f"It stands for the damping that D lacks and takes up to {taken:.0f} N·m at the shoulder.",
        "The controller of θ2 puts out the right arm's force. Address (assumed): rod at "
        f"{ADDRESS_ROD:g} m, θ1 = {experiment.reference[0, 0]:.3f} rad, shaft straight down. "
        "After their last sample the tables are held.",
    ]


def as_record(experiment: ThesisExperiment, others: Others) -> dict[str, Any]:
    """Return everything the table says as plain values for JSON; SI units."""
    return {
        "version": 2,
        "summary": asdict(experiment.summary),
        "statements": [row._asdict() for row in statements(experiment, others)],
        "assumptions": assumptions(experiment),
        "variants": {name: asdict(summary) for name, summary in others._asdict().items()},
    }


def draw(experiment: ThesisExperiment, path: Path) -> None:
    """Draw the thesis' figures 17 to 20 as one picture; the suffix of `path` is its format."""
    figure = Figure(figsize=(20, 10), layout="constrained")
    signals, paths = figure.subfigures(1, 2, squeeze=False, width_ratios=(2.2, 1), wspace=0.02)[0]
    grid, e, s = signals.subplots(3, 3, sharex=True), experiment, experiment.summary
    for row in range(3):
        angles, errors, efforts = grid[row]
        angles.plot(e.time, e.reference[:, row], "--", color=_REFERENCE, label="reference")
        angles.plot(e.time, e.angle[:, row], color=_ACTUAL, label="actual")
        angles.set_ylabel(f"θ{row + 1} {JOINTS[row]}, rad")
        errors.plot(e.time, e.reference[:, row] - e.angle[:, row], color=_ACTUAL)
        errors.set_ylabel(f"error of θ{row + 1}, rad")
        _draw_effort(efforts, e, row)
        for axes in grid[row]:
            _mark(axes, e)
    for column, title in enumerate(("Angles (fig. 20)", "Errors (fig. 18)", "Efforts (fig. 17)")):
        grid[0, column].set_title(title, fontweight="bold", loc="left")
        grid[2, column].set_xlabel("time, s")
    grid[0, 0].legend(loc="lower left", frameon=False)
    signals.align_ylabels()
    whole, near = paths.subplots(2, 1, height_ratios=(2, 1))
    for axes, title in ((whole, "Club-head path (fig. 19)"), (near, "At the ball")):
        axes.plot(*e.reference_head.T, "--", color=_REFERENCE, label="reference")
        axes.plot(*e.head.T, color=_ACTUAL, label="actual")
        axes.plot(*e.reference_head[0], "o", color="white", markeredgecolor="black", label="ball")
        axes.set_title(title, fontweight="bold", loc="left")
        axes.set(xlabel="x towards the target, m", ylabel="y up the swing plane, m", aspect="equal")
        axes.grid(alpha=0.25)
    x, y = e.reference_head[0]
    near.set(xlim=(x - 0.45, x + 0.45), ylim=(y - 0.1, y + 0.25))
    whole.legend(loc="upper right", frameon=False)
    found = ", ".join(row.found for row in statements(e, Others(s, s))[2:5])
    title = f"The thesis' experiment, run again — {'stable' if s.stable else 'UNSTABLE'}; {found}"
    figure.suptitle(title, fontsize=16, fontweight="bold")
    figure.supxlabel("\n".join(assumptions(e)), fontsize=10, x=0.01, ha="left")
    save_picture(figure, path)


def _draw_effort(axes: Axes, experiment: ThesisExperiment, row: int) -> None:
    limit, saturated = float(experiment.limit[row]), experiment.saturated[:, row]
    effort = np.clip(experiment.demand[:, row], -limit, limit)
    axes.plot(experiment.time, effort, color=_ACTUAL)
    axes.plot(experiment.time, np.where(saturated, effort, np.nan), color=_SATURATED, linewidth=2.2)
    share = 100 * experiment.summary.saturated[row]
    axes.set_title(f"limit ± {limit:.0f}, saturated {share:.0f} %", fontsize=9, loc="right")
    axes.set_ylabel(_EFFORTS[row])


def _mark(axes: Axes, experiment: ThesisExperiment) -> None:
    """Mark the top and the ball."""
    axes.grid(alpha=0.25)
    axes.axvline(thesis_swing().shoulder.time[68], color="black", linewidth=0.7, linestyle=":")
    if experiment.summary.contact_time is not None:
        axes.axvline(experiment.summary.contact_time, color=_BALL)


def _of_three(values: Sequence[float] | NDArray[np.float64], form: str) -> str:
    """Return three values as one when they are equal, else separated by strokes."""
    texts = [form.format(value) for value in values]
    return texts[0] if len(set(values)) == 1 else " / ".join(texts)


def _yes(holds: bool) -> str:
    return "yes" if holds else "no"
