"""What a test report states besides its results (ISO/IEC 17025:2017, 7.8), from plan and records.

What was left out is printed as "not stated": a person who signs sees the gap.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, date, datetime

from bench.campaign.campaign_record import ISSUE, CampaignRecord
from bench.campaign.carry import measured_of
from bench.campaign.conformity import DECISION_RULE
from bench.campaign.equipment import EquipmentTable
from bench.campaign.plan import ItemParticulars
from bench.errors import Refused
from bench.shot.shot import ShotStatus
from bench.store.campaigns import CampaignStore
from bench.store.records import ENDED, Event

NOT_STATED = "not stated"
STATEMENT = (
    "The results relate only to the items tested, as received. Identity, condition and receipt of the items, "
    "customer and instruments besides the bench are as the plan states them; they were not tested. The "
    "verdicts are statistics as planned, not opinions or interpretations. This report may be reproduced in "
    "full only."
)


def particulars(record: CampaignRecord, digest: str) -> list[tuple[str, str]]:
    """Return (name, text) of what a report states of itself, laboratory, customer, method and people."""
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
        ("Deviations", _deviations(record)),
        ("Digest of plan and data (SHA-256)", digest),
    ]


def _joined(*parts: str) -> str:
    return ", ".join(filter(None, parts)) or NOT_STATED


def _deviations(record: CampaignRecord) -> str:
    """Return the stated deviations, and where the others stand."""
    stated = list(record.plan.report.deviations)
    excluded = sum(shot.status is not ShotStatus.VALID for shot in record.shots)
    events = sum(event.kind not in {ISSUE, "look"} for event in record.events)
    if excluded:
        stated.append(f"{excluded} shots do not count")
    if events:
        stated.append(f"{events} events during the campaign")
    if excluded or events:
        stated[-1] += ", see Excluded and failed shots"
    return "; ".join(stated) or "none"


def item_table(record: CampaignRecord) -> EquipmentTable:
    """Return the tested items as received."""
    plan = record.plan
    rows = []
    for kind, names in (("ball", plan.ball_names), ("club", plan.design.clubs)):
        for name in names:
            item = plan.items.get(name, ItemParticulars())
            samples = sorted({s.sample for s in record.shots if s.ball == name and s.sample})
            number = ""
            if kind == "ball" and samples:
                number = f"{len(samples)}, no. {samples[0]} to {samples[-1]}"
            rows.append(
                (
                    name,
                    kind,
                    number,
                    item.identity or NOT_STATED,
                    item.condition or NOT_STATED,
                    item.received or NOT_STATED,
                )
            )
    head = ("item", "kind", "hit", "identity", "condition", "received")
    return EquipmentTable("Items tested, as the plan states them.", head, tuple(rows))


def calibration_table(record: CampaignRecord) -> EquipmentTable:
    """Return the calibrations in force during the tests, and what has none."""
    rows = tuple(_calibrations(record))
    last = max(shot.time_utc for shot in record.shots).date()
    caption = "Calibrations in force when the campaign began."
    if record.entry.simulated:
        caption = "Calibrations. Robot, ball and launch monitor are simulated: no instrument measured."
    head = ("what", "source", "date", "due", "state at the tests")
    late = tuple(what for what, *_, due in rows if isinstance(due, date) and due < last)
    states = (_state(due, last) if isinstance(due, date) else due for *_, due in rows)
    shown = tuple((*row[:-1], state) for row, state in zip(rows, states, strict=True))
    return EquipmentTable(caption, head, shown, late)


def _calibrations(record: CampaignRecord) -> Iterator[tuple[str, str, str, str, date | str]]:
    """Yield the cells of each row; in place of the last the date due, or the state of what has none."""
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


def _state(due: date, tested: date) -> str:
    return f"OVERDUE since {due}" if due < tested else "in force"


def issue_report(store: CampaignStore, record: CampaignRecord, by: str, reason: str, now: datetime) -> Event:
    """Store that the report is issued, and return the event.

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
    event = Event(now.astimezone(UTC), len(record.shots) + 1, ISSUE, text)
    store.note_event(record.entry.id, event)
    return event
