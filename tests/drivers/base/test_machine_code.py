"""The digest of what machine code depends on, and the pruning of old caches."""

from __future__ import annotations

import ast
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.base.machine_code import (
    compiled_sources,
    mark_in_use,
    module_digests,
    prune_versions,
    source_digest,
)

TOP = Path(__file__).parents[3]
PACKAGES = ("bench", "drivers", "sim")


def parsed() -> dict[str, tuple[str, ast.Module]]:
    """Return path and syntax tree of every module of the packages, keyed by the module's name."""
    trees = {}
    for package in PACKAGES:
        for path in (TOP / package).rglob("*.py"):
            relative = path.relative_to(TOP)
            parts = relative.with_suffix("").parts
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            trees[name] = (relative.as_posix(), ast.parse(path.read_bytes()))
    return trees


def imported(module: str, is_package: bool, tree: ast.Module) -> Iterator[str]:
    """Yield the names that `tree` imports, absolute, at any depth."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = module.split(".")[: None if is_package and node.level == 1 else -node.level]
                base = ".".join([*package, *([base] if base else [])])
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)


def has_compiled_function(tree: ast.Module) -> bool:
    return any(
        isinstance(decorator, ast.Name) and decorator.id.startswith("compiled")
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
        for decorator in node.decorator_list
    )


@pytest.mark.slow
def test_compiled_sources_contain_all_imported_files() -> None:
    trees = parsed()
    reached = set[str]()
    waiting = [module for module, (_, tree) in trees.items() if has_compiled_function(tree)]
    assert len(waiting) > 30
    while waiting:
        module = waiting.pop()
        if module in trees and module not in reached:
            reached.add(module)
            path, tree = trees[module]
            waiting += [module.rpartition(".")[0], *imported(module, path.endswith("/__init__.py"), tree)]
    paths = compiled_sources(TOP)
    assert {trees[module][0] for module in reached} <= paths.keys()
    assert {
        "bench/base/lifecycle.py",
        "bench/records/telemetry/cycle_record.py",
        "drivers/base/__init__.py",
        "bench/control/settings.py",
    } <= paths.keys()
    assert not [path for path in paths if path.startswith("bench/commands/")]


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    for package in PACKAGES:
        shutil.copytree(TOP / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path


@pytest.mark.slow
def test_source_digest_covers_only_compiled_sources(copy: Path) -> None:
    digest = source_digest(copy)
    assert digest == source_digest() == source_digest(copy)
    sources = compiled_sources(copy)
    for path, source in sources.items():
        (copy / path).write_bytes(source + b"\n")
        assert source_digest(copy) != digest, path
        (copy / path).write_bytes(source)
    assert source_digest(copy) == digest
    other = copy / "bench/commands/cli.py"
    other.write_text(other.read_text() + "\n")
    assert source_digest(copy) == digest


def test_module_digests_change_only_for_importing_modules(copy: Path) -> None:
    digests = module_digests(copy)
    assert digests == module_digests()
    changed = copy / "bench/control/law/pid.py"
    changed.write_text(changed.read_text() + "\n")
    now = module_digests(copy)
    renewed = {module for module in digests if now[module] != digests[module]}
    assert {"bench.control.law.pid", "bench.control.step", "bench.loop.loop"} <= renewed
    assert not renewed & {"sim.kane", "sim.dynamics", "sim.flight", "bench.control.envelope", "sim.driver"}


@pytest.mark.slow
def test_compiled_functions_call_no_argument() -> None:
    """Its machine code would contain a function that its module does not import."""
    found = []
    for path, tree in parsed().values():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and has_compiled_function(ast.Module([node], [])):
                names = {argument.arg for argument in node.args.args}
                calls = [call.func for call in ast.walk(node) if isinstance(call, ast.Call)]
                found += [f"{path}: {node.name}" for call in calls if getattr(call, "id", "") in names]
    assert found == []


def test_source_digest_depends_on_paths(tmp_path: Path) -> None:
    source = "from drivers.base.compiled import compiled\n\n@compiled\ndef f(): ...\n"
    for package in PACKAGES:
        (tmp_path / package).mkdir()
    digests = set()
    for path in ("bench/a.py", "bench/b.py", "sim/a.py"):
        (tmp_path / path).write_text(source)
        digests.add(source_digest(tmp_path))
        (tmp_path / path).unlink()
    assert len(digests) == 3


@pytest.mark.parametrize(
    "line",
    [
        "import sim.constants",
        "import sim.constants as c",
        "from sim import constants",
        "from sim import (\n    constants,\n)",
        "from sim.constants import A",
        "def f():\n    from sim.constants import A",
        "if TYPE_CHECKING:\n    from sim.constants import A",
    ],
)
def test_compiled_sources_follow_every_import_form(tmp_path: Path, line: str) -> None:
    for package in PACKAGES:
        (tmp_path / package).mkdir()
    (tmp_path / "sim/constants.py").write_text("from bench.enums import B\n")
    (tmp_path / "bench/enums.py").write_text("B = 1\n")
    (tmp_path / "bench/other.py").write_text("")
    (tmp_path / "bench/user.py").write_text(f"{line}\n\n@compiled\ndef g(): ...\n")
    assert [*compiled_sources(tmp_path)] == ["bench/enums.py", "bench/user.py", "sim/constants.py"]


# Pruning ---------------------------------------------------------------------------------------------


def version(module: Path, number: int, last_used: float) -> Path:
    folder = module / f"{number:016x}"
    (folder / "sim").mkdir(parents=True)
    (folder / "sim/f.nbc").touch()
    os.utime(folder, (last_used, last_used))
    return folder


def test_prune_versions_keeps_last_used(tmp_path: Path) -> None:
    folders = [version(tmp_path, number, 1e9 + 10.0 * number) for number in range(5)]
    other = tmp_path / "notes"
    other.mkdir()
    os.utime(other, (1.0, 1.0))
    mark_in_use(folders[1])
    prune_versions(tmp_path, kept=2)
    assert sorted(tmp_path.iterdir()) == sorted([folders[1], folders[4], other])


def test_prune_and_mark_unwritable_path_do_not_raise(tmp_path: Path) -> None:
    prune_versions(tmp_path / "absent", kept=0)
    (tmp_path / "file").touch()
    mark_in_use(tmp_path / "file" / "0123456789abcdef")
    (tmp_path / "fedcba9876543210").symlink_to(tmp_path / "elsewhere")
    prune_versions(tmp_path, kept=0)
