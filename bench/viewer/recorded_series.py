"""Find the records of a series: those of a folder, or the given ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bench.base.errors import BenchError


def record_files(places: Sequence[Path]) -> list[Path]:
    """Return the records at `places` in order; a folder stands for all records in it, sorted by name.

    Raises:
        BenchError: a place does not exist, or no record is found.
    """
    files: list[Path] = []
    for location in places:
        if location.is_dir():
            files += sorted(location.rglob("*.parquet"))
        elif location.exists():
            files.append(location)
        else:
            raise BenchError(
                str(location),
                "no such file or folder",
                "a record or a folder of records",
                "Correct the path of the records.",
            )
    if not files:
        found, expected = "no record (.parquet)", "at least one record"
        raise BenchError(
            ", ".join(map(str, places)) or "records",
            found,
            expected,
            "Give a folder such as data/campaigns/ID/swings.",
        )
    return files
