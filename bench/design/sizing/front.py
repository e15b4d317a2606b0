"""Picture of a sizing: prices and head speeds of the candidates. Results of a search do not depend on it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np

from bench.design.sizing.search import SizedPoint, non_dominated
from bench.records.shot.plot_style import COLOURS, GREY, STYLE, save_picture, styled


def draw_front(points: Sequence[SizedPoint], speed: float, path: Path) -> None:
    """Draw all planned points with the front, and the swings at the demanded `speed` (m/s), into `path`."""
    planned = [point for point in points if not point.plan.failure]
    front = non_dominated(planned)
    swings = [(p.price, p.swing.speed) for p in points if p.swing is not None and not p.swing.failure]
    figures = ([(p.price, p.plan.speed) for p in some] for some in (planned, front))
    plans, best, swung = (np.reshape(some, (-1, 2)).T for some in (*figures, swings))
    with mpl.rc_context(STYLE):
        figure = styled(3.6)
        axes = figure.subplots()
        axes.scatter(plans[0], plans[1], s=14, color=GREY, label="candidates")
        label = "front of plans by collocation alone"
        axes.step(*best, where="post", color=COLOURS[0], label=label)
        axes.axhline(speed, color=COLOURS[1], linewidth=0.8, label=f"demanded, {speed:g} m/s")
        if swings:
            label = "whole swing in closed loop"
            axes.scatter(swung[0], swung[1], s=36, marker="D", color=COLOURS[2], label=label)
        for point in front:
            axes.annotate(
                f"{point.hardware.vane} {point.hardware.arm} {point.hardware.shoulder_valve}\n"
                f"{point.hardware.pressure / 1e5:g} bar",
                (point.price, point.plan.speed),
                xytext=(4, -12),
                textcoords="offset points",
                fontsize=6,
            )
        axes.set_xlabel("price, upper ends of the parts' classes (assumed), EUR")
        axes.set_ylabel("head speed at the ball, m/s")
        axes.legend(loc="lower right")
        save_picture(figure, path)
