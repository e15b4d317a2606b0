"""Tests of the process of the simulated nodes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.canopen.frames import SYNC, TPDO2
from sim.exchange import PLANT_SURROUNDINGS
from sim.nodes.process import BenchNodes
from sim.nodes.wall_plant import WallGrid
from sim.plant import PlantParameters
from tests.drivers.canopen.in_step import nodes_plan
from tests.sim.nodes.test_wall_plant import at_the_ball

FALL, STALL = 0.25, 0.012
"""s until the arms fall fast, and s for which the process stands still then."""


def counts_answered(stall: float) -> np.ndarray:
    """Return the counts (n, 3) with which the encoders of falling arms answer a SYNC each millisecond.

    Before the last ones the process stands still for `stall` (s); the frames of that time wait.
    """
    sent: dict[int, list[int]] = {}
    nodes = BenchNodes(
        replace(nodes_plan(), angle=(1.2, 4.3, 6.0)),
        lambda identifier, data: sent.setdefault(identifier, []).append(int.from_bytes(data, "little")),
    )
    nodes.boot(0.0)
    nodes.receive(0, bytes((1, 0)), 0.0)
    period = nodes.plant.plant.parameters.tick
    grid = WallGrid(period, 0.0, 25)
    waiting: list[float] = []
    for n in range(1, round((FALL + STALL) / 0.001)):
        now = 0.001 * n + 0.0004
        waiting.append(now)
        if FALL - stall < now < FALL:
            continue
        for received in waiting:
            nodes.catch_up(grid, 0.0, received)
            nodes.receive(SYNC, b"", received)
        waiting = []
        nodes.catch_up(grid, 0.0, now)
    return np.array([sent[TPDO2 + encoder.number] for encoder in nodes.encoders]).T


def test_bench_nodes_after_stall_answer_sync_at_receive_time() -> None:
    in_time, late = counts_answered(0.0), counts_answered(STALL)
    assert np.abs(np.diff(in_time[-10:], axis=0)).max() > 20, "the arms move"
    assert np.array_equal(late, in_time)


@pytest.mark.parametrize("after", [0.0001, 0.0009])
def test_encoder_count_after_impact_follows_new_speed(after: float) -> None:
    plant = PlantParameters()
    plan = nodes_plan(replace(plant, encoders=replace(plant.encoders, latency=5e-4)))
    counts: dict[int, int] = {}

    def keep(identifier: int, data: bytes) -> None:
        counts[identifier] = int.from_bytes(data, "little")

    nodes = BenchNodes(plan, keep)
    nodes.boot(0.0)
    nodes.receive(0, bytes((1, 0)), 0.0)
    around = np.zeros(1, PLANT_SURROUNDINGS)
    for name in ("emergency_stop_clear", "guard_closed", "encoder_valid", "ball_handled", "ball_present"):
        around[name] = 1
    nodes.set_surroundings(around)
    state = nodes.plant.state
    # The head is at the ball within the second tick.
    q, u = at_the_ball(plant, plant.site.ball_x - 0.048, plant.site.ball_y, speed=25.0)
    state["angle"], state["speed"], state["history"] = q, u, q
    while not nodes.plant.contacts:
        nodes.move(nodes.instant + plant.tick)
        nodes.update_report()
        assert nodes.plant.ticks < 10
    nodes.receive(SYNC, b"", nodes.instant + after)
    answered = np.array([counts[TPDO2 + encoder.number] for encoder in nodes.encoders])
    turned = state["angle"][0] + after * state["speed"][0]
    expected = turned * nodes.plant.plant.plant["encoder_scale"][0] + plant.encoders.zero_count
    assert np.abs(u - state["speed"][0]).max() > 1.0, "the blow changes the joints' speed"
    one_turn = plant.encoders.counts_per_revolution
    apart = (answered - expected + one_turn / 2) % one_turn - one_turn / 2
    assert np.abs(apart).max() < 3
