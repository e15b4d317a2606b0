"""Plot of two swings on one clock."""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from bench.records.shot.overlay import SwingCourse, clocks
from bench.records.shot.plot_style import COLOURS, INK, STYLE, styled
from drivers.base import JOINTS

_BROAD: dict[str, Any] = {"linewidth": 2.6, "alpha": 0.4}
_THIN: dict[str, Any] = {"linewidth": 0.8}


def overlay_plot(first: SwingCourse, second: SwingCourse) -> Figure:
    """Return head speed, angles, tracking errors, openings and pressures of both swings."""
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
