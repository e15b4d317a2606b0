"""The documents stay true: links, paths, commands, exit codes, and the drawing of floors."""

from __future__ import annotations

import re
import shlex
import tomllib
from enum import Enum
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import pytest
import typer

from bench.base.errors import ExitCode
from bench.commands.cli import EXIT_CODES, app

ROOT = Path(__file__).resolve().parents[1]
SKIPPED = {".venv", "data", "node_modules"}
DOCUMENTS = sorted(
    path for path in ROOT.rglob("*.md") if not any(part in SKIPPED for part in path.relative_to(ROOT).parts)
)
TOP = "bench|sim|drivers|tests|systemd|\\.github|\\.ci"
PATH_IN_TEXT = re.compile(rf"`((?:{TOP})/[\w./-]*(?:\.\w+|/))`")
"""A path from the top of the project in backticks: it ends with an extension or a slash."""
LINK = re.compile(r"\]\((?!https?:|#|mailto:)([^)#\s]+)")
COMMAND = re.compile(r"(?:^|`)[ \t]*(?:\$ )?(?:sudo )?(?:\S*/)?golfbench ((?:[a-z]|--)[^`\n]*)", re.MULTILINE)
PLACEHOLDERS = ("…", "...", "|", "\\|")


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def _paths(text: str) -> list[str]:
    """Return the paths that `text` names from the top of the project; NAME and ID are placeholders."""
    return [path for path in PATH_IN_TEXT.findall(text) if not re.search(r"\b(NAME|ID)\b", path)]


def _section(document: str, title: str) -> str:
    """Return the section of `document` whose title begins with `title`."""
    return (ROOT / document).read_text().partition(f"## {title}")[2].partition("\n## ")[0]


def _commands(text: str) -> list[str]:
    """Return the arguments of `golfbench` in each command line in `text`, without comment."""
    return [found[1].split("   ", 1)[0].split(" #", 1)[0].rstrip("&` ") for found in COMMAND.finditer(text)]


def _choices(annotation: Any) -> set[str]:
    """Return the values that an option of this annotation takes; empty if it takes any."""
    if get_origin(annotation) is Literal:
        return {str(value) for value in get_args(annotation)}
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return {str(member.value) for member in annotation}
    return {choice for part in get_args(annotation) for choice in _choices(part)}


def _parse(command: Any, context: Any, arguments: list[str]) -> tuple[dict[str, Any], list[str]]:
    """Return options by name and the rest of `arguments`; assert that the options exist."""
    try:
        options, leftover, _ = command.make_parser(context).parse_args(list(arguments))
    except Exception as error:
        raise AssertionError(f"{context.command_path}: {error}") from None
    return options, leftover


def _check_parses(command: Any, line: str) -> None:
    """Assert that `line`, the arguments of `golfbench`, consists of an existing command and options."""
    words = [word.strip("[]") for word in shlex.split(line)]
    arguments = [word for word in words if word and word not in PLACEHOLDERS]
    context = command.context_class(command, info_name="golfbench")
    while hasattr(command, "commands"):
        _, arguments = _parse(command, context, arguments)
        if not arguments:
            return  # the name of a group in a sentence
        name, *arguments = arguments
        assert name in command.commands, f"{context.command_path} has no command {name}"
        command = command.commands[name]
        context = command.context_class(command, info_name=name, parent=context)
    options, leftover = _parse(command, context, arguments)
    assert not leftover, f"unexpected {leftover}"
    for parameter in command.params:
        choices = _choices(parameter.type_descriptor.annotation)
        given = options.get(parameter.name)
        if choices and isinstance(given, str):
            assert set(given.split("|")) <= choices, f"--{parameter.name} takes {sorted(choices)}"


def _floors(text: str) -> dict[str, list[set[str]]]:
    """Return the floors of each root package in the drawing of bench/README.md, from the top."""
    block = re.search(r"## Floors.*?```\n(.*?)```", text, re.DOTALL)
    assert block is not None
    floors: dict[str, list[set[str]]] = {}
    root = ""
    for line in block[1].splitlines():
        root = line[:9].strip() or root
        rooms = re.split(r"\s{2,}", line[9:].strip())[0]
        floors.setdefault(root, []).append(set(rooms.split(" · ")))
    return floors


def test_readme_is_at_most_100_lines() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 100


@pytest.mark.parametrize("path", DOCUMENTS, ids=_name)
def test_document_links_and_paths_exist(path: Path) -> None:
    text = path.read_text()
    missing = [target for target in LINK.findall(text) if not (path.parent / target).exists()]
    missing += [named for named in _paths(text) if not (ROOT / named).exists()]
    assert not missing


@pytest.fixture(scope="module")
def golfbench() -> Any:
    """The command line."""
    return typer.main.get_command(app)


@pytest.mark.parametrize("path", DOCUMENTS, ids=_name)
def test_document_commands_parse(path: Path, golfbench: Any) -> None:
    wrong = []
    for line in _commands(path.read_text()):
        try:
            _check_parses(golfbench, line)
        except AssertionError as error:
            wrong.append(f"golfbench {line}: {error}")
    assert not wrong


@pytest.mark.parametrize(
    "line",
    ["profile nowhere", "swing list", "run --porfile default", "run --driver", "status more", "demo --seed"],
)
def test_check_parses_wrong_command_fails(line: str, golfbench: Any) -> None:
    assert _commands(f"```\n$ golfbench {line}   # comment\n```") == [line]
    with pytest.raises(AssertionError):
        _check_parses(golfbench, line)


def test_exit_codes_are_documented_and_used() -> None:
    assert set(EXIT_CODES) == set(ExitCode)
    code = "".join(path.read_text() for path in (ROOT / "bench").rglob("*.py") if path.name != "cli.py")
    code += (ROOT / "bench/commands/cli.py").read_text().partition("_EPILOG")[2]
    assert [member.name for member in ExitCode if f"ExitCode.{member.name}" not in code] == []


def test_floors_drawing_matches_import_contracts() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    contracts = {
        contract["containers"][0]: [set(floor.split(" | ")) for floor in contract["layers"]]
        for contract in project["tool"]["importlinter"]["contracts"]
        if contract["type"] == "layers" and contract.get("containers") in (["bench"], ["sim"], ["drivers"])
    }
    assert _floors((ROOT / "bench/README.md").read_text()) == contracts


def _named(row: str) -> tuple[list[Path], list[str], list[str]]:
    """Return the files that a row of the table of changes names, those that are missing, and its symbols."""
    found, missing, symbols = list[Path](), list[str](), list[str]()
    for word in re.findall(r"`([^`]+)`", row):
        if re.fullmatch(r"[\w./@-]+(\.\w+|/)|Makefile|\.ci/run", word):
            near = (folder for path in reversed(found) for folder in (path, *path.parents[:2]))
            paths = [folder / word for folder in (ROOT, *near) if (folder / word).exists()]
            found += paths[:1]
            missing += [] if paths else [word]
        elif re.fullmatch(r"[A-Za-z_]\w*", word):
            symbols.append(word)
    return found, missing, symbols


def test_change_table_files_and_symbols_exist() -> None:
    rows = _section("bench/README.md", "Where do I change").partition("|---|---|\n")[2].split("\n\n")[0]
    wrong = []
    for row in rows.splitlines():
        found, missing, symbols = _named(row.partition(" | ")[2])
        text = "".join(path.read_text() for path in found if path.is_file())
        wrong += missing + [name for name in symbols if not re.search(rf"\b{name}\b", text)]
        wrong += [] if found else [row]
    assert len(rows.splitlines()) >= 20
    assert wrong == []


def test_fault_matrix_figures_match_documents() -> None:
    found = re.search(
        r", (\d+) cases(?:, a sample of one in \d+,)? from (\d+) instants, .*: (\d+) [^,]*, (\d+) [^,]*, "
        r"(\d+) [^,]*, (\d+) unsafe; (\d+)",
        (ROOT / "sim/FAULTS.md").read_text(),
        re.MULTILINE,
    )
    assert found is not None
    cases, instants, safe, harmless, undetected, unsafe, excluded = found.groups()
    assert f"{unsafe} of {cases} fault cases" in (ROOT / "README.md").read_text()
    text = " ".join((ROOT / "bench/faults/README.md").read_text().split())
    assert f"{cases} cases from {instants} instants" in text
    assert f"{safe} detected and safe, {harmless} without harm, {undetected} undetected" in text
    assert f"{unsafe} unsafe; {excluded} pairs" in text


def test_changelog_starts_with_project_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    first = re.search(r"^## (\S+)", (ROOT / ".github/CHANGELOG.md").read_text(), re.MULTILINE)
    assert first is not None
    assert first[1] == project["version"]
