"""A benchmark keeps its figures with command, commit, date and machine, a section for each command."""

from __future__ import annotations

from pathlib import Path

from tests.benchmarks.results import keep, provenance
from tests.benchmarks.row import Row


def test_keep_same_command_replaces_only_own_section(tmp_path: Path) -> None:
    rows = [Row("speed", "swings", 1234.5, "1/s", "a|b", at_least=1000.0)]
    made = provenance()
    keep("speed", ["--cores", "2"], rows, made, tmp_path)
    keep("speed", [], [Row("speed", "swings", 3.0, "1/s", at_most=2.0)], made, tmp_path)
    path = keep("speed", ["--cores", "2"], [rows[0]._replace(value=2000.0)], made, tmp_path)
    text = path.read_text("utf-8")
    assert text.startswith("# speed\n\nWritten by the benchmark")
    assert text.count("## `python -m tests.benchmarks speed") == 2
    assert "| swings | 2000 1/s | at least 1000 | a\\|b |" in text
    assert "| swings | **3 1/s** | at most 2 |  |" in text
    assert "1234" not in text
    assert text.count("commit ") == text.count("cores, Linux ") == 2
