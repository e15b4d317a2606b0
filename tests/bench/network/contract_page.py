"""The tables of the wire contract's page, from the contract itself; `python -m tests.manual` writes them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


def contract_tables(contract: dict[str, Any]) -> dict[str, str]:
    """Return the generated parts of the page by name."""
    telemetry = contract["telemetry"]
    columns: dict[tuple[str, str, str, str], list[str]] = {}
    for column in telemetry["columns"]:
        about = column["description"].replace("|", "\\|")
        columns.setdefault((about, column["type"], column["unit"], column.get("enumeration", "")), []).append(
            f"`{column['name']}`"
        )
    return {
        "keys": table(
            ("key", "encoding", "when", "content"),
            [
                (f"`{row['key']}`", row["encoding"], row["when"], row["content"])
                for row in contract["published"]
            ]
            + [
                ("`golfbench/BENCH/command/VERB`", "application/json", "query", "commands, see below"),
                (f"`{contract['schema']['key']}`", "application/json", "query", "this contract"),
            ],
        ),
        "commands": table(
            ("command", "lease", "keys", "accepted in"),
            [
                (
                    f"`{form['name']}`",
                    "yes" if form["lease"] else "no",
                    ", ".join(
                        f"`{key}`" + (" (optional)" if key not in form["request"]["required"] else "")
                        for key in form["request"]["properties"]
                    ),
                    ", ".join(form["accepted_in"] or ["not bound to a state"]),
                )
                for form in contract["commands"]["forms"]
            ],
        ),
        "lease": list_text(contract["lease"]["rules"])
        + "\n- Its duration: {min_seconds:g} to {max_seconds:g} s, {default_seconds:g} s by default.".format(
            **contract["lease"]
        ),
        "loss": list_text(contract["loss"]),
        "telemetry": f"Each message is {telemetry['form']}, at most {telemetry['max_rows']} rows, schema "
        f"`{telemetry['version']['golfbench_schema']}`. The batch's metadata: "
        + "; ".join(f"`{key}`, {text}" for key, text in telemetry["batch_metadata"].items())
        + ".\n\n"
        + table(
            ("columns", "type", "unit", "content"),
            [(" ".join(names), kind, unit, about) for (about, kind, unit, _), names in columns.items()],
        ),
        "enumerations": table(
            ("enumeration", "names"),
            [
                (
                    f"`{name}`",
                    ", ".join(f"{code} {text}" for code, text in members.items())
                    if isinstance(members, dict)
                    else ", ".join(members),
                )
                for name, members in contract["enumerations"].items()
            ],
        ),
        "versions": list_text(contract["may_change"]),
    }


def table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """Return a table in Markdown with `head` and `rows`."""
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def list_text(lines: list[str]) -> str:
    """Return `lines` as a list in Markdown."""
    return "\n".join(f"- {line}" for line in lines)
