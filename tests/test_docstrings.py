"""Names in docstrings exist: one that was renamed or removed is found here."""

from __future__ import annotations

import ast
import builtins
import re
import sys
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from bench.records.telemetry.cycle_record import arrow_schema

TOP = Path(__file__).resolve().parent.parent
FILES = sorted(path for package in ("bench", "drivers", "sim") for path in (TOP / package).rglob("*.py"))
NAME = re.compile(r"(?<!`)`([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*)(?:\([^`]*\))?`(?!`)")


def _texts(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the line and text of each docstring, also those below fields and constants."""
    for node in ast.walk(tree):
        match node:
            case ast.Expr(value=ast.Constant(value=str(text))):
                yield node.lineno, text


@cache
def _trees() -> dict[Path, ast.Module]:
    return {path: ast.parse(path.read_text()) for path in FILES}


@cache
def _known() -> frozenset[str]:
    """Return every word that the project's code, apart from its docstrings, and its data files use."""
    found = set(dir(builtins)) | set(sys.stdlib_module_names) | {path.stem for path in FILES}
    found |= {field.name for field in arrow_schema()}
    for tree in _trees().values():
        documentation = {text for _, text in _texts(tree)}
        for node in ast.walk(tree):
            match node:
                case ast.Name(id=name) | ast.Attribute(attr=name) | ast.arg(arg=name):
                    found.add(name)
                case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.keyword(arg=str(name)):
                    found.add(name)
                case ast.alias(name=name):
                    found |= set(name.split("."))
                case ast.Constant(value=str(text)) if text not in documentation:
                    found |= set(re.findall(r"\w+", text))
    for path in (*TOP.glob("config.toml"), *TOP.glob("bench/**/*.toml"), *TOP.glob("bench/**/*.j2")):
        found |= set(re.findall(r"\w+", path.read_text()))
    return frozenset(found)


def _exists(name: str) -> bool:
    first, *rest = name.split(".")
    if first not in ("bench", "drivers", "sim") or not rest:
        elsewhere = bool(rest) and find_spec(first) is not None
        return elsewhere or all(part in _known() for part in (first, *rest))
    for length in range(len(rest), -1, -1):
        module = TOP.joinpath(first, *rest[:length])
        if module.with_suffix(".py").exists() or module.is_dir():
            found = import_module(".".join([first, *rest[:length]]))
            for attribute in rest[length:]:
                if not hasattr(found, attribute):
                    return False
                found = getattr(found, attribute)
            return True
    return False


def test_package_docstring_names_are_own_modules() -> None:
    for path, tree in _trees().items():
        if path.name == "__init__.py":
            named = set(NAME.findall(ast.get_docstring(tree) or ""))
            assert named <= {path.parent.name, *(module.stem for module in path.parent.iterdir())}, path


def test_docstring_names_exist() -> None:
    lost = [
        f"{path.relative_to(TOP)}:{line}: `{name}`"
        for path, tree in _trees().items()
        for line, text in _texts(tree)
        for name in NAME.findall(text)
        if not _exists(name)
    ]
    assert lost == []
