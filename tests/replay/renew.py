"""Renew the reference records: `make reference`, which is `python -m tests.replay.renew`.

Do so only after an intended change of the controller's behaviour, and state it in the commit. Two
swings of the default profile on the software plant: one at a ball, until the robot is on its way back, and
one that is stopped in the backswing. The plant's truth, unnecessary for a replay, is left out.
"""

from __future__ import annotations

import sys
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from bench.base.lifecycle import Phase, Reaction
from bench.records.telemetry.record_file import write_swing
from bench.records.telemetry.swing_metadata import since
from bench.simulation.replay import MEASURED
from bench.simulation.simulated_bench import Bench, SwingResult, simulate_swing
from bench.swing.library import find_profile
from bench.swing.profile import load_profile

FOLDER = Path(__file__).parent
SWING, STOP = FOLDER / "swing.parquet", FOLDER / "stop.parquet"

_RETURN_TICKS = 100
"""Kept of the way back."""
_BRAKE_TICKS = 300
"""Kept of the stop."""
_LOOKS_BEFORE_STOP = range(100, 1500)
"""Looks at Ctrl-C, one in 200 ms of a swing, before it comes, tried in turn: in the backswing."""

_UNDER_WAY = 400
"""Ticks of the backswing after which it is under way."""


def reference_bench() -> Bench:
    """Return the bench that swings: noise on its encoders, so that the estimator has work to do."""
    bench = Bench(load_profile(find_profile("default")), hold=0.1)
    encoders = replace(bench.plant.encoders, noise=5e-6, jitter=2e-6)
    return replace(bench, plant=replace(bench.plant, encoders=encoders))


def stopped_in_the_backswing(bench: Bench) -> SwingResult | None:
    """Return a swing of `bench` that Ctrl-C stops in its backswing; None if it never comes there."""
    for looks in _LOOKS_BEFORE_STOP:
        left = iter([False] * looks)
        with suppress(KeyboardInterrupt):  # it came before the swing's record began
            stopped = simulate_swing(bench, stop=partial(next, left, True))
            if stopped.interrupted and np.sum(stopped.cycles["phase"] == Phase.BACKSWING) > _UNDER_WAY:
                return stopped
    return None


def write_reference(path: Path, bench: Bench, result: SwingResult, ticks: int | None = None) -> None:
    """Write the first `ticks` cycles of `result` (all without) and the data for a replay."""
    cycles = since(result.cycles[:ticks], 0.0)  # a copy
    for name in MEASURED:
        cycles[name] = 0.0
    write_swing(path, cycles, bench.metadata({"kind": "swing", **result.replay_metadata()}))
    phases = ", ".join(Phase(int(phase)).name for phase in dict.fromkeys(cycles["phase"].tolist()))
    print(f"{path.name}: {len(cycles)} cycles, {path.stat().st_size / 1e3:.0f} kB: {phases}")


def main() -> int:
    """Swing twice and write the records; 1 when a swing does not meet the reference's conditions."""
    bench = reference_bench()
    swing = simulate_swing(bench)
    if swing.reason:
        print(f"the swing gave no valid shot: {swing.reason}")
        return 1
    returning = int(np.argmax(swing.cycles["phase"] == Phase.RETURN))
    write_reference(SWING, bench, swing, returning + _RETURN_TICKS)
    stopped = stopped_in_the_backswing(bench)
    if stopped is None:
        print("the stop did not come in the backswing: change _LOOKS_BEFORE_STOP")
        return 1
    braking = int(np.argmax(stopped.cycles["reaction"] == Reaction.BRAKE))
    write_reference(STOP, bench, stopped, braking + _BRAKE_TICKS)
    return 0


if __name__ == "__main__":
    sys.exit(main())
