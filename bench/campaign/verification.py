"""Is a report still what the records say? Digest, every figure and every text are computed again.

A page carries, as data, the digests of what it was made from and its figures with all digits. Verifying
computes both from the records, and writes the page again to compare the texts shown.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import SequenceMatcher
from html.parser import HTMLParser
from math import isclose
from pathlib import Path
from typing import Any

from bench.campaign.campaign_record import CampaignRecord
from bench.campaign.campaign_report import record_parts, render_campaign_report
from bench.campaign.digest import SHOT_DIGITS, shot_digests, whole_digest
from bench.campaign.findings import findings, findings_record
from bench.campaign.interruptions import software_versions
from bench.campaign.reader_units import UnitSystem
from bench.errors import BenchError
from bench.store.campaigns import StoredShot

_MOST = 20
"""Max number of differences of one kind that are named."""
_TOLERANCE = 1e-9
"""Share by which a figure may differ: libraries of another machine round differently."""
_DATA = re.compile(r'<script type="application/json" id="record">(.*?)</script>', re.DOTALL)
_TODAY = re.compile(r"<section data-today>.*?</section>", re.DOTALL)
"""Parts of a page that count on after the campaign, as the wear of the bench's parts."""
_MARK, _VOID = "<svg>", frozenset({"img", "meta", "link", "br"})
_PICTURE = re.compile(r"<svg.*?</svg>", re.DOTALL)


@dataclass(frozen=True)
class Verification:
    """Result of comparing a page with the records."""

    digest: str
    """Of the records."""
    figures: int
    """Number of figures that were computed again."""
    texts: int
    """Number of texts that were compared; 0 if the page is of another version of golfbench."""
    differences: tuple[str, ...]


def verify_page(record: CampaignRecord, page: str, place: str) -> Verification:
    """Return how `page`, the text of a report, differs from the records.

    Raises:
        BenchError: it is no report of this campaign.
    """
    data = _embedded(record, page, place)
    shots, differences = shot_digests(record.shots), list[str]()
    parts = record_parts(record, shots)
    digest = whole_digest(parts)
    differences += _digests(data, parts, digest, page)
    differences += _shots(record, shots, str(data["shots"]))
    units, issued = UnitSystem(data["units"]), int(data["issue"])
    issues = {id(event) for event in record.issues[issued:]}
    then = replace(record, events=[event for event in record.events if id(event) not in issues])
    found = findings(record.plan, record.shots, data["looks"], units)
    figures = json.loads(json.dumps(findings_record(found)))
    changed = list(_changed(data["figures"], figures, ""))
    differences += _first(changed)
    texts = 0
    if data["software"] == software_versions()["source"]:
        texts, unlike = _compared(page, render_campaign_report(then, found, units))
        differences += _first(unlike)
    return Verification(digest, _leaves(figures), texts, tuple(differences))


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
    """Return the data that `page` carries."""
    match = _DATA.search(page)
    cure = "Write the report again: golfbench campaign report ID."
    try:
        data: Any = json.loads(match[1]) if match else None
    except ValueError:
        data = None
    if not isinstance(data, dict) or not {"campaign", "shots", "figures", "units", "issue"} <= data.keys():
        raise BenchError(place, "no data of a report", "a report of this version of golfbench", cure)
    if data["campaign"] != record.entry.id:
        raise BenchError(place, f"the report of {data['campaign']}", f"that of {record.entry.id}", cure)
    return data


def _digests(data: Mapping[str, Any], parts: Mapping[str, str], digest: str, page: str) -> Iterator[str]:
    for name, value in parts.items():
        if data["parts"].get(name) != value:
            then = str(data["parts"].get(name, ""))
            yield f"{name}: not as reported (digest {value[:16]}, in the report {then[:16]})"
    if data["digest"] != digest and data["parts"] == parts:
        yield f"digest: {data['digest'][:16]} in the report, {digest[:16]} by the records"
    if page.count(str(data["digest"])) < 2:
        yield "digest: the page shows another one than its data"


def _shots(record: CampaignRecord, digests: Sequence[str], reported: str) -> list[str]:
    """Return which shots differ from the reported ones."""
    then = [reported[at : at + SHOT_DIGITS] for at in range(0, len(reported), SHOT_DIGITS)]
    found = [
        f"shot {shot.shot}: not as reported"
        for shot, digest, before in zip(record.shots, digests, then, strict=False)
        if not digest.startswith(before)
    ]
    if len(then) != len(record.shots):
        found.insert(0, f"shots: {len(then)} in the report, {len(record.shots)} in the records")
    return _first(found)


def _changed(before: Any, now: Any, path: str) -> Iterator[str]:
    """Yield the figures that differ, with their path."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in sorted(before.keys() | now.keys()):
            yield from _changed(before.get(key), now.get(key), f"{path}.{key}" if path else key)
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        for place, (one, two) in enumerate(zip(before, now, strict=True)):
            yield from _changed(one, two, f"{path}.{place}")
    elif isinstance(before, float | int) and isinstance(now, float | int):
        if not isclose(before, now, rel_tol=_TOLERANCE, abs_tol=1e-12):
            yield f"{path}: {before:.10g} in the report, {now:.10g} by the records"
    elif before != now:
        yield f"{path}: {_short(before)} in the report, {_short(now)} by the records"


def _short(value: Any) -> str:
    if isinstance(value, dict | list):
        return f"{len(value)} entries"
    return "nothing" if value is None else str(value)


def _leaves(value: Any) -> int:
    """Return the number of figures in `value`."""
    if isinstance(value, dict):
        return sum(map(_leaves, value.values()))
    if isinstance(value, list):
        return sum(map(_leaves, value))
    return int(isinstance(value, float | int) and not isinstance(value, bool))


class _Texts(HTMLParser):
    """The texts of a page with the heading and the row that they stand in."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, str]] = []
        self._open: list[str] = []
        self._heading = self._row = ""

    @property
    def _place(self) -> str:
        return ", ".join(filter(None, (self._heading, self._row)))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note where the next text stands."""
        if tag == "img":
            self.found.append((self._place, _MARK))
        if tag in _VOID:
            return
        self._open = [*self._open[-8:], tag]
        if tag == "tr":
            self._row = ""

    def handle_endtag(self, tag: str) -> None:
        """Leave an element."""
        if self._open and self._open[-1] == tag:
            self._open.pop()

    def handle_data(self, data: str) -> None:
        """Take a text."""
        text, tag = " ".join(data.split()), self._open[-1] if self._open else ""
        if not text or tag in {"style", "script"}:
            return
        if tag in {"h1", "h2", "h3", "title"}:
            self._heading, self._row = text, ""
        self.found.append((self._place, text))
        if tag == "th" and not self._row:
            self._row = text


def _texts(page: str) -> list[tuple[str, str]]:
    """Return (place, text) of all texts and pictures of `page`."""
    parser, pictures = _Texts(), iter(_PICTURE.findall(page))
    parser.feed(_PICTURE.sub("<img>", page))
    return [(place, next(pictures)) if text == _MARK else (place, text) for place, text in parser.found]


def _compared(page: str, again: str) -> tuple[int, list[str]]:
    """Return the number of texts of `page`, and those that differ from a page written `again`."""
    one, two = (_TODAY.sub("", text) for text in (page, again))
    texts = _texts(one)
    if one == two:
        return len(texts), []
    others, found = _texts(two), list[str]()
    matcher = SequenceMatcher(None, texts, others, autojunk=len(texts) > 20_000)
    for what, begin, end, start, stop in matcher.get_opcodes():
        if what == "equal":
            continue
        place = (texts[begin:end] or others[start:stop])[0][0]
        shown = " ".join(_named(text) for _, text in texts[begin:end]) or "nothing"
        right = " ".join(_named(text) for _, text in others[start:stop]) or "nothing"
        found.append(f"page, {place}: {shown[:160]!r} is shown, {right[:160]!r} by the records")
    if not found:
        found.append("page: mark-up or style differ from those of a report by the records")
    return len(texts), found


def _named(text: str) -> str:
    return "a picture" if text.startswith("<svg") else text


def _first(found: Sequence[str]) -> list[str]:
    more = len(found) - _MOST
    return [*found[:_MOST], f"... and {more} more"] if more > 0 else list(found)
