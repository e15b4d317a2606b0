"""Plots of measured swings: angles, speeds, events and swing plane; comparison of two swings."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.golfer.comparison import DEFINITION, MotionDeviation
from bench.golfer.golfer_file import MeasuredSwing
from bench.records.shot.plot_style import COLOURS, GREY, INK, STYLE, styled

_NAMES = ("θ1 shoulders", "θ2 lead arm", "θ3 wrist")


def golfer_plot(swing: MeasuredSwing, title: str) -> Figure:
    """Return the figure of `swing`."""
    with mpl.rc_context(STYLE):
        figure = styled(6.2)
        axes_of = figure.subplot_mosaic([[f"{row}", "plane"] for row in range(4)])
        rows = [axes_of[f"{row}"] for row in range(4)]
        begin = max(len(swing.time) - 1 - int(4.0 * (len(swing.time) - 1 - swing.top_row)), 0)
        since = 1e3 * swing.time[begin:]
        for joint, name in enumerate(_NAMES):
            axes = rows[joint]
            axes.set(title=name, ylabel="degrees")
            if np.isnan(swing.angle[-1, joint]):
                axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", color=GREY)
            else:
                axes.plot(since, np.degrees(swing.angle[begin:, joint]), color=COLOURS[joint])
        for role, colour in (("head", COLOURS[1]), ("lead_wrist", COLOURS[0])):
            if role in swing.speed:
                rows[3].plot(since, swing.speed[role][begin:], color=colour, label=role.replace("_", " "))
        rows[3].set(title="speed", ylabel="m/s", xlabel="ms before the ball")
        rows[3].legend(loc="upper left")
        for axes in rows[:3]:
            axes.sharex(rows[3])
            axes.tick_params(labelbottom=False)
        for axes in rows:
            axes.axvline(1e3 * swing.time[swing.top_row], color=GREY, linewidth=0.8)
            axes.axvline(0.0, color=INK, linewidth=0.8)
            if swing.club_top_row is not None:
                axes.axvline(1e3 * swing.time[swing.club_top_row], color=GREY, linewidth=0.8, linestyle=":")
        _draw_plane(axes_of["plane"], swing)
        figure.suptitle(f"{title}\nGrey: top (dotted: the shaft turns back). Black: ball.", fontsize=8.5)
    return figure


def comparison_plot(rows: Sequence[MotionDeviation]) -> Figure:
    """Return the plot of `rows`: downswing of each reference and of the swing compared with it."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(11.0, 2.3 * len(rows) + 0.8), layout="constrained")
        grid = figure.subplots(len(rows), 4, squeeze=False)
        for across, row in zip(grid, rows, strict=True):
            rows_of = row.reference.in_downswing
            since, angle = 1e3 * row.reference.time[rows_of], row.reference.angle[rows_of]
            for joint in range(3):
                across[joint].plot(since, np.degrees(angle[:, joint]), "--", color=COLOURS[1])
                across[joint].plot(1e3 * row.time, np.degrees(row.beside[:, joint]), color=COLOURS[0])
                error = f"{100 * row.share[joint]:.1f} %, {np.degrees(row.error[joint]):.1f}°"
                across[joint].set_title(f"{_NAMES[joint]}: {error}")
            across[3].plot(*row.reference.head[rows_of].T, "--", color=COLOURS[1])
            across[3].plot(*row.head_beside.T, color=COLOURS[0])
            across[3].set_title(f"head: {100 * row.share[3]:.1f} %, {1e3 * row.error[3]:.0f} mm")
            across[3].set_aspect("equal", adjustable="datalim")
            across[0].set_ylabel(f"{row.other.name}\nagainst {row.reference.name}")
        for axes in grid[-1, :3]:
            axes.set_xlabel("ms before the ball")
        figure.suptitle(fill(f"Dashed: reference. Line: swing. {DEFINITION}.", 150), fontsize=8)
    return figure


def _draw_plane(axes: Axes, swing: MeasuredSwing) -> None:
    """Draw the paths in the plane, and the stick figure at the top, in the downswing and at the ball."""
    begin = swing.top_row
    for role, colour in (("head", COLOURS[1]), ("lead_wrist", COLOURS[0]), ("lead_shoulder", COLOURS[2])):
        if role in swing.position:
            path = swing.position[role][begin:]
            axes.plot(path[:, 0], path[:, 1], color=colour, linewidth=1.0, label=role.replace("_", " "))
    chain = ["trail_shoulder", "lead_shoulder", "lead_wrist", *(["head"] if swing.has_club else [])]
    last = len(swing.time) - 1
    for row in np.linspace(begin, last, 6).astype(int):
        stick = np.array([swing.position[role][row, :2] for role in chain])
        colour, width, alpha = (INK, 1.2, 1.0) if row in (begin, last) else (GREY, 0.6, 0.6)
        axes.plot(*stick.T, "o-", color=colour, markersize=2.5, linewidth=width, alpha=alpha)
    axes.set(
        title=f"swing plane, {np.degrees(swing.plane):.1f}° from the ground",
        xlabel="to the target, m",
        ylabel="up the plane, m",
    )
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="upper right")
