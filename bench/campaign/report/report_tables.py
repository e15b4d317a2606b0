"""Balls, clubs and the statements of ISO/IEC 17025 as tables of a report.

On hardware a ball's measurements describe it. The plan's factors of restitution, drag and lift describe a
simulated ball and do not appear.

What plan and records leave out of ISO/IEC 17025:2017, 7.8, is printed as "not stated": a person who signs
sees the gap.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, date, datetime
from math import degrees
from typing import Any, NamedTuple

from bench.base.errors import Refused
from bench.campaign.plan.carry import Measured, measured_of
from bench.campaign.plan.plan import CampaignPlan, ItemParticulars
from bench.campaign.report._conformity import DECISION_RULE
from bench.campaign.report.campaign_record import ISSUE, CampaignRecord
from bench.campaign.report.report_format import UnitSystem, display_unit
from bench.golfer.comparison import followed_texts
from bench.records.shot.shot import Shot, ShotStatus
from bench.store.rows import ENDED, CampaignEntry, Event
from sim.ball import Ball
from sim.robot import Club

FLIGHT_OF: Mapping[str, str] = {
    "reference": "flown from the measured launch with the reference ball's aerodynamics, all balls alike: it "
    "compares launches, not flights",
    "monitor": "as the launch monitor reported it",
    "measured": "flown from the measured launch with the aerodynamics measured on each ball",
    "simulated": "flown with the simulated ball's own aerodynamics",
}
"""Meaning of each source of carry and flight."""
_DIGITS = 12
"""Printed digits of the SHA-256 of a golfer's file."""


class EquipmentTable(NamedTuple):
    """A table of the report."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    overdue: tuple[str, ...] = ()
    """First cells of the rows whose calibration was overdue at the tests."""


def ball_table(
    plan: CampaignPlan, measured: Measured, *, simulated: bool, units: UnitSystem = UnitSystem.SI
) -> EquipmentTable:
    """Return the balls that are hit, with their measured aerodynamics."""
    columns = _simulated_columns(units) if simulated else {}
    rows = tuple(
        (
            name,
            "control" if name not in plan.design.balls else "compared",
            *(cell(ball) if (ball := plan.balls.get(name)) else "–" for cell in columns.values()),
            measured[name].text if name in measured else "none",
        )
        for name in plan.ball_names
    )
    caption = "Balls" + (
        "; restitution, drag and lift as factors of the simulation on those of club and flight model"
        if simulated
        else "; what they are is measured, nothing of it comes from the plan"
    )
    return EquipmentTable(f"{caption}.", ("ball", "role", *columns, "measured aerodynamics"), rows)


def _simulated_columns(units: UnitSystem) -> dict[str, Callable[[Ball], str]]:
    mass, width = display_unit("mass_kg", units), display_unit("diameter_m", units)
    return {
        f"mass, {mass.unit}": lambda ball: mass.text(ball.mass),
        f"diameter, {width.unit}": lambda ball: width.text(2 * ball.radius),
        "restitution": lambda ball: f"{ball.restitution_factor:g}",
        "friction": lambda ball: f"{ball.friction:g}",
        "drag": lambda ball: f"{ball.drag_factor:g}",
        "lift": lambda ball: f"{ball.lift_factor:g}",
    }


def club_table(plan: CampaignPlan, units: UnitSystem = UnitSystem.SI) -> EquipmentTable:
    """Return the clubs."""
    length, mass = display_unit("length_m", units), display_unit("head_mass_kg", units)
    columns: dict[str, Callable[[Club], str]] = {
        "loft, °": lambda club: f"{degrees(club.loft):.2f}",
        "lie, °": lambda club: f"{degrees(club.lie):.2f}",
        "face angle, °": lambda club: f"{degrees(club.face_angle):.2f}",
        f"length to the face, {length.unit}": lambda club: length.text(club.length_to_face),
        f"head mass, {mass.unit}": lambda club: mass.text(club.head_mass),
    }
    rows = tuple((name, *(cell(club) for cell in columns.values())) for name, club in plan.clubs.items())
    return EquipmentTable("Clubs, as plan and configuration have them.", ("club", *columns), rows)


def golfer_table(golfers: Mapping[str, Any], units: UnitSystem = UnitSystem.SI) -> EquipmentTable:
    """Return the golfers that the swings follow, as a campaign's entry has them."""
    speed = display_unit("club_speed_mps", units)
    rows = tuple(
        (
            arm,
            f"{one['golfer']}, {one['sha256'][:_DIGITS]}…",
            one["follow"],
            speed.text(one["head_speed_mps"]),
            *followed_texts(one),
        )
        for arm, one in golfers.items()
    )
    head = ("swing, club", "golfer, SHA-256 of the file", "follows", f"golfer's club, {speed.unit}")
    definitions = "; ".join(dict.fromkeys(one["definition"] for one in golfers.values()))
    caption = f"Measured golfers, and deviations of the robot's planned motion. {definitions}."
    return EquipmentTable(caption, (*head, "shoulder", "arm", "wrist", "head"), rows)


def carry_words(shots: Sequence[Shot]) -> str:
    """Return which carry the shots have; empty without one."""
    sources = dict.fromkeys(shot.carry_source for shot in shots if shot.carry_source)
    return "; ".join(f"{source} – {FLIGHT_OF.get(source, 'unknown')}" for source in sources)


def used_configuration(entry: CampaignEntry, plan: CampaignPlan) -> dict[str, Any]:
    """Return the configuration for the report: without clubs, sites and balls that are not the plan's.

    That of a real bench lacks all balls: they are its simulation's.
    """
    balls = plan.ball_names if entry.simulated else ()
    used = {"clubs": plan.design.clubs, "sites": plan.design.clubs, "balls": balls}
    kept = {
        section: {name: one for name, one in values.items() if name in used[section]}
        if section in used and isinstance(values, Mapping)
        else values
        for section, values in entry.configuration.items()
    }
    if not entry.simulated and isinstance(plant := kept.get("plant"), Mapping):
        kept["plant"] = {key: value for key, value in plant.items() if key != "ball"}
    return kept


NOT_STATED = "not stated"
STATEMENT = (
    "The results relate only to the items tested, as received. Identity, condition and receipt of the items, "
    "customer and instruments besides the bench are as the plan states them; they were not tested. The "
    "verdicts are statistics as planned, not opinions or interpretations. This report may be reproduced in "
    "full only."
)


def particulars(record: CampaignRecord, digest: str) -> list[tuple[str, str]]:
    """Return (name, text) of a report's statements on itself, laboratory, customer, method and people."""
    report, entry, plan = record.plan.report, record.entry, record.plan
    times = [shot.time_utc for shot in record.shots]
    people = dict.fromkeys(run.by for run in record.runs if run.by)
    method = f"golfbench campaign, plan {plan.campaign.name} ({entry.digest})"
    issue = record.issues[-1] if record.issues else None
    tested = f"{min(times):%Y-%m-%d}"
    if max(times).date() != min(times).date():
        tested += f" to {max(times):%Y-%m-%d}"
    return [
        ("Report number", record.number),
        ("Issued", f"{issue.date:%Y-%m-%d}, {issue.text}" if issue else "not issued: a draft"),
        ("Laboratory", _joined(report.laboratory, report.address)),
        ("Place of the tests", report.location or report.address or NOT_STATED),
        ("Customer", _joined(report.customer, report.customer_contact)),
        ("Method", "; ".join(filter(None, (report.method, method)))),
        ("Operator", report.operator or ", ".join(people) or NOT_STATED),
        ("Tested", tested),
        ("Sampling", report.sampling or NOT_STATED),
        ("Decision rule", DECISION_RULE if plan.rules.apply else "none: no statement of conformity is made"),
        ("Deviations", _sds(record)),
        ("Digest of plan and data (SHA-256)", digest),
    ]


def _joined(*parts: str) -> str:
    return ", ".join(filter(None, parts)) or NOT_STATED


def _sds(record: CampaignRecord) -> str:
    stated = list(record.plan.report.deviations)
    excluded = sum(shot.status is not ShotStatus.VALID for shot in record.shots)
    events = sum(event.kind not in {ISSUE, "look"} for event in record.events)
    if excluded:
        stated.append(f"{excluded} shots do not count" if excluded > 1 else "1 shot does not count")
    if events:
        stated.append(f"{events} event{'s' * (events > 1)} during the campaign")
    if excluded or events:
        stated[-1] += ", see Excluded and failed shots"
    return "; ".join(stated) or "none"


def item_table(record: CampaignRecord) -> EquipmentTable:
    """Return the tested items as received."""
    plan, rows = record.plan, list[tuple[str, ...]]()
    kinds = {"ball": plan.ball_names, "club": plan.design.clubs}
    for kind, name in ((kind, name) for kind, names in kinds.items() for name in names):
        item = plan.items.get(name, ItemParticulars())
        samples = sorted({s.sample for s in record.shots if s.ball == name and s.sample})
        number = f"{len(samples)}, no. {samples[0]} to {samples[-1]}" if kind == "ball" and samples else ""
        stated = (text or NOT_STATED for text in (item.identity, item.condition, item.received))
        rows.append((name, kind, number, *stated))
    head = ("item", "kind", "hit", "identity", "condition", "received")
    return EquipmentTable("Items tested, as the plan states them.", head, tuple(rows))


def calibration_table(record: CampaignRecord) -> EquipmentTable:
    """Return the calibrations in force during the tests, and the items without one."""
    rows = tuple(_calibrations(record))
    last = max(shot.time_utc for shot in record.shots).date()
    caption = "Calibrations in force when the campaign began."
    if record.entry.simulated:
        caption = "Calibrations. Robot, ball and launch monitor are simulated: no instrument measured."
    head = ("what", "source", "date", "due", "state at the tests")
    late = tuple(what for what, *_, due in rows if isinstance(due, date) and due < last)
    states = (
        due if not isinstance(due, date) else f"OVERDUE since {due}" if due < last else "in force"
        for *_, due in rows
    )
    shown = tuple((*row[:-1], state) for row, state in zip(rows, states, strict=True))
    return EquipmentTable(caption, head, shown, late)


def _calibrations(record: CampaignRecord) -> Iterator[tuple[str, str, str, str, date | str]]:
    """Yield the cells of each row, and last the date due, or the state of an item without one."""
    entry = record.entry
    bench = entry.calibrations.get("bench", {})
    for one in bench.get("in_force", ()):
        what = " ".join(filter(None, ("bench", str(one["kind"]), str(one["subject"]))))
        source = f"version {one['version']}, {one['method']}, by {one['by']}"
        due = datetime.fromisoformat(one["expires"])
        yield what, source, str(one["date"])[:10], f"{due:%Y-%m-%d}", due.date()
    for name in bench.get("nominal", ()):
        yield f"bench {name}", "none", "–", "–", "nominal: never calibrated"
    for stated in record.plan.calibrations.values():
        until = date.fromisoformat(stated.due) if stated.due else "no date due"
        words = ", ".join(filter(None, (stated.instrument, stated.identity)))
        yield words, stated.source or NOT_STATED, stated.date or "–", stated.due or "–", until
    for ball, found in measured_of(entry.calibrations, f"campaign {entry.id}").items():
        source = f"version {found.version}, {found.source}, by {found.by}"
        yield f"aerodynamics of {ball}", source, f"{found.date:%Y-%m-%d}", "–", "used"


def issue_report(record: CampaignRecord, by: str, reason: str, now: datetime) -> Event:
    """Return the event of an issue, to be stored once its page is written.

    Raises:
        Refused: the campaign is not over, or an amendment has no reason.
    """
    place, issues = f"campaign {record.entry.id}", record.issues
    if record.standing.state not in ENDED:
        expected = "a finished or aborted campaign"
        raise Refused(place, f"{record.standing.state}", expected, "Resume it, or issue its report later.")
    if issues and not reason:
        expected = "a reason for an amended report"
        raise Refused(place, f"{record.number} is issued", expected, "Give the reason with --reason TEXT.")
    text = f"issued by {by}"
    if issues:
        text += f"; replaces {record.number}: {reason}"
    elif reason:
        text += f"; {reason}"
    return Event(now.astimezone(UTC), len(record.shots) + 1, ISSUE, text)
