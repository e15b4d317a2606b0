"""The runner itself: a mutant that must die dies, wherever its value was taken to, and nothing else does."""

from __future__ import annotations

import ast
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from tests.mutation.mutants import mutants

ROOT = Path(__file__).parents[2]

TRIALS = """
import json, os, sys
os.environ["NUMBA_DISABLE_JIT"] = "1"
from pathlib import Path
from tests.mutation.trial import NoVerdictError, Trials
trials = Trials("bench.base.lifecycle", [sys.argv[1]])
source = Path("bench/base/lifecycle.py").read_text()
trials.begin(source)
def mutated(old, new):
    assert source.count(old) == 1
    return trials.killer(source.replace(old, new)).rpartition("::")[2]
told = [
    trials.killer(source),
    mutated("HOLD = 2", "HOLD = 12"),
    mutated("return [[int(reaction) for reaction in STOP_REACTIONS[phase]] for phase in Phase]", "return []"),
    mutated("NEEDS_LEASE = frozenset(Request) -", "NEEDS_LEASE = frozenset(Request) +"),
    mutated("return [[int(state in", "while True: pass\\n    return [[int(state in"),
    trials.killer(source),
]
print(json.dumps(told))
"""
WATCHING = """
    import bench.control.envelope, bench.control.states
    from bench.control.settings import build_controller
    from bench.base.lifecycle import accepted_table

    def test_a_constant_in_an_importer():
        assert bench.control.envelope.Phase.IMPACT == 7 and bench.control.states.Phase.HOLD == 2

    def test_a_function_in_an_importer():
        assert len(bench.control.settings.reaction_table()) == 10

    def test_that_ends():
        accepted_table()
"""


def tried(file: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", TRIALS, str(file)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100.0, check=False)


@pytest.mark.slow
def test_trials_mutant_reaches_importers(tmp_path: Path) -> None:
    file = tmp_path / "test_watching.py"
    file.write_text(textwrap.dedent(WATCHING))
    run = tried(file)
    assert run.returncode == 0, run.stderr
    assert ast.literal_eval(run.stdout) == [
        "",
        "test_a_constant_in_an_importer",
        "test_a_function_in_an_importer",
        "import",
        "test_that_ends",
        "",
    ]


@pytest.mark.slow
def test_trials_test_failing_without_mutant_raises_no_verdict(tmp_path: Path) -> None:
    file = tmp_path / "test_failing.py"
    file.write_text("import bench.base.lifecycle\n\ndef test_it():\n    assert False\n")
    run = tried(file)
    assert "NoVerdictError: bench.base.lifecycle: " in run.stderr
    assert "test_it fails without a mutant" in run.stderr


@pytest.mark.parametrize(
    ("source", "changes"),
    [
        ("a < b", ["a < b -> a <= b", "a < b -> a >= b"]),
        ("x = a + 1", ["a + 1 -> a - 1", "1 -> 2"]),
        (
            "if not a and b:\n    c()",
            [
                "if not a and b: -> if not (not a and b):",
                "not a and b -> not a or b",
                "not a and b -> b",
                "not a and b -> not a",
                "not a -> a",
                "c() -> pass",
            ],
        ),
        (
            "s.x = max(y, -z)",
            [
                "s.x = max(y, -z) -> pass",
                "max(y, -z) -> min(y, -z)",
                "-z -> z",
            ],
        ),
        ('"""Text 1."""\nx: tuple[int] = True', ["True -> False"]),
        ("x = Colour.RED\ny = Colour.BLUE", ["Colour.RED -> Colour.BLUE", "Colour.BLUE -> Colour.RED"]),
    ],
)
def test_mutants_source_gives_expected_changes(source: str, changes: list[str]) -> None:
    found = list(mutants(source, {"Colour": ("RED", "BLUE")}))
    assert [mutant.change for mutant in found] == changes
    assert len({mutant.source for mutant in found}) == len(found)
    for mutant in found:
        ast.parse(mutant.source)


def test_mutants_same_line_have_unique_names() -> None:
    first, *others = [mutant.name for mutant in mutants("x = a[0] + b[0]")]
    assert first == "x = a[0] + b[0]: a[0] + b[0] -> a[0] - b[0]"
    assert others == ["x = a[0] + b[0]: 0 -> 1", "x = a[0] + b[0]: 0 -> 1 (2)"]
