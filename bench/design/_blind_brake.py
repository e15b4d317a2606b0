"""Blind brakes: patterns that stop the robot from each instant of a swing without encoders.

From the nominal states at each row a compass search (Kolda, Lewis and Torczon 2003) looks for a pattern of
valve commands and durations. It starts from centred spools and from the row's pattern of the starting swing.
A candidate that is good enough is taken as it is. Rows for which none is found search on from the patterns of
the rows around them: the cost has many local minima, and a pattern for 20 ms later often stops the robot now.
The search is deterministic.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.design._refine import Rehearsal, without_history
from bench.simulation.safety import stop_shares
from bench.simulation.simulated_bench import Bench
from drivers.base.compiled import compiled
from sim.plant import Plant, advance, build_plant

Array = NDArray[np.float64]

SPACING = 20
_WATCHED = 0.9
"""Time for which a pattern is followed, s."""
_MAX_DURATION = 0.4
"""Longest duration of a valve command (s)."""
_GOOD = 0.35
"""Cost below which a candidate is taken: no load above half its rating, and it comes to rest."""
_STEPS = (0.3, 0.12)
_ROUNDS = 6
_LOW, _HIGH = np.array([-1.0] * 3 + [0.0] * 3), np.array([1.0] * 3 + [_MAX_DURATION] * 3)
_MOVING = (-0.4, -0.2, -0.2, 0.15, 0.15, 0.15)
"""Pattern from which a search begins where centred spools are not good enough."""
_NEAR, _TRIED, _SWEEPS = 4, 3, 3
"""Search for a row without a good pattern: neighbouring rows on each side whose patterns are tried, best ones
that are refined, and sweeps."""


class _Found(NamedTuple):
    """A pattern (6,) and its cost for a row."""

    cost: float
    pattern: Array


_COST = attrgetter("cost")


@compiled
def play_blind(
    robot: Any, plant: Any, impact: Any, state: Any, command: Any, pattern: Any, ticks: int
) -> tuple[float, float, float]:
    """Apply a blind-brake `pattern` (6,): valve commands, durations (s); then spools centred.

    Returns lowest and highest theta1 (rad) and the mean speed over the last fifth (rad/s).
    """
    period = plant[0].tick
    lowest, highest, speed, counted = 1e9, -1e9, 0.0, 0
    for k in range(ticks):
        s = state[0]
        for i in range(3):
            command[0].valve[i] = pattern[i] if k * period < pattern[3 + i] else 0.0
        advance(robot, plant, impact, state, command)
        lowest, highest = min(lowest, s.angle[0]), max(highest, s.angle[0])
        if k >= ticks - ticks // 5:
            speed += abs(s.speed[0]) + abs(s.speed[1]) + abs(s.speed[2])
            counted += 1
    return lowest, highest, speed / max(counted, 1)


class _BlindSearch(NamedTuple):
    """The search for patterns (6,), one for each row."""

    plant: Plant
    states: list[list[tuple[NDArray[Any], NDArray[Any]]]]
    """Plant states and commands from which each row's pattern has to stop the robot."""
    ticks: int

    def cost(self, row: int, pattern: Array) -> float:
        """Return the cost of `pattern`: loads, way of the shoulder, pressure, motion at the end, ground."""
        shoulder = self.plant.parameters.shoulder
        total = 0.02 * float(np.sum(np.abs(pattern[:3])))
        for state, command in self.states[row]:
            trial, applied = state.copy(), command.copy()
            low, high, speed = play_blind(*self.plant.records, trial, applied, pattern, self.ticks)
            total += 40 * float(
                np.sum(np.maximum(stop_shares(trial["stop_energy"][0], self.plant.parameters) - 0.5, 0.0))
            )
            total += 10 * max(high - shoulder.upper, 0.0) + 10 * max(shoulder.lower - low, 0.0)
            total += 5e-5 * float(np.sum(np.maximum(trial["peak_pressure"] - 1.1e6, 0.0))) + 0.5 * speed
            total += 50 * max(-float(trial["lowest_clearance"][0]), 0.0)
        return total

    def first(self, row: int, start: Array | None) -> _Found:
        """Return the pattern for `row` found from centred spools and from `start`."""
        origins = [np.zeros(6)] if start is None else [np.zeros(6), np.clip(start, _LOW, _HIGH)]
        found = min((self._found(row, pattern) for pattern in origins), key=_COST)
        if found.cost <= _GOOD:
            return found
        moving = found if np.any(found.pattern) else self._found(row, np.array(_MOVING))
        return min(found, self._descended(row, moving), key=_COST)

    def around(self, row: int, patterns: Sequence[_Found]) -> _Found:
        """Return the best pattern for `row`: its own, or one found from those of the rows around it."""
        best = patterns[row]
        near = [*patterns[max(row - _NEAR, 0) : row], *patterns[row + 1 : row + 1 + _NEAR]]
        tried = sorted((self._found(row, other.pattern) for other in near), key=_COST)
        for origin in tried[:_TRIED]:
            best = min(best, self._descended(row, origin), key=_COST)
            if best.cost <= _GOOD:
                break
        return best

    def _found(self, row: int, pattern: Array) -> _Found:
        return _Found(self.cost(row, pattern), pattern)

    def _descended(self, row: int, origin: _Found) -> _Found:
        """Return the pattern that the compass search finds from `origin`."""
        found = origin
        for size in _STEPS:
            for _ in range(_ROUNDS):
                moved = False
                for i in range(6):
                    for sign in (1.0, -1.0):
                        trial = found.pattern.copy()
                        trial[i] += sign * size * (_MAX_DURATION if i >= 3 else 1.0)
                        tried = self._found(row, np.clip(trial, _LOW, _HIGH))
                        if tried.cost < found.cost:
                            found, moved = tried, True
                            break
                if not moved or found.cost < _GOOD:
                    break
        return found


def design_blind_brake(bench: Bench, start: Array | None, progress: Callable[[float], None]) -> Array:
    """Return a pattern (6,) for each row of the bench's profile; `start` (m, 6): first patterns, or None.

    Raises:
        LoopFailed: the undisturbed swing does not run.
    """
    profile, plant = bench.profile, build_plant(bench.plant)
    spacing, rows = profile.blind_spacing, len(profile.blind_brake)
    ticks = round(_WATCHED / profile.period)
    rehearsals = [Rehearsal(bench, ball=ball) for ball in (True, False)]
    begun: list[list[tuple[NDArray[Any], NDArray[Any]]]] = []
    for row in range(rows):
        states = []
        for rehearsal in rehearsals:
            states.append((without_history(rehearsal.bench.plant_state), rehearsal.bench.command.copy()))
            rehearsal.advance(min(spacing, len(profile.angle) - row * spacing))
        past_contact = row * spacing * profile.period > profile.impact_time - 0.01
        begun.append(states if past_contact else states[1:])
    search = _BlindSearch(plant, begun, ticks)
    starts = [None if start is None else start[min(row, len(start) - 1)] for row in range(rows)]
    with ThreadPoolExecutor(2) as pool:
        found = list[_Found]()
        for pattern in pool.map(search.first, range(rows), starts):
            found.append(pattern)
            progress(0.5 * len(found) / rows)
        for sweep in range(_SWEEPS):
            left = [row for row in range(rows) if found[row].cost > _GOOD]
            around = list(pool.map(lambda row, now=tuple(found): search.around(row, now), left))
            for row, pattern in zip(left, around, strict=True):
                found[row] = pattern
            progress(0.5 + 0.5 * (sweep + 1) / _SWEEPS)
    return np.round([pattern.pattern for pattern in found], 4)
