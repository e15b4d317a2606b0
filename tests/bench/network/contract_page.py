"""The tables of the wire contract's page, from the contract itself.

.venv/bin/python -m tests.bench.network.contract_page      # renews them after a change of the contract
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.network import wire_contract as contract_module
from bench.network.wire_contract import wire_contract

PAGE = Path(contract_module.__file__).with_name("README.md")


def tables(contract: dict[str, Any]) -> dict[str, str]:
    """Return the generated parts of the page by name."""
    telemetry = contract["telemetry"]
    columns: dict[tuple[str, str, str, str], list[str]] = {}
    for column in telemetry["columns"]:
        about = column["description"].replace("|", "\\|")
        columns.setdefault((about, column["type"], column["unit"], column.get("enumeration", "")), []).append(
            f"`{column['name']}`"
        )
    return {
        "keys": _table(
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
        "commands": _table(
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
        "lease": _list(contract["lease"]["rules"])
        + "\n- Its duration: {min_seconds:g} to {max_seconds:g} s, {default_seconds:g} s by default.".format(
            **contract["lease"]
        ),
        "loss": _list(contract["loss"]),
        "telemetry": f"Each message is {telemetry['form']}, at most {telemetry['max_rows']} rows, schema "
        f"`{telemetry['version']['golfbench_schema']}`. The batch's metadata: "
        + "; ".join(f"`{key}`, {text}" for key, text in telemetry["batch_metadata"].items())
        + ".\n\n"
        + _table(
            ("columns", "type", "unit", "content"),
            [(" ".join(names), kind, unit, about) for (about, kind, unit, _), names in columns.items()],
        ),
        "enumerations": _table(
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
        "versions": _list(contract["may_change"]),
    }


def page(text: str) -> str:
    """Return the page `text` with its generated parts renewed."""
    for name, content in tables(wire_contract()).items():
        found = re.search(rf"(<!-- {name}: begin -->\n).*?<!-- {name}: end -->", text, re.DOTALL)
        assert found is not None, name
        text = f"{text[: found.end(1)]}{content}\n<!-- {name}: end -->{text[found.end() :]}"
    return text


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _list(lines: list[str]) -> str:
    return "\n".join(f"- {line}" for line in lines)


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text()))
