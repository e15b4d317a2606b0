"""The step with joints that are where a test puts them, and readings that a test makes up."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from functools import cache
from math import nan, pi
from typing import Any

import numpy as np

from bench.base.lifecycle import Answer, Cause, Phase, Reaction, Request, State
from bench.control.settings import (
    SIMULATED,
    ControlSettings,
    EnvelopeSettings,
    HomingSettings,
    LifecycleSettings,
    ModelSettings,
    build_controller,
)
from bench.control.step import step
from bench.control.step_records import new_control_state
from bench.records.telemetry.cycle_record import CYCLE
from bench.swing.profile import PHASES, Profile
from drivers.base import PASSIVE
from drivers.base.compiled import new_record
from drivers.base.records import COMMAND, READINGS, unpack_command
from sim.plant import PlantParameters

Array = np.ndarray[Any, Any]

ADDRESS = np.array([0.40, 4.30, 6.10])
SAMPLES, SPACING = 700, 20
BEGINS = (0, 100, 200, 300, 400, 500, 600)
COUNTS = PlantParameters().encoders.counts_per_revolution
QUICK = ControlSettings(gains="hand", precharge_time=0.02, move_timeout=0.2, open_loop_settling_time=0.1)
"""Its gains are those by hand: the machine's take a minute of plain Python, and these joints need none."""
UNMODELLED = EnvelopeSettings(model=ModelSettings(check="off"))
"""These joints obey no law of motion."""
SUPPLY, ATMOSPHERE = 8e5, 1.013e5
"""Pa absolute."""
GOOD = ("emergency_stop_clear", "guard_closed", "guard_locked")


def still_profile() -> Profile:
    """Return a swing that stays at the address, with blind brakes that differ from row to row."""
    row = np.arange(SAMPLES // SPACING)[:, None]
    blind = np.hstack([np.cos(row + [0.0, 1.0, 2.0]), 0.02 + 0.001 * (row % 7) + [[0.0, 0.01, 0.02]]])
    return Profile(
        "still",
        "",
        "",
        "",
        1e-3,
        BEGINS,
        np.tile(ADDRESS, (SAMPLES, 1)),
        np.zeros((SAMPLES, 3)),
        np.zeros((SAMPLES, 3)),
        SPACING,
        blind,
        (0.25, -1.56),
        0.55,
    )


STILL = still_profile()


def put(record: np.ndarray[Any, Any], location: str, value: Any) -> None:
    """Set the field at `location` of `record`, as "venting.start"."""
    *groups, field = location.split(".")
    for group in groups:
        record = record[group]
    record[field] = value


class Puppet:
    """The step with joints that follow its reference at once, and whatever else a test sets."""

    def __init__(
        self,
        profile: Profile = STILL,
        control: ControlSettings = QUICK,
        tick: float = 1e-3,
        lifecycle: LifecycleSettings = SIMULATED,
        homing: HomingSettings = HomingSettings(reference="pose", stops=False),  # noqa: B008
        *,
        state: State = State.READY,
        read_only: bool = False,
    ) -> None:
        """Stand at the profile's address, which is also where the vented robot hangs."""
        # A manifold that is empty within a tick.
        plant = replace(PlantParameters(), tick=tick)
        plant = replace(plant, supply=replace(plant.supply, volume=1e-5))
        self.parameters = build_controller(
            plant, profile, control, UNMODELLED, lifecycle=lifecycle, homing=homing, read_only=read_only
        )
        self.parameters.control["home_pose"] = ADDRESS
        self.state = new_control_state(state)
        self.state.control["first_motion"]["answered"] = 1  # or it makes a test motion before its hold
        self.readings, self.record, self.cycle = new_record(READINGS), new_record(COMMAND), new_record(CYCLE)
        self.angle = ADDRESS.copy()
        self.offset = np.zeros(3)
        """Tracking errors of the joints (rad)."""
        self.stamp = np.zeros(3)
        """Errors of the encoders' time stamps (s)."""
        self.follows = True
        self.time, self.period = 100.0, tick
        r = self.readings
        for name in GOOD:
            r[name] = True
        self.supply: float | None = None
        """Pressure that the manifold always shows (Pa); None: it follows the supply valve."""
        r["supply_pressure"], r["chamber_pressure"], r["encoder_valid"] = ATMOSPHERE, nan, 1
        r["encoder_indexed"], r["vent_open"] = 1, nan
        r["shut_off_open"] = r["spool_position"] = nan

    @property
    def control(self) -> Any:
        return self.state.control[0]

    @property
    def phase(self) -> Phase:
        return Phase(int(self.control["phase"]))

    @property
    def bench(self) -> State:
        """The state of the bench."""
        return State(int(self.control["state"]))

    @property
    def reaction(self) -> Reaction:
        return Reaction(int(self.control["reaction"]))

    @property
    def cause(self) -> Cause:
        return Cause(int(self.control["cause"]))

    def give(self, **values: Any) -> Puppet:
        """Set fields of the readings, or of the step's memory: "venting.start" is one of a record in it."""
        for name, value in values.items():
            if name == "supply_pressure":
                self.supply = value
            put(self.readings if name in (READINGS.names or ()) else self.state.control, name, value)
        return self

    def tick(self, request: int = 0) -> int:
        """Run one tick and return the answer to `request`; 0 if there was none."""
        self.control["answer"] = 0
        self.step(request)
        return int(self.control["answer"])

    def step(self, request: int = 0) -> None:
        """Run one tick; the last answer stands until there is another."""
        self.time += self.period
        r = self.readings
        if self.supply is None:
            r["supply_pressure"] = SUPPLY if self.record["supply_enable"][0] else ATMOSPHERE
        seen = self.angle + self.offset
        r["time"], r["encoder_count"] = self.time, np.round(seen * COUNTS / (2 * pi)) % COUNTS
        valid = r["encoder_valid"][0] != 0
        r["encoder_time"][0, valid] = (self.time + self.stamp)[valid]
        self.control["request"] = request
        step(self.state, self.parameters, r, self.time, self.record, self.cycle)
        if self.follows and self.phase is not Phase.STANDING:
            self.angle = self.control["reference"].copy()

    def run(self, ticks: int, request: int = 0) -> Array:
        """Run `ticks` ticks; return their openings (ticks, 3)."""
        openings = np.zeros((ticks, 3))
        for k in range(ticks):
            self.tick(request if k == 0 else 0)
            openings[k] = self.record["valve"][0]
        return openings

    def shift(self, joint: int, miss: float) -> None:
        """Let `joint` miss the reference by `miss`, taking 0.2 s for it."""
        for value in np.linspace(self.offset[joint], miss, 200):
            self.offset[joint] = value
            self.tick()

    def is_without_energy(self) -> bool:
        return unpack_command(self.record) == PASSIVE

    def hold(self) -> Puppet:
        """Go to address."""
        self.run(10)
        assert self.tick(Request.ARM) == Answer.ACCEPTED
        self.run(400)
        assert (self.phase, self.reaction) == (Phase.HOLD, Reaction.NONE)
        return self

    def swing(self, sample: int) -> Puppet:
        """Hold, then swing up to `sample`."""
        self.hold()
        assert self.tick(Request.SWING) == Answer.ACCEPTED
        self.run(sample)
        assert self.control["swing"]["sample"] == sample
        return self

    def enter(self, phase: Phase) -> Puppet:
        """Be in the middle of `phase`, however it came to that."""
        if phase in PHASES and phase is not Phase.HOLD:
            return self.swing(BEGINS[PHASES.index(phase)] + 50)
        if phase is Phase.STANDING:
            self.run(10)
            return self
        if phase is Phase.RETURN:
            self.run(10)
            assert self.tick(Request.ARM) == Answer.ACCEPTED
            self.run(60)
        elif phase is Phase.HOMING:
            self.parameters.control["home_by_index"] = True
            self.give(state=State.SAFE, homed=False, encoder_indexed=0).run(10)
            assert self.tick(Request.HOME) == Answer.ACCEPTED
            self.run(60)
        else:
            self.hold()
        assert self.phase is phase
        return self


def entered(phase: Phase) -> Puppet:
    """Return a default puppet in the middle of `phase`; its way there is gone once."""
    return deepcopy(_entered(phase))


@cache
def _entered(phase: Phase) -> Puppet:
    return Puppet().enter(phase)
