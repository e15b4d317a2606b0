"""`golfbench profile check`: proves a profile's stops on the plant, from every instant of the swing.

The nominal swing runs once with and once without a ball. From each instant of both, each reaction of the
stopping table is provoked, each valve sticks open either way or shut, and communication is lost. Each time
the complete control step continues against the plant until everything rests. Once for each height, ground and
ball are higher than the bench assumes, so that the head meets the turf first (a fat shot).
`bench.simulation.safety` assesses the end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from bench.base.errors import Refused
from bench.base.lifecycle import CAUSE_TEXT, Cause, Phase, Request
from bench.simulation.lockstep import Lockstep
from bench.simulation.safety import RunEnd, SafetyLimits, unsafe_reasons
from bench.simulation.simulated_bench import Bench
from bench.simulation.swing_operator import LockstepEngine
from drivers.base import JOINTS
from sim.faults import Fault, own_records
from sim.plant import build_plant

_LONG_STILL = 1.5
"""Standstill after which a trial ends, s."""
_STILL = 0.2
"""Joint speed below which a joint rests, rad/s."""
_CHUNK = 100
"""Ticks between two looks."""
_WATCHED = 14.0
"""Longest trial, s: a raised arm sinks slowly on the air that its throttled vents release."""


class FaultTrial(NamedTuple):
    """One trial: the parts that break, a request, with or without a ball, ground that came up."""

    name: str
    faults: tuple[Fault, ...] = ()
    request: int = 0
    ball: bool = True
    raised: float = 0.0
    """Height by which ground and ball stand too high, m, through the whole swing."""


_ESTOP = (Fault("emergency stop", "emergency stop", "off"),)
_LOST = tuple(Fault(f"{joint} encoder", f"{joint} encoder", "off") for joint in JOINTS)
_SILENT = (Fault("bench silent", "loop", "off"),)
_FAT = (0.005, 0.010, 0.020)
"""Heights by which ground and ball stand too high, m: worn feet, a thicker mat, a wrong zero."""

TRIALS = (
    FaultTrial("none"),
    FaultTrial("no ball", ball=False),
    *(FaultTrial(f"ground {1e3 * height:g} mm higher", raised=height) for height in _FAT),
    FaultTrial("operator stop", request=Request.STOP),
    FaultTrial("operator stop, no ball", request=Request.STOP, ball=False),
    FaultTrial("emergency stop", _ESTOP),
    FaultTrial("emergency stop, no ball", _ESTOP, ball=False),
    FaultTrial("encoders lost", _LOST),
    FaultTrial("encoders lost, no ball", _LOST, ball=False),
    FaultTrial("bench silent", _SILENT),
    FaultTrial("bench silent, no ball", _SILENT, ball=False),
    *(
        FaultTrial(f"{joint} valve stuck {name}", (Fault("valve", f"{joint} valve", "stuck", opening),))
        for joint in JOINTS
        for name, opening in (("open", 1.0), ("open in reverse", -1.0), ("shut", 0.0))
    ),
)


@dataclass(frozen=True)
class TrialOutcome:
    """Outcome of one fault at one instant; loads are ratios to their ratings, 1 is the limit."""

    fault: str
    time: float
    """Time from the start of the swing (s)."""
    phase: Phase
    stop_share: float
    stop: str
    """End stop with that ratio."""
    pressure_share: float
    clearance: float
    """Lowest clearance of the head over the ground, m."""
    head_speed: float
    """Max head speed (m/s)."""
    rest_time: float
    """Time from the fault until all joints rested (s); inf if they did not."""
    cause: Cause
    unsafe: str
    """Why this end is unsafe; empty if it is safe."""


class SwingCheck:
    """A bench on its plant, checked fault by fault."""

    def __init__(self, bench: Bench) -> None:
        """Build plant and controller; nothing runs yet."""
        self.plant, self.parameters = build_plant(bench.plant), bench.controller()
        self.profile = bench.profile
        self.watched = round(_WATCHED / bench.plant.tick)

    def _bases(self, ticks: Sequence[int], *, ball: bool) -> Iterator[tuple[int, LockstepEngine]]:
        """Yield the bench at rising `ticks` of a nominal swing, which runs to its end: (tick, bench)."""
        stepper = Lockstep(self.plant, self.parameters, self.profile.angle[0])
        bench = LockstepEngine(stepper, name=self.profile.name)
        bench.arm()
        bench.await_air()
        bench.control["tee"] = ball
        now = 0
        for tick in (*ticks, len(self.profile.angle)):
            if tick > now:
                bench.advance(tick - now, Request.SWING if now == 0 else 0)
            now = tick
            if bench.cause:
                raise Refused(
                    f"checking profile {self.profile.name!r}",
                    f"the undisturbed swing stopped by tick {tick}: {CAUSE_TEXT[bench.cause]}",
                    "an undisturbed swing that runs to its end",
                    "Try it with `golfbench profile simulate`.",
                )
            if tick < len(self.profile.angle):
                yield tick, bench

    def outcomes(
        self,
        trials: tuple[FaultTrial, ...] = TRIALS,
        spacing: int = 10,
        progress: Callable[[float], None] = lambda part: None,
        *,
        ticks: Sequence[int] | None = None,
    ) -> list[TrialOutcome]:
        """Return how each of `trials` ends from every `spacing`-th tick of the swing, or from rising `ticks`.

        Raises:
            Refused: the undisturbed swing does not run.
        """
        found, every = [], range(0, len(self.profile.angle), spacing)
        for part, ball in enumerate((True, False)):
            wanted = [trial for trial in trials if trial.ball == ball]
            for tick, bench in self._bases(every if ticks is None else ticks, ball=ball) if wanted else ():
                found += [
                    self._outcome(trial, tick, bench) for trial in wanted if not (trial.raised and tick)
                ]
                progress((part + tick / len(self.profile.angle)) / 2)
        return found

    def _outcome(self, trial: FaultTrial, tick: int, base: LockstepEngine) -> TrialOutcome:
        bench = base.copy()
        bench.reset_peaks()
        if trial.faults:
            bench.stepper.break_with(trial.faults, watchdog=0.0)  # worst case: its watchdog acts at once
        if trial.raised:  # in copies of the records, for this bench alone
            bench.stepper.plant = own_records(bench.stepper.plant)
            for name in ("ground", "ball_y"):
                bench.stepper.plant.plant[name] += trial.raised
        request = Request.SWING if tick == 0 and not trial.request else trial.request
        rest = self._run_to_rest(bench, request, silent=trial.faults is _SILENT)
        rested = rest < (self.watched - 1) * self.plant.parameters.tick
        loads, limits = bench.loads(), SafetyLimits()
        # A sole may be as much deeper in the ground as that came up to it.
        limits = replace(limits, ground_touch=limits.ground_touch + trial.raised)
        return TrialOutcome(
            fault=trial.name,
            time=tick * self.profile.period,
            phase=self.profile.phase_of(tick),
            stop_share=loads.stop_share,
            stop=loads.stop,
            pressure_share=loads.pressure_share,
            clearance=loads.lowest_clearance,
            head_speed=loads.peak_head_speed,
            rest_time=rest if rested else float("inf"),
            cause=bench.cause,
            unsafe="; ".join(unsafe_reasons(RunEnd(loads, rested=rested), limits)),
        )

    def _run_to_rest(self, bench: LockstepEngine, request: int, *, silent: bool) -> float:
        """Run `bench`; return the time (s) after which no joint exceeded `_STILL`."""
        period, rest, ticks = self.plant.parameters.tick, 0, 0
        while ticks < self.watched:
            speed = bench.advance(min(_CHUNK, self.watched - ticks), request)["plant_velocity"]
            moving = np.flatnonzero((np.abs(speed) > _STILL).any(axis=1))
            if len(moving):
                rest = ticks + int(moving[-1])
            ticks, request = ticks + len(speed), 0
            # Standing still without energy for long enough: nothing more will come.
            standing = silent or bench.phase is Phase.STANDING
            if standing and (ticks - rest) * period > _LONG_STILL:
                break
        return rest * period


@dataclass(frozen=True)
class TrialSummary:
    """All instants of one fault."""

    fault: str
    instants: int
    unsafe: int
    worst_stop: TrialOutcome
    worst_pressure: TrialOutcome
    lowest: TrialOutcome
    slowest: TrialOutcome


def summarise(outcomes: list[TrialOutcome]) -> list[TrialSummary]:
    """Return one summary a fault, in the order of first appearance."""
    names = list(dict.fromkeys(outcome.fault for outcome in outcomes))
    groups = [[outcome for outcome in outcomes if outcome.fault == name] for name in names]
    return [
        TrialSummary(
            name,
            len(group),
            sum(bool(outcome.unsafe) for outcome in group),
            max(group, key=lambda o: o.stop_share),
            max(group, key=lambda o: o.pressure_share),
            min(group, key=lambda o: o.clearance),
            max(group, key=lambda o: o.rest_time),
        )
        for name, group in zip(names, groups, strict=True)
    ]
