"""Reading a Rerun file back."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader


class Recording:
    """Contents of a recording by entity: times (s) and the values of one component, row by row."""

    def __init__(self, path: Path) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a live recording has no table of contents
            chunks = list(RrdReader(path).stream())
        self.chunks = [chunk for chunk in chunks if not chunk.is_static]
        self.static = {str(chunk.entity_path) for chunk in chunks if chunk.is_static}
        self.entities = {str(chunk.entity_path) for chunk in chunks}

    def read(self, entity: str, component: str) -> tuple[np.ndarray, list[Any]]:
        times, rows = [], []
        for chunk in self.chunks:
            if str(chunk.entity_path) == entity:
                batch = chunk.to_record_batch()
                times.append(batch.column("bench_time").cast("int64").to_numpy() * 1e-9)
                rows += batch.column(component).to_pylist()
        return np.concatenate(times), rows

    def last(self, entity: str) -> float:
        """Return the latest time at which `entity` has something, s; −inf when it is timeless."""
        times = [
            chunk.to_record_batch().column("bench_time").cast("int64").to_numpy()[-1] * 1e-9
            for chunk in self.chunks
            if str(chunk.entity_path) == entity and "bench_time" in chunk.to_record_batch().schema.names
        ]
        return max(times, default=-np.inf)
