"""A baseline: figures of a campaign that must lie within stated bands, as a gate in CI.

A TOML file with one `[[figure]]` a band: `path`, dotted, into the campaign's JSON, and `low` and `high`.
Numbers are places in lists; names pick a list's entry of that `name`, `column` or `club`. A missing
or unknown figure lies outside every band. JUnit XML has a test case for each band and for each planned shot.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from bench.base.errors import BenchError
from bench.base.from_toml import checked_values, read_toml
from bench.campaign.plan.shot_sequence import Role
from bench.campaign.run.runner import RunOutcome
from bench.records.shot.shot import Shot, ShotStatus
from bench.store.rows import CampaignEntry, CampaignState, state_text


@dataclass(frozen=True)
class Band:
    """Where one figure must lie."""

    path: str
    low: float = field(default=-inf, metadata={"optional": True})
    high: float = field(default=inf, metadata={"optional": True})

    def __post_init__(self) -> None:
        if self.low > self.high or (self.low, self.high) == (-inf, inf):
            raise ValueError("low, high or both, low at most high")


@dataclass(frozen=True)
class Checked:
    """A figure and its band."""

    band: Band
    value: float | None

    @property
    def holds(self) -> bool:
        """Whether the figure is known and inside."""
        return self.value is not None and self.band.low <= self.value <= self.band.high

    def __str__(self) -> str:
        value = "not there" if self.value is None else f"{self.value:.6g}"
        return f"{self.band.path}: {value}, band {self.band.low:g} to {self.band.high:g}"


def read_baseline(path: Path) -> list[Band]:
    """Return the bands in `path`.

    Raises:
        BenchError: the file is missing or no TOML.
        ExceptionGroup: BenchErrors, one for each mistake in it.
    """
    raw = read_toml(path, "a baseline", "Correct the path.")
    entries, action = raw.get("figure"), "Write [[figure]] with path, low and high."
    if set(raw) != {"figure"} or not isinstance(entries, list) or not entries:
        expected = "[[figure]] entries, no other key"
        raise BenchError(str(path), f"keys {', '.join(raw) or 'none'}", expected, action)
    faults, bands = list[Exception](), list[Band]()
    for number, entry in enumerate(entries, 1):
        try:
            content = entry if isinstance(entry, dict) else {}
            bands.append(checked_values(Band, content, f"{path}: figure {number}", action))
        except ExceptionGroup as wrong:
            faults += wrong.exceptions
    if faults:
        raise ExceptionGroup(f"{path} is invalid", faults)
    return bands


def check_baseline(record: Mapping[str, Any], bands: Sequence[Band]) -> list[Checked]:
    """Return each band's figure in the campaign's JSON `record`."""
    return [Checked(band, _found(record, band.path.split("."))) for band in bands]


def _found(node: Any, parts: Sequence[str]) -> float | None:
    for part in parts:
        if isinstance(node, Mapping):
            node = node.get(part)
        elif isinstance(node, list):
            if part.isdigit():
                node = node[int(part)] if int(part) < len(node) else None
            else:
                node = next((entry for entry in node if _named(entry, part)), None)
        else:
            return None
    return float(node) if isinstance(node, int | float) and not isinstance(node, bool) else None


def _named(entry: Any, name: str) -> bool:
    return isinstance(entry, Mapping) and name in (entry.get(key) for key in ("name", "column", "club"))


_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def junit_xml(
    entry: CampaignEntry, outcome: RunOutcome, shots: Sequence[Shot], checks: Sequence[Checked] = ()
) -> bytes:
    """Return the XML; a planned shot fails when its last attempt was not valid."""
    last: dict[tuple[int, int], Shot] = {
        (shot.block, shot.position): shot for shot in shots if shot.role != Role.WARM_UP
    }
    cases: list[tuple[str, str, str]] = [
        (
            f"block {block} position {position}: {shot.ball}, {shot.club}, {shot.swing}",
            "shots",
            "" if shot.status is ShotStatus.VALID else f"{shot.status}: {shot.reason}",
        )
        for (block, position), shot in sorted(last.items())
    ]
    ended = outcome.state is CampaignState.FINISHED
    cases.append(("came to its end", "campaign", "" if ended else state_text(outcome.state, outcome.reason)))
    cases += [(check.band.path, "baseline", "" if check.holds else str(check)) for check in checks]
    failures = sum(bool(failure) for _, _, failure in cases)
    suite = ElementTree.Element(
        "testsuite",
        name=entry.id,
        tests=str(len(cases)),
        failures=str(failures),
        errors="0",
        timestamp=f"{entry.date:%Y-%m-%dT%H:%M:%S}",
    )
    for name, group, failure in cases:
        case = ElementTree.SubElement(
            suite, "testcase", classname=f"{entry.name}.{group}", name=_FORBIDDEN.sub("?", name)
        )
        if failure:
            ElementTree.SubElement(case, "failure", message=_FORBIDDEN.sub("?", failure))
    text: bytes = ElementTree.tostring(suite, encoding="utf-8", xml_declaration=True)
    return text
