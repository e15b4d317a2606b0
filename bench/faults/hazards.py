"""The hazard table for the person who signs the installation, made from the matrix."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import files
from textwrap import wrap
from typing import Any

import jinja2

from bench.faults.catalogue import HARDWARE
from sim.faults import sort_of

_WIDTH = 119
"""Columns of a paragraph."""


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
    rules: dict[str, list[str]] = {}
    for row in summary["rows"]:
        for rule in row["rules"]:
            rules.setdefault(rule, []).append(row["breakage"])
    return markdown(
        "hazards.md.j2",
        s={"comparison": [], **summary},
        every=summary["origin"].get("every", 1),
        next_swing=next_swing_text(summary),
        rules=rules,
        hardware_for=hardware_for,
    )


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
