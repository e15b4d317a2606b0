"""Ticks from a fault to its reaction, and what that ended in, phase by phase, on the plant in lock-step.

Faults come in at the driver, as from hardware; the cycle is the one of the real-time loop.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.config import load_configuration
from bench.control.settings import build_controller
from bench.lifecycle import Cause, Phase, Reaction, Request
from bench.loop import Cycle, CycleArray
from bench.simulation.loads import Loads, begin_tally, loads_of
from bench.simulation.safety import RunEnd, SafetyLimits, dangers
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base import Command, DriverError, Readings
from sim.driver import SimDriver
from tests.benchmarks.row import Row

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
LONGEST = 20_000
"""Ticks until a phase is reached, or the robot rests."""


class FaultyDriver(SimDriver):
    """The simulated robot, broken from a chosen tick on."""

    fault = ""
    silent = False
    """Its watchdog let go of the valves."""

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
        """Apply the command, or what a broken device makes of it."""
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
        """False once it let go by itself."""
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


class NotReached(RuntimeError):
    """The robot did not come to where it was awaited."""


class Case(NamedTuple):
    """How one fault in one phase ended."""

    fault: str
    phase: Phase
    ticks: int
    """From the first faulty tick (0: in it) to the start of the reaction; -1: there was none."""
    cause: Cause
    reaction: Reaction
    loads: Loads
    travel: float
    """Way of the club head from the fault to rest, m."""
    fastest: float
    """Head speed after the fault, m/s."""

    @property
    def unsafe(self) -> bool:
        """Whether the loads are unsafe."""
        return bool(dangers(RunEnd(self.loads), SafetyLimits()))


def run_case(fault: str, phase: Phase) -> Case:
    """Swing up to the first tick of `phase`, break what `fault` says, and watch until the robot rests."""
    c = load_configuration(None)
    driver = FaultyDriver(c.plant)
    profile = load_profile(find_profile(c.swing.profile))
    parameters = build_controller(c.plant, profile, c.control, c.envelope, c.estimator)
    kept = CycleArray(4 * LONGEST)
    cycle = Cycle(driver, parameters, kept, name="sim", note_truth=driver.note_truth)
    driver.open()
    period, tick = c.plant.tick, 0

    def run(holds: Callable[[], bool]) -> None:
        nonlocal tick
        for _ in range(LONGEST):
            if holds():
                return
            try:
                cycle.run_tick(tick * period)
            except DriverError:
                pass  # what the loop process does too: it goes on, passive
            tick += 1
        raise NotReached(f"{fault} in {phase.name}: still {cycle.phase.name} after {LONGEST} ticks")

    def ask(request: Request) -> None:
        cycle.request(request)
        run(lambda: int(cycle.state.control["request"][0]) == 0)

    run(lambda: tick == 300)
    if phase is not Phase.STANDING:
        driver.place_ball()
        ask(Request.ARM)
        held = [0]

        def at_address() -> bool:
            held[0] = held[0] + 1 if cycle.phase is Phase.HOLD else 0
            return held[0] > 800

        run(at_address)
        if phase is Phase.HOLD:
            pass
        else:
            ask(Request.SWING)
            run(lambda: cycle.phase is phase)
    state = driver.plant_state
    begin_tally(state)
    first = tick
    if fault == "operator stop":
        cycle.request(Request.STOP)
    elif fault == "supervisor dead":
        cycle.state.control["supervisor_alive"] = cycle.state.control["lease_held"] = False
    else:
        driver.fault = fault
    still = [0]

    def at_rest() -> bool:
        still[0] = still[0] + 1 if np.all(np.abs(state["speed"][0]) < 0.2) and cycle.phase == 0 else 0
        return still[0] > 1500

    with suppress(NotReached):  # no reaction: the robot holds on
        run(at_rest)
    records = kept.cycles[-(tick - first) :]
    # A tick that raised before it was decided leaves no record; the state holds what it led to.
    reacted = np.flatnonzero((records["trip"] != 0) | (records["reaction"] > Reaction.COMPLETE))
    speed = records["plant_head_speed"]
    return Case(
        fault,
        phase,
        int(records["tick"][reacted[0]] - records["tick"][0]) if len(reacted) else -1,
        Cause(int(cycle.state.control["cause"][0])),
        Reaction(int(records["reaction"][reacted[0]])) if len(reacted) else Reaction.NONE,
        loads_of(state, c.plant),
        float(np.nansum(speed) * period),
        float(np.nanmax(speed)),
    )


def show(cases: Sequence[Case], console: Console) -> None:
    """Print a line for each case."""
    table = Table("fault", "phase", "reaction", "cause", box=None, header_style="bold")
    for name in ("ticks", "stop energy", "pressure", "way of the head", "fastest"):
        table.add_column(name, justify="right")
    for case in cases:
        loads = case.loads
        table.add_row(
            case.fault,
            case.phase.name,
            case.reaction.name,
            case.cause.name,
            str(case.ticks),
            f"{100 * loads.stop_share:.0f} %",
            f"{100 * loads.pressure_share:.0f} %",
            f"{case.travel:.2f} m",
            f"{case.fastest:.1f} m/s",
            style="red" if case.unsafe else "",
        )
    console.print(table)


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
        unreacted = [case.phase.name for case in moving if case.ticks < 0]
        rows.append(
            Row(
                "reactions",
                fault,
                slowest.ticks,
                "ticks",
                note + (f"; none in {', '.join(unreacted)}" if unreacted else ""),
                at_most=FAULTS[fault],
            )
        )
    show(cases, Console(width=140))
    return rows
