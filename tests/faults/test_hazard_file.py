"""The hazard file is up to date, covers the whole matrix, and its judgement is checked."""

from __future__ import annotations

import re
import tomllib
from itertools import product
from pathlib import Path

import pytest

from bench.base.lifecycle import REFUSAL_WORDS, Refusal
from bench.faults.summary import JUDGEMENT, hazard_file
from tests.faults.made_matrix import whole_matrix

ROOT = Path(__file__).resolve().parents[2]
FIGURES = re.compile(r"\| [^|]* \| [^|]* \| \d+: \d+, \d+ \| \d+ % \|")
"""Detection, reaction, cases and absorber of a failure mode."""


def judged(text: str) -> str:
    """Return a hazard file without the figures of its matrix."""
    before, _, after = text.partition("\nMatrix: ")
    return before + FIGURES.sub("|", after.partition("\n\n")[2])


def test_committed_hazard_file_matches_judgement() -> None:
    made = hazard_file(whole_matrix())
    assert judged((ROOT / "sim" / "HAZARDS.md").read_text()) == judged(made), "run make faults"


def test_hazard_file_counts_every_case_once() -> None:
    summary = whole_matrix()
    text = hazard_file(summary)
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| F")]
    cases = [cells[7].replace(":", ",").split(", ") for cells in rows]
    assert sum(int(cell[0]) for cell in cases) == summary["cases"]
    assert sum(int(cell[1]) for cell in cases) == summary["verdicts"]["unsafe"]
    assert sum(int(cell[2]) for cell in cases) == summary["verdicts"]["undetected"]


def test_hazard_file_unknown_fault_is_refused() -> None:
    summary = whole_matrix()
    summary["rows"].append(summary["rows"][0] | {"signal": "brake", "breakage": "brake stuck"})
    with pytest.raises(ExceptionGroup) as caught:
        hazard_file(summary)
    assert [str(fault).split(":")[1] for fault in caught.value.exceptions] == [" brake stuck"]


def test_risk_graph_level_never_decreases_with_risk() -> None:
    graph = tomllib.loads(JUDGEMENT.read_text())["risk_graph"]
    assert set(graph) == {f"S{s} F{f} P{p}" for s, f, p in product((1, 2), repeat=3)}
    for risk, level in graph.items():
        for axis in "SFP":
            assert graph[risk.replace(f"{axis}1", f"{axis}2")] >= level
    assert (graph["S1 F1 P1"], graph["S2 F2 P2"]) == ("a", "e")


def test_door_test_names_answer_that_bridged_switch_does_not_give() -> None:
    """A switch that is bridged gives another refusal; arming is refused in ACCESS whatever it reads."""
    entries = tomllib.loads(JUDGEMENT.read_text())["failures"]
    (proof,) = (one["proof_test"] for one in entries if one["item"] == "guard switches")
    daily = (ROOT / "bench/manual/operator/first_day.md").read_text()
    answer = f"`access --end` answers: {REFUSAL_WORDS[Refusal.GUARD][0]}"
    assert answer in proof
    assert answer in daily.replace("\n  ", " ")
    assert "arm" not in proof


KEYS = {
    "sources": "standard read used",
    "failures": "item function mode signals effect severity safe_state remains proof_test interval owner",
    "untried": "item mode effect severity measure proof_test interval owner",
    "functions": "name standard demand reaction safe_state s f p why category means proof_test interval open",
    "hazards": "hazard where consequence measures open",
}
"""Keys of each entry of a list; failures may also have `kinds`."""


def test_judgement_entries_are_complete() -> None:
    read = tomllib.loads(JUDGEMENT.read_text())
    assert set(read) == {*KEYS, "intervals", "owners", "open", "scope", "risk_graph"}
    for name, keys in KEYS.items():
        for entry in read[name]:
            assert set(entry) - {"kinds"} == set(keys.split()), entry
            assert all(entry.values()), entry
            assert "kinds" not in entry or name == "failures"
            assert entry.get("interval", "year") in read["intervals"], entry
            assert entry.get("owner", "bench") in read["owners"], entry
            assert entry.get("severity", 1) in (1, 2, 3, 4), entry
    assert all("{s} {f} {p}".format(**entry) in read["risk_graph"] for entry in read["functions"])
