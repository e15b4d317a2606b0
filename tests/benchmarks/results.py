"""Measurements that are kept: `tests/results/NAME.md`, one file a benchmark, one section a command."""

from __future__ import annotations

import os
import platform
import shlex
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from bench.faults.summary import commit
from tests.benchmarks.row import Row

RESULTS = Path(__file__).parents[1] / "results"
_HEAD = "Written by the benchmark (`--keep`); do not edit.\n"
_SECTION = "\n## `"


def keep(name: str, options: Sequence[str], rows: Sequence[Row], made: str, folder: Path = RESULTS) -> Path:
    """Write `rows` of a run of benchmark `name`, `made` so, in place of this command's previous ones."""
    command = f"python -m tests.benchmarks {shlex.join([name, *options])}"
    path = folder / f"{name}.md"
    parts = path.read_text("utf-8").split(_SECTION)[1:] if path.exists() else []
    sections = {part.partition("`")[0]: part for part in parts}
    sections[command] = f"{command}`\n\n{made}\n\n{table(rows)}"
    folder.mkdir(exist_ok=True)
    text = f"# {name}\n\n{_HEAD}" + "".join(_SECTION + sections[key] for key in sorted(sections))
    path.write_text(text, "utf-8")
    return path


def table(rows: Sequence[Row]) -> str:
    """Return `rows` as a table of Markdown."""
    lines = ["| figure | value | promised | note |", "|---|---|---|---|"]
    for row in rows:
        value = f"{row.value:.4g} {row.unit}".strip()
        cells = (row.name, value if row.holds else f"**{value}**", row.promise, row.note)
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def provenance() -> str:
    """Return commit ("+" where files differ), date, processor, cores, kernel and Python, before a run."""
    lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    model, cores = names[0] if names else platform.machine(), len(os.sched_getaffinity(0))
    return (
        f"commit {commit(RESULTS.parent)}, {datetime.now(UTC):%Y-%m-%d}, {model}, {cores} cores, "
        f"Linux {platform.release()}, Python {platform.python_version()}"
    )
