"""Compiled and plain Python code give the same records: coverage and mutation tests run the plain one."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping

import numba
import numpy as np
import pytest

from bench.records.telemetry.cycle_record import CYCLE

PROGRAM = """
import sys
import numpy as np
from bench.control.settings import build_controller
from bench.base.lifecycle import Request
from bench.simulation.lockstep import Lockstep
from bench.swing.profile import Profile
from sim.plant import PlantParameters, build_plant

address = np.array([0.40, 4.30, 6.10])
n = 10
profile = Profile(
    "still", "", "", "", 1e-3, (0, 1, 2, 3, 4, 5, 6), np.tile(address, (n, 1)), np.zeros((n, 3)),
    np.zeros((n, 3)), 20, np.zeros((1, 6)), (0.25, -1.56), 0.0,
)
parameters = PlantParameters()
bench = Lockstep(build_plant(parameters), build_controller(parameters, profile), address)
bench.plant_state["speed"] = (0.8, -0.4, 1.5)
bench.advance(3)
sys.stdout.buffer.write(bench.advance(60, Request.ARM).tobytes())
"""


def records(environment: Mapping[str, str]) -> bytes:
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", PROGRAM],
        env={**os.environ, **environment},
        capture_output=True,
        check=True,
    )
    return run.stdout


@pytest.mark.slow
@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="there is nothing compiled to compare with")
def test_lockstep_compiled_and_plain_python_give_equal_records() -> None:
    compiled, plain = records({"NUMBA_DISABLE_JIT": "0"}), records({"NUMBA_DISABLE_JIT": "1"})
    assert compiled == plain
    angle = np.frombuffer(compiled, CYCLE)["plant_angle"]
    assert np.ptp(angle, axis=0).max() > 0.05  # it moved
