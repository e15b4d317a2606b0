"""Ticks from a fault on the CAN bus to the reaction at the valve node, and its outcome, in lock-step.

Driver and simulated nodes in one process on virtual time, plant and controller as they run in real time. The
reaction has come when the valve node obeys a command of the stopping table, or releases the valves itself.
"""

from __future__ import annotations

import argparse
import errno
import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.base.lifecycle import Cause, Phase, Reaction
from bench.config import Configuration, load_configuration
from bench.simulation.safety import Loads, RunEnd, SafetyLimits, unsafe_reasons
from tests.benchmarks.row import Row
from tests.drivers.canopen.in_step import PERIOD, Wire
from tests.drivers.canopen.swing_in_step import LONGEST, SwingBench, on_canopen

PHASES = (
    Phase.HOLD,
    Phase.BACKSWING,
    Phase.TOP,
    Phase.DOWNSWING,
    Phase.COMMITTED,
    Phase.IMPACT,
    Phase.RETURN,
)

Meddling = Callable[[Wire], None]

_POSITION, _INPUTS, _HEARTBEAT, _EMERGENCY = 0x280, 0x18A, 0x700, 0x080
_ARM, _NODE = 2, 10
"""Numbers of the arm's encoder and of the valve node."""
_BABBLE = 7
"""Frames of eight bytes that 1 Mbit/s has room for in a tick."""


def _drop(*identifiers: int) -> Meddling:
    def do(wire: Wire) -> None:
        wire.meddle = lambda i, data: [] if i in identifiers else [(i, data)]

    return do


def _double(wire: Wire) -> None:
    wire.meddle = lambda i, data: [(i, data)] * (2 if _POSITION < i < _POSITION + 4 else 1)


def _shorten(wire: Wire) -> None:
    wire.meddle = lambda i, data: [(i, data[:3] if i == _POSITION + _ARM else data)]


def _lose_some(wire: Wire) -> None:
    """Let every fiftieth position of each encoder get lost."""
    seen = dict.fromkeys(range(_POSITION + 1, _POSITION + 4), 0)

    def meddle(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        if identifier in seen:
            seen[identifier] += 1
            if seen[identifier] % 50 == 0:
                return []
        return [(identifier, data)]

    wire.meddle = meddle


def _delay(wire: Wire) -> None:
    """Let the arm's positions come when their tick waits no more, before the next SYNC."""
    held: list[tuple[int, bytes]] = []

    def meddle(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        if identifier == _POSITION + _ARM:
            held.append((identifier, data))
            return []
        return [(identifier, data)]

    def release(wire: Wire) -> None:
        while held:
            wire.put(*held.pop(0))

    wire.meddle, wire.each_tick = meddle, release


def _tell_error(number: int) -> Meddling:
    return lambda wire: wire.put(_EMERGENCY + number, struct.pack("<HB5x", 0x2310, 0x03))


def _blind_encoder(wire: Wire) -> None:
    wire.nodes.plant.state["encoder_valid"] = (1, 0, 1)


def _order(command: int, number: int) -> Meddling:
    return lambda wire: wire.order(command, number)


def _error_frame(identifier: int, reason: int = 0) -> Meddling:
    return lambda wire: wire.put(identifier, bytes([0, reason, 0, 0, 0, 0, 0, 0]))


def _refuse(number: int, ticks: int = LONGEST) -> Meddling:
    def do(wire: Wire) -> None:
        wire.refuse, left = OSError(number, "refused"), [ticks]

        def count(wire: Wire) -> None:
            left[0] -= 1
            if left[0] <= 0:
                wire.refuse = None

        wire.each_tick = count

    return do


def _babble(identifier: int, data: bytes) -> Meddling:
    """Put foreign frames on the wire before the answers to each SYNC."""
    babble = [(identifier, data)] * _BABBLE

    def do(wire: Wire) -> None:
        wire.meddle = lambda i, sent: [*babble, (i, sent)] if i == _POSITION + 1 else [(i, sent)]

    return do


def _go_deaf(wire: Wire) -> None:
    wire.deaf = True


class Fault(NamedTuple):
    """Something that goes wrong."""

    bring: Meddling | None
    """None: the bench itself falls silent."""
    longest: int | None
    """Ticks to the reaction that are promised; None: there must be none, the swing completes."""


FAULTS: dict[str, Fault] = {
    "every 50th position lost": Fault(_lose_some, None),
    "positions doubled": Fault(_double, None),
    "an encoder's positions late": Fault(_delay, None),
    "an encoder's positions missing": Fault(_drop(_POSITION + _ARM), 5),
    "an encoder's positions of a wrong length": Fault(_shorten, 5),
    "an encoder reports an error": Fault(_blind_encoder, 5),
    "the valve node reports an error": Fault(_tell_error(_NODE), 1),
    "an encoder's heartbeat lost": Fault(_drop(_HEARTBEAT + _ARM), 152),
    "the valve node's heartbeat lost": Fault(_drop(_HEARTBEAT + _NODE), 152),
    "the interlocks lost": Fault(_drop(_INPUTS), 62),
    "an encoder restarts": Fault(_order(129, _ARM), 2),
    "the valve node restarts": Fault(_order(129, _NODE), 1),
    "the valve node stopped by another": Fault(_order(2, _NODE), 1),
    "bus-off": Fault(_error_frame(0x20000040), 1),
    "error-passive": Fault(_error_frame(0x20000004, 0x10), None),
    "no room for 4 ticks (ENOBUFS)": Fault(_refuse(errno.ENOBUFS, 4), None),
    "no room any more (ENOBUFS)": Fault(_refuse(errno.ENOBUFS), 21),
    "interface down": Fault(_refuse(errno.ENETDOWN), 21),
    "interface down for 10 ticks": Fault(_refuse(errno.ENETDOWN, 10), 11),
    "commands do not arrive": Fault(_go_deaf, 21),
    "the bench silent": Fault(None, 21),
    "a node babbles, foreign frames": Fault(_babble(0x555, bytes(8)), None),
    "a node babbles as an encoder": Fault(_babble(_POSITION + _ARM, bytes(4)), 5),
}


class Case(NamedTuple):
    """How one fault in one phase ended."""

    fault: str
    phase: Phase
    ticks: int
    """From the first faulty tick (0: in it) to the reaction at the valve node; -1: there was none."""
    reaction: Reaction
    """The one that the valve node obeyed first; PASSIVE also when it released the valves itself."""
    cause: Cause
    device_fault: str
    loads: Loads
    ended: Phase

    @property
    def unsafe(self) -> bool:
        """Whether the loads are unsafe."""
        return bool(unsafe_reasons(RunEnd(self.loads), SafetyLimits()))


def run_case(configuration: Configuration, fault: str, phase: Phase) -> Case:
    """Swing up to the first tick of `phase`, bring the fault, and watch until the robot rests or holds."""
    bench, driver, wire = on_canopen(configuration)
    bench.reach(phase)
    bench.reset_peaks()
    plant, first = wire.nodes.plant, bench.tick
    reacted: list[tuple[int, Reaction]] = []

    def look() -> None:
        reaction = Reaction(int(bench.cycle.state.control["reaction"][0]))
        arrives = not wire.deaf and wire.refuse is None
        if not plant.applied.supply_enable:  # in all these phases the air is on
            reaction, arrives = Reaction.PASSIVE, True
        if not reacted and arrives and reaction > Reaction.COMPLETE:
            reacted.append((bench.tick - first - 1, reaction))

    bring = FAULTS[fault].bring
    if bring is not None:
        bring(wire)
        bench.come_to_rest(look)
    else:
        _stay_silent(bench, wire, look)
    ticks, reaction = reacted[0] if reacted else (-1, Reaction.NONE)
    return Case(
        fault,
        phase,
        ticks,
        reaction,
        Cause(int(bench.cycle.state.control["cause"][0])),
        driver.fault,
        bench.loads,
        bench.cycle.phase,
    )


def _stay_silent(bench: SwingBench, wire: Wire, look: Callable[[], None]) -> None:
    """Run the plant without the loop until the node has released the valves and the robot rests."""
    plant = wire.nodes.plant
    for _ in range(LONGEST):
        wire.pass_time(PERIOD)
        bench.tick += 1
        look()
        if not plant.applied.supply_enable and np.all(np.abs(bench.state["speed"][0]) < 0.01):
            return


def show(cases: Sequence[Case], console: Console) -> None:
    """Print a line for each case."""
    table = Table("fault", "phase", "reaction", "cause", box=None, header_style="bold")
    for name in ("ticks", "stop energy", "pressure"):
        table.add_column(name, justify="right")
    table.add_column("driver report")
    for case in cases:
        table.add_row(
            case.fault,
            case.phase.name,
            case.reaction.name,
            case.cause.name,
            str(case.ticks),
            f"{100 * case.loads.stop_share:.0f} %",
            f"{100 * case.loads.pressure_share:.0f} %",
            case.device_fault,
            style="red" if case.unsafe else "",
        )
    console.print(table)


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Return the slowest reaction to each fault, and how many cases ended above a rating."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks canopen_reactions")
    parser.add_argument("--faults", nargs="*", default=list(FAULTS), choices=list(FAULTS))
    names = [phase.name for phase in PHASES]
    parser.add_argument("--phases", nargs="*", default=names, choices=names)
    options = parser.parse_args(arguments)
    configuration = load_configuration(None)
    rows, cases = [], []
    for fault in options.faults:
        found = [run_case(configuration, fault, Phase[name]) for name in options.phases]
        cases += found
        rows.append(_row(fault, found))
    show(cases, Console(width=200))
    return rows


def _row(fault: str, found: Sequence[Case]) -> Row:
    longest = FAULTS[fault].longest
    slowest = max(found, key=lambda case: case.ticks)
    note = f"{sum(case.unsafe for case in found)} of {len(found)} above a rating"
    if longest is None:
        reacted = [case for case in found if case.ticks >= 0]
        stopped = ", ".join(f"{case.phase.name} {case.cause.name}" for case in reacted)
        return Row("canopen reactions", fault, len(reacted), "swings stopped", f"{note} {stopped}", at_most=0)
    unreacted = [case.phase.name for case in found if case.ticks < 0]
    note += f"; none in {', '.join(unreacted)}" if unreacted else f"; slowest in {slowest.phase.name}"
    ticks = slowest.ticks if not unreacted else LONGEST
    return Row("canopen reactions", fault, ticks, "ticks", note, at_most=longest)
