"""Plot of a swing against its reference: angles and errors over time, phases shaded."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from bench.lifecycle import Phase
from bench.shot.plot_style import COLOURS, GREY, INK, styled
from drivers.base import JOINTS

_PHASES = {
    Phase.BACKSWING: ("backswing", "#eef2ff"),
    Phase.TOP: ("top", "#fef9c3"),
    Phase.DOWNSWING: ("downswing", "#dcfce7"),
    Phase.COMMITTED: ("committed", "#bbf7d0"),
    Phase.IMPACT: ("impact", "#fecaca"),
    Phase.FOLLOW_THROUGH: ("follow-through", "#fdf2e9"),
    Phase.RETURN: ("return", "#f3f4f6"),
}


def _since_start(cycles: np.ndarray[Any, Any]) -> np.ndarray:
    since: np.ndarray = cycles["time"] - cycles["time"][0]
    return since


def _without_return(cycles: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return the cycles up to the slow return, all of them without one."""
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
    patches = [
        Patch(facecolor=colour, edgecolor="#d1d5db", linewidth=0.5, label=name)
        for phase, (name, colour) in _PHASES.items()
        if phase.value in present
    ]
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
        angle.plot(time, reference, color=INK, linewidth=1.0, linestyle=(0, (4, 2)), label="reference")
        angle.plot(time, actual, color=COLOURS[0], label="actual (estimate)")
        angle.set(title=f"θ{joint + 1} {name}", ylabel="degrees")
        error.plot(time, reference - actual, color=COLOURS[1], linewidth=1.0)
        error.axhline(0, color=GREY, linewidth=0.6)
        error.set(title="reference − actual", ylabel="degrees")
        if to_ball.any():
            largest = max(1.15 * float(np.abs(reference - actual)[to_ball].max()), 0.01)
            error.set_ylim(-largest, largest)
    grid[0, 0].legend(loc="best")
    for axes in grid[2]:
        axes.set(xlabel="time, s", xlim=(time[0], time[-1]))
    _phase_legend(figure, cycles)
    return figure
