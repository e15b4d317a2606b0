"""What came out of the thesis' experiment: one picture, one table beside the thesis' own statements, JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure, FigureBase
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.padding import Padding
from rich.table import Table as Grid
from rich.text import Text

from bench.swing.tables import Table
from bench.swing.thesis_experiment import (
    QUARTER_DECAY,
    ExperimentSummary,
    ThesisExperiment,
    ThesisParameters,
    Triple,
    run_thesis_experiment,
    variants,
)
from drivers.base import JOINTS
from sim.kinematics import joint_positions

_COLUMNS = ("ball s", "y cm", "m/s", "errors rad", "saturated %", "stable")
_JOINT_TITLES = ("θ1 shoulder", "θ2 arm", "θ3 wrist")
_EFFORT_TITLES = ("shoulder torque, N·m", "right-arm force, N", "wrist torque, N·m")

_REFERENCE, _ACTUAL, _SATURATED, _BALL = "#7f7f7f", "#1f5fa8", "#d1495b", "#2a9d5c"


class Statement(NamedTuple):
    """A statement of the thesis beside what the experiment found."""

    what: str
    thesis: str
    found: str
    remark: str = ""


def simulate_thesis(
    output_folder: Path | str, as_json: bool = False, parameters: ThesisParameters | None = None
) -> ThesisExperiment:
    """Run the experiment, write `thesis.png`, `thesis.svg` and `thesis.json`, print the table or the JSON.

    Raises:
        ValueError: a parameter is out of range; nothing was run or written.
        OSError: the folder cannot be made or written.
    """
    experiment = run_thesis_experiment(parameters)
    others = variants(experiment.parameters)
    folder = Path(output_folder)
    folder.mkdir(parents=True, exist_ok=True)
    pictures = (folder / "thesis.png", folder / "thesis.svg")
    for picture in pictures:
        draw(experiment, picture)
    text = json.dumps(as_record(experiment, others), indent=2, allow_nan=False, ensure_ascii=False)
    (folder / "thesis.json").write_text(text + "\n", encoding="utf-8")
    if as_json:
        print(text)
    else:
        show(experiment, others, Console())
        Console().print(
            f"Picture: {pictures[0]} and .svg · figures: {folder / 'thesis.json'}", highlight=False
        )
    return experiment


def statements(experiment: ThesisExperiment, others: dict[str, ExperimentSummary]) -> list[Statement]:
    """Return the thesis' statements on its experiment beside our figures, differences as found."""
    s = experiment.summary
    free, strong = others["no friction"], others["actuators without limits"]
    back_end = float(experiment.swing.shoulder.time[68])
    downswing = whole = height = speed = "never reaches the ball"
    side = ""
    if s.contact_time is not None and s.height_error is not None and s.club_speed is not None:
        downswing = f"{s.contact_time - back_end:.3f} s from the tables' {back_end:.2f} s"
        whole = f"{s.contact_time:.3f} s to the ball"
        height = f"{100 * s.height_error:+.1f} cm"
        side = (
            "passes above; the thesis' cure suits a head that is low"
            if s.height_error > 0
            else "passes below"
        )
        speed = f"{s.club_speed:.1f} m/s"
    largest, busiest = int(np.argmax(s.largest_error)), int(np.argmax(s.saturated))
    errors = _of_three(s.largest_error, "{:.2f}")
    shares = _of_three([100 * share for share in s.saturated], "{:.0f}")
    return [
        Statement("backswing", "0.68 s", f"{s.top_time:.3f} s until θ1 turns round"),
        Statement("downswing", "0.19 s", downswing),
        Statement("whole swing", "0.87 s", whole),
        Statement("error in y at the ball", "about 3 cm", height, side),
        Statement("club-head speed there", "not given", speed),
        Statement(
            "largest error",
            "wrist",
            f"{JOINTS[largest]}, {s.largest_error[largest]:.2f} rad",
            f"{errors} rad",
        ),
        Statement(
            "most saturation",
            "wrist",
            f"{JOINTS[busiest]}, {100 * s.saturated[busiest]:.0f} % of the time"
            if any(s.saturated)
            else "none",
            f"{shares} %; the thesis has “a lot”",
        ),
        Statement("stable with this PID", "yes", "yes" if s.stable else "no"),
        Statement(
            "stable without friction",
            "no",
            "yes" if free.stable else "no",
            "" if free.stable else "the arm is driven through its stretched position",
        ),
        Statement(
            "rod without end stops",
            "not given",
            f"{s.rod_range[0]:.2f} to {s.rod_range[1]:.2f} m",
            f"its stroke: 0 to {experiment.robot.stroke:g} m",
        ),
        Statement(
            "stronger actuators",
            "much smaller errors",
            f"{_of_three(strong.largest_error, '{:.2f}')} rad without limits",
            "the arm stays soft: 1000 N/rad on a lever of 0.33 m",
        ),
    ]


def show(experiment: ThesisExperiment, others: dict[str, ExperimentSummary], console: Console) -> None:
    """Print the table, the choices behind it and what other choices would give."""
    table = _grid(
        "The thesis' experiment, run again", "", "thesis", "found", "remark", wrapped=("found", "remark")
    )
    for row in statements(experiment, others):
        table.add_row(*row)
    console.print(table)
    for line in assumptions(experiment):
        console.print(Padding(Text(f"· {line}"), (0, 0, 0, 1)))
    console.print()
    effect = _grid(
        "What the choices do that the thesis leaves open (friction kept)",
        "choice",
        *_COLUMNS,
        wrapped=("choice",),
    )
    for name, summary in others.items():
        effect.add_row(name, *_cells(summary))
    console.print(effect)
    if experiment.search:
        search = _grid(
            f"The search for the friction, N·m·s/rad: stable, and damping of at least {QUARTER_DECAY:.3f}",
            "friction",
            *_COLUMNS,
            "damping",
        )
        for trial in experiment.search[:: -max(1, len(experiment.search) // 10)][::-1]:
            search.add_row(f"{trial.friction:.1f}", *_cells(trial.summary), f"{trial.damping:.3f}")
        console.print(search)


def assumptions(experiment: ThesisExperiment) -> list[str]:
    """Return the settings used, a line each: those of the thesis and those it leaves open."""
    p = experiment.parameters
    friction = p.friction or (0.0, 0.0, 0.0)
    taken = float(np.abs(experiment.velocity[:, 0]).max()) * friction[0]
    found = "smallest with a stable swing and quarter-amplitude damping" if experiment.search else "as given"
    gains = [f"{name} = {_of_three(values, '{:g}')}" for name, values in _gains(p)]
    return [
        f"From the thesis: tables of Appendix B, {', '.join(gains)} (D on the measured speed), "
        "head of 0.1 kg, no end stops.",
        f"Limits (assumed): {p.limit[0]:.0f} N·m, {p.limit[1]:.0f} N, {p.limit[2]:.0f} N·m"
        + (" · |sin β| at the wrist." if p.wrist_lever else ", constant."),
        f"Friction ({found}): {_of_three(friction, '{:g}')} N·m·s/rad. "
        f"It stands for the damping that D lacks and takes up to {taken:.0f} N·m at the shoulder.",
        f"The controller of θ2 puts out the right arm's {p.arm_output}. Address (assumed): rod at "
        f"{p.address.rod:g} m, θ1 = {experiment.reference[0, 0]:.3f} rad"
        + (", shaft straight down." if p.address.theta1 is None else ".")
        + " After their last sample the tables "
        + ("go on with their last slope." if p.extrapolate else "are held."),
    ]


def as_record(experiment: ThesisExperiment, others: dict[str, ExperimentSummary]) -> dict[str, Any]:
    """Return everything the table says as plain values for JSON; SI units."""
    return {
        "version": 1,
        "parameters": asdict(experiment.parameters),
        "summary": asdict(experiment.summary),
        "statements": [row._asdict() for row in statements(experiment, others)],
        "assumptions": assumptions(experiment),
        "variants": {name: asdict(summary) for name, summary in others.items()},
        "friction_search": [
            {"friction": t.friction, "damping": t.damping, "accepted": t.accepted, **asdict(t.summary)}
            for t in experiment.search
        ],
    }


def draw(experiment: ThesisExperiment, path: Path | str) -> None:
    """Draw what the thesis' figures 14 and 17-20 show, as one picture; the suffix of `path` is its format."""
    figure = Figure(figsize=(22, 11), layout="constrained")
    signals, paths = figure.subfigures(1, 2, squeeze=False, width_ratios=(2.6, 1), wspace=0.02)[0]
    columns = ("Reference tables (fig. 14)", "Angles (fig. 20)", "Errors (fig. 18)", "Efforts (fig. 17)")
    grid = signals.subplots(3, 4, sharex=True)
    for column, part in enumerate((_draw_table, _draw_angle, _draw_error, _draw_effort)):
        grid[0, column].set_title(columns[column], fontweight="bold", loc="left")
        grid[2, column].set_xlabel("time, s")
        for row in range(3):
            part(grid[row, column], experiment, row)
            _mark_phases(grid[row, column], experiment)
    signals.align_ylabels()
    upper, lower = paths.subplots(2, 1, height_ratios=(2.6, 1))
    _draw_path(paths, upper, experiment)
    _draw_ball(lower, experiment)
    s = experiment.summary
    outcome = (
        "the head never reaches the ball"
        if s.contact_time is None or s.height_error is None or s.club_speed is None
        else f"at the ball {s.contact_time:.3f} s, {100 * s.height_error:+.1f} cm, {s.club_speed:.1f} m/s"
    )
    figure.suptitle(
        f"The thesis' experiment, run again — {'stable' if s.stable else 'UNSTABLE'}; {outcome}",
        fontsize=16,
        fontweight="bold",
    )
    figure.supxlabel("\n".join(assumptions(experiment)), fontsize=10, x=0.01, ha="left")
    figure.savefig(path, dpi=100)


def _draw_table(axes: Axes, experiment: ThesisExperiment, row: int) -> None:
    swing = experiment.swing
    table: Table = (swing.shoulder, swing.right_arm, swing.wrist)[row]
    axes.plot(table.time, table.value, ".-", color=_REFERENCE, linewidth=0.8, markersize=4)
    axes.set_ylabel(("θ1 from address, rad", "right-arm displacement, m", "θ3, rad")[row])
    if row == 0:
        _name_instant(axes, swing.shoulder.time[68], "top ", "black", "right")
        if experiment.summary.contact_time is not None:
            _name_instant(axes, experiment.summary.contact_time, "ball ", _BALL, "left")


def _name_instant(axes: Axes, time: float, name: str, colour: str, side: str) -> None:
    axes.annotate(
        name, (time, 0.98), xycoords=("data", "axes fraction"), ha=side, va="top", rotation=90, color=colour
    )


def _draw_angle(axes: Axes, experiment: ThesisExperiment, row: int) -> None:
    axes.plot(experiment.time, experiment.reference[:, row], "--", color=_REFERENCE, label="reference")
    axes.plot(experiment.time, experiment.angle[:, row], color=_ACTUAL, label="actual")
    axes.set_ylabel(f"{_JOINT_TITLES[row]}, rad")
    if row == 0:
        axes.legend(loc="lower left", frameon=False)


def _draw_error(axes: Axes, experiment: ThesisExperiment, row: int) -> None:
    error = experiment.reference[:, row] - experiment.angle[:, row]
    axes.axhline(0.0, color="black", linewidth=0.6)
    axes.plot(experiment.time, error, color=_ACTUAL)
    axes.set_ylabel(f"error of θ{row + 1}, rad")
    until = experiment.time <= _end(experiment)
    worst = int(np.abs(error[until]).argmax())
    axes.plot(experiment.time[worst], error[worst], "o", color=_SATURATED, markersize=5)
    axes.annotate(
        f"{error[worst]:+.2f}",
        (experiment.time[worst], error[worst]),
        xytext=(-6, 0),
        textcoords="offset points",
        ha="right",
        va="center",
        color=_SATURATED,
    )
    axes.margins(y=0.12)


def _draw_effort(axes: Axes, experiment: ThesisExperiment, row: int) -> None:
    time, effort, limit = experiment.time, experiment.effort[:, row], experiment.limit[:, row]
    saturated = experiment.saturated[:, row]
    for sign in (-1, 1):
        axes.plot(time, sign * limit, color="black", linewidth=0.7, linestyle=(0, (6, 3)))
    for start, stop in _stretches(saturated):
        axes.axvspan(time[start], time[stop], color=_SATURATED, alpha=0.15, linewidth=0)
    axes.plot(time, effort, color=_ACTUAL)
    axes.plot(time, np.where(saturated, effort, np.nan), color=_SATURATED, linewidth=2.2)
    axes.set_ylabel(_EFFORT_TITLES[row])
    axes.text(
        0.03,
        0.9,
        f"limit ± {limit.max():.0f}\nsaturated {100 * experiment.summary.saturated[row]:.0f} %",
        transform=axes.transAxes,
        va="top",
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1.5},
    )


def _mark_phases(axes: Axes, experiment: ThesisExperiment) -> None:
    axes.grid(alpha=0.25)
    axes.set_xlim(0.0, experiment.time[-1])
    axes.axvline(experiment.swing.shoulder.time[68], color="black", linewidth=0.7, linestyle=":")
    if experiment.summary.contact_time is not None:
        axes.axvline(experiment.summary.contact_time, color=_BALL, linewidth=1.0)


def _draw_path(figure: FigureBase, axes: Axes, experiment: ThesisExperiment) -> None:
    axes.set_title("Club-head path (fig. 19)", fontweight="bold", loc="left")
    for instant in (0.0, experiment.summary.top_time):
        _draw_robot(axes, experiment, int(np.searchsorted(experiment.time, instant)))
    axes.plot(*experiment.reference_head.T, "--", color=_REFERENCE, linewidth=1.0, label="reference")
    points = experiment.head[::5, None, :]
    path = LineCollection(
        list(np.concatenate([points[:-1], points[1:]], axis=1)), cmap="viridis", linewidth=2.4, label="actual"
    )
    path.set_array(_head_speed(experiment)[:-1:5])
    axes.add_collection(path)
    figure.colorbar(path, ax=axes, label="speed of the head, m/s", location="bottom", shrink=0.7, aspect=40)
    axes.plot(*experiment.ball, "o", color="white", markeredgecolor="black", markersize=8, label="ball")
    axes.set(xlabel="x towards the target, m", ylabel="y up the swing plane, m", aspect="equal")
    axes.legend(loc="upper right", frameon=False)
    axes.grid(alpha=0.25)


def _draw_robot(axes: Axes, experiment: ThesisExperiment, index: int) -> None:
    r1, r2, r3, r6, head = joint_positions(experiment.robot, experiment.angle[index])
    axes.plot(*np.array([r6, r3]).T, "-", color="#dddddd", linewidth=5, zorder=0)
    axes.plot(*np.array([r6, r1, r2, r3]).T, "-o", color="#b0b0b0", linewidth=3, markersize=5, zorder=0)
    axes.plot(*np.array([r3, head]).T, "-", color="#b0b0b0", linewidth=1.2, zorder=0)


def _draw_ball(axes: Axes, experiment: ThesisExperiment) -> None:
    (x, y), s = experiment.ball, experiment.summary
    down = experiment.time >= s.top_time
    axes.plot(*experiment.reference_head[down].T, "--", color=_REFERENCE, label="reference, downswing")
    axes.plot(*experiment.head[down].T, color=_ACTUAL, label="actual, downswing")
    axes.plot(*experiment.head[~down].T, ":", color=_ACTUAL, label="actual, backswing")
    axes.plot(x, y, "o", color="white", markeredgecolor="black", markersize=14, label="ball")
    if s.height_error is not None:
        axes.plot([x, x], [y, y + s.height_error], color=_SATURATED, linewidth=2.0)
        axes.annotate(
            f"{100 * s.height_error:+.1f} cm",
            (x, y + s.height_error),
            xytext=(10, 8),
            textcoords="offset points",
            color=_SATURATED,
            fontweight="bold",
        )
    axes.set_title("At the ball", fontweight="bold", loc="left")
    axes.set(
        xlim=(x - 0.45, x + 0.45), ylim=(y - 0.1, y + 0.25), xlabel="x, m", ylabel="y, m", aspect="equal"
    )
    axes.legend(loc="upper left", frameon=False, fontsize=8, ncols=2)
    axes.grid(alpha=0.25)


def _head_speed(experiment: ThesisExperiment) -> NDArray[np.float64]:
    return np.asarray(np.hypot(*np.gradient(experiment.head, experiment.time, axis=0).T))


def _stretches(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return (first, last) index of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


def _end(experiment: ThesisExperiment) -> float:
    contact = experiment.summary.contact_time
    return experiment.swing.end if contact is None else contact


def _of_three(values: Sequence[float], form: str) -> str:
    """Return three values as one when they are equal, else separated by strokes."""
    texts = [form.format(value) for value in values]
    return texts[0] if len(set(values)) == 1 else " / ".join(texts)


def _gains(p: ThesisParameters) -> list[tuple[str, Triple]]:
    return [("P", p.proportional), ("I", p.integral), ("D", p.derivative)]


def _grid(title: str, *columns: str, wrapped: Sequence[str] = ()) -> Grid:
    grid = Grid(title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        grid.add_column(column, no_wrap=column not in wrapped)
    return grid


def _cells(s: ExperimentSummary) -> tuple[str, ...]:
    at_ball = ("–", "–", "–")
    if s.contact_time is not None and s.height_error is not None and s.club_speed is not None:
        at_ball = (f"{s.contact_time:.3f}", f"{100 * s.height_error:+.1f}", f"{s.club_speed:.1f}")
    return (
        *at_ball,
        "/".join(f"{error:.2f}" for error in s.largest_error),
        "/".join(f"{100 * share:.0f}" for share in s.saturated),
        "yes" if s.stable else "no",
    )
