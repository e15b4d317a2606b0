"""The report of a series: one HTML file that needs nothing else, for the screen and for paper."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np
from scipy import stats

from bench.campaign.comparison import Verdict, compare, verdict
from bench.campaign.report_plots import YARD, Look, all_figures
from bench.shot.shot import Shot, Status
from bench.shot.shot_record import ShotRecord
from bench.telemetry.whole_file import whole_file
from sim.ball import Ball
from sim.plant import Site
from sim.robot import RobotParameters

MPH = 0.44704

LIMITS = (
    "Comparisons use valid shots only. A shot is excluded for its delivery or a fault, never for where its "
    "ball went; every shot is in the table below.",
    "Intervals are Welch's, for independent shots with normal scatter; with more than two balls they are "
    "widened (Bonferroni) so that they hold together. Drift over the series is not corrected.",
    "In a tilted swing plane attack angle and club path are coupled, and the two strike figures are "
    "projections of one in-plane number; they are not independent measurements.",
    "Each figure's source is given in the shot table. Figures marked simulated come from models and show "
    "what the model does, not what a ball does; carry is always for the stated air and ground.",
)
"""What holds for every report; a series adds its own."""


@dataclass(frozen=True)
class Setup:
    """What a series was done with; printed as it is given."""

    title: str
    robot: RobotParameters
    site: Site
    ball: Ball = field(default_factory=Ball)
    """A ball for the drawing's scale."""
    facts: Mapping[str, str] = field(default_factory=dict)
    """Short facts for the head of the report: series, profile, seed, air, operator."""
    versions: Mapping[str, str] = field(default_factory=dict)
    configuration: Mapping[str, Any] = field(default_factory=dict)
    """Effective configuration, nested as in the file."""
    assumptions: Sequence[str] = ()
    """Limits and assumptions of this series, beside the general ones."""
    wished_yd: float = 1.0
    """Difference in carry that the series would like to resolve."""


class Quantity(NamedTuple):
    """One measured figure as reports show it."""

    name: str
    unit: str
    digits: int
    value: Callable[[Shot], float | None]


def _column(name: str, scale: float = 1.0) -> Callable[[Shot], float | None]:
    """Return a function that reads one column of a shot, divided by `scale`."""

    def value(shot: Shot) -> float | None:
        found: float | None = getattr(shot, name)
        return None if found is None else found / scale

    return value


SUMMARY = (
    Quantity("Club speed", "mph", 2, _column("club_speed_mps", MPH)),
    Quantity("Ball speed", "mph", 2, _column("ball_speed_mps", MPH)),
    Quantity("Launch angle", "°", 2, _column("launch_angle_deg")),
    Quantity("Spin", "rpm", 0, _column("spin_rpm")),
    Quantity("Carry", "yd", 2, _column("carry_m", YARD)),
    Quantity("Total", "yd", 2, _column("total_m", YARD)),
)

ROBOT = (
    Quantity("Club speed", "m/s", 3, _column("club_speed_mps")),
    Quantity("Attack angle", "°", 3, _column("attack_angle_deg")),
    Quantity("Club path", "°", 3, _column("club_path_deg")),
    Quantity("Face angle", "°", 3, _column("face_angle_deg")),
    Quantity("Dynamic loft (shaft lean)", "°", 3, _column("dynamic_loft_deg")),
    Quantity("Strike, heel–toe", "mm", 2, _column("strike_x_mm")),
    Quantity("Strike, low–high", "mm", 2, _column("strike_y_mm")),
)

TABLE = (
    Quantity("club", "mph", 1, _column("club_speed_mps", MPH)),
    Quantity("attack", "°", 2, _column("attack_angle_deg")),
    Quantity("path", "°", 2, _column("club_path_deg")),
    Quantity("face", "°", 2, _column("face_angle_deg")),
    Quantity("loft", "°", 2, _column("dynamic_loft_deg")),
    Quantity("strike x", "mm", 1, _column("strike_x_mm")),
    Quantity("strike y", "mm", 1, _column("strike_y_mm")),
    Quantity("ball", "mph", 1, _column("ball_speed_mps", MPH)),
    Quantity("launch", "°", 2, _column("launch_angle_deg")),
    Quantity("direction", "°", 2, _column("direction_deg")),
    Quantity("spin", "rpm", 0, _column("spin_rpm")),
    Quantity("axis", "°", 2, _column("spin_axis_deg")),
    Quantity("carry", "yd", 1, _column("carry_m", YARD)),
    Quantity("total", "yd", 1, _column("total_m", YARD)),
    Quantity("apex", "yd", 1, _column("apex_m", YARD)),
    Quantity("landing", "°", 1, _column("landing_angle_deg")),
)


class Spread(NamedTuple):
    """Mean and standard deviation of a figure, written out; "–" where there is nothing to say."""

    mean: str
    deviation: str
    interval: str = "–"
    """95 % confidence interval of the standard deviation."""
    span: str = "–"


class BallSummary(NamedTuple):
    """One ball's row of the summary."""

    name: str
    colour: str
    hit: int
    valid: int
    excluded: int
    spreads: list[Spread]


def write_report(path: Path, records: Sequence[ShotRecord], setup: Setup) -> None:
    """Write the report of `records` to `path`, whole or not at all; the same input gives the same bytes.

    The file loads nothing: no script, no font, no picture from elsewhere, and forbids it to the browser.
    Raises BenchError when it cannot be stored and ValueError when there are no records.
    """
    text = render_report(records, setup)
    with whole_file(path) as stream:
        stream.write(text.encode())


def render_report(records: Sequence[ShotRecord], setup: Setup) -> str:
    """Return the report of `records` as HTML."""
    if not records:
        raise ValueError("a report needs at least one shot")
    valid = [record.shot for record in records if record.valid]
    shown = _typical(records)
    look = Look(records)
    template = page_template("report.html.j2")
    times = [record.shot.time_utc for record in records]
    return template.render(
        title=setup.title,
        setup=setup,
        first=min(times),
        last=max(times),
        verdicts=verdicts(valid, setup.wished_yd),
        robot_words=robot_words(valid),
        balls=[_ball_summary(ball, look.colour(ball), records) for ball in look.balls],
        summary=SUMMARY,
        robot=[(quantity, _spread(quantity, valid)) for quantity in ROBOT],
        table=TABLE,
        rows=[(record.shot, [figure_text(q, q.value(record.shot)) for q in TABLE]) for record in records],
        colour=look.colour,
        count={status: sum(record.shot.status is status for record in records) for status in Status},
        shown=shown.shot if shown else None,
        figures=all_figures(records, shown, setup.robot, setup.site, setup.ball.radius),
        configuration=flat(setup.configuration),
        sources=_sources(records),
        limits=(*setup.assumptions, *LIMITS),
    )


def page_template(name: str, filters: Mapping[str, Callable[..., Any]] | None = None) -> jinja2.Template:
    """Return a page of this package, with `filters` of its own; what is not defined in it is an error."""
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(
            lambda wanted: (files("bench.campaign") / wanted).read_text(encoding="utf-8")
        ),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(filters or {})
    return environment.get_template(name)


def verdicts(valid: Sequence[Shot], wished_yd: float = 1.0) -> list[Verdict]:
    """Compare the balls' carries over `valid` shots, in words; `wished_yd` is a difference worth finding."""
    carries: dict[str, list[float]] = {}
    for shot in valid:
        if shot.carry_m is not None:
            carries.setdefault(shot.ball, []).append(shot.carry_m / YARD)
    differences = compare(carries)
    if differences:
        return [verdict(difference, "carry", "yd", wished_yd) for difference in differences]
    if len(carries) < 2:
        return [Verdict(False, "One ball only: nothing to compare.", "The figures below describe it.")]
    return [
        Verdict(False, "Too few valid shots to compare the balls.", "At least two of each ball are needed.")
    ]


def robot_words(valid: Sequence[Shot]) -> str:
    """Say in one sentence how repeatable the robot was."""
    speeds = _values(ROBOT[0], valid)
    if len(speeds) < 2:
        return "Fewer than two valid shots: the robot's repeatability is not known."
    mean, deviation = float(np.mean(speeds)), float(np.std(speeds, ddof=1))
    relative = 100 * deviation / mean
    return (
        f"The robot delivered {mean:.2f} m/s ({mean / MPH:.1f} mph) of club speed with a standard "
        f"deviation of {deviation:.3f} m/s ({relative:.2f} %) over {len(speeds)} valid shots."
    )


def _ball_summary(ball: str, colour: str, records: Sequence[ShotRecord]) -> BallSummary:
    """Count and average one ball's shots."""
    shots = [record.shot for record in records if record.shot.ball == ball]
    valid = [shot for shot in shots if shot.status is Status.VALID]
    excluded = sum(shot.status is Status.EXCLUDED for shot in shots)
    return BallSummary(
        ball, colour, len(valid) + excluded, len(valid), excluded, [_spread(q, valid) for q in SUMMARY]
    )


def _values(quantity: Quantity, shots: Sequence[Shot]) -> list[float]:
    return [value for shot in shots if (value := quantity.value(shot)) is not None]


def _spread(quantity: Quantity, shots: Sequence[Shot]) -> Spread:
    """Return mean, standard deviation with its 95 % interval (chi-square) and range."""
    values = np.array(_values(quantity, shots))
    if not len(values):
        return Spread("–", "–")
    mean = figure_text(quantity, float(values.mean()))
    if len(values) < 2:
        return Spread(mean, "–")
    digits = quantity.digits
    deviation, freedom = float(values.std(ddof=1)), len(values) - 1
    low, high = deviation * np.sqrt(freedom / stats.chi2.ppf([0.975, 0.025], freedom))
    span = f"{figure_text(quantity, float(values.min()))} … {figure_text(quantity, float(values.max()))}"
    return Spread(mean, f"{deviation:.{digits}f}", f"{low:.{digits}f} … {high:.{digits}f}", span)


def figure_text(quantity: Quantity, value: float | None) -> str:
    """Write a figure with the quantity's digits and a real minus sign."""
    if value is None:
        return "–"
    text = f"{value:.{quantity.digits}f}"
    return (text.removeprefix("-") if float(text) == 0 else text).replace("-", "−")


def _typical(records: Sequence[ShotRecord]) -> ShotRecord | None:
    """Return the swing to draw against time: the valid one with the median club speed, else the first."""
    speeds = [(r.shot.club_speed_mps, n) for n, r in enumerate(records) if r.valid and r.shot.club_speed_mps]
    if speeds:
        return records[sorted(speeds)[(len(speeds) - 1) // 2][1]]
    return next((record for record in records if len(record.cycles) > 1), None)


def flat(configuration: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return the configuration as titled groups of (key, value as text)."""
    groups: dict[str, list[tuple[str, str]]] = {}

    def visit(prefix: str, value: object) -> None:
        if isinstance(value, Mapping) and value:
            for key, inner in value.items():
                visit(f"{prefix}.{key}" if prefix else str(key), inner)
        else:
            group, _, key = prefix.rpartition(".")
            groups.setdefault(group, []).append((key, _text(value)))

    visit("", configuration)
    return list(groups.items())


def _text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)


def _sources(records: Sequence[ShotRecord]) -> list[tuple[str, str]]:
    """Return where delivery, launch and carry come from."""
    return [
        (
            what,
            ", ".join(dict.fromkeys(s for r in records if (s := getattr(r.shot, f"{what}_source"))))
            or "none",
        )
        for what in ("delivery", "launch", "carry")
    ]
