"""The plant's fixed substep is fine enough: a tenfold finer one gives the same delivery at the ball.

The downswing is one that the swing designer found (openings at knots of 30 ms), from rest at the top with
charged chambers: wrist and shoulder reverse under dry friction, the wrist and the rod touch their stops,
the valves cross their dead bands, and the face meets the ball at 45 m/s.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.base.compiled import new_record
from drivers.base.records import COMMAND
from sim.plant import Plant, PlantParameters, Shaft, Site, advance, build_plant, initial_state
from tests.compiled_only import needs_speed

pytestmark = needs_speed

POSITION = 1e-4  # m
RELATIVE = 1e-4  # of speed, and as an angle of the velocity (rad)

TOP = (-1.294, 3.805, 4.925)
PRESSURE = (557000.0, 559000.0, 525000.0, 636000.0, 798000.0, 450000.0)
KNOTS = np.array(
    [
        (0.012, -0.032, 0.059),
        (0.843, -0.130, -0.759),
        (0.664, 0.697, -0.603),
        (0.665, 0.845, -0.527),
        (0.820, 0.804, -0.485),
        (0.846, 0.776, 0.849),
        (0.849, 0.613, 0.611),
        (0.804, 0.734, -0.499),
        (0.592, 0.617, 0.035),
        (0.832, 0.218, 0.550),
        (0.850, 0.224, 0.394),
        (0.826, 0.427, 0.121),
    ]
)
SPACING = 0.03


class AtBall(NamedTuple):
    """Delivery at the ball."""

    x: float
    y: float
    speed: float
    attack: float
    """In-plane angle of the head's velocity (rad)."""


def start(plant: Plant) -> tuple[Any, Any]:
    """Return state and command at the top of the swing."""
    state, command = initial_state(plant, np.array(TOP), pressurised=True), new_record(COMMAND)
    state["pressure"], state["ball_present"] = PRESSURE, True
    command["supply_enable"] = command["exhaust_closed"] = command["guard_lock"] = True
    return state, command


def openings(tick: float) -> NDArray[np.float64]:
    """Return the valves' openings for every tick, straight lines between the knots."""
    times, corners = np.arange(0.0, SPACING * (len(KNOTS) - 1), tick), SPACING * np.arange(len(KNOTS))
    return np.column_stack([np.interp(times, corners, column) for column in KNOTS.T])


@cache
def downswing(substeps: int) -> AtBall:
    plant = build_plant(PlantParameters(substeps=substeps))
    state, command = start(plant)
    for valve in openings(plant.parameters.tick):
        command["valve"] = valve
        advance(*plant.records, state, command)
        if state["struck"][0]:
            x, y, _, vx, vy, _ = (float(value) for value in state["impact_head"][0])
            return AtBall(x, y, float(np.hypot(vx, vy)), float(np.arctan2(vy, vx)))
    raise AssertionError("the downswing misses the ball")


def errors(substeps: int, fine: int) -> tuple[float, float, float]:
    """Return position (m), speed (relative) and attack angle (rad) of the one less the other."""
    coarse, exact = downswing(substeps), downswing(fine)
    distance = float(np.hypot(coarse.x - exact.x, coarse.y - exact.y))
    return distance, abs(coarse.speed / exact.speed - 1.0), abs(coarse.attack - exact.attack)


def test_delivery_default_substep_matches_tenfold_finer_step() -> None:
    default = PlantParameters().substeps
    assert downswing(default).speed > 40.0
    position, speed, attack = errors(default, 10 * default)
    assert position < POSITION
    assert speed < RELATIVE
    assert attack < RELATIVE


def test_delivery_errors_fall_at_second_order() -> None:
    worst = [max(errors(substeps, 160)) for substeps in (1, 4, 16)]  # one alone may pass through zero
    assert worst[1] < worst[0] / 8
    assert worst[2] < worst[1] / 4


def test_downswing_reverses_joints_and_meets_stops() -> None:
    """Otherwise it would prove little."""
    plant = build_plant(PlantParameters())
    state, command = start(plant)
    speeds = []
    for valve in openings(plant.parameters.tick):
        command["valve"] = valve
        advance(*plant.records, state, command)
        speeds.append(state["speed"][0].copy())
        if state["struck"][0]:
            break
    assert np.all(np.abs(np.diff(np.sign(speeds), axis=0)).max(axis=0)[1:] >= 1.0)
    assert np.count_nonzero(state["stop_energy"]) >= 1


def test_flexible_shaft_finer_substep_keeps_head_position() -> None:
    heads = []
    for substeps in (4, 40):
        shaft = Shaft(flexible=True, frequency=12.0)
        plant = build_plant(PlantParameters(substeps=substeps, shaft=shaft, site=Site(ground=-3.0)))
        state, command = start(plant)
        for valve in openings(plant.parameters.tick)[:200]:
            command["valve"] = valve
            advance(*plant.records, state, command)
        heads.append(state["head"][0])
    assert heads[0][3] ** 2 + heads[0][4] ** 2 > 20.0**2
    assert np.hypot(*(heads[0][:2] - heads[1][:2])) < POSITION
