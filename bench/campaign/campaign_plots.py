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
from bench.campaign.block_model import Array
from bench.campaign.control_chart import ControlChart
from bench.campaign.dispersion import DispersionEllipse
from bench.campaign.display_units import DisplayUnit, UnitSystem, display_unit
from bench.campaign.findings import Findings, SectionViews
from bench.campaign.plan import CampaignPlan, levels
from bench.campaign.quantities import QUANTITY_NAMES
from bench.campaign.randomization import Role, sections
from bench.campaign.repeatability import FIGURES
from bench.campaign.verdicts import NAMES
from bench.shot.plot_style import STYLE, colour_of, marker_of, styled, to_svg
from bench.shot.shot import Shot, ShotStatus

_INK, _GREY, _RED = "#1a1a1a", "#6b7280", "#b91c1c"
_MANY = 1500
"""Number of points from which a cloud is drawn as a bitmap."""
_DELIVERY = ("club_speed_mps", "attack_angle_deg", "dynamic_loft_deg", "strike_x_mm")


def campaign_figures(
    plan: CampaignPlan, shots: Sequence[Shot], found: Findings, units: UnitSystem = UnitSystem.SI
) -> Mapping[str, Any]:
    """Return the SVGs: "delivery", and for each section "dispersion", "levels", "drift" and "control".

    "each" has a panel for each level where there are many; "each" and "control" are empty otherwise.
    """
    with mpl.rc_context(STYLE):
        made: dict[str, Any] = {"delivery": to_svg(_delivery(shots, units), "delivery"), "sections": []}
        for section, analysis, views in zip(sections(plan), found.sections, found.views, strict=True):
            mine = [shot for shot in shots if shot.section == section.number and shot.role != Role.WARM_UP]
            name = f"s{section.number}"
            flown = _landing_points(plan, mine)
            many = len(flown) > _FEW
            made["sections"].append(
                {
                    "dispersion": to_svg(_dispersion(plan, mine, views, units), f"{name}d"),
                    "each": to_svg(_each(flown, views, units), f"{name}e") if many else "",
                    "levels": to_svg(_levels(plan, mine, analysis, units), f"{name}l"),
                    "drift": to_svg(_drift(plan, mine, analysis, units), f"{name}t"),
                    "control": to_svg(_control(views, units), f"{name}c") if views.control_charts else "",
                }
            )
        return made


def _look(index: int, many: bool) -> dict[str, Any]:
    return {
        "color": colour_of(index),
        "marker": marker_of(index),
        "markersize": 2.0 if many else 4.0,
        "linestyle": "none",
        "alpha": 0.35 if many else 0.8,
        "rasterized": many,
        "markeredgewidth": 0.6,
    }


def _by_level(plan: CampaignPlan, shots: Sequence[Shot]) -> list[tuple[str, list[Shot]]]:
    tests = [shot for shot in shots if shot.role == Role.TEST]
    return [(name, [s for s in tests if getattr(s, plan.design.compare) == name]) for name in levels(plan)]


_FEW = 4
"""Max number of levels that one picture of landing points keeps apart."""
_COLUMNS = 5
"""Panels side by side."""


def _landing_points(plan: CampaignPlan, shots: Sequence[Shot]) -> list[tuple[str, Array, Array]]:
    """Return (level, valid points, other points) as (n, 2) offline and carry, m."""
    found = []
    for name, mine in _by_level(plan, shots):
        flown = [s for s in mine if s.carry_m is not None and s.carry_side_m is not None]
        points = [
            np.array(
                [(s.carry_side_m, s.carry_m) for s in flown if (s.status is ShotStatus.VALID) is valid],
                dtype=float,
            ).reshape(-1, 2)
            for valid in (True, False)
        ]
        found.append((name, points[0], points[1]))
    return found


def _dispersion(plan: CampaignPlan, shots: Sequence[Shot], views: SectionViews, units: UnitSystem) -> Figure:
    """Landing points from above with ellipses, and carry against ball speed."""
    figure = styled(3.8)
    above, speed = figure.subplots(1, 2, width_ratios=[1, 1.1])
    distance, fast = display_unit("carry_m", units), display_unit("ball_speed_mps", units)
    many, flown = len(shots) > _MANY, _landing_points(plan, shots)
    ellipses = {ellipse.name: ellipse for ellipse in views.dispersion}
    extent: list[Array] = []
    for index, (name, points, others) in enumerate(flown):
        style = _look(index, many)
        if len(flown) > _FEW:
            style |= {"markersize": 2.5, "alpha": 0.5}
        above.plot(*distance.of(points).T, **style, label=name)
        above.plot(*distance.of(others).T, **{**style, "markerfacecolor": "none"})
        extent += [points, others]
        if name in ellipses:
            extent.append(_draw_ellipse(above, ellipses[name], style["color"], distance.size))
    for index, (name, mine) in enumerate(_by_level(plan, shots)):
        both = [
            (fast.of(s.ball_speed_mps), distance.of(s.carry_m))
            for s in mine
            if s.ball_speed_mps and s.carry_m is not None and s.status is ShotStatus.VALID
        ]
        speed.plot(*np.array(both, dtype=float).reshape(-1, 2).T, **_look(index, many), label=name)
    _from_above(above, np.concatenate(extent) / distance.size if extent else np.zeros((0, 2)))
    unit = distance.unit
    above.set(title="Landing points from above", xlabel=f"left  ←  offline, {unit}  →  right")
    above.set_ylabel(f"carry, {unit}")
    speed.set(title="Carry against ball speed", xlabel=f"ball speed, {fast.unit}", ylabel=f"carry, {unit}")
    figure.legend(*speed.get_legend_handles_labels(), loc="outside lower center", ncols=10, fontsize=7)
    return figure


def _from_above(axes: Axes, points: Array) -> None:
    """Show all `points` (n, 2) at one scale in both directions, with the target line."""
    axes.axvline(0, color=_GREY, linewidth=0.8, linestyle=(0, (5, 3)))
    if len(points):
        low, high = points.min(axis=0), points.max(axis=0)
        middle, half = (low + high) / 2, max(float((high - low).max()) * 0.56, 3.0)
        axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
        axes.set_aspect("equal")


def _each(flown: Sequence[tuple[str, Array, Array]], views: SectionViews, units: UnitSystem) -> Figure:
    """A panel for each level: its landing points and ellipse before those of all others."""
    distance = display_unit("carry_m", units)
    rows = -(-len(flown) // _COLUMNS)
    figure = styled(0.35 + 1.55 * rows)
    grid: np.ndarray[Any, Any] = figure.subplots(rows, _COLUMNS, sharex=True, sharey=True, squeeze=False)
    ellipses = {ellipse.name: ellipse for ellipse in views.dispersion}
    every = np.concatenate([points for _, points, _ in flown]) / distance.size
    corners = [_corners(ellipse) / distance.size for ellipse in views.dispersion]
    for index, axes in enumerate(grid.ravel()):
        if index >= len(flown):
            axes.set_visible(False)
            continue
        name, points, _ = flown[index]
        style = _look(index, len(every) > _MANY) | {"markersize": 3.0}
        axes.plot(*every.T, ".", color="#d1d5db", markersize=1.5, rasterized=True)
        axes.plot(*distance.of(points).T, **style)
        title = name
        if name in ellipses:
            _draw_ellipse(axes, ellipses[name], style["color"], distance.size)
            title += f": {ellipses[name].area / distance.size**2:.0f} {distance.unit}²"
        _from_above(axes, np.concatenate([every, *corners]))
        axes.set_title(title, fontsize=7.5)
        axes.tick_params(labelsize=6.5)
    figure.supxlabel(f"offline, {distance.unit}", fontsize=7.5)
    figure.supylabel(f"carry, {distance.unit}", fontsize=7.5)
    return figure


def _levels(
    plan: CampaignPlan, shots: Sequence[Shot], analysis: SectionAnalysis, units: UnitSystem
) -> Figure:
    """Each level's shots with mean and interval, its scatter with interval, and the club speed delivered."""
    unit, name = display_unit(plan.analysis.quantity, units), NAMES[plan.analysis.quantity]
    fast, found = display_unit("club_speed_mps", units), _by_level(plan, shots)
    figure = styled(1.0 + 0.32 * max(len(found), 2))
    result, scatter, club = figure.subplots(1, 3, sharey=True, width_ratios=[1.6, 0.9, 1])
    many = len(shots) > _MANY
    bar = {"color": _INK, "marker": "|", "markersize": 12, "capsize": 4, "linewidth": 1.4}
    for index, (_, mine) in enumerate(found):
        style = _look(index, many) | {"markersize": 2.5}
        _, values = values_of(plan, mine)
        result.plot(unit.of(values), np.full(len(values), index) + _spread_out(len(values)), **style)
        s = analysis.levels[index].spread
        if s.n >= 2:
            reach = [[unit.of(s.mean) - unit.of(s.low)], [unit.of(s.high) - unit.of(s.mean)]]
            result.errorbar([unit.of(s.mean)], [index], xerr=reach, **bar)
            sides = [[s.deviation - s.deviation_low], [s.deviation_high - s.deviation]]
            scatter.errorbar(
                [s.deviation / unit.size],
                [index],
                xerr=np.array(sides) / unit.size,
                **bar | {"marker": style["marker"], "markersize": 4, "color": style["color"]},
            )
        speeds = [
            fast.of(s.club_speed_mps) for s in mine if s.club_speed_mps and s.status is ShotStatus.VALID
        ]
        club.plot(speeds, np.full(len(speeds), index) + _spread_out(len(speeds)), **style)
    result.set_yticks(range(len(found)), [level for level, _ in found])
    result.set_ylim(len(found) - 0.4, -0.6)
    level = f"{100 * plan.analysis.confidence:g} % interval"
    result.set(title=f"{name.capitalize()}: mean and {level}", xlabel=f"{name}, {unit.unit}")
    scatter.set(title="SD of one shot", xlabel=unit.unit)
    scatter.set_xlim(left=0)
    club.set(title="Club speed delivered", xlabel=fast.unit)
    return figure


def _spread_out(count: int) -> np.ndarray:
    """Return offsets that keep like points apart, the same each time."""
    steps = (np.arange(count) * 0.6180339887) % 1.0
    return 0.5 * (steps - 0.5)


def _drift(plan: CampaignPlan, shots: Sequence[Shot], analysis: SectionAnalysis, units: UnitSystem) -> Figure:
    """The compared quantity over the shots less its level's mean, and the control ball's drift."""
    unit, name = display_unit(plan.analysis.quantity, units), NAMES[plan.analysis.quantity]
    figure = styled(2.5)
    axes = figure.subplots()
    many = len(shots) > _MANY
    for index, (_, mine) in enumerate(_by_level(plan, shots)):
        kept, values = values_of(plan, mine)
        if len(values):
            axes.plot([s.shot for s in kept], (values - values.mean()) / unit.size, **_look(index, many))
    kept, values = values_of(plan, [shot for shot in shots if shot.role == Role.CONTROL])
    if len(values) > 1:
        number, off = np.array([s.shot for s in kept], dtype=float), (values - values.mean()) / unit.size
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
        if (fit := analysis.confirmatory) is not None and fit.drift is not None:
            line = fit.drift * (number - number.mean()) / unit.size
            axes.plot(number, line, color=_INK, label="drift as removed")
        axes.legend(loc="upper right", ncols=2)
    for shot, _ in analysis.outliers:
        axes.axvline(shot, color=_RED, linewidth=0.6, alpha=0.5)
    axes.axhline(0, color=_GREY, linewidth=0.8)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(
        title=f"Drift: {name} less the level's mean, in the order played", xlabel="shot", ylabel=unit.unit
    )
    return figure


def _delivery(shots: Sequence[Shot], units: UnitSystem) -> Figure:
    """The delivery over the campaign: valid and other shots."""
    figure = styled(3.4)
    grid: np.ndarray[Any, Any] = figure.subplots(2, 2, sharex=True)
    names = {column: text for column, text, _, _ in FIGURES}
    keys = list(dict.fromkeys((s.swing, s.club) for s in shots))
    many = len(shots) > _MANY
    for axes, column in zip(grid.ravel(), _DELIVERY, strict=True):
        unit = display_unit(column, units)
        for index, key in enumerate(keys):
            mine = [s for s in shots if (s.swing, s.club) == key and getattr(s, column) is not None]
            for valid in (True, False):
                some = [s for s in mine if (s.status is ShotStatus.VALID) is valid]
                _points(axes, some, column, _look(index, many), unit, filled=valid)
        axes.set(title=names[column], ylabel=unit.unit)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    for axes in grid[1]:
        axes.set_xlabel("shot")
    return figure


def _points(
    axes: Axes, shots: Sequence[Shot], column: str, style: dict[str, Any], unit: DisplayUnit, *, filled: bool
) -> None:
    look = style | {"markersize": 2.0} if filled else style | {"markerfacecolor": "none", "color": _RED}
    axes.plot([s.shot for s in shots], [unit.of(getattr(s, column)) for s in shots], **look)


def _control(views: SectionViews, units: UnitSystem) -> Figure:
    """The control charts: values in order with one, two and three standard deviations, signals marked."""
    charts = views.control_charts
    figure = styled(1.9 * len(charts) + 0.2)
    grid: np.ndarray[Any, Any] = figure.subplots(len(charts), 1, sharex=True, squeeze=False)
    for axes, chart in zip(grid.ravel(), charts, strict=True):
        unit, many = display_unit(chart.column, units), len(chart.values) > _MANY
        values = unit.of(np.array(chart.values))
        centre, step = unit.of(chart.centre), chart.deviation / unit.size
        for times, line in ((1, (0, (1, 3))), (2, (0, (4, 3))), (3, "solid")):
            for sign in (-1, 1):
                colour = _RED if times == 3 else _GREY
                axes.axhline(centre + sign * times * step, color=colour, linewidth=0.7, linestyle=line)
        axes.axhline(centre, color=_GREY, linewidth=0.8)
        joined = "none" if many else "-"
        axes.plot(
            chart.shots,
            values,
            color=_INK,
            marker="x",
            markersize=2.0 if many else 3.5,
            linestyle=joined,
            linewidth=0.6,
            rasterized=many,
        )
        _mark_signals(axes, chart, dict(zip(chart.shots, values, strict=True)))
        axes.set(title=f"Control ball: {QUANTITY_NAMES[chart.column]}", ylabel=unit.unit)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    grid[-1, 0].set_xlabel("shot")
    return figure


def _mark_signals(axes: Axes, chart: ControlChart, values: Mapping[int, float]) -> None:
    """Ring the shots that end a pattern and number their rules."""
    rules: dict[int, list[str]] = {}
    for signal in chart.signals:
        for shot in signal.shots:
            rules.setdefault(shot, []).append(str(signal.rule))
    shots = sorted(rules)
    axes.plot(
        shots,
        [values[shot] for shot in shots],
        color=_RED,
        marker="o",
        markersize=6,
        markerfacecolor="none",
        linestyle="none",
        rasterized=len(shots) > _MANY // 10,
    )
    for shot in shots[:_NAMED]:
        at, words = (shot, values[shot]), ",".join(rules[shot])
        axes.annotate(words, at, (0, 5), textcoords="offset points", ha="center", fontsize=6, color=_RED)


_NAMED = 40
"""Max number of signals whose rules are written into a chart; all are in the list beside it."""


def _draw_ellipse(axes: Axes, ellipse: DispersionEllipse, colour: str, size: float) -> Array:
    """Draw the ellipse in units of `size` (m); return the corners of its box, m."""
    centre = ellipse.centre[0] / size, ellipse.centre[1] / size
    width, height = ellipse.short_axis / size, ellipse.long_axis / size
    turn = -float(np.degrees(ellipse.tilt))
    for style in ({"fill": False, "edgecolor": colour}, {"color": colour, "alpha": 0.07}):
        line = 1.0 if "edgecolor" in style else 0.0
        axes.add_patch(Ellipse(centre, width, height, angle=turn, linewidth=line, **style))
    return _corners(ellipse)


def _corners(ellipse: DispersionEllipse) -> Array:
    """Return two opposite corners, (2, 2), of the box around an ellipse, m."""
    factor = 5.991464547107979  # 95 % quantile of chi-square with two degrees of freedom
    reach = np.sqrt(factor * np.array([ellipse.covariance[0], ellipse.covariance[2]]))
    return np.array([ellipse.centre - reach, ellipse.centre + reach])
