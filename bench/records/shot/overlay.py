"""Two swings on one clock: their deliveries, and the differences along their courses.

A course is a record's, with the estimated angles, or a profile's, with the planned ones. Clocks are aligned
at the ball, or at the start of the backswing where one of the two did not come to the ball.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import nan
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.records.shot.recorded_shot import RecordedShot
from bench.records.shot.strike import SWINGING, time_at_ball
from bench.swing.actuator_motion import head_speed
from bench.swing.profile import Profile
from drivers.base import JOINTS
from sim.plant import PlantParameters

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
_Summary = Callable[[Array], float]

DELIVERY = {
    "club_speed_mps": "m/s",
    "attack_angle_deg": "°",
    "club_path_deg": "°",
    "face_angle_deg": "°",
    "dynamic_loft_deg": "°",
    "strike_x_mm": "mm",
    "strike_y_mm": "mm",
    "ball_speed_mps": "m/s",
    "launch_angle_deg": "°",
    "direction_deg": "°",
    "spin_rpm": "rpm",
    "carry_m": "m",
}
"""Figures of a shot, and their units."""
_PLANNED = {"head_speed_mps": "club_speed_mps", "attack_angle_deg": "attack_angle_deg"}
"""Columns of a shot by the name of the profile's figure."""


@dataclass(frozen=True)
class SwingCourse:
    """One swing over time (n,), s from the start of its backswing."""

    name: str
    time: Array
    ball: float | None
    """Instant at which the head came to the ball's place (s); None if it did not."""
    angle: Array
    """(n, 3) rad, estimated or planned."""
    error: Array
    """(n, 3) rad, of the angles from their reference; NaN of a profile."""
    opening: Array
    """(n, 3) applied by the valves, or planned."""
    pressure: Array
    """(n, 6) Pa absolute of the chambers; NaN where not measured."""
    head_speed: Array
    """(n,) m/s, from angles and velocities."""
    figures: dict[str, float] = field(default_factory=dict)
    """Delivery by the names in DELIVERY, as far as it is known."""


class FigureDifference(NamedTuple):
    """One figure of two swings, NaN where it is not known."""

    name: str
    unit: str
    first: float
    second: float
    between: float
    """Second minus first."""
    rms: float = nan
    """Root mean square of the differences along the course, up to the ball."""


def course_of_record(name: str, shot: RecordedShot) -> SwingCourse:
    """Return the course of a record's swing, empty where it holds none."""
    cycles = shot.record.cycles
    cycles = cycles[np.isin(cycles["phase"], SWINGING)]
    start = float(cycles["time"][0]) if len(cycles) else 0.0
    at_ball = time_at_ball(shot.plant.robot, cycles, shot.plant.site.ball_x, estimated=True)
    figures = {column: getattr(shot.record.shot, column) for column in DELIVERY}
    pressure = np.where(np.isfinite(cycles["chamber_pressure"]), cycles["chamber_pressure"], nan)
    return SwingCourse(
        name,
        cycles["time"] - start,
        None if at_ball is None else at_ball - start,
        cycles["angle"],
        cycles["angle"] - cycles["reference_angle"],
        cycles["applied_valve"],
        pressure,
        cycles["head_speed"],
        {column: float(value) for column, value in figures.items() if value is not None},
    )


def course_of_profile(plant: PlantParameters, profile: Profile) -> SwingCourse:
    """Return the planned course of `profile` on `plant`."""
    rows = np.isin(profile.phases, SWINGING)
    time: Array = np.flatnonzero(rows).astype(float) * profile.period
    unknown = np.full((len(time), 9), nan)
    return SwingCourse(
        profile.name,
        time - time[0],
        profile.impact_time - float(time[0]),
        profile.angle[rows],
        unknown[:, :3],
        profile.valve[rows],
        unknown[:, 3:],
        head_speed(plant.robot, profile.angle[rows], profile.velocity[rows]),
        {_PLANNED[name]: value for name, value in profile.delivery.items() if name in _PLANNED},
    )


def clocks(first: SwingCourse, second: SwingCourse) -> tuple[Array, Array, bool]:
    """Return the times of both (s) on one clock, and whether it is 0 at the ball."""
    if first.ball is None or second.ball is None:
        return first.time, second.time, False
    return first.time - first.ball, second.time - second.ball, True


def differences(first: SwingCourse, second: SwingCourse) -> list[FigureDifference]:
    """Return the figures of both swings and their differences, those along the course up to the ball."""
    rows = []
    for name, unit in DELIVERY.items():
        if name in first.figures or name in second.figures:
            pair = first.figures.get(name, nan), second.figures.get(name, nan)
            rows.append(
                FigureDifference(name.rpartition("_")[0].replace("_", " "), unit, *pair, pair[1] - pair[0])
            )
    one, two, at_ball = clocks(first, second)
    shown = one <= (0.0 if at_ball else np.inf)
    time = one[shown]
    for k, joint in enumerate(JOINTS):
        errors, angles = (first.error[:, k], second.error[:, k]), (first.angle[:, k], second.angle[:, k])
        chambers = [(course.pressure[:, 2 * k : 2 * k + 2] * 1e-5).T for course in (first, second)]
        courses: tuple[tuple[str, str, _Summary | None, tuple[Array, Array]], ...] = (
            ("tracking error", "°", _rms, (np.degrees(errors[0]), np.degrees(errors[1]))),
            ("angle", "°", None, (np.degrees(angles[0]), np.degrees(angles[1]))),
            ("valve opening", "%", _largest, (100 * first.opening[:, k], 100 * second.opening[:, k])),
            *(
                (f"pressure {chamber}", "bar", _largest, (chambers[0][row], chambers[1][row]))
                for row, chamber in enumerate("AB")
            ),
        )
        for what, unit, summary, (mine, other) in courses:
            beside = _beside(time, two, other)
            pair = (nan, nan) if summary is None else (summary(mine[shown]), summary(beside))
            name = f"{joint}: {what}" + _SUMMARIES.get(summary, "")
            rows.append(FigureDifference(name, unit, *pair, pair[1] - pair[0], _rms(beside - mine[shown])))
    return [row for row in rows if np.isfinite(row[2:]).any()]


def _beside(time: Array, own: Array, values: Array) -> Array:
    """Return `values` at `time` (s), linear between `own` (s), NaN outside."""
    if not len(own):
        return np.full(len(time), nan)
    return np.interp(time, own, values, left=nan, right=nan)


def _rms(values: Array) -> float:
    """Return the root mean square of the numbers among `values`, NaN without one."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else nan


def _largest(values: Array) -> float:
    """Return the largest magnitude of the numbers among `values`, NaN without one."""
    known = values[np.isfinite(values)]
    return float(np.abs(known).max()) if len(known) else nan


_SUMMARIES: dict[_Summary | None, str] = {_rms: ", RMS", _largest: ", largest"}
"""Ending of a row's name by its summary."""


_BROAD: dict[str, Any] = {"linewidth": 2.6, "alpha": 0.4}
_THIN: dict[str, Any] = {"linewidth": 0.8}


def overlay_plot(first: SwingCourse, second: SwingCourse) -> Figure:
    """Return head speed, angles, tracking errors, openings and pressures of both swings."""
    import matplotlib as mpl

    from bench.records.shot.plot_style import COLOURS, INK, STYLE, styled

    one, two, at_ball = clocks(first, second)
    with mpl.rc_context(STYLE):
        figure = styled(9.5)
        grid = figure.subplots(5, 3, sharex=True)
        for axes in grid[0, 1:]:
            axes.remove()
        speed = figure.add_subplot(grid[0, 0].get_subplotspec().get_gridspec()[0, :], sharex=grid[1, 0])
        grid[0, 0].remove()
        for time, course, style in ((one, first, _BROAD), (two, second, _THIN)):
            speed.plot(time, course.head_speed, color=INK, label=course.name, **style)
            for k, joint in enumerate(JOINTS):
                columns = (
                    np.degrees(course.angle[:, k]),
                    np.degrees(course.error[:, k]),
                    100 * course.opening[:, k],
                )
                for axes, column in zip(grid[1:4, k], columns, strict=True):
                    axes.plot(time, column, color=COLOURS[k], **style)
                for chamber, colour in ((2 * k, COLOURS[k]), (2 * k + 1, COLOURS[k + 3])):
                    grid[4, k].plot(time, 1e-5 * course.pressure[:, chamber], color=colour, **style)
                grid[1, k].set_title(joint)
        speed.set(title="head speed", ylabel="m/s")
        speed.legend(loc="upper left")
        labels = ("angle, °", "tracking error, °", "valve opening, %", "pressures A, B, bar")
        for row, label in zip(grid[1:], labels, strict=True):
            row[0].set_ylabel(label)
        for axes in grid[4]:
            axes.set_xlabel("s from the ball" if at_ball else "s from the start")
        if at_ball:
            for axes in [speed, *grid[1:].ravel()]:
                axes.axvline(0.0, color=INK, linewidth=0.8)
    return figure
