"""Verification of a report against the records: digests and figures are recomputed.

A page carries, as data, the digests of its records and its figures with all digits. Verification recomputes
both. A page of this version of golfbench must also match, letter by letter, the page generated from the
records.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isclose
from pathlib import Path
from typing import Any

from bench.base.errors import BenchError
from bench.base.json_schema import json_object
from bench.campaign.interruptions import software_versions
from bench.campaign.report.campaign_record import (
    SHOT_DIGITS,
    CampaignRecord,
    Digests,
    reasons_by_hand,
    record_digests,
)
from bench.campaign.report.campaign_report import render_campaign_report
from bench.campaign.report.findings import findings, findings_record
from bench.campaign.report.report_format import UnitSystem
from bench.store.campaigns import StoredShot
from bench.store.rows import amendment

_MAX_DIFFERENCES = 10
"""Max number of reported differences of one kind."""
_TOLERANCE = 1e-9
"""Share by which a figure may differ: libraries of another machine round differently."""
_TEXTS = re.compile(r"\.(headline|detail|notes\.\d+)$")
"""Paths of texts, which another version words differently; the page of this version is compared with them."""
_DATA = re.compile(r'<script type="application/json" id="record">(.*?)</script>', re.DOTALL)
_TODAY = re.compile(r"<section data-today>.*?</section>", re.DOTALL)
"""Sections of a page that change after the campaign, such as the wear of the bench's parts."""


@dataclass(frozen=True)
class Verification:
    """Result of comparing a page with the records."""

    digest: str
    figures: int
    """Number of recomputed figures."""
    page: bool
    """Whether the page itself was compared; False if it is of another version of golfbench."""
    differences: tuple[str, ...]


def verify_page(record: CampaignRecord, page: str, place: str) -> Verification:
    """Return how `page`, the text of a report, differs from the records.

    Raises:
        BenchError: it is no report of this campaign.
    """
    data = _embedded(record, page, place)
    digests = record_digests(record)
    units, issued = UnitSystem(data["units"]), int(data["issue"])
    differences = [
        *_changes_after(record, issued),
        *_digests(data, digests, page),
        *_shots(record, digests.shots, str(data["shots"])),
    ]
    issues = {id(event) for event in record.issues[issued:]}
    then = replace(record, events=[event for event in record.events if id(event) not in issues])
    found = findings(record.plan, record.shots, data["looks"], units)
    figures = dict(_figures(json.loads(json.dumps(findings_record(found)))))
    differences += _first(list(_changed(dict(_figures(data["figures"])), figures)))
    today = bool(data["software"] == software_versions()["source"])
    if today and _TODAY.sub("", page) != _TODAY.sub("", render_campaign_report(then, found, units)):
        differences.append("page: not the one that the records give")
    count = sum(isinstance(one, float | int) and not isinstance(one, bool) for one in figures.values())
    return Verification(digests.whole, count, today, tuple(differences))


def _changes_after(record: CampaignRecord, issued: int) -> Iterator[str]:
    """Yield which shots a person excluded, or let count again, after the report's issue number `issued`."""
    if not 0 < issued <= len(record.issues):
        return
    date = record.issues[issued - 1].date
    before = reasons_by_hand([one for one in record.exclusions if one.date <= date]).keys()
    now = reasons_by_hand(record.exclusions).keys()
    for shots, words in ((now - before, "excluded"), (before - now, "counted again")):
        if shots:
            numbers, action = ", ".join(map(str, sorted(shots))), amendment(record.entry.id)
            yield f"shots {words} after the issue: {numbers}; issue an amendment: {action}"


def missing_records(stored: Sequence[StoredShot], data_dir: Path) -> list[str]:
    """Return which records of swings are missing below `data_dir`, or of another size than stored."""
    found = []
    for one in stored:
        if not one.file:
            continue
        path = data_dir / one.file
        if not path.is_file():
            found.append(f"shot {one.shot.shot}: record {one.file} is missing")
        elif path.stat().st_size != one.bytes:
            size = f"{path.stat().st_size} bytes, stored {one.bytes}"
            found.append(f"shot {one.shot.shot}: record {one.file} has {size}")
    return _first(found)


def _embedded(record: CampaignRecord, page: str, place: str) -> Mapping[str, Any]:
    match = _DATA.search(page)
    action = "Write the report again: golfbench campaign report ID."
    data = json_object(match[1] if match else "")
    if data is None or not {"campaign", "shots", "figures", "units", "issue"} <= data.keys():
        raise BenchError(place, "no data of a report", "a report of this version of golfbench", action)
    if data["campaign"] != record.entry.id:
        raise BenchError(place, f"the report of {data['campaign']}", f"that of {record.entry.id}", action)
    return data


def _digests(data: Mapping[str, Any], found: Digests, page: str) -> Iterator[str]:
    for name, value in found.parts.items():
        if data["parts"].get(name) != value:
            then = str(data["parts"].get(name, ""))
            yield f"{name}: not as reported (digest {value[:16]}, in the report {then[:16]})"
    if data["digest"] != found.whole and data["parts"] == found.parts:
        yield f"digest: {data['digest'][:16]} in the report, {found.whole[:16]} by the records"
    if page.count(str(data["digest"])) < 2:
        yield "digest: the page shows another one than its data"


def _shots(record: CampaignRecord, digests: Sequence[str], reported: str) -> list[str]:
    then = [reported[at : at + SHOT_DIGITS] for at in range(0, len(reported), SHOT_DIGITS)]
    found = [
        f"shot {shot.shot}: not as reported"
        for shot, digest, before in zip(record.shots, digests, then, strict=False)
        if not digest.startswith(before)
    ]
    if len(then) != len(record.shots):
        found.insert(0, f"shots: {len(then)} in the report, {len(record.shots)} in the records")
    return _first(found)


def _figures(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if not isinstance(value, dict | list):
        yield path, value
        return
    for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
        yield from _figures(inner, f"{path}.{key}" if path else str(key))


def _changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    for path in sorted(path for path in before.keys() | now.keys() if not _TEXTS.search(path)):
        one, two = before.get(path), now.get(path)
        if isinstance(one, float | int) and isinstance(two, float | int):
            if not isclose(one, two, rel_tol=_TOLERANCE, abs_tol=1e-12):
                yield f"{path}: {one:.10g} in the report, {two:.10g} by the records"
        elif one != two:
            then, found = ("nothing" if value is None else value for value in (one, two))
            yield f"{path}: {then} in the report, {found} by the records"


def _first(found: Sequence[str]) -> list[str]:
    more = len(found) - _MAX_DIFFERENCES
    return [*found[:_MAX_DIFFERENCES], f"... and {more} more"] if more > 0 else list(found)
