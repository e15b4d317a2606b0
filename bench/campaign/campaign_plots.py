"""The plots of a campaign's report, as inline SVG; clouds of many points are pictures inside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import MaxNLocator

from bench.campaign.analysis import SectionAnalysis, values_of
from bench.campaign.lowess import lowess
from bench.campaign.plan import CampaignPlan, levels
from bench.campaign.preview import UNITS
from bench.campaign.repeatability import FIGURES
from bench.campaign.sequence import Role, sections
from bench.campaign.verdicts import NAMES
from bench.shot.plot_style import COLOURS, MARKERS, STYLE, styled, to_svg
from bench.shot.shot import Shot, ShotStatus

_INK, _GREY, _RED = "#1a1a1a", "#6b7280", "#b91c1c"
_MANY = 1500
"""Number of points from which a cloud is drawn as a bitmap."""
_DELIVERY = ("club_speed_mps", "attack_angle_deg", "dynamic_loft_deg", "strike_x_mm")


def campaign_figures(
    plan: CampaignPlan, shots: Sequence[Shot], analyses: Sequence[SectionAnalysis]
) -> Mapping[str, Any]:
    """Return the SVGs: "delivery", and for each section "dispersion", "levels" and "drift"."""
    with mpl.rc_context(STYLE):
        found: dict[str, Any] = {"delivery": to_svg(_delivery(shots), "delivery"), "sections": []}
        for section, analysis in zip(sections(plan), analyses, strict=True):
            mine = [shot for shot in shots if shot.section == section.number and shot.role != Role.WARM_UP]
            name = f"s{section.number}"
            found["sections"].append(
                {
                    "dispersion": to_svg(_dispersion(plan, mine), f"{name}d"),
                    "levels": to_svg(_levels(plan, mine, analysis), f"{name}l"),
                    "drift": to_svg(_drift(plan, mine, analysis), f"{name}t"),
                }
            )
        return found


def _look(index: int, many: bool) -> dict[str, Any]:
    return {
        "color": COLOURS[index % len(COLOURS)],
        "marker": MARKERS[(index + index // len(COLOURS)) % len(MARKERS)],
        "markersize": 2.0 if many else 4.0,
        "linestyle": "none",
        "alpha": 0.35 if many else 0.8,
        "rasterized": many,
        "markeredgewidth": 0.6,
    }


def _by_level(plan: CampaignPlan, shots: Sequence[Shot]) -> list[tuple[str, list[Shot]]]:
    tests = [shot for shot in shots if shot.role == Role.TEST]
    return [(name, [s for s in tests if getattr(s, plan.design.compare) == name]) for name in levels(plan)]


def _dispersion(plan: CampaignPlan, shots: Sequence[Shot]) -> Figure:
    """Landing points from above with ellipses, and carry against ball speed."""
    figure = styled(3.8)
    above, speed = figure.subplots(1, 2, width_ratios=[1, 1.1])
    many = len(shots) > _MANY
    extent: list[tuple[float, float]] = []
    for index, (name, mine) in enumerate(_by_level(plan, shots)):
        flown = [s for s in mine if s.carry_m is not None and s.carry_side_m is not None]
        points = np.array(
            [(s.carry_side_m, s.carry_m) for s in flown if s.status is ShotStatus.VALID], dtype=float
        ).reshape(-1, 2)
        others = np.array(
            [(s.carry_side_m, s.carry_m) for s in flown if s.status is not ShotStatus.VALID], dtype=float
        ).reshape(-1, 2)
        style = _look(index, many)
        above.plot(*points.T, **style, label=name)
        above.plot(*others.T, **{**style, "markerfacecolor": "none"})
        extent += [tuple(p) for p in (*points, *others)]
        if len(points) >= 3:
            extent += _draw_ellipse(above, points, style["color"])
        both = [
            (s.ball_speed_mps, s.carry_m) for s in flown if s.ball_speed_mps and s.status is ShotStatus.VALID
        ]
        speed.plot(*np.array(both, dtype=float).reshape(-1, 2).T, **style, label=name)
    above.axvline(0, color=_GREY, linewidth=0.8, linestyle=(0, (5, 3)))
    if extent:
        low, high = np.min(extent, axis=0), np.max(extent, axis=0)
        middle, half = (low + high) / 2, max(float((high - low).max()) * 0.56, 3.0)
        above.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
        above.set_aspect("equal")
    above.set(title="Landing points from above", xlabel="left  ←  offline, m  →  right", ylabel="carry, m")
    speed.set(title="Carry against ball speed", xlabel="ball speed, m/s", ylabel="carry, m")
    figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=10, fontsize=7)
    return figure


def _levels(plan: CampaignPlan, shots: Sequence[Shot], analysis: SectionAnalysis) -> Figure:
    """Each level's shots with mean and interval: the compared quantity, and the delivered club speed."""
    unit, name = UNITS[plan.analysis.quantity], NAMES[plan.analysis.quantity]
    found = _by_level(plan, shots)
    figure = styled(1.0 + 0.32 * max(len(found), 2))
    result, club = figure.subplots(1, 2, sharey=True, width_ratios=[1.6, 1])
    many = len(shots) > _MANY
    for index, (level, mine) in enumerate(found):
        style = _look(index, many) | {"markersize": 2.5}
        _, values = values_of(plan, mine)
        result.plot(values, np.full(len(values), index) + _spread_out(len(values)), **style)
        spread = analysis.levels[index].spread
        if spread.n >= 2:
            result.errorbar(
                [spread.mean],
                [index],
                xerr=[[spread.mean - spread.low], [spread.high - spread.mean]],
                color=_INK,
                marker="|",
                markersize=12,
                capsize=4,
                linewidth=1.4,
                label=level,
            )
        speeds = [s.club_speed_mps for s in mine if s.club_speed_mps and s.status is ShotStatus.VALID]
        club.plot(speeds, np.full(len(speeds), index) + _spread_out(len(speeds)), **style)
    result.set_yticks(range(len(found)), [level for level, _ in found])
    result.set_ylim(len(found) - 0.4, -0.6)
    result.set(
        title=f"{name.capitalize()}: mean and {100 * plan.analysis.confidence:g} % interval",
        xlabel=f"{name}, {unit}",
    )
    club.set(title="Club speed delivered", xlabel="m/s")
    return figure


def _spread_out(count: int) -> np.ndarray:
    """Return offsets that keep like points apart, the same each time."""
    steps = (np.arange(count) * 0.6180339887) % 1.0
    return 0.5 * (steps - 0.5)


def _drift(plan: CampaignPlan, shots: Sequence[Shot], analysis: SectionAnalysis) -> Figure:
    """The compared quantity over the shots less its level's mean, and the control ball's drift."""
    unit, name = UNITS[plan.analysis.quantity], NAMES[plan.analysis.quantity]
    figure = styled(2.5)
    axes = figure.subplots()
    many = len(shots) > _MANY
    for index, (_, mine) in enumerate(_by_level(plan, shots)):
        kept, values = values_of(plan, mine)
        if len(values):
            axes.plot([s.shot for s in kept], values - values.mean(), **_look(index, many))
    kept, values = values_of(plan, [shot for shot in shots if shot.role == Role.CONTROL])
    if len(values) > 1:
        number, off = np.array([s.shot for s in kept], dtype=float), values - values.mean()
        axes.plot(
            number,
            off,
            color=_INK,
            marker="x",
            markersize=2.5 if many else 4,
            linestyle="none",
            rasterized=many,
            label="control ball",
        )
        if len(off) >= 6:
            at = number if len(number) <= 100 else np.linspace(number[0], number[-1], 101)
            axes.plot(at, lowess(number, off, at, share=0.4), color=_INK, label="control ball, LOWESS")
        axes.legend(loc="upper right", ncols=2)
    for shot, _ in analysis.outliers:
        axes.axvline(shot, color=_RED, linewidth=0.6, alpha=0.5)
    axes.axhline(0, color=_GREY, linewidth=0.8)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(title=f"Drift: {name} less the level's mean, in the order played", xlabel="shot", ylabel=unit)
    return figure


def _delivery(shots: Sequence[Shot]) -> Figure:
    """The delivery over the campaign: valid and other shots."""
    figure = styled(3.4)
    grid: np.ndarray[Any, Any] = figure.subplots(2, 2, sharex=True)
    names = {column: (text, unit) for column, text, unit, _ in FIGURES}
    keys = list(dict.fromkeys((s.swing, s.club) for s in shots))
    many = len(shots) > _MANY
    for axes, column in zip(grid.ravel(), _DELIVERY, strict=True):
        for index, key in enumerate(keys):
            mine = [s for s in shots if (s.swing, s.club) == key and getattr(s, column) is not None]
            _points(axes, [s for s in mine if s.status is ShotStatus.VALID], column, _look(index, many), True)
            _points(
                axes, [s for s in mine if s.status is not ShotStatus.VALID], column, _look(index, many), False
            )
        text, unit = names[column]
        axes.set(title=text, ylabel=unit)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    for axes in grid[1]:
        axes.set_xlabel("shot")
    return figure


def _points(axes: Axes, shots: Sequence[Shot], column: str, style: dict[str, Any], filled: bool) -> None:
    look = style | {"markersize": 2.0} if filled else style | {"markerfacecolor": "none", "color": _RED}
    axes.plot([s.shot for s in shots], [getattr(s, column) for s in shots], **look)


_CHI2_95 = 5.991
"""95 % quantile of chi-square with two degrees of freedom."""


def _draw_ellipse(axes: Axes, points: np.ndarray, colour: str) -> list[tuple[float, float]]:
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
