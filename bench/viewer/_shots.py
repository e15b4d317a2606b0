"""Shots as Rerun entities: flight, landing, dispersion and a table, one shot at a time.

The dispersion has its own plane: x to the right of the target line, y away from the target (so that
a longer shot is higher up), both in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil, floor
from typing import Any

import numpy as np
import rerun as rr

from bench.records.shot.shot import Shot, ShotRecord, ShotStatus
from bench.viewer._scene import COLOURS, Array, Colour, Scene
from sim.flight import Flight

_YARD, _MPH = 0.9144, 0.44704
_GRID = 5.0
"""Spacing of the dispersion grid, m."""
_LINE: Colour = (82, 90, 102)
_TEXT: Colour = (176, 184, 196)
_MIN_FOR_ELLIPSE = 3
_MAX_ROWS = 40
"""Max rows of the table; older shots are counted, not shown."""


class ShotSeries:
    """The shots logged so far into `scene`; one colour per ball."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.records: list[ShotRecord] = []
        """Their figures, without cycles and paths: a live view runs for days."""
        self._balls: dict[str, Colour] = {}
        self._flying: Array = np.zeros((0, 5))
        """Part of the last ball's flight that is not logged yet."""

    def log_shot(
        self, record: ShotRecord, start: float, struck: float | None, latest: float = np.inf
    ) -> float:
        """Log a shot from `start` with impact at `struck` (s; None without impact); return its end (s).

        Nothing is logged after `latest`: a live view computes the whole flight before the ball lands, and
        continues it with `advance`.
        """
        self.records.append(_figures_only(record))
        shown = end = start
        if struck is not None and record.flight is not None:
            end = struck + float(record.flight.path[-1, 0])
            shown = min(struck + record.flight.time, latest)
            self._log_flight(record.shot, record.flight, struck, shown)
            self._flying = _trajectory(record.flight.path, struck)
            near = self._flying[self._flying[:, 0] <= min(latest, struck + 1.0)]
            self._scene.log_ball(near[:, 0], self._scene.rest + near[:, 1:4] - near[0, 1:4])
            self.advance(latest)
            self._log_dispersion(self._scene.times(np.array([shown])))
        self._log_text(record.shot, start, struck)
        self.document("shots", min(shown, latest), shot_table(self.records))
        return end

    def advance(self, now: float) -> None:
        """Log the last ball on the range up to `now` (s); the line of its speed ends with its flight."""
        if not len(self._flying):
            return
        past = self._flying[:, 0] <= now
        flown, end, self._flying = self._flying[past], self._flying[-1:, 0], self._flying[~past]
        speed, times = "signals/ball_speed_mps", self._scene.times
        if len(flown):
            self._scene.scalars(speed, times(flown[:, 0]), flown[:, 4:])
            places = rr.Points3D.columns(positions=flown[:, 1:4])
            self._scene.recording.send_columns("range/ball", times(flown[:, 0]), places)
        if not len(self._flying):
            self._scene.scalars(speed, times(end + 1e-3), np.array([[np.nan]]))

    def document(self, entity: str, at: float, text: str) -> None:
        """Log `text` (Markdown) at one instant (s)."""
        words = rr.TextDocument.columns(text=[text], media_type=["text/markdown"])
        self._scene.recording.send_columns(entity, self._scene.times(np.array([at])), words)

    def _log_flight(self, shot: Shot, flight: Flight, struck: float, landed: float) -> None:
        path, times = flight.path, self._scene.times
        colour = self._balls.setdefault(shot.ball, COLOURS[len(self._balls) % len(COLOURS)])
        entity = f"range/shots/{shot.shot:03d}"
        number = [rr.TimeColumn("shot", sequence=[shot.shot])]
        sparse = np.unique(np.append(np.arange(0, len(path), 4), len(path) - 1))
        line = rr.LineStrips3D.columns(strips=[path[sparse, 1:]])
        style = rr.LineStrips3D.from_fields(colors=colour, radii=rr.Radius.ui_points(1.5))
        self._show(f"{entity}/path", times(np.array([struck])) + number, line, style)
        down = min(int(np.searchsorted(path[:, 0], flight.time)), len(path) - 1)
        point = rr.Points3D.columns(positions=path[down, 1:][None])
        dot = rr.Points3D.from_fields(colors=colour, radii=rr.Radius.ui_points(4.0))
        self._show(f"{entity}/landing", times(np.array([landed])) + number, point, dot)

    def _log_dispersion(self, now: list[rr.TimeColumn]) -> None:
        """Log the landing points of all valid shots, with two standard deviations per ball."""
        shots = [r for r in self.records if r.shot.status is not ShotStatus.FAILED]
        landed = [(r.shot, flight) for r in shots if (flight := r.flight) is not None]
        points = np.array([(flight.carry_side, _along(flight)) for _, flight in landed])
        corner, unit = self._log_grid(now, points)
        for location, (ball, colour) in enumerate(self._balls.items()):
            mine = points[[shot.ball == ball for shot, _ in landed]]
            numbers = [str(shot.shot) for shot, _ in landed if shot.ball == ball]
            if not len(mine):
                continue
            shown = mine * [1.0, -1.0]
            name = "".join(c if c.isalnum() or c in "-_." else "_" for c in ball) or "ball"
            entity = f"dispersion/{name}"
            dots = rr.Points2D.columns(positions=shown, labels=numbers).partition([len(shown)])
            self._show(f"{entity}/shots", now, dots, _dot(colour, 5.0, labels=False))
            key = corner + unit * np.array([0.5, 0.06 + 0.08 * location])
            words = rr.Points2D.columns(
                positions=[key], labels=[f"{ball}: {mine[:, 1].mean():.1f} m, {len(mine)} shots"]
            )
            self._show(f"{entity}/key", now, words, _dot(colour, 5.0, labels=True))
            if len(mine) >= _MIN_FOR_ELLIPSE:
                ellipse = rr.LineStrips2D.columns(strips=[_ellipse(shown)])
                line = rr.LineStrips2D.from_fields(colors=colour, radii=rr.Radius.ui_points(1.25))
                self._show(f"{entity}/two_sigma", now, ellipse, line)

    def _log_text(self, shot: Shot, start: float, struck: float | None) -> None:
        """Log the shot's figures: target values at its start, measured values after the impact."""
        title = f"**Shot {shot.shot}: {shot.ball}**\n" if shot.ball else f"**Shot {shot.shot}**\n"
        before, after = f"{title}\n{shot.club}, swinging", _figures(title, shot)
        at, texts = ([start], [after]) if struck is None else ([start, struck], [before, after])
        times = [*self._scene.times(np.array(at)), rr.TimeColumn("shot", sequence=[shot.shot] * len(at))]
        words = rr.TextDocument.columns(text=texts, media_type=["text/markdown"] * len(at))
        self._scene.recording.send_columns("shot", times, words)

    def _log_grid(self, now: list[rr.TimeColumn], points: Array) -> tuple[Array, float]:
        """Log a grid of metres around `points` (n, 2; right, along); return far left corner and length."""
        middle = points.mean(axis=0)
        reach = max(1.5 * _GRID, float(np.abs(points - middle).max()) + 0.5 * _GRID)
        left, right = (_GRID * f((middle[0] + s * reach) / _GRID) for f, s in ((floor, -1), (ceil, 1)))
        near, far = (_GRID * f((middle[1] + s * reach) / _GRID) for f, s in ((floor, -1), (ceil, 1)))
        across, along = np.arange(near, far + 1, _GRID), np.arange(left, right + 1, _GRID)
        lines = [[(left, -y), (right, -y)] for y in across] + [[(x, -near), (x, -far)] for x in along]
        strips = rr.LineStrips2D.columns(strips=lines).partition([len(lines)])
        style = rr.LineStrips2D.from_fields(colors=_LINE, radii=rr.Radius.ui_points(0.5), draw_order=-2.0)
        self._show("dispersion/grid", now, strips, style)
        marks = np.array([(left, -y) for y in across[1:-1]] + [(x, -near) for x in along[1::2]])
        words = [f"{y:.0f} m" for y in across[1:-1]]
        words += [f"{abs(x):.0f} m {'right' if x > 0 else 'left' if x < 0 else ''}" for x in along[1::2]]
        texts = rr.Points2D.columns(positions=marks, labels=words).partition([len(marks)])
        self._show("dispersion/marks", now, texts, _dot(_TEXT, 1.0, labels=True))
        return np.array([left, -far]), far - near

    def _show(self, entity: str, times: list[rr.TimeColumn], columns: Any, style: Any) -> None:
        self._scene.recording.send_columns(entity, times, columns)
        self._scene.recording.log(entity, style, static=True)


def _dot(colour: Colour, size: float, *, labels: bool) -> rr.Points2D:
    return rr.Points2D.from_fields(colors=colour, radii=rr.Radius.ui_points(size), show_labels=labels)


def _figures_only(record: ShotRecord) -> ShotRecord:
    """Return `record` without cycles and path; copies, because a view keeps the whole array."""
    flight = record.flight
    if flight is not None:
        flight = replace(flight, path=flight.path[:0].copy())
    return replace(record, cycles=record.cycles[:0].copy(), flight=flight)


def _trajectory(path: Array, struck: float) -> Array:
    """Return time (s), place from the impact (m) and speed (m/s) of a flight's `path` (n, 4) as (n, 5)."""
    moved = len(path) > 1
    speed = np.linalg.norm(np.gradient(path[:, 1:], path[:, 0], axis=0), axis=1) if moved else path[:, 0]
    return np.column_stack([struck + path[:, 0], path[:, 1:], speed])


def shot_table(records: Sequence[ShotRecord]) -> str:
    """Return the shots as a Markdown table, the newest last, and the means of each ball's valid ones."""
    lines = [
        "| # | ball | club m/s | attack ° | strike mm | ball m/s | launch ° | spin rpm | carry m | right m "
        "| total m | |",
        "|--:|:--|--:|--:|--:|--:|--:|--:|--:|--:|--:|:--|",
    ]
    for record in records[-_MAX_ROWS:]:
        shot, flight = record.shot, record.flight
        right = None if flight is None else flight.carry_side
        strike = f"{_cell(shot.strike_x_mm, '+.1f')} {_cell(shot.strike_y_mm, '+.1f')}"
        club = _cell(shot.club_speed_mps, ".2f"), _cell(shot.attack_angle_deg, "+.2f"), strike
        launch = _cell(shot.ball_speed_mps, ".2f"), _cell(shot.launch_angle_deg, ".1f")
        carry = _cell(shot.carry_m, ".1f"), _cell(right, "+.1f"), _cell(shot.total_m, ".1f")
        outcome = "" if shot.status is ShotStatus.VALID else f"{shot.status}: {shot.reason}"
        cells = str(shot.shot), shot.ball, *club, *launch, _cell(shot.spin_rpm, ".0f"), *carry, outcome
        lines.append(f"| {' | '.join(_plain(cell) for cell in cells)} |")
    means = _means(records)
    hidden = len(records) - _MAX_ROWS
    more = [f"- {hidden} earlier shots are not shown"] if hidden > 0 else []
    return "\n".join([*means, *more, "", *lines])


def _means(records: Sequence[ShotRecord]) -> list[str]:
    """Return one line per ball: mean and standard deviation of carry and club speed of its valid shots."""
    lines = []
    for ball in dict.fromkeys(record.shot.ball for record in records if record.valid):
        mine = [r.shot for r in records if r.valid and r.shot.ball == ball]
        figures = []
        for name, key, unit in (("carry", "carry_m", "m"), ("club", "club_speed_mps", "m/s")):
            values = [value for shot in mine if (value := getattr(shot, key)) is not None]
            if values:
                spread = f" ± {np.std(values, ddof=1):.2f}" if len(values) > 1 else ""
                figures.append(f"{name} {np.mean(values):.2f}{spread} {unit}")
        lines.append(f"- **{_plain(ball) or 'no ball'}**, {len(mine)} valid: {', '.join(figures)}")
    return lines


def _figures(title: str, shot: Shot) -> str:
    rows = [
        ("Club", shot.club_speed_mps, 1 / _MPH, "mph", 1),
        ("Attack", shot.attack_angle_deg, 1, "°", 2),
        ("Ball", shot.ball_speed_mps, 1 / _MPH, "mph", 1),
        ("Launch", shot.launch_angle_deg, 1, "°", 1),
        ("Spin", shot.spin_rpm, 1, "rpm", 0),
        ("Carry", shot.carry_m, 1 / _YARD, "yd", 1),
        ("Total", shot.total_m, 1 / _YARD, "yd", 1),
        ("Apex", shot.apex_m, 1 / _YARD, "yd", 1),
    ]
    cells = [
        f"{name} | {value * scale:.{digits}f} {unit}"
        for name, value, scale, unit, digits in rows
        if value is not None
    ]
    pairs = [f"| {' | '.join(cells[n : n + 2])} |" for n in range(0, len(cells), 2)]
    table = "\n".join([*pairs[:1], "|:--|--:|:--|--:|", *pairs[1:]]) if cells else ""
    sources = sorted({s for s in (shot.delivery_source, shot.launch_source, shot.carry_source) if s})
    outcome = f"{shot.status}{': ' + shot.reason if shot.reason else ''}"
    return f"{title}\n{table}\n\n{outcome}{'; ' if sources else ''}{', '.join(sources)}"


def _cell(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form).replace("-", "−")


def _plain(text: str) -> str:
    """Return `text` without characters that end a Markdown table cell."""
    return text.replace("|", "/").replace("\n", " ")


def _along(flight: Flight) -> float:
    """Return the carry along the target line, m; Flight.carry is the straight distance."""
    return float(np.sqrt(max(0.0, flight.carry**2 - flight.carry_side**2)))


def _ellipse(points: Array) -> Array:
    """Return two standard deviations about the mean of `points` (n, 2), (73, 2)."""
    mean = points.mean(axis=0)
    values, vectors = np.linalg.eigh(np.cov(points.T))
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    drawn: Array = mean + circle * 2.0 * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    return drawn
