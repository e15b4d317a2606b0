"""The report of a campaign from its stored shots: one self-contained HTML file."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import zip_longest
from math import inf
from typing import Any

from matplotlib.figure import Figure

from bench.campaign.interruptions import software_versions
from bench.campaign.plan.carry import measured_of
from bench.campaign.plan.plan import NAMES, levels
from bench.campaign.report._budget import BudgetLine, UncertaintyBudget, uncertainty_budgets
from bench.campaign.report._campaign_plots import campaign_figures
from bench.campaign.report._conformity import DECISION_RULE
from bench.campaign.report.campaign_record import (
    ISSUE,
    NO_DATA,
    SHOT_DIGITS,
    CampaignRecord,
    Digests,
    reasons_by_hand,
    record_digests,
)
from bench.campaign.report.findings import (
    QUANTITIES,
    Findings,
    RankedLevel,
    SectionFindings,
    as_flown,
    findings,
    findings_record,
    not_compared,
)
from bench.campaign.report.report_format import (
    BALL,
    CLUB,
    DisplayUnit,
    UnitSystem,
    display_unit,
    flat,
    number_text,
    page_template,
    shot_figures,
    two_digits,
)
from bench.campaign.report.report_tables import (
    STATEMENT,
    EquipmentTable,
    ball_table,
    calibration_table,
    carry_words,
    club_table,
    golfer_table,
    item_table,
    particulars,
    used_configuration,
)
from bench.campaign.report.verdicts import confidence_words, quantity_name
from bench.campaign.statistics.analysis import Level
from bench.campaign.statistics.control_chart import MIN_VALUES, NELSON
from bench.records.shot.plot_style import marker_svg, to_svg
from bench.records.shot.shot import Shot, ShotStatus
from bench.store.rows import (
    CampaignEntry,
    CampaignState,
    Hit,
    Prompt,
    PromptKind,
    ShotExclusion,
    ShotNote,
    Standing,
)

_ALL_ROWS = 1000
"""Max number of shots with a row each; above it only those not valid or flagged have one."""
_MAX_ROWS = 1000
"""Max number of shots in the table."""
_MAX_LINES = 200
"""Max number of events, and of lines of manual work."""

LIMITS = (
    "Comparisons use valid shots only. The bench excludes a shot for its delivery or a fault, never for "
    "where its ball went; a person only with name and reason.",
    "Intervals are for normal scatter, of each level its own; a ball's hits belong together, so that a model "
    "is judged by its balls, blocks are fixed. The plan fixed quantity, margin and analysis before the first "
    "shot.",
    "The drift correction is linear within a block, from the control ball and all others together; what "
    "differs between blocks is taken out by the blocks.",
    "In a tilted swing plane attack angle and club path are coupled, and the two strike figures are "
    "projections of one in-plane number; they are not independent measurements.",
)


def render_campaign_report(
    record: CampaignRecord, found: Findings, units: UnitSystem = UnitSystem.SI, worn: Figure | None = None
) -> str:
    """Return the report as HTML, all figures in `units`, as the sentences of `found` are.

    The same record gives the same bytes. `worn` is the chart of the robot's worn parts.

    Raises:
        ValueError: there are no shots.
    """
    if not record.shots:
        raise ValueError("a report needs at least one shot")
    plan, entry, shots = record.plan, record.entry, record.shots
    template = page_template(_filters(display_unit(plan.analysis.quantity, units), units))
    times = [shot.time_utc for shot in shots]
    compared = quantity_name(as_flown(plan, shots))
    return template.render(
        **_signed_part(record, found, units),
        **_lists(record, found, units),
        title=entry.title,
        entry=entry,
        plan=plan,
        found=found,
        first=min(times),
        last=max(times),
        time_format="%H:%M:%S" if _one_day(record) else "%Y-%m-%d %H:%M:%S",
        facts=_facts(record, units),
        standing_words=_standing_words(record.standing),
        figures=campaign_figures(plan, shots, found, units),
        marker=marker_svg,
        quantities=QUANTITIES,
        names=NAMES,
        places={name: place for place, name in enumerate(levels(plan))},
        ranked=_ranked,
        open_questions=list(not_compared(plan, found.differences, compared)),
        alone=sum(len(section.verdicts) for section in found.sections) == 1,
        units=units,
        column_unit=lambda column: display_unit(column, units).unit,
        nelson=NELSON,
        least_controls=MIN_VALUES,
        quantity=compared,
        carry=carry_words(shots),
        roles=_roles(shots),
        unit=display_unit(plan.analysis.quantity, units).unit,
        confidence=f"{100 * plan.analysis.confidence:g}",
        decision_rule=DECISION_RULE,
        reasons=_reasons(found),
        many_clubs=len(plan.design.clubs) > 1,
        many_swings=len(plan.design.swings) > 1,
        sources=_sources(shots),
        limits=_limits(record, units),
        wear=_wear(record.hits),
        worn="" if worn is None else to_svg(worn, "worn"),
        plan_entries=flat({"plan": _plan_shown(entry)}),
        configuration=flat(used_configuration(entry, plan)),
        equipment=_equipment(record, units),
    )


def _signed_part(record: CampaignRecord, found: Findings, units: UnitSystem) -> dict[str, Any]:
    digests, calibrations = record_digests(record), calibration_table(record)
    budgets = uncertainty_budgets(
        record.plan, record.shots, record.entry.calibrations, simulated=record.entry.simulated
    )
    return {
        "number": record.number,
        "issued": bool(record.issues),
        "particulars": particulars(record, digests.whole),
        "particular_tables": (item_table(record), calibrations),
        "overdue": calibrations.overdue,
        "statement": STATEMENT,
        "budgets": budgets,
        "contributions": _contributions(budgets),
        "data": _page_data(record, found, units, digests),
    }


def _lists(record: CampaignRecord, found: Findings, units: UnitSystem) -> dict[str, Any]:
    """Return the variables of long lists, with their number where they are cut."""
    listed, handwork = _listed(record, found), _handwork(record.prompts)
    events = [event for event in record.events if event.kind != ISSUE]
    return {
        "notes": _notes(record.notes),
        "by_hand": len(reasons_by_hand(record.exclusions)),
        "exclusions": _exclusions(record),
        "counted": _counted(record, found, units),
        "events": events[:_MAX_LINES],
        "more_events": max(0, len(events) - _MAX_LINES),
        "handwork": handwork[:_MAX_LINES],
        "more_handwork": max(0, len(handwork) - _MAX_LINES),
        "table": list(zip_longest(CLUB.items(), BALL.items())),
        "all_rows": len(record.shots) <= _ALL_ROWS,
        "listed": len(listed),
        "rows": [
            (shot, list(zip_longest(shot_figures(shot, CLUB, units), shot_figures(shot, BALL, units))))
            for shot in listed[:_MAX_ROWS]
        ],
    }


def _filters(compared: DisplayUnit, units: UnitSystem) -> dict[str, Callable[..., Any]]:
    """Return the filters of the page's template; filters of numbers use the record's values."""

    def number(value: float, digits: int = 2) -> str:
        return number_text(compared.of(value), digits)

    def signed(value: float, digits: int = 2) -> str:
        return number_text(compared.of(value), digits, signed=True)

    def column(value: float, name: str, more: int = 1) -> str:
        return display_unit(name, units).text(value, more)

    return {
        "number": number,
        "signed": signed,
        "plan_size": lambda value: f"{compared.of(value):.4g}",
        "column": column,
        "width": lambda value, name, more=1: number_text(
            value / display_unit(name, units).size, display_unit(name, units).digits + more
        ),
        "two": lambda value, name: two_digits(value / display_unit(name, units).size),
        "derivative": lambda line, name: two_digits(
            line.sensitivity * display_unit(line.input, units).size / display_unit(name, units).size
        ),
        "area": lambda value: number_text(value / display_unit("carry_m", units).size ** 2, 1),
        "level": confidence_words,
        "chance": _chance,
        "plain": lambda value: number_text(value, 2),
        "zip": zip,
    }


def _page_data(record: CampaignRecord, found: Findings, units: UnitSystem, digests: Digests) -> str:
    """Return the data that verify a page, as JSON that is safe within it."""
    data = {
        "schema": 1,
        "campaign": record.entry.id,
        "number": record.number,
        "issue": len(record.issues),
        "units": str(units),
        "looks": found.looks,
        "software": software_versions()["source"],
        "digest": digests.whole,
        "parts": digests.parts,
        "shots": "".join(digest[:SHOT_DIGITS] for digest in digests.shots),
        "figures": findings_record(found),
    }
    return json.dumps(data, separators=(",", ":")).replace("&", "\\u0026").replace("<", "\\u003c")


def _contributions(budgets: Sequence[UncertaintyBudget]) -> list[tuple[UncertaintyBudget, BudgetLine]]:
    """Return the contributions of type B of each section's first level that has them, by quantity."""
    seen: set[tuple[int, str]] = set()
    found = []
    for budget in budgets:
        lines = [line for line in budget.lines if line.kind == "B"]
        if lines and (budget.section, budget.column) not in seen:
            seen.add((budget.section, budget.column))
            found += [(budget, line) for line in lines]
    return found


def _listed(record: CampaignRecord, found: Findings) -> list[Shot]:
    """Return all shots of a short campaign, or the invalid, outlying and noted ones of a long one."""
    if len(record.shots) <= _ALL_ROWS:
        return list(record.shots)
    flagged = {shot for section in found.sections for shot, _ in section.analysis.outliers}
    flagged |= {note.shot for note in record.notes}
    return [s for s in record.shots if s.status is not ShotStatus.VALID or s.shot in flagged]


def _notes(notes: Sequence[ShotNote]) -> dict[int, str]:
    found: dict[int, list[str]] = {}
    for note in notes:
        found.setdefault(note.shot, []).append(f"{note.text or 'marked'} ({note.by})")
    return {shot: "; ".join(texts) for shot, texts in found.items()}


def _exclusions(record: CampaignRecord) -> list[tuple[ShotExclusion, str, bool]]:
    """Return the exclusions by hand with the shot's ball, and whether results were evaluated earlier."""
    balls = {shot.shot: f"{shot.ball} #{shot.sample}" if shot.sample else shot.ball for shot in record.shots}
    looks = [event.date for event in record.events if event.kind in NO_DATA]
    end = len(record.shots) if record.standing.state is CampaignState.FINISHED else None  # a run ends with it
    return [
        (one, balls.get(one.shot, ""), one.after_shot == end or any(date <= one.date for date in looks))
        for one in record.exclusions
    ]


def _counted(record: CampaignRecord, found: Findings, units: UnitSystem) -> list[str]:
    """Return the headlines that change if shots excluded by hand count, as they would then read."""
    if not reasons_by_hand(record.exclusions):
        return []
    taken = findings(record.plan, record.shots_as_taken, found.looks, units)
    pairs = [
        (one, two)
        for mine, other in zip(found.sections, taken.sections, strict=True)
        for one, two in zip(mine.verdicts, other.verdicts, strict=True)
    ]
    return [two.headline for one, two in pairs if one.headline != two.headline]


def _one_day(record: CampaignRecord) -> bool:
    """Return whether all its shots and events are of one day; those of a simulation have their own."""
    days = {shot.time_utc.date() for shot in record.shots} | {
        event.date.date() for event in record.events if event.kind != ISSUE
    }
    return len(days) == 1


def _ranked(found: SectionFindings) -> list[tuple[Level, RankedLevel | None]]:
    """Return the levels in the order of their ranking, then those without one, then the control ball."""
    ranks, section = {one.name: one for one in found.ranking}, found.analysis
    order = sorted(section.levels, key=lambda level: ranks[level.name].rank if level.name in ranks else inf)
    control = [(section.control, None)] if section.control else []
    return [*((level, ranks.get(level.name)) for level in order), *control]


def _roles(shots: Sequence[Shot]) -> str:
    count = Counter(shot.role for shot in shots).most_common()
    return ", ".join(f"{number} {role}" for role, number in count) if len(count) > 1 else ""


def _facts(record: CampaignRecord, units: UnitSystem) -> list[tuple[str, str]]:
    entry, plan, air = record.entry, record.plan, air_words(record.shots, units)
    handling = plan.ball_handling
    warm = display_unit("air_temperature_k", units)
    tolerance = handling.temperature_tolerance / warm.size
    golfers = dict.fromkeys(one["golfer"] for one in entry.golfers.values())
    return [
        ("Campaign", entry.id),
        ("Bench", f"{entry.bench}{', simulated' if entry.simulated else ''}"),
        ("Begun", f"{entry.date:%Y-%m-%d %H:%M} UTC"),
        ("Seed", str(entry.seed)),
        ("Plan", entry.digest),
        ("Ball models", ", ".join(plan.ball_names)),
        ("Clubs", ", ".join(plan.design.clubs)),
        ("Swings", ", ".join(plan.design.swings)),
        *([("Golfer", ", ".join(golfers))] if golfers else []),
        ("Air", air or "not measured"),
        (
            "Balls",
            f"at most {handling.samples} of each, from no. {handling.first_sample}, {handling.hits} hits; "
            f"{warm.of(handling.temperature):.0f} ± {tolerance:.2g} {warm.unit} for "
            f"{handling.conditioning_time / 3600:g} h ({_conditioned(record)})",
        ),
    ]


def _plan_shown(entry: CampaignEntry) -> dict[str, Any]:
    """Return the plan without balls and clubs, which have tables; on hardware without the simulation."""
    left_out = {"balls", "clubs"} if entry.simulated else {"balls", "clubs", "simulation"}
    return {key: value for key, value in entry.plan.items() if key not in left_out}


def _equipment(record: CampaignRecord, units: UnitSystem) -> list[EquipmentTable]:
    entry = record.entry
    measured = measured_of(entry.calibrations, f"campaign {entry.id}")
    return [
        ball_table(record.plan, measured, simulated=entry.simulated, units=units),
        club_table(record.plan, units),
        *([golfer_table(entry.golfers, units)] if entry.golfers else []),
    ]


def air_words(shots: Sequence[Shot], units: UnitSystem) -> str:
    """Return the ranges of the air's figures over the `shots`; empty if none was measured."""
    words = []
    for column in ("air_temperature_k", "air_pressure_pa", "relative_humidity"):
        values, unit = (
            [v for s in shots if (v := getattr(s, column)) is not None],
            display_unit(column, units),
        )
        if values:
            low, high = unit.text(min(values)), unit.text(max(values))
            words.append(f"{low}{'' if low == high else f' to {high}'} {unit.unit}")
    return ", ".join(words)


def _conditioned(record: CampaignRecord) -> str:
    people = dict.fromkeys(p.by for p in record.prompts if p.kind == PromptKind.BALLS and p.by)
    if record.entry.simulated:
        return "as planned; simulated balls have no temperature"
    return f"confirmed by {', '.join(people)}" if people else "as planned, not confirmed"


def _handwork(prompts: Sequence[Prompt]) -> list[str]:
    """Return the manual work; that done by the simulation as a number only."""
    by_itself = Counter(prompt.kind for prompt in prompts if prompt.by == "simulation")
    words = [f"{number} times {kind}: done by the simulation itself" for kind, number in by_itself.items()]
    for prompt in prompts:
        if prompt.by != "simulation":
            done = f"{prompt.by}, {prompt.answered:%H:%M:%S}" if prompt.answered else "not done yet"
            words.append(f"before shot {prompt.before_shot}, {prompt.asked:%H:%M:%S}: {prompt.text} {done}")
    return words


def _standing_words(standing: Standing) -> str:
    if standing.state is CampaignState.FINISHED:
        return f"Ended early by its own rule: {standing.reason}." if standing.reason else ""
    reason = f" ({standing.reason})" if standing.reason else ""
    return f"This campaign is not finished: {standing.state}{reason}. These are the results so far."


def _reasons(found: Findings) -> list[tuple[str, int]]:
    total: Counter[str] = Counter()
    for section in (one.analysis for one in found.sections):
        for level in (*section.levels, *((section.control,) if section.control else ())):
            total.update(level.reasons)
    return total.most_common()


def _limits(record: CampaignRecord, units: UnitSystem) -> list[str]:
    limits = list(LIMITS)
    s, fast = record.plan.simulation, display_unit("ball_speed_mps", units)
    far = display_unit("carry_m", units)
    monitor = (
        f"launch monitor {fast.of(s.ball_speed):.2g} {fast.unit}, spin {s.spin_rpm:g} rpm, carry "
        f"{far.of(s.carry):.2g} {far.unit}"
    )
    differ = "From shot to shot differ (standard deviations, assumptions):"
    scatter = (
        f"restitution {100 * s.restitution:g} % from hit to hit and {100 * s.sample:g} % from ball to ball, "
        f"{monitor}."
    )
    if record.entry.simulated:
        in_real_time = (
            "The robot swung in real time, with its actual scatter. The ball's result was computed from the "
            "delivery measured by the encoders; the robot hit its configuration's ball. "
            f"{differ} {scatter}"
        )
        in_lock_step = (
            f"{differ} supply pressure {100 * s.supply:g} %, {scatter} Each swing begins from the same armed "
            "instant: the robot's own scatter from swing to swing is not in it."
        )
        limits[:0] = [
            "Every figure is simulated: robot, air, impact, flight and launch monitor are models. They show "
            "the behaviour of models, not of balls.",
            in_real_time if record.entry.real_time else in_lock_step,
        ]
    if errors := [e for shot in record.shots if (e := shot.carry_measured_error_m) is not None]:
        limits.append(
            "Measured carry has a standard uncertainty from its coefficients, common to all shots of a ball: "
            f"{far.of(min(errors)):.2f} to {far.of(max(errors)):.2f} {far.unit}. It is in the "
            "differences of balls and in the rules' decisions, not in the intervals of means; more shots do "
            "not reduce it."
        )
    if record.plan.stop.rule != "fixed":
        limits.append(
            f"The plan's rule looks at the data up to {record.plan.stop.interim_analyses} times. Each look, "
            "of the rule or of a person, has its share of the error (alpha spending like O'Brien and "
            "Fleming's), so that all together keep the confidence."
        )
    return limits


def _wear(hits: Counter[Hit]) -> list[tuple[str, str]]:
    total: dict[tuple[str, str], list[int]] = {}
    for hit, number in sorted(hits.items()):
        total.setdefault((hit.kind, hit.name), []).append(number)
    return [
        (
            f"{kind} {name}",
            f"{sum(n)} hits" + (f", a ball at most {max(n)}" if kind == "ball" else "")
            if kind != "valve"
            else f"{sum(n)} swings",
        )
        for (kind, name), n in total.items()
    ]


def _sources(shots: Sequence[Shot]) -> list[tuple[str, str]]:
    return [
        (
            what,
            ", ".join(dict.fromkeys(s for shot in shots if (s := getattr(shot, f"{what}_source")))) or "none",
        )
        for what in ("delivery", "launch", "carry", "flight")
    ]


def _chance(p: float) -> str:
    return "< 0.0001" if p < 0.0001 else f"{p:.4f}" if p < 0.01 else f"{p:.2f}"
