"""Memory, descriptors and threads of processes over hours, the machine's stolen time, and what grows."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import theilslopes

_MIB = 1024.0
_USER = 11
"""Place of the user time in /proc/PID/stat after the name, the system time follows."""
_STEAL = 8
"""Place of the stolen time in a line of /proc/stat."""


class ProcessFigures(NamedTuple):
    """What one process holds."""

    resident: float
    """MiB, with what others map too."""
    unique: float
    """MiB that its end would set free."""
    descriptors: float
    threads: float
    processor: float = 0.0
    """s of processor time since its start."""


class Growth(NamedTuple):
    """Growth an hour of one figure over the second half of a run: Theil and Sen's slope."""

    slope: float
    low: float
    """95 % bounds of the slope."""
    high: float


def figures_of(pid: int) -> ProcessFigures | None:
    """Return what process `pid` holds; None if it has ended."""
    folder = Path(f"/proc/{pid}")
    try:
        found = dict(re.findall(r"(\w+):\s+(\d+) kB", (folder / "smaps_rollup").read_text()))
        (threads,) = re.findall(r"Threads:\s+(\d+)", (folder / "status").read_text())
        descriptors = len(os.listdir(folder / "fd"))
        words = (folder / "stat").read_text().rpartition(")")[2].split()
    except (OSError, ValueError):
        return None
    unique = int(found["Private_Clean"]) + int(found["Private_Dirty"])
    spent = (int(words[_USER]) + int(words[_USER + 1])) / os.sysconf("SC_CLK_TCK")
    return ProcessFigures(int(found["Rss"]) / _MIB, unique / _MIB, descriptors, int(threads), spent)


def stolen_time() -> float:
    """Return the time that the hypervisor took from all cores since the start, s."""
    words = Path("/proc/stat").read_text().splitlines()[0].split()
    return int(words[_STEAL]) / os.sysconf("SC_CLK_TCK")


def folder_size(folder: Path) -> float:
    """Return the size of all files below `folder`, MB."""
    total = 0
    for path in folder.rglob("*"):
        try:
            total += path.stat().st_size if path.is_file() else 0
        except OSError:  # gone meanwhile
            continue
    return total / 1e6


def growth(times: ArrayLike, values: ArrayLike) -> Growth:
    """Return the growth of `values` an hour in the second half of `times` (s); NaN if they are few."""
    at, value = np.array(times, float), np.array(values, float)
    half = at >= 0.5 * (at[0] + at[-1])
    if half.sum() < 4:
        return Growth(np.nan, np.nan, np.nan)
    slope, _, low, high = theilslopes(value[half], at[half] / 3600.0, 0.95)
    return Growth(float(slope), float(low), float(high))


def growths(
    times: Sequence[float], samples: Sequence[Mapping[str, ProcessFigures]], field: str
) -> dict[str, Growth]:
    """Return the growth of `field` of ProcessFigures of each process in the last of `samples`."""
    found = {}
    for name in samples[-1]:
        seen = [
            (at, getattr(one[name], field)) for at, one in zip(times, samples, strict=True) if name in one
        ]
        found[name] = growth(*zip(*seen, strict=True))
    return found
