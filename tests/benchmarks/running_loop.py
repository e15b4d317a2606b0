"""The real loop process against the real plant process, with a small supervisor that swings all the time."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

from bench.config import Configuration, load_configuration
from bench.lifecycle import Request, State
from bench.processes.child import Child
from bench.processes.loop_link import LoopLink
from bench.processes.ownership import take_bench
from bench.processes.plan import TIMING_FILE, LoopPlan
from bench.processes.tick_timing import TimingReader
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.live.exchange import PlantPlan
from tests.ready_child import ready_child

START = 180.0
"""s that compiling may take."""
PATIENCE = 120.0
"""s in which the robot should be at its address."""
PLANT_RATE = 4000.0
"""Hz of the plant's internal steps at the shipped 1 kHz; kept at higher rates."""
_TURN = 0.02

_NEXT = {
    State.ESTOP: Request.RESET,
    State.FAULT: Request.RESET,
    State.SAFE: Request.HOME,
    State.READY: Request.ARM,
    State.ARMED: Request.SWING,
}
"""What the supervisor asks for in each state; elsewhere it waits."""


class RunningLoop:
    """A loop at work. `turn` keeps it swinging and must be called many times a second."""

    def __init__(self, link: LoopLink, loop: Child, timing: TimingReader) -> None:
        self.link, self.loop, self.timing = link, loop, timing
        self.swings = 0
        self.stops = 0
        """Faults and emergency stops after the first, from which it went on."""
        self._state = State.STARTING

    def turn(self) -> State:
        """Beat, and ask for whatever comes next; return the state of the bench.

        Raises:
            RuntimeError: the loop ended.
        """
        if not self.loop.alive:
            raise RuntimeError(f"the loop {self.loop.ending}")
        self.link.beat(lease=1, support_ready=True)
        state = State[self.link.state]
        if state is State.SWINGING and self._state is not State.SWINGING:
            self.swings += 1
        if state in (State.FAULT, State.ESTOP) and self._state not in (state, State.STARTING):
            self.stops += 1
        self._state = state
        if request := _NEXT.get(state):
            self.link.request(request)
        return state

    def live(self, seconds: float) -> None:
        """Take turns for `seconds`."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.turn()
            time.sleep(_TURN)

    def wait_for_swing(self) -> None:
        """Take turns until the first swing.

        Raises:
            RuntimeError: there is none within PATIENCE.
        """
        end = time.monotonic() + PATIENCE
        while self.turn() is not State.SWINGING:
            if time.monotonic() > end:
                raise RuntimeError(f"no swing within {PATIENCE:g} s; the bench is in {self._state.name}")
            time.sleep(_TURN)


def configured(rate: float, priority: int, cpu: int) -> Configuration:
    """Return the shipped configuration at `rate` (Hz), real time required, swing following on swing.

    The plant has a clock of its own: one in step with the loop would let it be late.
    """
    c = load_configuration(Path("shipped"))
    return replace(
        c,
        driver=replace(c.driver, time="wall"),
        loop=replace(c.loop, rate=rate, realtime="require", priority=priority, cpu=cpu),
        plant=replace(c.plant, tick=1.0 / rate, substeps=max(1, round(PLANT_RATE / rate))),
        lifecycle=replace(c.lifecycle, series=True, warning_time=0.1),
    ).running()


@contextmanager
def running_loop(configuration: Configuration) -> Iterator[RunningLoop]:
    """Yield a loop that is ready, with its plant; both are ended at the block's end."""
    c = configuration
    with ExitStack() as stack:
        owner = stack.enter_context(take_bench(f"benchmark-{os.getpid()}"))
        link = LoopLink(owner.folder)
        stack.callback(link.close)
        plan = PlantPlan(owner.folder, c.plant, c.driver.watchdog, priority=c.loop.priority - 1)
        stack.callback(ready_child("sim.live.process", plan, START).end, 2.0)
        profile = load_profile(find_profile(c.swing.profile))
        loop = Child.start(
            "loop",
            "bench.processes.loop_process",
            LoopPlan(c, profile, owner.folder, owner.descriptor),
            pass_fds=(owner.descriptor,),
        )
        stack.callback(loop.end, 15.0)
        loop.wait_until_ready(START)
        link.connect()
        timing = stack.enter_context(TimingReader(owner.folder / TIMING_FILE))
        yield RunningLoop(link, loop, timing)
