"""Uncertainty budgets of club speed, ball speed, launch angle and carry (JCGM 100:2008, GUM).

Type A is the standard uncertainty of the mean from the series, its balls being random. Type B comes from the
calibrations in force: bench (encoder zeros, club length) and the instruments that the plan names.
Carry that is flown here inherits from launch and air by the flight model's derivatives. The expanded
uncertainty holds 95.45 % with Student's factor at the effective degrees of freedom (Welch and Satterthwaite).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from math import inf, pi, radians, sqrt
from typing import Any

import numpy as np
from scipy import stats

from bench.campaign.plan.plan import NAMES, CampaignPlan, stated_uncertainties
from bench.campaign.plan.shot_sequence import sections, tests_by_level
from bench.campaign.report._conformity import COVERAGE
from bench.campaign.statistics.block_model import independent_codes, mean_error
from bench.records.shot.shot import Shot, ShotStatus
from sim.ball import Air
from sim.flight import fly_many

BUDGETED = ("club_speed_mps", "ball_speed_mps", "launch_angle_deg", "carry_m")
_STATED_AS = {"launch_angle_deg": "launch_angle"}
"""Quantity of the plan by column."""
_FLOWN = frozenset({"reference", "measured", "simulated"})
"""Sources of a carry that is flown from the launch."""
_LAUNCH = {"ball_speed_mps": 0.1, "launch_angle": 0.1, "spin_rpm": 20.0}
_AIR = {"air_temperature_k": 0.5, "air_pressure_pa": 100.0, "relative_humidity": 0.05}
"""Inputs of a flight with the step of the derivative."""


@dataclass(frozen=True)
class BudgetLine:
    """One contribution to an uncertainty."""

    name: str
    kind: str
    """"A", from the series, or "B"."""
    source: str
    input: str
    """Quantity of the input, for its unit."""
    uncertainty: float
    """Standard uncertainty of the input, in its own unit."""
    sensitivity: float
    """Derivative of the quantity by the input."""
    contribution: float
    """Standard uncertainty of the quantity, its unit."""
    dof: float


@dataclass(frozen=True)
class UncertaintyBudget:
    """The mean of one quantity of one level with its uncertainty; SI, angles in degrees."""

    section: int
    level: str
    column: str
    shots: int
    mean: float
    lines: tuple[BudgetLine, ...]
    type_a: float
    type_b: float
    combined: float
    dof: float
    """Effective degrees of freedom."""
    coverage: float
    expanded: float | None
    """None where type B is not known."""
    missing: str
    """Reason for an unknown type B; empty if it is known."""


def uncertainty_budgets(
    plan: CampaignPlan, shots: Sequence[Shot], calibrations: Mapping[str, Any], *, simulated: bool
) -> tuple[UncertaintyBudget, ...]:
    """Return the budgets of each section's levels; `calibrations` are those that the campaign began with."""
    valid = [shot for shot in shots if shot.status is ShotStatus.VALID]
    found = []
    for section in sections(plan):
        mine = [shot for shot in valid if shot.section == section.number]
        for level, own in tests_by_level(plan, mine).items():
            for column in BUDGETED:
                known = [shot for shot in own if getattr(shot, column) is not None]
                if len(known) > 1:
                    lines = [] if simulated else list(_type_b(plan, known, column, calibrations))
                    found.append(_budget(plan, section.number, level, column, known, lines))
    return tuple(found)


def _budget(
    plan: CampaignPlan,
    section: int,
    level: str,
    column: str,
    shots: Sequence[Shot],
    found: Sequence[BudgetLine | str],
) -> UncertaintyBudget:
    """Return the budget of a level's `shots`; `found` is what `_type_b` found."""
    values = np.array([getattr(shot, column) for shot in shots], dtype=float)
    codes = np.unique(independent_codes(plan, shots), return_inverse=True)[1]
    error, dof = mean_error(values, codes)
    a = BudgetLine("scatter of the series", "A", f"{len(shots)} valid shots", column, error, 1.0, error, dof)
    lines = [a, *(line for line in found if isinstance(line, BudgetLine))]
    missing = ", ".join(dict.fromkeys(word for word in found if isinstance(word, str)))
    type_b = sqrt(sum(line.contribution**2 for line in lines if line.kind == "B"))
    combined = sqrt(error**2 + type_b**2)
    spread = sum(line.contribution**4 / line.dof for line in lines if line.contribution)
    effective = combined**4 / spread if spread else inf
    coverage = float(stats.t.ppf((1 + COVERAGE) / 2, effective))
    return UncertaintyBudget(
        section,
        level,
        column,
        len(shots),
        float(values.mean()),
        tuple(lines),
        error,
        type_b,
        combined,
        effective,
        coverage,
        None if missing else coverage * combined,
        missing,
    )


def _type_b(
    plan: CampaignPlan, shots: Sequence[Shot], column: str, calibrations: Mapping[str, Any]
) -> Iterator[BudgetLine | str]:
    """Yield the contributions of calibrations, and as text those that are missing."""
    quantity = _STATED_AS.get(column, column)
    sources = {shot.carry_source for shot in shots} if column == "carry_m" else set()
    if sources & _FLOWN:
        yield from _flown(plan, shots)
        if "measured" in sources:
            errors = [e for shot in shots if (e := shot.carry_measured_error_m) is not None]
            middle = float(np.mean(errors)) if errors else 0.0
            yield BudgetLine(
                "aerodynamics of the ball", "B", "measured flights", column, middle, 1.0, middle, inf
            )
        return
    if column == "club_speed_mps" and not {s.delivery_source for s in shots} - {"encoders+model"}:
        yield from _by_encoders(shots, calibrations)
        return
    if not (stated := stated_uncertainties(plan, quantity)):
        yield f"no calibration states {quantity}"
    for u, dof, source in stated:
        yield BudgetLine("instrument", "B", source, column, u, 1.0, u, dof)


def _by_encoders(shots: Sequence[Shot], calibrations: Mapping[str, Any]) -> Iterator[BudgetLine | str]:
    """Yield what club speed by encoders and model owes the bench's own calibrations."""
    bench = calibrations.get("bench", {})
    arms = {(shot.swing, shot.club) for shot in shots}
    mounts = [("club", club) for club in sorted({club for _, club in arms})]
    slopes = [one for one in bench.get("club_speed", ()) if (one["swing"], one["club"]) in arms]
    entries = {(one["kind"], one["subject"]): one for one in bench.get("in_force", ())}
    for name, unit, slope, key, places in (
        ("length of the club", "length_m", "length", "length_uncertainty", mounts),
        ("zeros of the encoders", "angle_rad", "zeros", "uncertainty", [("encoders", "")]),
    ):
        known = [entries[place] for place in places if place in entries]
        if len(known) < len(places) or not slopes:
            yield f"{name} not calibrated"
            continue
        most = max(known, key=lambda one: float(one["values"][key]))
        u, by = float(most["values"][key]), max(abs(float(one[slope])) for one in slopes)
        source = f"bench: {most['kind']} version {most['version']} of {most['date'][:10]}, {most['method']}"
        yield BudgetLine(name, "B", source, unit, u, by, u * by, inf)


def _flown(plan: CampaignPlan, shots: Sequence[Shot]) -> Iterator[BudgetLine | str]:
    """Yield the contributions of launch and air to a carry flown from the launch, or the missing input."""
    slopes = flight_slopes(shots)
    if not slopes:
        yield "launch not measured"
        return
    for name, slope in slopes.items():
        stated = stated_uncertainties(plan, name)
        if not stated and name != "relative_humidity":
            yield f"no calibration states {name}"
        for u, dof, source in stated:
            yield BudgetLine(NAMES[name], "B", source, name, u, slope, u * abs(slope), dof)


def flight_slopes(shots: Sequence[Shot]) -> dict[str, float]:
    """Return derivatives of the carry (m) at the mean launch by each input; empty without a launch.

    Flown with the reference ball: balls differ little in them.
    """
    names = ("ball_speed_mps", "launch_angle_deg", "spin_rpm")
    launched = [row for s in shots if None not in (row := tuple(getattr(s, name) for name in names))]
    if not launched:
        return {}
    at = dict(zip(_LAUNCH, np.mean(np.array(launched, dtype=float), axis=0), strict=True))
    for name, fallback in zip(_AIR, astuple(Air()), strict=True):
        values = [value for shot in shots if (value := getattr(shot, name)) is not None]
        at[name] = float(np.mean(values)) if values else fallback

    def carry(point: Mapping[str, float]) -> float:
        angle, spin = radians(point["launch_angle"]), point["spin_rpm"] * pi / 30
        launch = np.array([[point["ball_speed_mps"], angle, 0.0, spin, 0.0]])
        return float(fly_many(launch, Air(*(point[name] for name in _AIR)))["carry"][0])

    return {
        name: (carry(at | {name: at[name] + step}) - carry(at | {name: at[name] - step})) / (2 * step)
        for name, step in (_LAUNCH | _AIR).items()
        if name != "relative_humidity" or step <= at[name] <= 1 - step
    }
