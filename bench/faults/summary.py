"""Summary of a matrix, and the documents made of it: the hazard table to sign, and the hazard file.

The summary has verdicts by breakage and phase, times of the reactions, and the origin. The hazard file is for
a safety engineer: its judgement is data, `hazard_file.toml`; figures come from the matrix. The form follows
that of a failure modes and effects analysis, the required performance levels the risk graph of ISO 13849-1's
Annex A.
"""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import datetime
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from textwrap import wrap
from typing import Any

import jinja2

from bench.base.errors import BenchError
from bench.base.lifecycle import Phase
from bench.config import Configuration
from bench.faults._verdict import CaseOutcome
from bench.faults.catalogue import FAMILIES, HARDWARE, phase_name
from bench.faults.matrix import Skipped
from bench.swing.profile import Profile
from drivers.base.machine_code import source_digest
from sim.faults import MEANINGS, sort_of

SCHEMA_VERSION = 3
VERDICTS = ("irrelevant", "harmless", "safe", "undetected", "unsafe")
"""Verdicts, best first."""
PHASES = ("start", "access", *map(phase_name, Phase))


def summarise(
    outcomes: Sequence[CaseOutcome],
    skipped: Sequence[Skipped],
    *,
    model_check: bool,
    profile: str,
    seconds: float,
    origin: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the summary of a matrix as a JSON-ready record; `origin` is from `origin_of`."""
    rows = []
    for name in dict.fromkeys([*(o.breakage for o in outcomes), *(s.breakage for s in skipped)]):
        own, left_out = (
            [o for o in outcomes if o.breakage == name],
            [s for s in skipped if s.breakage == name],
        )
        first: Any = (own or left_out)[0]
        rows.append(
            {
                "breakage": name,
                "signal": first.signal,
                "kind": first.kind,
                "family": first.family,
                "meaning": MEANINGS[sort_of(first.signal)][first.kind],
                "verdicts": dict(Counter(o.verdict for o in own)),
                "phases": {phase: _phase(phase, own, left_out) for phase in PHASES},
                "detected_by": _usual([o.detected_by for o in own]),
                "reactions": _usual([o.reaction for o in own]),
                "detection_ticks": sorted(o.detection_ticks for o in own if o.detection_ticks >= 0),
                "worst_stop": max((o.stop_share for o in own), default=0.0),
                "worst_pressure": max((o.pressure_share for o in own), default=0.0),
                "reasons": _reasons(own),
                "rules": sorted({s.rule for s in left_out}),
            }
        )
    return {
        "schema_version": SCHEMA_VERSION,
        "profile": profile,
        "origin": dict(origin),
        "model_check": model_check,
        "cases": len(outcomes),
        "instants": list(dict.fromkeys(o.instant for o in outcomes)),
        "left_out_by_rule": len(skipped),
        "verdicts": {verdict: sum(o.verdict == verdict for o in outcomes) for verdict in VERDICTS[1:]},
        "families": {
            family: {v: sum(o.verdict == v for o in outcomes if o.family == family) for v in VERDICTS[1:]}
            for family in FAMILIES
        },
        "reasons": _by_reason(outcomes),
        "next_swing": _by_next_swing(outcomes),
        "seconds": round(seconds, 1),
        "reaction_ticks": reaction_ticks(outcomes),
        "rows": rows,
    }


def _usual(texts: list[str]) -> list[str]:
    """Return the three most frequent of `texts`."""
    return [text for text, _ in Counter(filter(None, texts)).most_common(3)]


def _phase(phase: str, own: Sequence[CaseOutcome], skipped: Sequence[Skipped]) -> dict[str, Any]:
    here = [o for o in own if o.phase == phase]
    if not here:
        rule = next((s.rule for s in skipped if s.phase == phase), "")
        return {"verdict": "irrelevant", "rule": rule} if rule else {}
    worst = max(here, key=lambda o: VERDICTS.index(o.verdict))
    return {"verdict": worst.verdict, "reason": "; ".join(worst.reasons), "detected_by": worst.detected_by}


def _reasons(own: Sequence[CaseOutcome]) -> list[str]:
    """Return each reason once, the worst first."""
    bad = sorted((o for o in own if o.reasons), key=lambda o: -VERDICTS.index(o.verdict))
    return list(dict.fromkeys(f"{o.instant}: {'; '.join(o.reasons)}{_found_later(o)}" for o in bad))


def _found_later(outcome: CaseOutcome) -> str:
    """Return the report of the next swing on an undetected fault."""
    if outcome.verdict != "undetected":
        return ""
    return f"; next swing: {outcome.next_swing or 'not noticed either'}"


_FIGURE = re.compile(r"[-+]?\d+(?:\.\d+)?")


def _by_reason(outcomes: Sequence[CaseOutcome]) -> dict[str, dict[str, int]]:
    """Return how many unsafe and undetected cases have each reason, without its figures; the most first."""
    found: dict[str, Counter[str]] = {"unsafe": Counter(), "undetected": Counter()}
    for outcome in outcomes:
        if outcome.verdict in found:
            found[outcome.verdict].update(_FIGURE.sub("…", reason) for reason in outcome.reasons)
    return {verdict: dict(reasons.most_common()) for verdict, reasons in found.items()}


def _by_next_swing(outcomes: Sequence[CaseOutcome]) -> dict[str, int]:
    """Return the number of undetected cases by report of the next swing ("" for none), descending."""
    found = Counter(outcome.next_swing for outcome in outcomes if outcome.verdict == "undetected")
    return dict(found.most_common())


def reaction_ticks(outcomes: Sequence[CaseOutcome]) -> dict[str, dict[str, float]]:
    """Return min, median and max ticks to the reaction by sort of fault, of detected faults."""
    groups: dict[str, list[int]] = {}
    for outcome in outcomes:
        ticks = outcome.detection_ticks if outcome.reaction_ticks < 0 else outcome.reaction_ticks
        if outcome.detected_by and ticks >= 0 and ", then" not in outcome.breakage:
            groups.setdefault(f"{sort_of(outcome.signal)} {outcome.kind}", []).append(ticks)
    return {
        name: {
            "cases": len(ticks),
            "least": min(ticks),
            "median": sorted(ticks)[len(ticks) // 2],
            "greatest": max(ticks),
        }
        for name, ticks in sorted(groups.items())
    }


def summary_text(summary: dict[str, Any]) -> str:
    """Return `summary` as JSON with one compact line a breakage."""
    parts = []
    for key, value in summary.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            lines = ",\n".join(_compact(row) for row in value)
            parts.append(f"{_compact(key)}:[\n{lines}\n]")
        else:
            parts.append(f"{_compact(key)}:{_compact(value)}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def _compact(value: object) -> str:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False)


SEED = 1
"""Seed of the faults' random numbers, the same in all cases."""


def origin_of(configuration: Configuration, profile: Profile, now: datetime) -> dict[str, Any]:
    """Return the data to reproduce a matrix made `now` of `profile` and `configuration`."""
    effective = json.dumps(configuration.effective(), sort_keys=True, default=str)
    swing = profile.angle.tobytes() + profile.valve.tobytes()
    return {
        "commit": commit(Path(__file__).parent),
        "configuration": _digest(effective.encode()),
        "profile": _digest(swing),
        "sources": source_digest(),
        "seed": SEED,
        "time_utc": now.isoformat(timespec="seconds"),
    }


def commit(folder: Path) -> str | None:
    """Return the commit of the checkout that `folder` is in, "+" where files differ; None outside."""
    try:
        run = subprocess.run(
            ["git", "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=10.0,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return run.stdout.strip() or None


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


_WIDTH = 119
"""Columns of a paragraph."""
_OF_THE_RUN = frozenset({"origin", "seconds"})
"""Keys of a summary that differ between two runs with the same outcomes."""


def part_of(signal: str) -> tuple[str, str]:
    """Return the part or sort of parts of `signal`, and the protection that only hardware gives."""
    for name, text in HARDWARE.items():
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
