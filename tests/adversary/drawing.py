"""Randomly sampled stories: next acts of people, network and nature, given the observable bench state."""

from __future__ import annotations

from dataclasses import replace
from math import isfinite

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from bench.base.lifecycle import Phase, Request, State
from drivers.base import JOINTS
from sim.faults import MEANINGS, SIGNALS, Fault, sort_of
from tests.adversary.player import INPUTS, PERMITS, Player
from tests.adversary.story import Setup, Step, Story, fault_entry

CONFIGURATIONS = ("shipped", "bag", "golfers", "high_speed")
_RAISED = np.array([1.42, 0.66, 1.40])
"""rad from the hanging pose to the lower end stops."""
_VALUES = {
    ("encoder", "offset"): (0.02, 3.0),
    ("encoder", "scale"): (0.5, 2.0),
    ("encoder", "slow"): (0.002, 0.2),
    ("encoder", "delayed"): (0.001, 0.06),
    ("encoder", "drifting"): (0.01, 5.0),
    ("valve", "stuck"): (-1.0, 1.0),
    ("valve", "offset"): (-0.5, 0.5),
    ("valve", "scale"): (-1.0, 2.0),
    ("valve", "slow"): (0.002, 0.2),
    ("valve", "delayed"): (0.001, 0.06),
    ("valve", "drifting"): (-2.0, 2.0),
    ("valve", "leaking"): (0.0, 0.3),
    ("supply", "scale"): (0.3, 1.4),
    ("supply", "drifting"): (-2e5, 2e5),
    ("supply", "delayed"): (0.001, 0.06),
    ("pressure", "offset"): (-3e5, 3e5),
    ("pressure", "scale"): (0.3, 2.0),
    ("pressure", "slow"): (0.002, 0.5),
    ("pressure", "delayed"): (0.001, 0.06),
    ("pressure", "drifting"): (-1e5, 1e5),
    ("switch", "delayed"): (0.001, 0.06),
    ("link", "delayed"): (0.001, 0.06),
    ("clock", "offset"): (-2.0, 5.0),
    ("clock", "scale"): (0.3, 3.0),
    ("loop", "delayed"): (0.002, 0.5),
    ("relief", "offset"): (-5e5, 3e5),
    ("relief", "leaking"): (0.0, 0.3),
    ("exhaust", "scale"): (0.0, 1.0),
}
_ENDS = frozenset({"supply", "vents", "vent", "shut-off", "switch", "relief", "safety relay"})
"""Sorts that stick at one end or the other."""
NOT_SHIPPED = "launch monitor", *(f"{joint} spool feedback" for joint in JOINTS)
"""Signals that a shipped plant does not have."""
_SIGNALS = tuple(signal for signal in SIGNALS if signal not in NOT_SHIPPED)


def drawn_setup(random: Generator) -> Setup:
    """Return a bench."""
    # Back from the hanging pose, as far as to the end stops: beyond it the club lies on the ground.
    share, raised = random.uniform(0, 1, 3), random.uniform() < 0.3
    turned = (-share * _RAISED).round(3).tolist() if raised else (0.0,) * 3
    return Setup(
        configuration=str(random.choice(CONFIGURATIONS)),
        incremental=bool(random.uniform() < 0.3),
        sensors=bool(random.uniform() < 0.8),
        check=bool(random.uniform() < 0.7),
        local_reset=bool(random.uniform() < 0.7),
        series=bool(random.uniform() < 0.5),
        warning_time=float(random.choice([0.5, 1.0, 2.0])),
        armed_timeout=float(random.choice([8.0, 120.0])),
        turned=(float(turned[0]), float(turned[1]), float(turned[2])),
        seed=int(random.integers(1, 10**6)),
    )


def drawn_fault(random: Generator) -> Fault:
    """Return a fault that starts at once or within a second, and mostly ends automatically."""
    while True:
        signal = str(random.choice(_SIGNALS))
        sort = sort_of(signal)
        kind = str(random.choice(list(MEANINGS[sort])))
        if (sort, kind) in (("loop", "off"), ("club head", "off")) and random.uniform() < 0.7:
            continue
        value = float("nan")
        if (sort, kind) in _VALUES:
            low, high = _VALUES[sort, kind]
            value = round(float(random.uniform(low, high)), 4)
            if sort == "encoder" and kind in ("offset", "drifting"):
                value *= float(random.choice([-1, 1]))
        elif kind == "intermittent":
            value = round(float(random.uniform(0.02, 1.0)), 3)
        if kind == "stuck" and sort in _ENDS:
            value = float(random.integers(0, 2))
        elif kind == "swapped":
            value = float(random.integers(0, len(JOINTS)))
        if kind == "stuck" and sort in ("valve", "switch") and random.uniform() < 0.4:
            value = float("nan")
        duration = float(random.choice([0.0, 0.01, 0.05, 0.3, 1.0, 5.0, 20.0]))
        if (sort, kind) == ("loop", "off"):
            duration = max(duration, 0.05)
        after = float(random.choice([0.0, 0.0, 0.02, 0.1, 0.4, 1.0]))
        assert kind not in ("offset", "scale", "slow", "drifting", "leaking", "delayed") or isfinite(value)
        return Fault(signal, signal, kind, value, after=after, duration=duration)  # type: ignore[arg-type]


def _waiting(random: Generator) -> Step:
    longest = int(random.choice([3, 30, 300, 1500, 6000], p=[0.15, 0.25, 0.3, 0.2, 0.1]))
    return ("wait", int(random.integers(1, longest + 1)), None)


def _onwards(player: Player, random: Generator) -> Step:
    """Return what leads on from here."""
    match player.state:
        case State.ESTOP | State.FAULT if not player.bench.plant_state["guard_locked"][0]:
            return ("press", None, None) if random.uniform() < 0.5 else ("ask", "secure", None)
        case State.ESTOP | State.FAULT:
            ask = "reset" if random.uniform() < 0.85 else "access"
            return ("press", None, None) if random.uniform() < 0.5 else ("ask", ask, None)
        case State.SAFE:
            return ("ask", "home", None)
        case State.READY:
            return ("ask", str(random.choice(["arm", "access", "home"], p=[0.8, 0.1, 0.1])), None)
        case State.ARMED if player.phase is Phase.HOLD:
            return ("ask", str(random.choice(["swing", "tee", "disarm"], p=[0.8, 0.1, 0.1])), None)
        case State.ACCESS if random.uniform() < 0.3:
            return ("input", "guard_closed", False)
        case State.ACCESS:
            return ("press", None, None) if random.uniform() < 0.5 else ("ask", "secure", None)
    return ("wait", int(random.integers(100, 2500)), None)


def next_step(player: Player, random: Generator, faults: int) -> Step:
    """Return the next step; at most `faults` faults at the same time."""
    state = player.bench.plant_state[0]
    closed = all(state[name] for name in INPUTS) and all(player.control[name][0] for name in PERMITS)
    draw = random.uniform()
    if not closed and draw < 0.3:
        for name in INPUTS:
            if not state[name]:
                return ("input", name, True)
        return ("permit", next(name for name in PERMITS if not player.control[name][0]), True)
    if len(player.faults) and draw < 0.36:
        return ("mend", None, None)
    if len(player.faults) < faults and draw < 0.1:
        return ("break", fault_entry(drawn_fault(random)), None)
    draw = random.uniform()
    if draw < 0.45:
        return _onwards(player, random)
    if draw < 0.80:
        return _waiting(random)
    if draw < 0.93:
        numbers = [r for r in Request if r]
        asked = int(random.choice([*numbers, 11, 255], p=_weights(len(numbers) + 2)))
        return ("ask", Request(asked).name.lower() if asked < len(Request) else asked, None)
    if draw < 0.965:
        return ("input", str(random.choice(INPUTS)), bool(random.uniform() < 0.4))
    if draw < 0.99:
        return ("permit", str(random.choice(PERMITS)), bool(random.uniform() < 0.4))
    return ("press", None, None)


def _weights(count: int) -> NDArray[np.float64]:
    weights = np.full(count, 1.0)
    weights[-2:] = 0.1
    return np.asarray(weights / weights.sum())


def improvise(seed: int, steps: int = 60) -> tuple[Story, Player]:
    """Draw and play the story of `seed`; return it, and its bench after a person has recovered it."""
    random = np.random.default_rng(seed)
    setup = drawn_setup(random)
    faults = int(random.choice([0, 1, 2], p=[0.25, 0.45, 0.3]))
    player = Player(setup)
    for _ in range(steps):
        player.do(next_step(player, random, faults))
        if player.broken:
            break
    else:
        player.recover()
        player.judge.end(player.loads, player.ever)
    found = "; ".join(player.broken[:3])
    return replace(Story(setup, tuple(player.steps)), found=found), player
