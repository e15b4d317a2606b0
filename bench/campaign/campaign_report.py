"""The report of a campaign from its stored shots: one self-contained HTML file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

from bench.campaign.analysis import Comparison, Pair, SectionAnalysis
from bench.campaign.campaign_plots import campaign_figures
from bench.campaign.carry import measured_of
from bench.campaign.equipment import (
    EquipmentTable,
    ball_table,
    carry_words,
    club_table,
    without_simulated_balls,
)
from bench.campaign.findings import Findings, as_flown
from bench.campaign.fitting import PromptKind
from bench.campaign.mixed_model import MixedModel
from bench.campaign.page import TABLE, figure_text, flat, page_template
from bench.campaign.plan import CampaignPlan
from bench.campaign.plan_file import plan_from_record
from bench.campaign.preview import UNITS
from bench.campaign.ruling import DECISION_RULE
from bench.campaign.verdicts import confidence_words, quantity_name
from bench.shot.plot_style import COLOURS
from bench.shot.shot import Shot, ShotStatus
from bench.store.campaigns import (
    CampaignEntry,
    CampaignState,
    CampaignStore,
    Event,
    Hit,
    Prompt,
    ShotNote,
    Standing,
)
from bench.telemetry.whole_file import whole_file

_ALL_ROWS = 1000
"""Max number of shots with a row each; of more, only those not valid or flagged."""
_MAX_ROWS = 1000
"""Max number of shots in the table."""
_MAX_LINES = 200
"""Max number of events, and of lines of manual work."""

LIMITS = (
    "Comparisons use valid shots only. A shot is excluded for its delivery or a fault, never for where its "
    "ball went.",
    "Intervals are for normal scatter, of each level its own; a ball's hits belong together, so that a model "
    "is judged by its balls, blocks are fixed. The plan fixed quantity, margin and analysis before the first "
    "shot.",
    "The drift correction is linear within a block, from the control ball and all others together; what "
    "differs between blocks is taken out by the blocks.",
    "In a tilted swing plane attack angle and club path are coupled, and the two strike figures are "
    "projections of one in-plane number; they are not independent measurements.",
)


@dataclass(frozen=True)
class CampaignRecord:
    """A campaign as stored in the database."""

    entry: CampaignEntry
    standing: Standing
    plan: CampaignPlan
    shots: Sequence[Shot]
    events: Sequence[Event]
    hits: Counter[Hit]
    prompts: Sequence[Prompt] = ()
    notes: Sequence[ShotNote] = ()


def load_record(store: CampaignStore, entry: CampaignEntry) -> CampaignRecord:
    """Return a campaign with all its data in the database."""
    return CampaignRecord(
        entry,
        store.standing(entry.id),
        plan_from_record(entry.plan, f"campaign {entry.id}"),
        [stored.shot for stored in store.shots(entry.id)],
        store.events(entry.id),
        store.hits(entry.hit_scope),
        store.prompts(entry.id),
        store.notes(entry.id),
    )


def write_campaign_report(path: Path, record: CampaignRecord, found: Findings) -> None:
    """Write the report to `path`, whole or not at all; the same record gives the same bytes.

    Raises:
        BenchError: it cannot be stored.
        ValueError: there are no shots.
    """
    text = render_campaign_report(record, found)
    with whole_file(path) as stream:
        stream.write(text.encode())


def render_campaign_report(record: CampaignRecord, found: Findings) -> str:
    """Return the report as HTML."""
    if not record.shots:
        raise ValueError("a report needs at least one shot")
    plan, entry, shots = record.plan, record.entry, record.shots
    listed, handwork = _listed(record, found), _handwork(record.prompts)
    filters: dict[str, Callable[..., Any]] = {
        "number": _number,
        "signed": _signed,
        "level": confidence_words,
        "chance": _chance,
        "digits": _digits,
        "zip": zip,
    }
    template = page_template("campaign.html.j2", filters)
    times = [shot.time_utc for shot in shots]
    return template.render(
        title=entry.title,
        entry=entry,
        plan=plan,
        found=found,
        first=min(times),
        last=max(times),
        notes=_notes(record.notes),
        time_format="%H:%M:%S" if _one_day(record) else "%Y-%m-%d %H:%M:%S",
        facts=_facts(record),
        standing_words=_standing_words(record.standing),
        figures=campaign_figures(plan, shots, found.sections),
        colours=COLOURS,
        quantity=quantity_name(as_flown(plan, shots)),
        unit=UNITS[plan.analysis.quantity],
        confidence=f"{100 * plan.analysis.confidence:g}",
        beside=_beside,
        decision_rule=DECISION_RULE,
        mixed_words=_mixed,
        reasons=_reasons(found),
        events=record.events[:_MAX_LINES],
        more_events=max(0, len(record.events) - _MAX_LINES),
        handwork=handwork[:_MAX_LINES],
        more_handwork=max(0, len(handwork) - _MAX_LINES),
        table=TABLE,
        all_rows=len(shots) <= _ALL_ROWS,
        listed=len(listed),
        rows=[(shot, [figure_text(q, q.value(shot)) for q in TABLE]) for shot in listed[:_MAX_ROWS]],
        many_clubs=len(plan.design.clubs) > 1,
        many_swings=len(plan.design.swings) > 1,
        sources=_sources(shots),
        limits=_limits(record),
        wear=_wear(record.hits),
        plan_entries=flat({"plan": _plan_shown(entry)}),
        configuration=flat(
            entry.configuration if entry.simulated else without_simulated_balls(entry.configuration)
        ),
        equipment=_equipment(record),
    )


def _listed(record: CampaignRecord, found: Findings) -> list[Shot]:
    """Return all shots of a short campaign; of a long one those that are invalid, outliers or noted."""
    if len(record.shots) <= _ALL_ROWS:
        return list(record.shots)
    flagged = {shot for section in found.sections for shot, _ in section.outliers}
    flagged |= {note.shot for note in record.notes}
    return [s for s in record.shots if s.status is not ShotStatus.VALID or s.shot in flagged]


def _notes(notes: Sequence[ShotNote]) -> dict[int, str]:
    """Return the marks and comments by shot."""
    found: dict[int, list[str]] = {}
    for note in notes:
        found.setdefault(note.shot, []).append(f"{note.text or 'marked'} ({note.by})")
    return {shot: "; ".join(texts) for shot, texts in found.items()}


def _one_day(record: CampaignRecord) -> bool:
    """Return whether all its shots and events are of one day; those of a simulation have their own."""
    days = {shot.time_utc.date() for shot in record.shots} | {event.date.date() for event in record.events}
    return len(days) == 1


def _facts(record: CampaignRecord) -> list[tuple[str, str]]:
    entry, plan = record.entry, record.plan
    air = (
        _range([s.air_temperature_k - 273.15 for s in record.shots if s.air_temperature_k], 1, "°C"),
        _range([s.air_pressure_pa / 100 for s in record.shots if s.air_pressure_pa], 0, "hPa"),
        _range([100 * s.relative_humidity for s in record.shots if s.relative_humidity is not None], 0, "%"),
    )
    handling = plan.ball_handling
    return [
        ("Campaign", entry.id),
        ("Bench", f"{entry.bench}{', simulated' if entry.simulated else ''}"),
        ("Begun", f"{entry.date:%Y-%m-%d %H:%M} UTC"),
        ("Seed", str(entry.seed)),
        ("Plan", entry.digest),
        ("Carry", carry_words(record.shots) or "none"),
        ("Clubs", ", ".join(plan.design.clubs)),
        ("Swings", ", ".join(plan.design.swings)),
        ("Air", ", ".join(filter(None, air)) or "not measured"),
        (
            "Balls",
            f"{handling.samples} of each from no. {handling.first_sample}, at most {handling.hits} hits; "
            f"{handling.temperature - 273.15:.0f} ± {handling.temperature_tolerance:g} °C for "
            f"{handling.conditioning_time / 3600:g} h ({_conditioned(record)})",
        ),
    ]


def _plan_shown(entry: CampaignEntry) -> dict[str, Any]:
    """Return the plan without balls and clubs, which have tables; on hardware without the simulation."""
    left_out = {"balls", "clubs"} if entry.simulated else {"balls", "clubs", "simulation"}
    return {key: value for key, value in entry.plan.items() if key not in left_out}


def _equipment(record: CampaignRecord) -> list[EquipmentTable]:
    entry = record.entry
    measured = measured_of(entry.calibrations, f"campaign {entry.id}")
    return [ball_table(record.plan, measured, simulated=entry.simulated), club_table(record.plan)]


def _range(values: Sequence[float], digits: int, unit: str) -> str:
    """Return the range of a figure over the campaign; empty if it was not measured."""
    if not values:
        return ""
    low, high = (f"{value:.{digits}f}" for value in (min(values), max(values)))
    return f"{low}{'' if low == high else f' to {high}'} {unit}"


def _conditioned(record: CampaignRecord) -> str:
    """Return who confirmed the conditioning of the balls."""
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
    """Return a notice if the campaign is incomplete."""
    if standing.state is CampaignState.FINISHED:
        return f"Ended early by its own rule: {standing.reason}." if standing.reason else ""
    reason = f" ({standing.reason})" if standing.reason else ""
    return f"This campaign is not finished: {standing.state}{reason}. What follows is what was found so far."


def _beside(section: SectionAnalysis, pair: Pair) -> str:
    other = _same_pair(section.beside, pair)
    return "–" if other is None else _signed(other.difference)


def _same_pair(comparison: Comparison | None, pair: Pair) -> Pair | None:
    pairs = comparison.pairs if comparison else ()
    return next((p for p in pairs if (p.first, p.second) == (pair.first, pair.second)), None)


def _mixed(model: MixedModel, pair: Pair) -> str:
    found = (p for p in model.pairs if (p.first, p.second) == (pair.first, pair.second))
    other = next(found, None)
    return "–" if other is None else f"{_signed(other.low)} … {_signed(other.high)}"


def _reasons(found: Findings) -> list[tuple[str, int]]:
    total: Counter[str] = Counter()
    for section in found.sections:
        for level in (*section.levels, *((section.control,) if section.control else ())):
            total.update(level.reasons)
    return total.most_common()


def _limits(record: CampaignRecord) -> list[str]:
    limits = list(LIMITS)
    s = record.plan.simulation
    if record.entry.simulated and record.entry.real_time:
        limits[:0] = [
            "Every figure is simulated: robot, air, impact, flight and launch monitor are models. They show "
            "what the models do, not what balls do.",
            "The robot swung in real time and its scatter is its own. What the ball does was computed from "
            "the delivery measured by the encoders; on the robot acted its own configuration's ball. From "
            f"shot to shot differ (standard deviations, assumptions): restitution {100 * s.restitution:g} % "
            f"from hit to hit and {100 * s.sample:g} % from ball to ball, launch monitor {s.ball_speed:g} "
            f"m/s, spin {s.spin_rpm:g} rpm, carry {s.carry:g} m.",
        ]
    elif record.entry.simulated:
        limits[:0] = [
            "Every figure is simulated: robot, air, impact, flight and launch monitor are models. They show "
            "what the models do, not what balls do.",
            f"From shot to shot differ (standard deviations, assumptions): supply pressure "
            f"{100 * s.supply:g} %, restitution {100 * s.restitution:g} % from hit to hit and "
            f"{100 * s.sample:g} % from ball to ball, launch monitor {s.ball_speed:g} m/s, spin "
            f"{s.spin_rpm:g} rpm, carry {s.carry:g} m. Each swing begins from the same armed instant: the "
            "robot's own scatter from swing to swing is not in it.",
        ]
    if errors := [e for shot in record.shots if (e := shot.carry_measured_error_m) is not None]:
        limits.append(
            "Measured carry has a standard uncertainty from its coefficients, common to all shots of a ball: "
            f"{min(errors):.2f} to {max(errors):.2f} m. It is in the differences of balls and in the "
            "rules' decisions, not in the intervals of means; more shots do not reduce it."
        )
    if record.plan.stop.rule != "fixed":
        limits.append(
            f"The plan's rule looks at the data up to {record.plan.stop.looks} times. Each look, of the rule "
            "or of a person, has its share of the error (alpha spending like O'Brien and Fleming's), so that "
            "all together keep the confidence."
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


def _number(value: float) -> str:
    return f"{value:.2f}".replace("-", "−") if isfinite(value) else "–"


def _signed(value: float) -> str:
    return f"{value:+.2f}".replace("-", "−") if isfinite(value) else "–"


def _digits(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".replace("-", "−") if isfinite(value) else "–"


def _chance(p: float) -> str:
    return "< 0.0001" if p < 0.0001 else f"{p:.4f}" if p < 0.01 else f"{p:.2f}"
