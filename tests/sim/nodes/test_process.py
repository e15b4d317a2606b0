"""Tests of the process of the simulated nodes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drivers.canopen.frames import SYNC, TPDO2
from sim.nodes.process import BenchNodes
from sim.nodes.wall_grid import WallGrid
from tests.drivers.canopen.in_step import nodes_plan

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


def test_nodes_that_stood_still_answer_each_sync_as_of_its_time() -> None:
    in_time, late = counts_answered(0.0), counts_answered(STALL)
    assert np.abs(np.diff(in_time[-10:], axis=0)).max() > 20, "the arms move"
    assert np.array_equal(late, in_time)
