"""The hazard table for the person who signs the installation, made from the matrix."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bench.faults.catalogue import HARDWARE
from sim.faults import sort_of

HEAD = """# Hazards

Made by `golfbench faults table` from `sim/FAULTS.json`, the matrix of `golfbench faults run`; do not edit.
It covers the simulated robot with the shipped configuration: assumed valves, absorbers and chambers. It does
not replace the risk assessment of an installation, but such an assessment may start from it.
"""


def hardware_for(signal: str) -> str:
    """Return the protection that only hardware can give."""
    for name, text in HARDWARE:
        if name in (signal, sort_of(signal)):
            return text
    return "not needed"


def next_swing_text(summary: Mapping[str, Any]) -> str:
    """Return how many undetected faults are named before another ball is struck, "" without any."""
    found = summary["next_swing"]
    if not found:
        return ""
    count = sum(found.values())
    return f"Of {count} undetected {count - found.get('', 0)} are named before another ball is struck."


def hazard_table(summary: dict[str, Any]) -> str:
    """Return the table as Markdown."""
    v = summary["verdicts"]
    lines = [
        HEAD,
        f"{summary['cases']} cases{_sampled(summary)} from {len(summary['instants'])} instants, "
        f"model-based check {'on' if summary['model_check'] else 'off'}: "
        f"{v['safe']} detected and safe, {v['harmless']} harmless, {v['undetected']} undetected with another "
        f"shot or pose, {v['unsafe']} unsafe; {summary['left_out_by_rule']} pairs left out by rule.",
        "",
        _origin(summary),
        "",
        *_families(summary),
        "",
        *((text, "") if (text := next_swing_text(summary)) else ()),
        "| hazard | cases | detected by | reaction, ticks | residual risk | only by hardware |",
        "|---|---|---|---|---|---|",
    ]
    lines += [_row(row) for row in summary["rows"] if row["verdicts"]]
    lines += ["", "## Pairs left out by rule", "", *(_rules(summary))]
    if summary.get("comparison"):
        lines += ["", "## The model-based check, off and on", "", *_comparison(summary["comparison"])]
    lines += ["", "## Hazards that software cannot cover", "", *_ALWAYS]
    return "\n".join(lines) + "\n"


_ALWAYS = (
    "- A person inside the fence: fence, light curtain and a hard-wired emergency stop of two channels.",
    "- A burst hose or cylinder, a broken shaft, a loose head: fence, relief valves, inspection.",
    "- A raised arm that only friction holds after venting: a pin or a support before anybody goes near.",
    "- A shoulder valve stuck open at full speed when the chamber sensors have failed too: absorbers for the "
    "whole swing's energy. A second valve in series is no substitute: it acts only from the detection on.",
    "- A safety relay whose contacts weld shut: two with guided contacts, each read back before a reset.",
    "- A relief valve that stays shut: its proof test.",
    "- The bench's computer and the valve electronics failing together: the emergency stop's own dump valve.",
)


def _sampled(summary: dict[str, Any]) -> str:
    every = summary["origin"].get("every", 1)
    return f", a sample of one in {every}," if every > 1 else ""


def _origin(summary: dict[str, Any]) -> str:
    o = summary["origin"]
    return (
        f"Swing `{summary['profile']}`, commit {o['commit'] or 'unknown'}, digests: configuration "
        f"{o['configuration']}, profile {o['profile']}, compiled sources {o['sources']}; seed {o['seed']}; "
        f"{o['time_utc'][:16]} UTC."
    )


def _families(summary: dict[str, Any]) -> list[str]:
    names = ("safe", "harmless", "undetected", "unsafe")
    lines = ["| faults that come | " + " | ".join(names) + " |", "|---|---|---|---|---|"]
    lines += [
        f"| {family} | " + " | ".join(str(counts[name]) for name in names) + " |"
        for family, counts in summary["families"].items()
        if any(counts.values())
    ]
    lines += ["", "| verdict | reason | cases |", "|---|---|---|"]
    lines += [
        f"| {verdict} | {reason} | {count} |"
        for verdict, reasons in summary["reasons"].items()
        for reason, count in reasons.items()
    ]
    return lines


def _row(row: dict[str, Any]) -> str:
    ticks = row["detection_ticks"]
    median = f", median {ticks[len(ticks) // 2]}" if ticks else ""
    reaction = ", ".join(row["reactions"]) or "-"
    found = ", ".join(row["detected_by"]) or "-"
    count = sum(row["verdicts"].values())
    bad = [f"{row['verdicts'][name]} {name}" for name in ("unsafe", "undetected") if name in row["verdicts"]]
    residual = "; ".join(bad) + (f": {row['reasons'][0]}" if bad and row["reasons"] else "")
    cells = (
        f"**{row['breakage']}**: {row['meaning']}",
        str(count),
        found,
        reaction + median,
        residual or "not seen",
        hardware_for(row["signal"]),
    )
    return "| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |"


def _rules(summary: dict[str, Any]) -> list[str]:
    rules: dict[str, list[str]] = {}
    for row in summary["rows"]:
        for rule in row["rules"]:
            rules.setdefault(rule, []).append(row["breakage"])
    return [f"- {rule} (faults: {len(names)}, e.g. {names[0]})." for rule, names in rules.items()]


def _comparison(rows: list[dict[str, Any]]) -> list[str]:
    lines = [
        "| fault | cases | detected off → on | undetected off → on | unsafe off → on | median ticks |",
        "|---|---|---|---|---|---|",
    ]
    for r in rows:
        ticks = f"{r['median_ticks_off']} → {r['median_ticks_on']}".replace("None", "never")
        lines.append(
            f"| {r['what']} | {r['cases']} | {r['detected_off']} → {r['detected_on']} | "
            f"{r['undetected_off']} → {r['undetected_on']} | {r['unsafe_off']} → {r['unsafe_on']} | {ticks} |"
        )
    return lines
