"""Measurements that are kept: `tests/results/NAME.md`, one file a benchmark, one section a command."""

from __future__ import annotations

import platform
import shlex
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from tests.benchmarks.row import Row

RESULTS = Path(__file__).parents[1] / "results"
_HEAD = "Written by the benchmark (`--keep`); do not edit.\n"
_SECTION = "\n## `"


def keep(name: str, options: Sequence[str], rows: Sequence[Row], folder: Path = RESULTS) -> Path:
    """Write `rows` of a run of benchmark `name`, in place of what the same command gave before."""
    command = f"python -m tests.benchmarks {shlex.join([name, *options])}"
    path = folder / f"{name}.md"
    parts = path.read_text("utf-8").split(_SECTION)[1:] if path.exists() else []
    sections = {part.partition("`")[0]: part for part in parts}
    sections[command] = (
        f"{command}`\n\n{commit()}, {datetime.now(UTC):%Y-%m-%d}, {machine()}\n\n{table(rows)}"
    )
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


def commit() -> str:
    """Return the commit of the checkout, and whether files differ from it."""
    git = ["git", "-C", str(RESULTS.parents[1])]
    found = subprocess.run(
        [*git, "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=True
    )
    changed = subprocess.run(
        [*git, "status", "--porcelain", "-uno"], capture_output=True, text=True, check=True
    )
    return f"commit {found.stdout.strip()}" + (" with changes" if changed.stdout else "")


def machine() -> str:
    """Return processor, cores, kernel and Python."""
    lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    model = names[0] if names else platform.machine()
    return f"{model}, {len(names) or 1} cores, Linux {platform.release()}, Python {platform.python_version()}"
