"""Blind brakes: patterns that stop the robot from each instant of a swing without encoders.

From the nominal states at each row a compass search (Kolda, Lewis and Torczon 2003) looks for a pattern of
openings and durations, starting from centred spools and from the row's pattern of the starting swing. A
candidate that is good enough is taken as it is. The search is deterministic.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.design.closed_loop import Rehearsal
from bench.design.shooting import without_history
from bench.simulation.loads import stop_shares
from bench.simulation.simulated_bench import SimulatedBench
from drivers.base.compiled import compiled
from sim.plant import Plant, advance, build_plant

Array = NDArray[np.float64]

SPACING = 20
_WATCHED = 0.9
"""Time for which a pattern is followed, s."""
_LONGEST = 0.4
"""Longest duration of an opening, s."""
_GOOD = 0.35
"""Cost below which a candidate is taken: no load above half its rating, and it comes to rest."""
_STEPS = (0.3, 0.12)
_ROUNDS = 6


@compiled
def play_blind(
    robot: Any, plant: Any, impact: Any, state: Any, command: Any, pattern: Any, ticks: int
) -> tuple[float, float, float]:
    """Apply a blind-brake `pattern` (6,): openings, durations (s); then spools centred.

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


def _cost(plant: Plant, states: list[tuple[NDArray[Any], NDArray[Any]]], pattern: Array, ticks: int) -> float:
    shoulder = plant.parameters.shoulder
    total = 0.02 * float(np.sum(np.abs(pattern[:3])))
    for state, command in states:
        trial, applied = state.copy(), command.copy()
        low, high, speed = play_blind(*plant.records, trial, applied, pattern, ticks)
        total += 40 * float(
            np.sum(np.maximum(stop_shares(trial["stop_energy"][0], plant.parameters) - 0.5, 0.0))
        )
        total += 10 * max(high - shoulder.upper, 0.0) + 10 * max(shoulder.lower - low, 0.0)
        total += 5e-5 * float(np.sum(np.maximum(trial["peak_pressure"] - 1.1e6, 0.0))) + 0.5 * speed
        total += 50 * max(-float(trial["lowest_clearance"][0]), 0.0)
    return total


def design_blind_brake(
    bench: SimulatedBench, start: Array | None, progress: Callable[[float], None]
) -> Array:
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
    low, high = np.array([-1.0] * 3 + [0.0] * 3), np.array([1.0] * 3 + [_LONGEST] * 3)

    def search(row: int) -> Array:
        candidates = [np.zeros(6)]
        if start is not None:
            candidates.append(np.clip(start[min(row, len(start) - 1)], low, high))
        costs = [_cost(plant, begun[row], candidate, ticks) for candidate in candidates]
        best, cost = candidates[int(np.argmin(costs))], min(costs)
        if cost > _GOOD:
            tried = best if np.any(best) else np.array([-0.4, -0.2, -0.2, 0.15, 0.15, 0.15])
            tried_cost = _cost(plant, begun[row], tried, ticks)
            for size in _STEPS:
                for _ in range(_ROUNDS):
                    moved = False
                    for i in range(6):
                        for sign in (1.0, -1.0):
                            trial = tried.copy()
                            trial[i] += sign * size * (_LONGEST if i >= 3 else 1.0)
                            trial = np.clip(trial, low, high)
                            trial_cost = _cost(plant, begun[row], trial, ticks)
                            if trial_cost < tried_cost:
                                tried, tried_cost, moved = trial, trial_cost, True
                                break
                    if not moved or tried_cost < _GOOD:
                        break
            if tried_cost < cost:
                best = tried
        return np.round(best, 4)

    patterns = np.zeros((rows, 6))
    with ThreadPoolExecutor(2) as pool:
        for row, pattern in enumerate(pool.map(search, range(rows))):
            patterns[row] = pattern
            progress((row + 1) / rows)
    return patterns
