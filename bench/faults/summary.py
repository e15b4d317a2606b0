"""Summary of a matrix: verdicts by breakage and phase, times of the reactions, and its origin."""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from bench.base.lifecycle import Phase
from bench.config import Configuration
from bench.faults.catalogue import FAMILIES, phase_name
from bench.faults.matrix import Skipped
from bench.faults.verdict import CaseOutcome
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
