"""Encoder counts at the mechanical reference; centre and dead band of a valve from its chambers.

Within its overlap a spool passes hardly any air, whatever the command; beyond it the flow rises in
proportion. A line with a flat middle, fitted to the rate at which the difference of the two chambers'
pressures changes, shows both edges.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize

from bench.base.errors import Refused
from bench.records.telemetry.ring import RingReader
from drivers.base import JOINTS
from drivers.base.compiled import new_record
from drivers.base.records import COMMAND
from sim.driver import hanging_pose
from sim.plant import Plant, PlantParameters, advance, build_plant, initial_state

_MIN_RECORDS = 20
"""Min number of records: fewer mean that the loop hardly runs."""

_STILL = 8
"""Max noise of a locked joint, counts."""


def standing_counts(ring: Path, counts_per_revolution: int, seconds: float = 0.5) -> tuple[int, int, int]:
    """Watch the cycles in `ring` for `seconds` and return the median count of each joint.

    Raises:
        NoRing: no bench runs here.
        Refused: the control loop does not run, an encoder gives no valid reading, or a joint moves.
    """
    reader = RingReader(ring)
    try:
        reader.read()
        time.sleep(seconds)
        cycles = reader.read(limit=100_000)
    finally:
        reader.close()
    location = "calibrate encoders --from-pose"
    if len(cycles) < _MIN_RECORDS:
        raise Refused(
            location,
            f"{len(cycles)} cycles in {seconds:g} s",
            "a running loop",
            "Start `golfbench run` again.",
        )
    middles = []
    for joint, name in enumerate(JOINTS):
        if not cycles["encoder_valid"][:, joint].all():
            raise Refused(
                location,
                f"{name}: invalid readings",
                "valid readings",
                f"Check the cable of the {name} encoder.",
            )
        counts = cycles["encoder_count"][:, joint]
        # Around the last one, so that a count at the range's end does not split.
        half = counts_per_revolution // 2
        around = (counts - counts[-1] + half) % counts_per_revolution - half
        spread = int(np.ptp(around))
        if spread > _STILL:
            found = f"{name}: it moved by {spread} counts in {seconds:g} s"
            raise Refused(location, found, f"{_STILL} at most", "Lock the robot at its mechanical reference.")
        middles.append(int(counts[-1] + round(float(np.median(around)))) % counts_per_revolution)
    a, b, c = middles
    return a, b, c


Array = NDArray[np.float64]

_NEAR = 0.04
"""Opening beyond an edge up to which the flow counts: further out emptying and filling bend the line."""
_MIN_BEYOND = 4
"""Min number of measurements beyond each edge."""
_CLEAR = 5.0
"""Rate beyond an edge over the fit's scatter from which the edge counts as seen."""
_NO_ANSWER = (
    "the pressures do not go from falling to rising: check the supply, the chamber sensors and the hoses "
    "(A and B swapped?), or ramp further"
)

SWEEP = np.linspace(-0.3, 0.3, 241)
"""Openings of the ramp."""
_HOLD = 0.02
"""Time at each opening (s): the spool's own motion takes a small part of it."""


class ValveCentre(NamedTuple):
    """Result of the ramp for one valve, as openings (fractions of the full one)."""

    centre: float
    dead_band: float
    """Overlap to either side of the centre."""
    residual: float
    """Opening: the fit's scatter over its slope, a measure of the uncertainty."""


def find_centre(openings: ArrayLike, pressure_rates: ArrayLike) -> ValveCentre:
    """Return centre and dead band from commands (n,) and the rates (n,) of p_A - p_B (Pa/s) they gave.

    Raises:
        ValueError: invalid values, or an edge outside the measurement; the text gives the action.
    """
    x, rate = np.asarray(openings, dtype=float), np.asarray(pressure_rates, dtype=float)
    if x.ndim != 1 or x.shape != rate.shape or not (np.isfinite(x).all() and np.isfinite(rate).all()):
        raise ValueError(f"openings {x.shape} and rates {rate.shape}, expected finite values of one length")
    order = np.argsort(x)
    x, rate = x[order], rate[order]
    edges = _coarse_edges(x, rate)
    edges, _, _ = _refined(x, rate, *edges)
    # Once more, on the measurements around the edges just found.
    (lower, upper), slope, scatter = _refined(x, rate, *edges)
    if slope * _NEAR <= _CLEAR * scatter:
        raise ValueError(_NO_ANSWER)
    return ValveCentre((lower + upper) / 2, (upper - lower) / 2, scatter / slope)


def _refined(x: Array, rate: Array, lower: float, upper: float) -> tuple[tuple[float, float], float, float]:
    """Return edges, smaller flow slope and residual deviation of the best fit near the given edges."""
    near = (x > lower - _NEAR) & (x < upper + _NEAR)
    for beyond, edge in ((x < lower, "lower"), (x > upper, "upper")):
        if np.count_nonzero(near & beyond) < _MIN_BEYOND:
            raise ValueError(f"the {edge} edge lies outside the ramp: ramp further, or in finer steps")
    some, rates = x[near], rate[near]

    def error(edges: Array) -> float:
        return _fit(some, rates, *sorted(edges))[1]

    start = np.array([(lower, upper), (lower + _NEAR / 4, upper), (lower, upper - _NEAR / 4)])
    least_change = 1e-12 * float(np.var(rates))
    answer = minimize(
        error,
        start[0],
        method="Nelder-Mead",
        options={"xatol": 1e-7, "fatol": least_change, "initial_simplex": start},
    )
    lower, upper = sorted(map(float, answer.x))
    (_, below, above), least = _fit(some, rates, lower, upper)
    return (lower, upper), float(min(below, above)), float(np.sqrt(least))


def _fit(x: Array, rate: Array, lower: float, upper: float) -> tuple[Array, float]:
    """Return (level, slope below, slope above) of the best line, flat between the edges, and its error."""
    columns = np.stack([np.ones_like(x), np.minimum(x - lower, 0.0), np.maximum(x - upper, 0.0)], axis=1)
    solution = np.linalg.lstsq(columns, rate, rcond=None)[0]
    return solution, float(np.mean((columns @ solution - rate) ** 2))


def _coarse_edges(x: Array, rate: Array) -> tuple[float, float]:
    """Return about where the flat middle begins and ends: around the change of sign, a tenth of the ends."""
    if len(x) < 3 * _MIN_BEYOND or x[0] == x[-1]:
        raise ValueError(f"{len(x)} measurements, expected at least {3 * _MIN_BEYOND} over a ramp")
    reach = 0.1 * min(rate.max(), -rate.min())
    falling, rising = np.flatnonzero(rate < -reach), np.flatnonzero(rate > reach)
    if reach <= 0.0 or falling[-1] > rising[0]:
        raise ValueError(_NO_ANSWER)
    return float(x[falling[-1]]), float(x[rising[0]])


def ramp_valve(parameters: PlantParameters, actuator: int) -> tuple[Array, Array]:
    """Return openings (n,) and rates of p_A - p_B (n,) Pa/s of one valve (0 to 2) of the software plant.

    The robot hangs with charged chambers before each opening, which is held for a few hundredths of a second.
    """
    plant = build_plant(parameters)
    pose = hanging_pose(parameters)
    rates = [_rate_at(plant, pose, actuator, opening) for opening in SWEEP]
    return SWEEP.copy(), np.array(rates)


def _rate_at(plant: Plant, pose: Array, actuator: int, opening: float) -> float:
    state, command = initial_state(plant, pose, pressurised=True), new_record(COMMAND)
    for name in ("supply_enable", "exhaust_closed", "guard_lock"):
        command[name] = True
    command["valve"] = [valve.valve.centre for valve in plant.parameters.actuators]
    command["valve"][0, actuator] = opening
    ticks = max(round(_HOLD / plant.parameters.tick), 1)
    for _ in range(ticks):
        advance(*plant.records, state, command)
    pressure: Any = state["pressure"][0]
    return float(pressure[2 * actuator] - pressure[2 * actuator + 1]) / (ticks * plant.parameters.tick)
