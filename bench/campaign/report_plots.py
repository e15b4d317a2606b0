"""The plots of a report, as inline SVG that is the same for the same input."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from math import cos, sin
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Patch
from matplotlib.ticker import MaxNLocator

from bench.lifecycle import Phase
from bench.shot.head_path import path_to_ball
from bench.shot.shot import Status
from bench.shot.shot_record import ShotRecord
from drivers.base import ACTUATORS, JOINTS
from sim.plant import Site
from sim.robot import RobotParameters

YARD = 0.9144

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
"""Okabe and Ito's colours: told apart also by colour-blind readers; each ball has a marker of its own too."""
MARKERS = "os^Dvp"
_INK = "#1a1a1a"
_GREY = "#6b7280"
_CHI2_95 = 5.991
"""95 % quantile of chi-square with two degrees of freedom."""
_WIDTH = 7.4
"""Inches: the text width of a printed A4 page."""

STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelcolor": _INK,
    "axes.edgecolor": "#9ca3af",
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e5e7eb",
    "grid.linewidth": 0.6,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "legend.frameon": False,
    "legend.fontsize": 7.5,
    "lines.linewidth": 1.2,
    "lines.solid_capstyle": "round",
    "svg.fonttype": "path",
    "path.simplify": True,
    "text.parse_math": False,  # names of balls are plain text, dollar signs included
}

_PHASES = {
    Phase.BACKSWING: ("backswing", "#eef2ff"),
    Phase.TOP: ("top", "#fef9c3"),
    Phase.DOWNSWING: ("downswing", "#dcfce7"),
    Phase.COMMITTED: ("committed", "#bbf7d0"),
    Phase.IMPACT: ("impact", "#fecaca"),
    Phase.FOLLOW_THROUGH: ("follow-through", "#fdf2e9"),
    Phase.RETURN: ("return", "#f3f4f6"),
}


class Look:
    """Colour and marker of each ball, in the order in which the balls first appear."""

    def __init__(self, records: Sequence[ShotRecord]) -> None:
        self.balls = tuple(dict.fromkeys(record.shot.ball for record in records))
        self._index = {ball: index for index, ball in enumerate(self.balls)}

    def colour(self, ball: str) -> str:
        """Return the ball's colour."""
        return COLOURS[self._index[ball] % len(COLOURS)]

    def marker(self, ball: str) -> str:
        """Return the ball's marker."""
        return MARKERS[self._index[ball] % len(MARKERS)]


def to_svg(figure: Figure, name: str) -> str:
    """Return `figure` as an SVG element for a page; `name` keeps its ids apart from other figures'."""
    stream = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": name, "svg.fonttype": "path"}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    svg = stream.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>\s*", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\bid="', f'id="{name}-', svg)
    svg = re.sub(r'((?:xlink:)?href="|url\()#', rf"\1#{name}-", svg)
    return svg.replace("<svg ", '<svg aria-hidden="true" focusable="false" ', 1)


def styled(height: float) -> Figure:
    """Return an empty figure of the page's width and `height` (inches)."""
    return Figure(figsize=(_WIDTH, height), layout="constrained")


def dispersion(records: Sequence[ShotRecord], look: Look) -> Figure:
    """Landing points seen from above with a 95 % ellipse a ball, and carry shot by shot."""
    figure = styled(3.6)
    above, run = figure.subplots(1, 2, width_ratios=[1, 1.15], gridspec_kw={"wspace": 0.1})
    _landing(above, records, look)
    _run_chart(run, records, look)
    return figure


def _landing(axes: Axes, records: Sequence[ShotRecord], look: Look) -> None:
    flown = [(r.shot.ball, r.flight.carry_side, r.flight.carry, r.valid) for r in records if r.flight]
    extent = [(side, carry) for _, side, carry, _ in flown] + [(0.0, carry) for _, _, carry, _ in flown[:1]]
    for ball in look.balls:
        points = np.array([(s, c) for name, s, c, valid in flown if name == ball and valid]).reshape(-1, 2)
        others = np.array([(s, c) for name, s, c, valid in flown if name == ball and not valid]).reshape(
            -1, 2
        )
        style: dict[str, Any] = {"color": look.colour(ball), "marker": look.marker(ball), "markersize": 4.5}
        axes.plot(*points.T, **style, linestyle="none", alpha=0.85, label=ball)
        axes.plot(*others.T, **style, linestyle="none", markerfacecolor="none")
        if len(points) >= 3:
            extent += draw_ellipse(axes, points, look.colour(ball))
        if len(points):
            axes.plot(*points.mean(axis=0), color=look.colour(ball), marker="+", markersize=10, mew=1.4)
    axes.axvline(0, color=_GREY, linewidth=0.8, linestyle=(0, (5, 3)))
    if extent:
        low, high = np.min(extent, axis=0), np.max(extent, axis=0)
        # One scale for both axes; scatter below a metre is to look small.
        middle, half = (low + high) / 2, max(float((high - low).max()) * 0.56, 3.0)
        axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
        axes.set_aspect("equal")
    axes.set(title="Landing points from above", xlabel="left  ←  offline, m  →  right", ylabel="carry, m")
    _yards_on_the_right(axes)
    axes.legend(loc="upper left", handletextpad=0.2, borderaxespad=0.1)


def _yards_on_the_right(axes: Axes) -> None:
    def to_yards(metres: np.ndarray) -> np.ndarray:
        return metres / YARD

    def to_metres(yards: np.ndarray) -> np.ndarray:
        return yards * YARD

    functions: Any = (to_yards, to_metres)
    axes.secondary_yaxis("right", functions=functions).set_ylabel("carry, yd")


def draw_ellipse(axes: Axes, points: np.ndarray, colour: str) -> list[tuple[float, float]]:
    """Draw the ellipse that holds 95 % of a normal scatter like the points'; return its corners."""
    covariance = np.cov(points.T)
    values, vectors = np.linalg.eigh(covariance)
    width, height = 2 * np.sqrt(_CHI2_95 * np.maximum(values, 0))
    turn = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    centre = (float(points[:, 0].mean()), float(points[:, 1].mean()))
    axes.add_patch(Ellipse(centre, width, height, angle=turn, fill=False, edgecolor=colour, linewidth=1.0))
    axes.add_patch(Ellipse(centre, width, height, angle=turn, color=colour, alpha=0.07, linewidth=0))
    reach = np.sqrt(_CHI2_95 * np.diag(covariance))
    return [(centre[0] + sign * reach[0], centre[1] + sign * reach[1]) for sign in (-1, 1)]


def _run_chart(axes: Axes, records: Sequence[ShotRecord], look: Look) -> None:
    for ball in look.balls:
        mine = [r for r in records if r.shot.ball == ball and r.shot.carry_m is not None]
        counted = [r.shot for r in mine if r.valid]
        style: dict[str, Any] = {"color": look.colour(ball), "marker": look.marker(ball), "markersize": 4.5}
        numbers = [s.shot for s in counted]
        carries = np.array([s.carry_m for s in counted], dtype=float)
        axes.plot(numbers, carries, **style, linewidth=0.8, alpha=0.85, label=ball)
        axes.plot(
            [r.shot.shot for r in mine if not r.valid],
            np.array([r.shot.carry_m for r in mine if not r.valid], dtype=float),
            **style,
            linestyle="none",
            markerfacecolor="none",
        )
        if len(carries):
            axes.axhline(carries.mean(), color=look.colour(ball), linewidth=0.8, linestyle=(0, (2, 2)))
    for record in records:
        if record.shot.status is Status.FAILED:
            axes.axvline(record.shot.shot, color="#b91c1c", linewidth=0.8, alpha=0.6)
            axes.annotate(
                "not hit",
                (record.shot.shot, 0.02),
                xycoords=("data", "axes fraction"),
                rotation=90,
                fontsize=6.5,
                color="#b91c1c",
                ha="right",
                va="bottom",
            )
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(title="Carry, shot by shot (dotted: means)", xlabel="shot", ylabel="carry, m")
    _yards_on_the_right(axes)


def head_path(
    records: Sequence[ShotRecord],
    look: Look,
    robot: RobotParameters,
    site: Site,
    ball_radius: float,
    length: float = 0.10,
) -> Figure:
    """The face's centre in the swing plane on its last `length` metres to the ball, all swings, to scale."""
    figure = styled(2.9)
    axes, face = figure.subplots(1, 2, width_ratios=[1.75, 1])
    _strike(face, records, look, ball_radius)
    seen: set[str] = set()
    for record in records:
        path = path_to_ball(robot, record.cycles, site.ball_x, length)
        if path is None:
            continue
        ball = record.shot.ball
        axes.plot(
            *(path.position - [site.ball_x, site.ground]).T * 1e3,
            color=look.colour(ball),
            linewidth=1.1,
            alpha=0.9 if record.valid else 0.35,
            linestyle="-" if record.valid else "--",
            label=None if ball in seen else ball,
        )
        seen.add(ball)
    radius = ball_radius * 1e3
    height = (site.ball_y - site.ground) * 1e3
    middle = np.array([cos(robot.club.loft), sin(robot.club.loft) * sin(robot.lie)]) * radius + [0, height]
    axes.add_patch(Circle(tuple(middle), radius, facecolor="white", edgecolor=_INK, linewidth=1.0, zorder=3))
    axes.plot([middle[0]] * 2, [0, middle[1] - radius], color="#b45309", linewidth=2.5,
              solid_capstyle="butt", zorder=2)  # fmt: skip
    axes.plot(0, height, marker="x", color=_INK, markersize=5, zorder=4)
    axes.axhspan(-12, 0, color="#d9e7d3", linewidth=0)
    axes.axhline(0, color="#4d7c0f", linewidth=1.0)
    axes.axhline(height, color=_GREY, linewidth=0.6, linestyle=(0, (5, 3)))
    axes.annotate("target →", (78, height + 2), fontsize=7.5, color=_GREY, va="bottom", ha="right")
    axes.annotate("ground", (-length * 1e3, -6), fontsize=7.5, color="#4d7c0f", va="center")
    top = max(height + radius * 2.6, 80.0)
    axes.set(xlim=(-length * 1e3 - 6, 80), ylim=(-12, top), aspect="equal")
    axes.set(
        title="Centre of the club face at the ball (swing plane, to scale)",
        xlabel="along the target line, mm (×: contact)",
        ylabel="up the plane, mm",
    )
    if seen:
        axes.legend(loc="upper left", ncols=len(seen))
    return figure


def _strike(axes: Axes, records: Sequence[ShotRecord], look: Look, ball_radius: float) -> None:
    """Where on the face the balls were met, seen from the front, with the ball's size for scale."""
    for radius in (5, 10, 15, 20):
        axes.add_patch(Circle((0, 0), radius, fill=False, edgecolor="#d1d5db", linewidth=0.6))
    axes.add_patch(
        Circle((0, 0), ball_radius * 1e3, fill=False, edgecolor=_GREY, linewidth=0.8, linestyle=(0, (4, 2)))
    )
    for ball in look.balls:
        for valid in (True, False):
            points = [
                (r.shot.strike_x_mm, r.shot.strike_y_mm)
                for r in records
                if r.shot.ball == ball and r.valid is valid and r.shot.strike_x_mm is not None
            ]
            axes.plot(
                *np.array(points, dtype=float).reshape(-1, 2).T,
                color=look.colour(ball),
                marker=look.marker(ball),
                markersize=4,
                alpha=0.85,
                linestyle="none",
                markerfacecolor=None if valid else "none",
            )
    half = ball_radius * 1e3 + 3
    axes.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")
    axes.set(
        title="Strike on the face (dashed: ball)", xlabel="heel  ←  mm  →  toe", ylabel="low  ←  mm  →  high"
    )


def _since_start(cycles: np.ndarray[Any, Any]) -> np.ndarray:
    since: np.ndarray = cycles["time"] - cycles["time"][0]
    return since


def _without_return(cycles: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return the cycles up to the slow return, all of them when they have none."""
    returning = np.flatnonzero(cycles["phase"] == Phase.RETURN)
    return cycles[: returning[0] + 1] if returning.size and returning[0] > 0 else cycles


def _shade(axes: Axes, cycles: np.ndarray[Any, Any]) -> None:
    """Shade the phases of the swing."""
    phase, time = cycles["phase"], _since_start(cycles)
    edges = np.flatnonzero(np.diff(phase.astype(int)))
    starts, ends = np.concatenate([[0], edges + 1]), np.concatenate([edges + 1, [len(phase) - 1]])
    for start, end in zip(starts, ends, strict=True):
        shown = _PHASES.get(Phase(int(phase[start])))
        if shown:
            axes.axvspan(time[start], time[end], color=shown[1], linewidth=0)


def _phase_legend(figure: Figure, cycles: np.ndarray[Any, Any]) -> None:
    present = set(np.unique(cycles["phase"]).tolist())
    patches = [Patch(facecolor=colour, edgecolor="#d1d5db", linewidth=0.5, label=name)
               for phase, (name, colour) in _PHASES.items() if phase.value in present]  # fmt: skip
    if patches:
        figure.legend(handles=patches, loc="outside lower center", ncols=len(patches), fontsize=7)


def tracking(cycles: np.ndarray[Any, Any]) -> Figure:
    """Reference against actual joint angles, and their difference, phases shaded."""
    figure = styled(4.3)
    grid = figure.subplots(3, 2, sharex=True, width_ratios=[1.5, 1])
    cycles = _without_return(cycles)
    time = _since_start(cycles)
    to_ball = cycles["phase"] <= Phase.IMPACT
    for joint, name in enumerate(JOINTS):
        angle, error = grid[joint]
        reference = np.degrees(cycles["reference_angle"][:, joint])
        actual = np.degrees(cycles["angle"][:, joint])
        for axes in (angle, error):
            _shade(axes, cycles)
        angle.plot(time, reference, color=_INK, linewidth=1.0, linestyle=(0, (4, 2)), label="reference")
        angle.plot(time, actual, color=COLOURS[0], label="actual (estimate)")
        angle.set(title=f"θ{joint + 1} {name}", ylabel="degrees")
        error.plot(time, reference - actual, color=COLOURS[1], linewidth=1.0)
        error.axhline(0, color=_GREY, linewidth=0.6)
        error.set(title="reference − actual", ylabel="degrees")
        if to_ball.any():
            largest = max(1.15 * float(np.abs(reference - actual)[to_ball].max()), 0.01)
            error.set_ylim(-largest, largest)
    grid[0, 0].legend(loc="best")
    for axes in grid[2]:
        axes.set(xlabel="time, s", xlim=(time[0], time[-1]))
    _phase_legend(figure, cycles)
    return figure


def valves_and_efforts(cycles: np.ndarray[Any, Any]) -> Figure:
    """Valve openings wanted and applied, and, in simulation, the efforts of the actuators."""
    figure = styled(4.3)
    grid = figure.subplots(3, 2, sharex=True)
    cycles = _without_return(cycles)
    time = _since_start(cycles)
    units = ("N m", "N", "N m")
    for joint, name in enumerate(ACTUATORS):
        valve, effort = grid[joint]
        for axes in (valve, effort):
            _shade(axes, cycles)
            axes.axhline(0, color=_GREY, linewidth=0.6)
        valve.plot(time, 100 * cycles["desired_valve"][:, joint], color=_INK, linewidth=0.9,
                   linestyle=(0, (4, 2)), label="wanted")  # fmt: skip
        valve.plot(time, 100 * cycles["applied_valve"][:, joint], color=COLOURS[0], label="applied")
        valve.set(title=f"{name}: valve opening", ylabel="%", ylim=(-108, 108))
        values = cycles["plant_effort"][:, joint]
        if np.isfinite(values).any():
            effort.plot(time, values, color=COLOURS[2])
        else:
            effort.annotate("not measured on hardware", (0.5, 0.6), xycoords="axes fraction", ha="center")
        effort.set(title=f"{name}: effort (plant)", ylabel=units[joint])
    grid[0, 0].legend(loc="best", ncols=2)
    for axes in grid[2]:
        axes.set(xlabel="time, s", xlim=(time[0], time[-1]))
    _phase_legend(figure, cycles)
    return figure


def pressures(cycles: np.ndarray[Any, Any]) -> Figure:
    """Absolute pressures of all chambers and of the supply; the plant's where none are fitted."""
    figure = styled(2.6)
    row = figure.subplots(1, 3, sharey=True, sharex=True)
    cycles = _without_return(cycles)
    time = _since_start(cycles)
    fitted = np.isfinite(cycles["chamber_pressure"]).any()
    chambers = cycles["chamber_pressure" if fitted else "plant_pressure"] / 1e5
    for joint, (axes, name) in enumerate(zip(row, ACTUATORS, strict=True)):
        _shade(axes, cycles)
        axes.plot(
            time,
            cycles["supply_pressure"] / 1e5,
            color=_GREY,
            linewidth=0.9,
            linestyle=(0, (4, 2)),
            label="supply",
        )
        axes.plot(time, chambers[:, 2 * joint], color=COLOURS[0], label="chamber A")
        axes.plot(time, chambers[:, 2 * joint + 1], color=COLOURS[1], label="chamber B")
        axes.set(title=name, xlabel="time, s", xlim=(time[0], time[-1]))
    row[0].set(ylabel="bar absolute")
    row[0].set_ylim(bottom=0)
    row[0].legend(loc="best")
    _phase_legend(figure, cycles)
    return figure


def all_figures(
    records: Sequence[ShotRecord],
    shown: ShotRecord | None,
    robot: RobotParameters,
    site: Site,
    ball_radius: float,
) -> Mapping[str, str]:
    """Return every plot of a report as SVG by name; `shown` is the swing drawn against time."""
    look = Look(records)
    with mpl.rc_context(STYLE):
        figures = {
            "dispersion": dispersion(records, look),
            "head": head_path(records, look, robot, site, ball_radius),
        }
        if shown is not None and len(shown.cycles) > 1:
            figures |= {
                "tracking": tracking(shown.cycles),
                "valves": valves_and_efforts(shown.cycles),
                "pressures": pressures(shown.cycles),
            }
        return {name: to_svg(figure, name) for name, figure in figures.items()}
