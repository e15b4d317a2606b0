"""Declarations hold: import contracts, dependencies, pins, entry points, the wheel, the Makefile."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterable, Iterator
from importlib.metadata import distribution, entry_points, packages_distributions, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from drivers.base import Driver

TOP = Path(__file__).resolve().parent.parent
PACKAGES = ("bench", "drivers", "sim")
PROJECT = tomllib.loads((TOP / "pyproject.toml").read_text())


def _sources() -> Iterator[Path]:
    for package in PACKAGES:
        yield from (TOP / package).rglob("*.py")


# Import contracts ------------------------------------------------------------------------------------


def _contracts(folder: Path, extra: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """Run the import contracts on a skeleton of the packages with `extra` lines in some modules."""
    contracts = tomllib.loads((TOP / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    modules = {
        f"{container.replace('.', '/')}/{room.strip()}": ""
        for contract in contracts
        for container in contract.get("containers", ())
        for floor in contract["layers"]
        for room in floor.split("|")
    }
    modules["sim/driver"] = "from drivers.base import Driver"
    modules["bench/loop"] = "import sim.plant, drivers.mock"
    for package in sorted({module.rpartition("/")[0] for module in modules}):
        (folder / package).mkdir()
        (folder / package / "__init__.py").touch()
    for module, text in (modules | extra).items():
        home = folder / module
        (home / "__init__.py" if home.is_dir() else home.with_suffix(".py")).write_text(text + "\n")
    shutil.copy(TOP / "pyproject.toml", folder)
    linter = Path(sys.executable).with_name("lint-imports")
    return subprocess.run([linter, "--no-cache"], cwd=folder, capture_output=True, text=True, check=False)


FORBIDDEN = {
    "layers": (
        {
            "drivers/mock": "import bench.loop\nfrom sim import plant",
            "sim/plant": "def late():\n    from bench import loop\nfrom drivers import mock",
            "sim/driver": "from drivers.mock import MockDriver",
            "bench/control": "import bench.config",
            "bench/campaign": "from bench import commissioning",
            "bench/store": "from bench import network",
            "bench/records/telemetry": "from bench.records import shot",
            "bench/viewer/_scene": "from bench.viewer import blueprint",
            "bench/design/_refine": "from bench.design import _blind_brake",
            "bench/commands/common": "from bench.commands import swing",
            "bench/control/envelope": "from bench.control import step",
            "bench/campaign/plan": "from bench.campaign import run",
            "bench/commissioning/machine": "from bench.commissioning import steps",
        },
        {
            "drivers.mock -> bench.loop (l.1)",
            "drivers.mock -> sim.plant (l.2)",
            "sim.plant -> bench.loop (l.2)",
            "sim.plant -> drivers.mock (l.3)",
            "sim.driver -> drivers.mock (l.1)",
            "bench.control -> bench.config (l.1)",
            "bench.campaign -> bench.commissioning (l.1)",
            "bench.store -> bench.network (l.1)",
            "bench.records.telemetry -> bench.records.shot (l.1)",
            "bench.viewer._scene -> bench.viewer.blueprint (l.1)",
            "bench.design._refine -> bench.design._blind_brake (l.1)",
            "bench.commands.common -> bench.commands.swing (l.1)",
            "bench.control.envelope -> bench.control.step (l.1)",
            "bench.campaign.plan -> bench.campaign.run (l.1)",
            "bench.commissioning.machine -> bench.commissioning.steps (l.1)",
        },
    ),
    "test tools": (
        {"sim/plant": "import sympy", "bench/loop": "import pytest"},
        {"sim.plant -> sympy (l.1)", "bench.loop -> pytest (l.1)"},
    ),
}
"""Forbidden imports, one a line, and their reports. The contract on test tools reports chains of imports:
in one tree they would hide the loss of another contract."""


def test_import_contracts_allowed_imports_pass(tmp_path: Path) -> None:
    answer = _contracts(tmp_path, {})
    assert answer.returncode == 0, answer.stdout


@pytest.mark.parametrize("kind", FORBIDDEN)
def test_import_contracts_each_forbidden_import_is_reported(kind: str, tmp_path: Path) -> None:
    lines, expected = FORBIDDEN[kind]
    answer = _contracts(tmp_path, lines)
    assert answer.returncode == 1
    assert set(re.findall(r"- +(\S+ -> \S+ \(l\.\d+\))", answer.stdout)) >= expected


def test_import_contracts_unlisted_room_is_reported(tmp_path: Path) -> None:
    answer = _contracts(tmp_path, {"bench/unlisted": ""})
    assert answer.returncode == 1
    assert "unlisted" in answer.stdout


def test_workflow_checks_every_python_on_both_processors() -> None:
    classifiers = PROJECT["project"]["classifiers"]
    named = [line.rpartition(" :: ")[2] for line in classifiers if "Python :: 3." in line]
    workflow = (TOP / ".github/workflows/check.yml").read_text()
    assert named == ["3.11", "3.12", "3.13", "3.14"]
    assert f"python: {json.dumps(named)}" in workflow
    assert "machine: [ubuntu-24.04, ubuntu-24.04-arm]" in workflow
    assert PROJECT["project"]["requires-python"] == f">={named[0]}"


# Dependencies ----------------------------------------------------------------------------------------


def _imports(nodes: Iterable[ast.AST]) -> set[str]:
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.split(".")[0])
    return found - set(sys.stdlib_module_names) - set(PACKAGES)


def test_modules_used_in_room_only_have_underscore() -> None:
    """A reader sees a room's door without opening it; commands are loaded by name."""
    paths = {path.relative_to(TOP).with_suffix("") for path in _sources()}
    users: dict[Path, set[Path]] = {path: set() for path in paths}
    for path in paths:
        for node in ast.walk(ast.parse((TOP / path).with_suffix(".py").read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                room = Path(*node.module.split("."))
                for used in {room, *(room / alias.name for alias in node.names)} & paths:
                    users[used].add(path)
    for used, by in users.items():
        if by and Path("bench/commands") not in used.parents and used.name != "__init__":
            assert used.name.startswith("_") == all(path.parent == used.parent for path in by), (used, by)


def test_dependencies_declare_every_import() -> None:
    trees = [ast.parse(path.read_text()) for path in _sources()]
    extras = PROJECT["project"]["optional-dependencies"]
    needed = PROJECT["project"]["dependencies"]
    optional = [line for name, lines in extras.items() if name not in ("dev", "benchmark") for line in lines]
    owners = packages_distributions()

    def undeclared(imported: set[str], lines: list[str]) -> set[str]:
        declared = {canonicalize_name(Requirement(line).name) for line in lines}
        return {n for n in imported if declared.isdisjoint(map(canonicalize_name, owners.get(n, [n])))}

    everywhere = set().union(*(_imports(ast.walk(tree)) for tree in trees))
    at_once = set().union(*(_imports(tree.body) for tree in trees))
    assert undeclared(everywhere, [*needed, *optional]) == set()
    assert undeclared(at_once, needed) == set()


def _needed(line: str, seen: set[str]) -> None:
    """Add the names of everything the requirement `line` installs here to `seen`."""
    requirement = Requirement(line)
    name = canonicalize_name(requirement.name)
    if name in seen and not requirement.extras:
        return
    seen.add(name)
    for further in requires(name) or ():
        marker = Requirement(further).marker
        if marker is None or any(marker.evaluate({"extra": extra}) for extra in ("", *requirement.extras)):
            _needed(further, seen)


def test_constraints_pin_every_installed_package() -> None:
    pins = [
        Requirement(line) for line in (TOP / "constraints.txt").read_text().splitlines() if line[0] != "#"
    ]
    pinned = {canonicalize_name(pin.name): str(pin.specifier) for pin in pins}
    needed: set[str] = set()
    _needed("golfbench[dev]", needed)
    installed: dict[str, str] = {name: f"=={distribution(name).version}" for name in needed - {"golfbench"}}
    assert {name: pin for name, pin in pinned.items() if name in installed} == installed


def test_constraints_lie_within_declared_bounds() -> None:
    pins = [
        Requirement(line) for line in (TOP / "constraints.txt").read_text().splitlines() if line[0] != "#"
    ]
    version = {canonicalize_name(pin.name): next(iter(pin.specifier)).version for pin in pins}
    extras = PROJECT["project"]["optional-dependencies"].values()
    bounds = [Requirement(line) for line in sum(extras, start=PROJECT["project"]["dependencies"])]
    assert [
        str(bound) for bound in bounds if version[canonicalize_name(bound.name)] not in bound.specifier
    ] == []


# What is installed -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["canopen", "daq", "mock", "sim"])
def test_driver_entry_point_loads_driver(name: str) -> None:
    (entry,) = entry_points(group="golfbench.drivers", name=name)
    contract = [name for name in dir(Driver) if not name.startswith("_")]
    assert [name for name in contract if not hasattr(entry.load(), name)] == []


MANUAL = TOP / "bench" / "manual"
"""Documents with an example; the wheel has none."""


def test_wheel_holds_code_data_and_types(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=TOP, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("golfbench-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    expected = {str(path.relative_to(TOP)) for path in _sources() if MANUAL not in path.parents}
    for package in PACKAGES:
        expected.add(f"{package}/py.typed")
        for pattern in ("*.toml", "*.j2", "*.eds", "*.json", "*.csv", "*.parquet", "static/*"):
            expected |= {str(path.relative_to(TOP)) for path in (TOP / package).rglob(pattern)}
    results = {"sim/FAULTS.md", "sim/HAZARDS.md"}
    assert expected - names == set()
    assert names & results == set()
    assert [name for name in names if name.startswith("tests/")] == []


# The Makefile ----------------------------------------------------------------------------------------


def _make(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    shutil.copy(TOP / "Makefile", folder)
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    return subprocess.run(
        ["make", *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


def test_make_old_python_fails(tmp_path: Path) -> None:
    old = tmp_path / "python3.9"
    old.write_text('#!/bin/sh\nif [ "$1" = --version ]; then echo Python 3.9.2; else exit 1; fi\n')
    old.chmod(0o755)
    answer = _make(tmp_path, "demo", f"PYTHON={old}")
    assert answer.returncode != 0
    assert "golfbench needs Python 3.11 or newer; found Python 3.9.2." in answer.stderr
    assert "make PYTHON=" in answer.stderr
    assert not (tmp_path / ".venv").exists()


def test_make_without_target_lists_targets(tmp_path: Path) -> None:
    answer = _make(tmp_path)
    assert answer.returncode == 0
    for target in ("demo", "test", "benchmark", "lint", "coverage", "clean"):
        assert f"make {target} " in answer.stdout
