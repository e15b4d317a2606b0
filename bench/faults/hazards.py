"""The hazard table for the person who signs the installation, made from the matrix."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from hashlib import sha256
from importlib.resources import files
from textwrap import wrap
from typing import Any

import jinja2

from bench.faults.catalogue import HARDWARE
from sim.faults import sort_of

_WIDTH = 119
"""Columns of a paragraph."""
_OF_THE_RUN = frozenset({"origin", "seconds", "comparison"})
"""Keys of a summary that differ between two runs with the same outcomes."""


def part_of(signal: str) -> tuple[str, str]:
    """Return the part or sort of parts of `signal`, and the protection that only hardware gives."""
    for name, text in HARDWARE:
        if name in (signal, sort_of(signal)):
            return name, text
    return sort_of(signal), "not needed"


def next_swing_text(summary: Mapping[str, Any]) -> str:
    """Return how many undetected faults are named before another ball is struck, "" without any."""
    found = summary["next_swing"]
    if not found:
        return ""
    count = sum(found.values())
    return f"Of {count} undetected {count - found.get('', 0)} are named before another ball is struck."


def matrix_digest(summary: Mapping[str, Any]) -> str:
    """Return the digest of all outcomes in the matrix's `summary` (16 hex digits)."""
    outcomes = {key: value for key, value in summary.items() if key not in _OF_THE_RUN}
    return sha256(json.dumps(outcomes, sort_keys=True).encode()).hexdigest()[:16]


def hazard_table(summary: dict[str, Any], *, brief: bool = False) -> str:
    """Return the table as Markdown, one row a fault, or if `brief` one row a sort of parts."""
    rules: dict[str, list[str]] = {}
    for row in summary["rows"]:
        for rule in row["rules"]:
            rules.setdefault(rule, []).append(row["breakage"])
    return markdown(
        "hazards.md.j2",
        s={"comparison": [], **summary},
        every=summary["origin"].get("every", 1),
        digest=matrix_digest(summary),
        next_swing=next_swing_text(summary),
        brief=brief,
        parts=_by_part(summary["rows"]),
        rules=rules,
        part_of=part_of,
    )


def _by_part(rows: Sequence[Mapping[str, Any]]) -> list[tuple[Any, ...]]:
    """Return part, faults, cases, undetected and unsafe ones, and what only hardware covers."""
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
    """Return `text` as the lines of a paragraph."""
    lines = wrap(" ".join(text.split()), _WIDTH, break_long_words=False, break_on_hyphens=False)
    return "\n".join(lines) + "\n"


def _cells(entry: Mapping[str, Any], *keys: str) -> tuple[Any, ...]:
    return tuple(entry[key] for key in keys)


def _row(cells: Sequence[Any]) -> str:
    """Return a row of a Markdown table."""
    return f"| {' | '.join(str(cell).replace('|', '/') for cell in cells)} |"
