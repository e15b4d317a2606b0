"""Changes of state, phase, reaction and cause in a record, as events for other programs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from bench.lifecycle import CAUSE_TEXT, Cause, Phase, Reaction, State


class Change(NamedTuple):
    """A cycle that differs from the one before."""

    row: int
    cause: Cause
    """Cause of a stop; NONE without one."""
    text: str


def changes(cycles: np.ndarray[Any, Any]) -> Iterator[Change]:
    """Yield each change in `cycles`, the first cycle included."""
    keys = np.stack([cycles[name].astype(int) for name in ("state", "phase", "reaction", "trip")], axis=1)
    before = np.vstack([np.full((1, 4), -1), keys[:-1]])
    for row in np.flatnonzero(np.any(keys != before, axis=1)):
        state, phase, reaction, cause = keys[row].tolist()
        text = f"{State(state).name}, phase {Phase(phase).name}, reaction {Reaction(reaction).name}"
        yield Change(int(row), Cause(cause), f"{text}: {CAUSE_TEXT[Cause(cause)]}" if cause else text)
