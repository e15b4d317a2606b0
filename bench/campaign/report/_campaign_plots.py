"""The plots of a campaign's report, as inline SVG; clouds of many points are pictures inside it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import MaxNLocator

from bench.campaign.plan.plan import NAMES, CampaignPlan
from bench.campaign.plan.shot_sequence import Role, tests_by_level
from bench.campaign.report.findings import DifferenceTable, Findings, SectionFindings
from bench.campaign.report.report_format import DisplayUnit, UnitSystem, display_unit
from bench.campaign.statistics.analysis import SectionAnalysis, values_of
from bench.campaign.statistics.block_model import Array
from bench.campaign.statistics.control_chart import ControlChart, DispersionEllipse
from bench.records.shot.plot_style import STYLE, colour_of, marker_of, styled, to_svg
from bench.records.shot.shot import Shot, ShotStatus

_INK, _GREY, _RED = "#1a1a1a", "#6b7280", "#b91c1c"
_CROSSES: dict[str, Any] = {"color": _INK, "marker": "x"}
_MANY = 1500
"""Number of points from which a cloud is drawn as a bitmap."""
_DELIVERY = ("club_speed_mps", "attack_angle_deg", "dynamic_loft_deg", "strike_x_mm")


class Picture(NamedTuple):
    """A drawn figure with the text that belongs to it."""

    svg: str
    label: str
    """Text in place of the picture."""
    caption: str


class Landing(NamedTuple):
    """Landing points of a section."""

    section: SectionFindings
    levels: Sequence[tuple[str, Array, Array]]
    """(level, valid points, other points), each (n, 2) offline and carry, m."""


def campaign_figures(
    plan: CampaignPlan, shots: Sequence[Shot], found: Findings, units: UnitSystem = UnitSystem.SI
) -> Mapping[str, Any]:
    """Return the pictures "overview" and "delivery", and per section "results", "control" and "drift".

    The overview shows the differences from three levels on, else the landing points; None without any.
    """
    forest = next((table for table in found.differences if len(table.columns[0].compared) > 2), None)
    with mpl.rc_context(STYLE):
        drawn, landings = [], []
        for section in found.sections:
            number = section.analysis.number
            mine = [shot for shot in shots if shot.section == number and shot.role != Role.WARM_UP]
            landings.append(Landing(section, _landing_points(plan, mine)))
            drawn.append(_section_pictures(plan, mine, landings[-1], units))
        overview = None
        if forest is not None:
            overview = _forest(plan, forest, units)
        elif len(landings) == 1 and any(len(points) for _, points, _ in landings[0].levels):
            overview = drawn[0]["results"].pop(1)
        elif len(landings) > 1:
            overview = _dispersion(plan, landings, shots, units, "overview")
        return {"overview": overview, "sections": drawn, "delivery": _delivery(shots, units)}


def _picture(figure: Figure, name: str, label: str, captions: Mapping[str, object]) -> Picture:
    """Return the picture with those `captions` whose value is true."""
    return Picture(to_svg(figure, name), label, " ".join(text for text, told in captions.items() if told))


def _panels(height: float, count: int, width: int, *, shared: bool = False) -> tuple[Figure, list[Axes]]:
    """Return a figure with `count` panels in rows of `width`, and its panels."""
    figure = styled(height)
    grid: np.ndarray[Any, Any] = figure.subplots(
        -(-count // width), width, sharex=shared, sharey=shared, squeeze=False
    )
    for axes in grid.ravel()[count:]:
        axes.set_visible(False)
    return figure, list(grid.ravel()[:count])


def _section_pictures(
    plan: CampaignPlan, mine: Sequence[Shot], landing: Landing, units: UnitSystem
) -> dict[str, Any]:
    analysis, charts = landing.section.analysis, landing.section.control_charts
    name = f"s{analysis.number}"
    results = [
        _levels(plan, mine, analysis, units, f"{name}l"),
        _dispersion(plan, [landing], mine, units, f"{name}d"),
    ]
    if len(landing.levels) > _FEW:
        results.append(_each(landing, units, f"{name}e"))
    return {
        "results": results,
        "drift": _drift(plan, mine, analysis, units, f"{name}t"),
        "control": _control(charts, units, f"{name}c") if charts else None,
    }


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


_FEW = 4
"""Max number of levels that one picture of landing points keeps apart."""
_COLUMNS = 5
"""Panels side by side."""
_PANELS = 3
"""Panels of differences side by side."""
_PAIRED = (("ball_speed_mps", "carry_m"), ("launch_angle_deg", "spin_rpm"))
"""Columns of shots that are drawn against each other, across and up."""


def _landing_points(plan: CampaignPlan, shots: Sequence[Shot]) -> list[tuple[str, Array, Array]]:
    """Return each level's landing points of valid and of other shots, (n, 2): offline, carry, m."""
    found = []
    for name, mine in tests_by_level(plan, shots).items():
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


def _dispersion(
    plan: CampaignPlan, landings: Sequence[Landing], shots: Sequence[Shot], units: UnitSystem, name: str
) -> Picture:
    """Landing points of each section from above; a single section also has two pairs of figures."""
    alone, many = len(landings) == 1, len(shots) > _MANY
    width = 1 + len(_PAIRED) if alone else min(len(landings), _COLUMNS)
    rows = -(-len(landings) // width)
    figure, panels = _panels(
        0.4 + (2.3 if width < 4 else 1.9) * rows, width if alone else len(landings), width
    )
    distance = display_unit("carry_m", units)
    for axes, landing in zip(panels, landings, strict=False):
        _draw_landing(axes, landing, distance, many)
    if alone:
        for axes, columns in zip(panels[1:], _PAIRED, strict=True):
            _draw_pairs(axes, tests_by_level(plan, shots).values(), columns, units, many)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=10, fontsize=7)
    pairs = ", carry against ball speed, and spin against launch angle" if alone else ""
    captions = {
        "Dashed: target line.": True,
        "Filled: valid shots; open: not valid.": any(
            len(others) for one in landings for _, _, others in one.levels
        ),
        "Ellipse: holds 95 % of a normal scatter with the mean and covariance seen.": any(
            one.section.dispersion for one in landings
        ),
    }
    return _picture(figure, name, f"Landing points from above{pairs}.", captions)


def _draw_pairs(
    axes: Axes,
    by_level: Iterable[Sequence[Shot]],
    columns: tuple[str, str],
    units: UnitSystem,
    many: bool,
) -> None:
    x, y = (display_unit(column, units) for column in columns)
    for index, mine in enumerate(by_level):
        valid = [shot for shot in mine if shot.status is ShotStatus.VALID]
        rows = [row for shot in valid if None not in (row := [getattr(shot, column) for column in columns])]
        points = np.array(rows, dtype=float).reshape(-1, 2).T
        axes.plot(x.of(points[0]), y.of(points[1]), **_look(index, many))
    across, up = (NAMES[column] for column in columns)
    axes.set(title=f"{up} against {across}".capitalize())
    axes.set(xlabel=f"{across}, {x.unit}", ylabel=f"{up}, {y.unit}")


def _draw_landing(axes: Axes, landing: Landing, distance: DisplayUnit, many: bool) -> None:
    ellipses = {ellipse.name: ellipse for ellipse in landing.section.dispersion}
    extent: list[Array] = []
    for index, (name, points, others) in enumerate(landing.levels):
        style = _look(index, many)
        if len(landing.levels) > _FEW:
            style |= {"markersize": 2.5, "alpha": 0.5}
        axes.plot(*distance.of(points).T, **style, label=name)
        axes.plot(*distance.of(others).T, **{**style, "markerfacecolor": "none"})
        extent += [points, others]
        if name in ellipses:
            extent.append(_draw_ellipse(axes, ellipses[name], style["color"], distance.size))
    _from_above(axes, np.concatenate(extent) / distance.size)
    title = landing.section.label or "Landing points from above"
    axes.set(title=title, xlabel=f"left  ←  offline, {distance.unit}  →  right")
    axes.set_ylabel(f"carry, {distance.unit}")


def _forest(plan: CampaignPlan, table: DifferenceTable, units: UnitSystem) -> Picture:
    """Each level's difference to the reference with its interval, a panel per column of the table."""
    unit, name = display_unit(plan.analysis.quantity, units), NAMES[plan.analysis.quantity]
    places = [n for n, one in enumerate(table.columns[0].compared) if one.level.name != table.reference]
    rows, width = -(-len(table.columns) // _PANELS), min(len(table.columns), _PANELS)
    figure, panels = _panels((0.75 + 0.19 * len(places)) * rows, len(table.columns), width, shared=True)
    for axes, column in zip(panels, table.columns, strict=True):
        axes.axvline(0, color=_INK, linewidth=0.8)
        if plan.analysis.equivalence_margin:
            margin = plan.analysis.equivalence_margin / unit.size
            axes.axvspan(-margin, margin, color=_GREY, alpha=0.12, linewidth=0)
        for row, place in enumerate(places):
            pair = column.compared[place].pair
            if pair is None:
                continue
            middle = pair.difference / unit.size
            low, high = pair.low_together / unit.size, pair.high_together / unit.size
            reach = [[middle - low], [high - middle]]
            style: dict[str, Any] = {"color": colour_of(place), "marker": marker_of(place), "capsize": 3}
            if pair.verdict not in {"different", "both"}:
                style["markerfacecolor"] = "white"
            axes.errorbar([middle], [row], xerr=reach, markersize=5, **style)
        axes.set_yticks(range(len(places)), [column.compared[place].level.name for place in places])
        axes.set_ylim(len(places) - 0.4, -0.6)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.set_title(column.name or f"Difference to {table.reference} in {name}, {unit.unit}")
    if table.across:
        figure.supxlabel(f"difference to {table.reference} in {name}, {unit.unit}", fontsize=8)
    label = f"Differences of all {table.factor}s to {table.reference} with their intervals."
    captions = {
        f"Difference to {table.reference} with its interval, all pairs of a panel simultaneously.": True,
        "Filled: declared different; open: not.": True,
        "Grey band: the margin within which they count as the same.": plan.analysis.equivalence_margin,
    }
    return _picture(figure, "overview", label, captions)


def _from_above(axes: Axes, points: Array) -> None:
    """Show all `points` (n, 2) at one scale in both directions, with the target line."""
    axes.axvline(0, color=_GREY, linewidth=0.8, linestyle=(0, (5, 3)))
    if len(points):
        low, high = points.min(axis=0), points.max(axis=0)
        middle, half = (low + high) / 2, max(float((high - low).max()) * 0.56, 3.0)
        axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
        axes.set_aspect("equal")


def _each(landing: Landing, units: UnitSystem, picture: str) -> Picture:
    """A panel for each level: its landing points and ellipse before those of all others."""
    flown, dispersion = landing.levels, landing.section.dispersion
    distance = display_unit("carry_m", units)
    rows = -(-len(flown) // _COLUMNS)
    figure, panels = _panels(0.35 + 1.55 * rows, len(flown), _COLUMNS, shared=True)
    ellipses = {ellipse.name: ellipse for ellipse in dispersion}
    every = np.concatenate([points for _, points, _ in flown]) / distance.size
    corners = [_corners(ellipse) / distance.size for ellipse in dispersion]
    for index, (axes, (name, points, _)) in enumerate(zip(panels, flown, strict=True)):
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
    area = ", with the area of its ellipse" if ellipses else ""
    caption = f"Each level before all others (grey){area}. The dashed line is the target line."
    label = "Landing points of each level before those of all others."
    return _picture(figure, picture, label, {caption: True})


def _levels(
    plan: CampaignPlan, shots: Sequence[Shot], analysis: SectionAnalysis, units: UnitSystem, picture: str
) -> Picture:
    """Each level's shots with mean and interval, its scatter with interval, and the club speed delivered."""
    unit, name = display_unit(plan.analysis.quantity, units), NAMES[plan.analysis.quantity]
    fast, found = display_unit("club_speed_mps", units), tests_by_level(plan, shots)
    figure = styled(0.8 + 0.24 * max(len(found), 2))
    result, scatter, club = figure.subplots(1, 3, sharey=True, width_ratios=[1.6, 0.9, 1])
    many = len(shots) > _MANY
    bar = {"color": _INK, "marker": "|", "markersize": 12, "capsize": 4, "linewidth": 1.4}
    for index, mine in enumerate(found.values()):
        style = _look(index, many) | {"markersize": 2.5}
        _, values = values_of(plan, mine)
        result.plot(unit.of(values), np.full(len(values), index) + _spread_out(len(values)), **style)
        s = analysis.levels[index].spread
        if s.n >= 2:
            reach = [[unit.of(s.mean) - unit.of(s.low)], [unit.of(s.high) - unit.of(s.mean)]]
            result.errorbar([unit.of(s.mean)], [index], xerr=reach, **bar)
            sides = [[s.sd - s.sd_low], [s.sd_high - s.sd]]
            scatter.errorbar(
                [s.sd / unit.size],
                [index],
                xerr=np.array(sides) / unit.size,
                **bar | {"marker": style["marker"], "markersize": 4, "color": style["color"]},
            )
        speeds = [
            fast.of(s.club_speed_mps) for s in mine if s.club_speed_mps and s.status is ShotStatus.VALID
        ]
        club.plot(speeds, np.full(len(speeds), index) + _spread_out(len(speeds)), **style)
    result.set_yticks(range(len(found)), list(found))
    result.set_ylim(len(found) - 0.4, -0.6)
    level = f"{100 * plan.analysis.confidence:g} % interval"
    result.set(title=f"{name.capitalize()}: mean and {level}", xlabel=f"{name}, {unit.unit}")
    scatter.set(title="SD of one shot", xlabel=unit.unit)
    scatter.set_xlim(left=0)
    club.set(title="Club speed delivered", xlabel=fast.unit)
    for axes, ticks in ((result, 6), (scatter, 4), (club, 4)):
        axes.xaxis.set_major_locator(MaxNLocator(ticks))
    bars = "Bars: mean and standard deviation of one shot, each with its interval."
    captions = {"Every valid shot.": True, bars: any(one.spread.n > 1 for one in analysis.levels)}
    label = "Each level's shots, its standard deviation, and the club speed delivered."
    return _picture(figure, picture, label, captions)


def _spread_out(count: int) -> np.ndarray:
    """Return offsets that keep like points apart, the same each time."""
    steps = (np.arange(count) * 0.6180339887) % 1.0
    return 0.5 * (steps - 0.5)


def _drift(
    plan: CampaignPlan, shots: Sequence[Shot], analysis: SectionAnalysis, units: UnitSystem, picture: str
) -> Picture:
    """The compared quantity over the shots less its level's mean, and the control ball's drift."""
    unit, name = display_unit(plan.analysis.quantity, units), NAMES[plan.analysis.quantity]
    figure = styled(1.4)
    axes = figure.subplots()
    many = len(shots) > _MANY
    for index, mine in enumerate(tests_by_level(plan, shots).values()):
        kept, values = values_of(plan, mine)
        if len(values):
            axes.plot([s.shot for s in kept], (values - values.mean()) / unit.size, **_look(index, many))
    kept, values = values_of(plan, [shot for shot in shots if shot.role == Role.CONTROL])
    if len(values) > 1:
        number, off = np.array([s.shot for s in kept], dtype=float), (values - values.mean()) / unit.size
        style = _CROSSES | {"markersize": 2.5 if many else 4, "linestyle": "none", "rasterized": many}
        axes.plot(number, off, **style, label="control ball")
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
    captions = {
        "Level means taken off.": True,
        "Crosses: control ball.": len(values) > 1,
        "Red lines: outliers (robust z above 3.5), which stay in the analysis.": analysis.outliers,
    }
    return _picture(figure, picture, "The compared quantity over the campaign.", captions)


def _delivery(shots: Sequence[Shot], units: UnitSystem) -> Picture:
    figure = styled(2.4)
    grid: np.ndarray[Any, Any] = figure.subplots(2, 2, sharex=True)
    keys = list(dict.fromkeys((s.swing, s.club) for s in shots))
    many = len(shots) > _MANY
    for axes, column in zip(grid.ravel(), _DELIVERY, strict=True):
        unit = display_unit(column, units)
        for index, key in enumerate(keys):
            mine = [s for s in shots if (s.swing, s.club) == key and getattr(s, column) is not None]
            for valid in (True, False):
                some = [s for s in mine if (s.status is ShotStatus.VALID) is valid]
                empty = {"markerfacecolor": "none", "color": _RED}
                style = _look(index, many) | ({"markersize": 2.0} if valid else empty)
                figures = [unit.of(getattr(s, column)) for s in some]
                axes.plot([s.shot for s in some], figures, **style)
        axes.set(title=NAMES[column].capitalize(), ylabel=unit.unit)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    for axes in grid[1]:
        axes.set_xlabel("shot")
    label = "Club speed, attack angle, dynamic loft and strike point of every shot."
    every = all(shot.status is ShotStatus.VALID for shot in shots)
    caption = "Valid shots." if every else "Filled: valid shots; red and open: not valid."
    return _picture(figure, "delivery", label, {caption: True})


def _control(charts: Sequence[ControlChart], units: UnitSystem, picture: str) -> Picture:
    """The control charts: values in order with one, two and three standard deviations, signals marked."""
    figure = styled(1.5 * len(charts) + 0.2)
    grid: np.ndarray[Any, Any] = figure.subplots(len(charts), 1, sharex=True, squeeze=False)
    for axes, chart in zip(grid.ravel(), charts, strict=True):
        unit, many = display_unit(chart.column, units), len(chart.values) > _MANY
        values = unit.of(np.array(chart.values))
        centre, step = unit.of(chart.centre), chart.sd / unit.size
        for times, line in ((1, (0, (1, 3))), (2, (0, (4, 3))), (3, "solid")):
            for sign in (-1, 1):
                colour = _RED if times == 3 else _GREY
                axes.axhline(centre + sign * times * step, color=colour, linewidth=0.7, linestyle=line)
        axes.axhline(centre, color=_GREY, linewidth=0.8)
        style = _CROSSES | {"markersize": 2.0 if many else 3.5, "linewidth": 0.6, "rasterized": many}
        axes.plot(chart.shots, values, **style, linestyle="none" if many else "-")
        _mark_signals(axes, chart, dict(zip(chart.shots, values, strict=True)))
        axes.set(title=f"Control ball: {NAMES[chart.column]}", ylabel=unit.unit)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    grid[-1, 0].set_xlabel("shot")
    captions = {
        "Values in order; lines: mean and one, two and three standard deviations by the moving range.": True,
        "Ringed: the last shot of a pattern, with the number of its rule.": any(c.signals for c in charts),
    }
    return _picture(figure, picture, "Control charts of the control ball.", captions)


def _mark_signals(axes: Axes, chart: ControlChart, values: Mapping[int, float]) -> None:
    rules: dict[int, list[str]] = {}
    for rule, found in chart.signals.items():
        for shot in found:
            rules.setdefault(shot, []).append(str(rule))
    shots = sorted(rules)
    ring: dict[str, Any] = {"marker": "o", "markersize": 6, "markerfacecolor": "none", "linestyle": "none"}
    ringed = [values[shot] for shot in shots]
    axes.plot(shots, ringed, color=_RED, rasterized=len(shots) > _MANY // 10, **ring)
    for shot in shots[:_NAMED]:
        at, words = (shot, values[shot]), ",".join(rules[shot])
        axes.annotate(words, at, (0, 5), textcoords="offset points", ha="center", fontsize=6, color=_RED)


_NAMED = 40
"""Max number of signals that a chart labels with their rules; the table counts all."""


def _draw_ellipse(axes: Axes, ellipse: DispersionEllipse, colour: str, size: float) -> Array:
    """Draw the ellipse in units of `size` (m); return the corners of its box, m."""
    centre = ellipse.centre[0] / size, ellipse.centre[1] / size
    width, height = ellipse.short_axis / size, ellipse.long_axis / size
    turn = -float(np.degrees(ellipse.tilt))
    edge = {"fill": False, "edgecolor": colour, "linewidth": 1.0}
    for style in (edge, {"color": colour, "alpha": 0.07, "linewidth": 0.0}):
        axes.add_patch(Ellipse(centre, width, height, angle=turn, **style))
    return _corners(ellipse)


def _corners(ellipse: DispersionEllipse) -> Array:
    """Return two opposite corners, (2, 2), of the box around an ellipse, m."""
    factor = 5.991464547107979  # 95 % quantile of chi-square with two degrees of freedom
    reach = np.sqrt(factor * np.array([ellipse.covariance[0], ellipse.covariance[2]]))
    return np.array([ellipse.centre - reach, ellipse.centre + reach])
