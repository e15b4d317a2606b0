"""The generated parts of the manual, from the code.

.venv/bin/python -m tests.manual      # renews them after a change of causes, keys, commands or messages
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, get_origin, get_type_hints

from bench.base.json_schema import field_docs
from bench.base.lifecycle import CAUSE_WORDS, REFUSAL_WORDS, Cause, Refusal
from bench.commands.cli import EXIT_CODES, command_line
from bench.config import Configuration, load_configuration, shipped_configuration
from bench.config.files import _in_people_units, _Table, _tables, _written, keys_of, plain
from bench.network.messages import wire_contract
from drivers.base.ranges import Range
from sim.ball import Ball
from sim.robot import Club
from tests.bench.network.contract_page import contract_tables, table

ROOT = Path(__file__).resolve().parents[1]
MANUAL = ROOT / "bench/manual"

_UNITS = r"rad/s2|rad/s|m/s2|m/s|bit/s|1/s|Pa absolute|Pa|rad|bits|kg|Hz|m|s|V|K"
UNIT = re.compile(rf"^({_UNITS})(?=[ .,;]|$)| \(({_UNITS})\)|, ({_UNITS})(?=[ .,:;]|$)")
"""The unit in the docstring of a field: at its start, in brackets or after a comma."""


def message_tables() -> dict[str, str]:
    """Return the tables of causes and refusals."""
    causes = [(f"`{one.name}`", *CAUSE_WORDS[one]) for one in Cause if one]
    refusals = [(f"`{one.name}`", *REFUSAL_WORDS[one]) for one in Refusal if one]
    head = ("code", "meaning", "action")
    return {"causes": table(head, causes), "refusals": table(head, refusals)}


def plan_key_tables() -> dict[str, str]:
    """Return the list of a plan's sections, each with the table of its keys."""
    parts = []
    for heading, about, rows in _sections((ROOT / "bench/campaign/plan/defaults.toml").read_text()):
        parts.append(f"## {heading}\n" + (f"\n{about}\n" if about else ""))
        if rows:
            parts.append(table(("key", "default", "meaning"), rows) + "\n")
    return {"keys": "\n".join(parts)}


def configuration_key_tables() -> dict[str, str]:
    """Return the list of a configuration's sections, each with the table of its keys.

    Sections of one type, such as the three actuators, share a table.
    """
    kinds: dict[Any, list[Any]] = {}
    for one in _tables(_Table("", Configuration, load_configuration(shipped_configuration()), "")):
        kinds.setdefault(one.kind if is_dataclass(one.kind) else one.path, []).append(one)
    parts = []
    for kind, alike in kinds.items():
        if is_dataclass(kind):
            rows = [*_configuration_keys(alike)]
        else:
            rows = [*_entries(alike[0])]
        about = alike[0].comment if len(alike) == 1 else (kind.__doc__ or "").split("\n")[0].removesuffix(".")
        if rows or about:
            heading = ", ".join(f"`[{one.path}]`" for one in alike)
            parts.append(f"## {heading}\n" + (f"\n{about}\n" if about else ""))
        if rows:
            parts.append(table(("key", "unit", "default", "meaning"), rows) + "\n")
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
    MANUAL / "integrator/configuration_keys.md": configuration_key_tables,
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


def _configuration_keys(alike: list[Any]) -> Iterator[tuple[str, ...]]:
    """Yield key, unit, default and meaning of each key of the sections `alike`, which have one type."""
    kind = alike[0].kind
    hints, docs = get_type_hints(kind, include_extras=True), field_docs(kind)
    for name in keys_of(kind, f"{alike[0].path}."):
        hint = hints[name]
        if is_dataclass(hint) or get_origin(hint) is dict or (name == "name" and kind in (Club, Ball)):
            continue
        given = [_in_people_units(name, hint, plain(getattr(one.value, name), "")) for one in alike]
        values = [f"`{_written(value)}`" for _, value in given]
        values = values if len(set(values)) > 1 else values[:1]
        spans = (mark.unit for mark in getattr(hint, "__metadata__", ()) if isinstance(mark, Range))
        unit, meaning = _unit_and_meaning(" ".join(docs.get(name, "").split()).removesuffix("."), *spans)
        key = given[0][0]
        unit = {"_deg": "deg", "_hz": "Hz"}.get(key.removeprefix(name), unit)
        yield f"`{key}`", unit, ", ".join(values), meaning.replace("|", "\\|")


def _entries(section: Any) -> Iterator[tuple[str, ...]]:
    """Yield the values of a section whose keys are names, such as phases."""
    for name, value in section.value.items():
        if not is_dataclass(value):
            yield f"`{name}`", section.comment.rpartition(", ")[2], f"`{_written(value)}`", ""


def _unit_and_meaning(docs: str, unit: str = "") -> tuple[str, str]:
    """Return the `unit` of a field, or the only one that its `docs` state, and `docs` without it."""
    unit = "" if "(" in unit.replace("(s Pa)", "") else unit
    found = {next(filter(None, one.groups())): one for one in UNIT.finditer(docs)}
    if len(found) == 1 and unit in ("", *found):
        ((unit, one),) = found.items()
        docs = f"{docs[: one.start()]}{docs[one.end() :]}".lstrip(" ,;")
    return unit, re.sub(rf" \({re.escape(unit)}\)|, {re.escape(unit)}(?=[:;]|$)", "", docs) if unit else docs


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
