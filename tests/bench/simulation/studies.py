"""Studies for tests of sweeps; workers also import this module."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_info

from bench.base.errors import Refused


@dataclass(frozen=True)
class Draws:
    """A study of random walks: each case's seed is the case."""

    steps: int = 1000
    deadly: Path | None = None
    """File that the worker of case 7 takes away before it dies."""
    refused: int = -1

    def prepared(self) -> Callable[[int], float]:
        def walk(seed: int) -> float:
            if seed == self.refused:
                raise Refused("case", str(seed), "another", "Choose it.")
            if seed == 7 and self.deadly is not None and self.deadly.exists():
                self.deadly.unlink()
                os.kill(os.getpid(), signal.SIGKILL)
            return float(np.random.default_rng(seed).standard_normal(self.steps).cumsum().max())

        return walk


@dataclass(frozen=True)
class Slow:
    """The study of `Draws` that takes `duration` s a case."""

    duration: float

    def prepared(self) -> Callable[[int], float]:
        walk = Draws().prepared()

        def slowly(seed: int) -> float:
            time.sleep(self.duration)
            return walk(seed)

        return slowly


@dataclass(frozen=True)
class BlasThreads:
    """A study of the threads of each BLAS library: greatest number while it is prepared, and in a case."""

    def prepared(self) -> Callable[[int], tuple[int, int]]:
        before = _blas_threads()
        return lambda case: (before, _blas_threads())


def _blas_threads() -> int:
    return max(int(library["num_threads"]) for library in threadpool_info() if library["user_api"] == "blas")


def as_dict(value: float) -> dict[str, Any]:
    return {"value": value}


def as_float(record: dict[str, Any]) -> float:
    return float(record["value"])
