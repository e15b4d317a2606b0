"""How `golfbench profile check` shows its outcomes: a table for people, a record for programs."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from bench.design.stop_verification import TrialOutcome, TrialSummary

SCHEMA_VERSION = 1


def check_table(name: str, outcomes: list[TrialOutcome], summaries: list[TrialSummary]) -> Table:
    """Return one row a fault: how many instants, the worst ends and when they began."""
    unsafe = sum(bool(outcome.unsafe) for outcome in outcomes)
    table = Table(
        title=f"{name}: {len(outcomes)} cases, {unsafe} end unsafe",
        caption="Shares are of the rating; instants are seconds from the start of the swing.",
    )
    table.add_column("fault")
    for heading in ("cases", "unsafe", "most energy in a stop", "highest pressure", "clearance mm"):
        table.add_column(heading, justify="right")
    table.add_column("at rest after s", justify="right")
    for summary in summaries:
        stop, pressure = summary.worst_stop, summary.worst_pressure
        lowest, slowest = summary.lowest, summary.slowest
        table.add_row(
            summary.fault,
            str(summary.instants),
            f"[red]{summary.unsafe}[/red]" if summary.unsafe else "0",
            f"{100 * stop.stop_share:.0f} % {stop.stop} @{stop.time:.2f}",
            f"{100 * pressure.pressure_share:.0f} % @{pressure.time:.2f}",
            f"{1e3 * lowest.clearance:.0f} @{lowest.time:.2f}",
            f"{slowest.rest_time:.2f} @{slowest.time:.2f}",
        )
    return table


def check_record(name: str, outcomes: list[TrialOutcome], summaries: list[TrialSummary]) -> dict[str, Any]:
    """Return all outcomes as a JSON-ready record; a time that never came is null."""

    def one(outcome: TrialOutcome) -> dict[str, Any]:
        record = {key: getattr(outcome, key) for key in outcome.__dataclass_fields__}
        rests = outcome.rest_time < float("inf")
        return record | {
            "phase": outcome.phase.name,
            "cause": outcome.cause.name,
            "rest_time": outcome.rest_time if rests else None,
            "unsafe": outcome.unsafe,
        }

    return {
        "schema_version": SCHEMA_VERSION,
        "profile": name,
        "cases": len(outcomes),
        "unsafe": {summary.fault: summary.unsafe for summary in summaries},
        "outcomes": [one(outcome) for outcome in outcomes],
    }
