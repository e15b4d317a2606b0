"""The generated parts of the manual, from the code.

.venv/bin/python -m tests.manual      # renews them after a change of causes, plan keys, commands or messages
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from bench.cli import EXIT_CODES, command_line
from bench.lifecycle import CAUSE_WORDS, REFUSAL_WORDS, Cause, Refusal
from bench.network.wire_contract import wire_contract
from tests.bench.network.contract_page import contract_tables, table

ROOT = Path(__file__).resolve().parents[1]
MANUAL = ROOT / "bench/manual"


def message_tables() -> dict[str, str]:
    """Return the tables of causes and refusals."""
    causes = [(f"`{one.name}`", *CAUSE_WORDS[one]) for one in Cause if one]
    refusals = [(f"`{one.name}`", *REFUSAL_WORDS[one]) for one in Refusal if one]
    head = ("code", "meaning", "action")
    return {"causes": table(head, causes), "refusals": table(head, refusals)}


def plan_key_tables() -> dict[str, str]:
    """Return the list of a plan's sections, each with the table of its keys."""
    parts = []
    for heading, about, rows in _sections((ROOT / "bench/campaign/defaults.toml").read_text()):
        parts.append(f"## {heading}\n" + (f"\n{about}\n" if about else ""))
        if rows:
            parts.append(table(("key", "default", "meaning"), rows) + "\n")
    return {"keys": "\n".join(parts)}


def command_tables() -> dict[str, str]:
    """Return the tables of all commands, with the first sentence of their help, and of the exit codes."""
    codes = [(str(int(code)), *texts) for code, texts in EXIT_CODES.items()]
    return {
        "commands": table(("command", "purpose"), list(_commands(command_line(), "golfbench"))),
        "exit codes": table(("code", "meaning", "action"), codes),
    }


def contract_parts() -> dict[str, str]:
    """Return the tables of the wire contract."""
    return contract_tables(wire_contract())


PARTS: Mapping[Path, Callable[[], dict[str, str]]] = {
    MANUAL / "operator/messages.md": message_tables,
    MANUAL / "test_engineer/plan_keys.md": plan_key_tables,
    MANUAL / "command_line.md": command_tables,
    MANUAL / "integrator/wire_contract.md": contract_parts,
}
"""Function of the generated parts by page."""


def page(path: Path) -> str:
    """Return the text of the page at `path` with its generated parts renewed."""
    text = path.read_text()
    for name, content in PARTS[path]().items():
        found = re.search(rf"(<!-- {name}: begin -->\n).*?<!-- {name}: end -->", text, re.DOTALL)
        assert found is not None, name
        text = f"{text[: found.end(1)]}{content}\n<!-- {name}: end -->{text[found.end() :]}"
    return text


def _sections(text: str) -> Iterator[tuple[str, str, list[tuple[str, ...]]]]:
    """Yield heading, comment and rows (key, default, meaning) per section of the commented TOML `text`."""
    heading, about, rows = "", "", list[tuple[str, ...]]()
    for line in text.splitlines():
        if section := re.match(r"\[(.+?)\]\s*(?:# (.*))?$", line):
            if heading:
                yield heading, about, rows
            heading, about, rows = f"`[{section[1]}]`", section[2] or "", []
        elif key := re.match(r"(\w+) = (.*?)(?:\s+# (.*))?$", line):
            rows.append((f"`{key[1]}`", f"`{key[2]}`", (key[3] or "").replace("|", "\\|")))
        elif (more := re.match(r"\s+# (.*)", line)) and rows:
            rows[-1] = (*rows[-1][:2], f"{rows[-1][2]} {more[1]}")
        elif more:
            about = f"{about} {more[1]}"
    yield heading, about, rows


def _commands(command: Any, name: str) -> Iterator[tuple[str, str]]:
    for part, below in sorted(getattr(command, "commands", {}).items()):
        if hasattr(below, "commands"):
            yield from _commands(below, f"{name} {part}")
        else:
            first = re.split(r"(?<=\.)\s", (below.help or "").replace("\\[", "["))[0]
            yield f"`{name} {part}`", first.replace("|", "\\|")


if __name__ == "__main__":
    for path in PARTS:
        path.write_text(page(path))
