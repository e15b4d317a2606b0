"""Ticks from a fault to its reaction, and what that ended in, phase by phase, on the plant in lock-step.

Faults come in at the driver, as from hardware; the cycle is the one of the real-time loop.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
from rich.console import Console

from bench.base.lifecycle import Cause, Phase, Reaction, Request
from bench.config import load_configuration
from drivers.base import Command, DriverError, Readings
from sim.driver import SimDriver
from tests.benchmarks.canopen_reactions import Case, show
from tests.benchmarks.row import Row
from tests.drivers.canopen.swing_in_step import SwingBench

PHASES = (
    Phase.STANDING,
    Phase.HOLD,
    Phase.BACKSWING,
    Phase.TOP,
    Phase.DOWNSWING,
    Phase.COMMITTED,
    Phase.IMPACT,
    Phase.FOLLOW_THROUGH,
    Phase.RETURN,
)


class FaultyDriver(SimDriver):
    """The simulated robot, broken from a chosen tick on."""

    fault = ""
    silent = False
    """Its watchdog released the valves."""

    def read(self, time: float) -> Readings:
        """Return the readings, spoilt as the fault wants."""
        readings = super().read(time)
        match self.fault:
            case "read raises":
                raise DriverError("broken on purpose")
            case "one encoder invalid":
                return readings._replace(encoder_valid=(True, False, True))
            case "all encoders invalid":
                return readings._replace(encoder_valid=(False, False, False))
            case "guard opened":
                return readings._replace(guard_closed=False)
            case "emergency stop":
                return readings._replace(emergency_stop_clear=False)
        return readings

    def write(self, command: Command) -> Command:
        """Apply the command, or a broken device's version of it."""
        match self.fault:
            case "write raises":
                raise DriverError("broken on purpose")
            case "arm valve stuck open":
                valve = command.valve
                super().write(command._replace(valve=(valve[0], 1.0, valve[2])))
                return command
            case "device silent":
                self.silent = True
                self.make_passive()
                return self.applied
        return super().write(command)

    @property
    def operational(self) -> bool:
        """False once its watchdog released the valves."""
        return not self.silent


FAULTS = {
    "write raises": 0,
    "read raises": 0,
    "one encoder invalid": 5,
    "all encoders invalid": 5,
    "guard opened": 1,
    "emergency stop": 1,
    "device silent": 1,
    "supervisor dead": 1,
    "operator stop": 0,
    "arm valve stuck open": None,
}
"""Faults and the ticks to the reaction that are promised."""


def run_case(fault: str, phase: Phase) -> Case:
    """Swing up to the first tick of `phase`, break what `fault` says, and watch until the robot rests."""
    c = load_configuration(None)
    driver = FaultyDriver(c.plant)
    bench = SwingBench(c, driver, driver.plant_state)
    bench.reach(phase)
    bench.reset_peaks()
    control, first = bench.cycle.state.control, len(bench.kept.cycles)
    if fault == "operator stop":
        bench.cycle.request(Request.STOP)
    elif fault == "supervisor dead":
        control["supervisor_alive"] = control["lease_held"] = False
    else:
        driver.fault = fault
    bench.come_to_rest()
    records = bench.kept.cycles[first:]
    # A tick that raised before it was decided leaves no record; the state holds what it led to.
    reacted = np.flatnonzero((records["cause"] != 0) | (records["reaction"] > Reaction.COMPLETE))
    return Case(
        fault,
        phase,
        int(records["tick"][reacted[0]] - records["tick"][0]) if len(reacted) else -1,
        Reaction(int(records["reaction"][reacted[0]])) if len(reacted) else Reaction.NONE,
        Cause(int(bench.cycle.state.control["cause"][0])),
        "",
        bench.loads,
        bench.cycle.phase,
    )


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Return the slowest reaction to each fault, and how many cases ended above a rating."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks reactions")
    parser.add_argument("--faults", nargs="*", default=list(FAULTS), choices=list(FAULTS))
    options = parser.parse_args(arguments)
    rows, cases = [], []
    for fault in options.faults:
        found = [run_case(fault, phase) for phase in PHASES]
        cases += found
        moving = [case for case in found if case.phase is not Phase.STANDING]
        slowest = max(moving, key=lambda case: case.ticks)
        note = f"in {slowest.phase.name}; {sum(case.unsafe for case in found)} of {len(found)} above a rating"
        if unreacted := [case.phase.name for case in moving if case.ticks < 0]:
            note += f"; none in {', '.join(unreacted)}"
        rows.append(Row("reactions", fault, slowest.ticks, "ticks", note, at_most=FAULTS[fault]))
    show(cases, Console(width=140))
    return rows
