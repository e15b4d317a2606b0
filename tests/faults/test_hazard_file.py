"""The hazard file is up to date, covers the whole matrix, and its judgement is checked."""

from __future__ import annotations

import re
from itertools import product
from pathlib import Path

import pytest

from bench.base.errors import BenchError
from bench.faults.hazard_file import FILE, RISK_GRAPH, hazard_file, load_judgement
from tests.faults.made_matrix import whole_matrix

ROOT = Path(__file__).resolve().parents[2]
FIGURES = re.compile(r"\| [^|]* \| [^|]* \| \d+: \d+, \d+ \| \d+ % \|")
"""Detection, reaction, cases and absorber of a failure mode."""


def judged(text: str) -> str:
    """Return a hazard file without the figures of its matrix."""
    before, _, after = text.partition("\nMatrix: ")
    return before + FIGURES.sub("|", after.partition("\n\n")[2])


def test_committed_hazard_file_matches_judgement() -> None:
    made = hazard_file(whole_matrix(), load_judgement())
    assert judged((ROOT / "sim" / "HAZARDS.md").read_text()) == judged(made), "run make faults"


def test_hazard_file_counts_every_case_once() -> None:
    summary = whole_matrix()
    text = hazard_file(summary, load_judgement())
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| F")]
    cases = [cells[7].replace(":", ",").split(", ") for cells in rows]
    assert sum(int(cell[0]) for cell in cases) == summary["cases"]
    assert sum(int(cell[1]) for cell in cases) == summary["verdicts"]["unsafe"]
    assert sum(int(cell[2]) for cell in cases) == summary["verdicts"]["undetected"]


def test_hazard_file_unknown_fault_is_refused() -> None:
    summary = whole_matrix()
    summary["rows"].append(summary["rows"][0] | {"signal": "brake", "breakage": "brake stuck"})
    with pytest.raises(ExceptionGroup) as caught:
        hazard_file(summary, load_judgement())
    assert [str(fault).split(":")[1] for fault in caught.value.exceptions] == [" brake stuck"]


def test_risk_graph_level_never_decreases_with_risk() -> None:
    assert set(RISK_GRAPH) == set(product(("S1", "S2"), ("F1", "F2"), ("P1", "P2")))
    for risk, level in RISK_GRAPH.items():
        for i in range(3):
            worse = tuple(f"{c[0]}2" if k == i else c for k, c in enumerate(risk))
            assert RISK_GRAPH[worse[0], worse[1], worse[2]] >= level
    assert (RISK_GRAPH["S1", "F1", "P1"], RISK_GRAPH["S2", "F2", "P2"]) == ("a", "e")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("severity = 4", "severity = 5", "1 to 4"),
        ('interval = "year"', 'interval = "decade"', "half_year"),
        ('owner = "maintenance"', 'owner = "unknown"', "integrator"),
        ('remains = "the pattern', 'left = "the pattern', "remains"),
        ('f = "F1"', 'f = "F3"', "F1 or F2"),
    ],
)
def test_load_judgement_mistake_refusal_names_file(tmp_path: Path, old: str, new: str, words: str) -> None:
    text = FILE.read_text()
    assert old in text
    file = tmp_path / "judgement.toml"
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(ExceptionGroup) as caught:
        load_judgement(file)
    message = " ".join(str(fault) for fault in caught.value.exceptions)
    assert words in message
    assert "judgement.toml" in message


def test_load_judgement_missing_list_or_file_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "judgement.toml"
    file.write_text('scope = "all"\n')
    with pytest.raises(ExceptionGroup):
        load_judgement(file)
    with pytest.raises(BenchError, match="no such file"):
        load_judgement(tmp_path / "none.toml")
