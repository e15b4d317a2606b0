"""The hazard table to sign, and the hazard file for a safety engineer: figures of the matrix, judgement.

The judgement is data, `hazard_file.toml`; figures come from the matrix. The form follows that of a failure
modes and effects analysis, the required performance levels the risk graph of ISO 13849-1's Annex A.
"""

from __future__ import annotations

import json
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from textwrap import wrap
from typing import Any

import jinja2

from bench.base.errors import BenchError
from bench.faults.catalogue import HARDWARE
from sim.faults import sort_of

_WIDTH = 119
"""Columns of a paragraph."""
_OF_THE_RUN = frozenset({"origin", "seconds"})
"""Keys of a summary that differ between two runs with the same outcomes."""


def part_of(signal: str) -> tuple[str, str]:
    """Return the part or sort of parts of `signal`, and the protection that only hardware gives."""
    for name, text in HARDWARE:
        if name in (signal, sort_of(signal)):
            return name, text
    return sort_of(signal), "not needed"


def next_swing_text(summary: Mapping[str, Any]) -> str:
    """Return a sentence on undetected faults that the next swing reports, "" without any."""
    found = summary["next_swing"]
    if not found:
        return ""
    count = sum(found.values())
    return f"Of {count} undetected {count - found.get('', 0)} are named before another ball is struck."


def matrix_digest(summary: Mapping[str, Any]) -> str:
    """Return the digest of all outcomes in the matrix's `summary` (16 hex digits)."""
    outcomes = {key: value for key, value in summary.items() if key not in _OF_THE_RUN}
    return sha256(json.dumps(outcomes, sort_keys=True).encode()).hexdigest()[:16]


def hazard_table(summary: dict[str, Any]) -> str:
    """Return the table as Markdown, one row a sort of parts."""
    return markdown(
        "hazards.md.j2",
        s=summary,
        every=summary["origin"].get("every", 1),
        digest=matrix_digest(summary),
        next_swing=next_swing_text(summary),
        parts=_by_part(summary["rows"]),
    )


def _by_part(rows: Sequence[Mapping[str, Any]]) -> list[tuple[Any, ...]]:
    """Return part, faults, cases, undetected and unsafe ones, and the protection by hardware."""
    parts: dict[tuple[str, str], list[Mapping[str, int]]] = {}
    for row in rows:
        if row["verdicts"]:
            parts.setdefault(part_of(row["signal"]), []).append(row["verdicts"])
    return [
        (
            part,
            len(own),
            sum(sum(verdicts.values()) for verdicts in own),
            *(sum(verdicts.get(name, 0) for verdicts in own) for name in ("undetected", "unsafe")),
            hardware,
        )
        for (part, hardware), own in parts.items()
    ]


def markdown(template: str, **values: Any) -> str:
    """Return `template` of this folder filled with `values`; KeyError if one is missing."""
    environment = jinja2.Environment(  # noqa: S701 - this is no HTML
        undefined=jinja2.StrictUndefined, trim_blocks=True, keep_trailing_newline=True
    )
    environment.filters |= {"paragraph": _paragraph, "row": _row, "cells": _cells}
    text = files("bench.faults").joinpath(template).read_text(encoding="utf-8")
    try:
        return environment.from_string(text).render(values)
    except jinja2.UndefinedError as error:
        raise KeyError(str(error)) from None


def _paragraph(text: str) -> str:
    """Return `text`, wrapped, as the lines of a paragraph."""
    lines = wrap(" ".join(text.split()), _WIDTH, break_long_words=False, break_on_hyphens=False)
    return "\n".join(lines) + "\n"


def _cells(entry: Mapping[str, Any], *keys: str) -> tuple[Any, ...]:
    return tuple(entry[key] for key in keys)


def _row(cells: Sequence[Any]) -> str:
    """Return a row of a Markdown table."""
    return f"| {' | '.join(str(cell).replace('|', '/') for cell in cells)} |"


JUDGEMENT = Path(__file__).with_name("hazard_file.toml")
"""The judgement, written by people; `tests/faults/test_hazard_file.py` checks its form."""

RISK_GRAPH: Mapping[tuple[str, str, str], str] = {
    ("S1", "F1", "P1"): "a",
    ("S1", "F1", "P2"): "b",
    ("S1", "F2", "P1"): "b",
    ("S1", "F2", "P2"): "c",
    ("S2", "F1", "P1"): "c",
    ("S2", "F1", "P2"): "d",
    ("S2", "F2", "P1"): "d",
    ("S2", "F2", "P2"): "e",
}
"""Required performance level by severity, exposure and avoidance: the graph of ISO 13849-1, as printed in the
manuals that the hazard file names."""

SEVERITIES = (
    "none, or repaired in minutes",
    "damage to the machine",
    "injury that heals",
    "lasting injury or death",
)
"""Meanings of the severities 1 to 4; IEC 60812 sets no scale."""


def hazard_file(summary: Mapping[str, Any]) -> str:
    """Return the hazard file as Markdown from the matrix's `summary`.

    Raises:
        ExceptionGroup: one BenchError per row of the matrix that no failure or several claim.
    """
    judgement = tomllib.loads(JUDGEMENT.read_text(encoding="utf-8"))
    failures = judgement["failures"]
    claimed = zip(failures, _claims(summary["rows"], failures), strict=True)
    return markdown(
        "hazard_file.md.j2",
        **judgement | {"failures": [{**failure, **_figures(rows)} for failure, rows in claimed]},
        summary=summary,
        digest=matrix_digest(summary),
        next_swing=next_swing_text(summary),
        severities=SEVERITIES,
        risk_graph=RISK_GRAPH,
    )


def _claims(
    rows: Sequence[Mapping[str, Any]], failures: Sequence[Mapping[str, Any]]
) -> list[list[Mapping[str, Any]]]:
    """Return the matrix's rows of each failure."""
    claimed: list[list[Mapping[str, Any]]] = [[] for _ in failures]
    faults = []
    for row in rows:
        owners = [
            i
            for i, failure in enumerate(failures)
            if row["signal"] in failure["signals"] and row["kind"] in failure.get("kinds", [row["kind"]])
        ]
        if len(owners) == 1:
            claimed[owners[0]].append(row)
        else:
            found = f"{len(owners)} failures of the hazard file"
            action = "Correct signals and kinds in bench/faults/hazard_file.toml."
            faults.append(BenchError(f"matrix: {row['breakage']}", found, "one failure", action))
    if faults:
        raise ExceptionGroup("the hazard file does not cover the matrix", faults)
    return claimed


def _figures(rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return the figures in the matrix's `rows` of a failure."""
    verdicts: Counter[str] = Counter()
    for row in rows:
        verdicts.update(row["verdicts"])
    ticks = sorted(tick for row in rows for tick in row["detection_ticks"])
    median = f", median {ticks[len(ticks) // 2]} ms" if ticks else ""
    return {
        "detection": _most(rows, "detected_by"),
        "reaction": _most(rows, "reactions") + median,
        "cases": f"{sum(verdicts.values())}: {verdicts['unsafe']}, {verdicts['undetected']}",
        "absorber": f"{100 * max((row['worst_stop'] for row in rows), default=0.0):.0f} %",
    }


def _most(rows: Sequence[Mapping[str, Any]], key: str) -> str:
    """Return the three most frequent entries of the lists `key` in `rows`, ties in their order."""
    found = Counter(text for row in rows for text in row[key]).most_common(3)
    return ", ".join(text for text, _ in found) or "-"
