"""Interface between loop and plant process: a plan, and three shared records.

All are in one folder of shared memory. `PLANT_COMMAND` goes from the loop to the plant, `PLANT_REPORT` back,
and `PLANT_SURROUNDINGS` carries operator actions and faults (`sim.live.surroundings`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.base import Triple
from drivers.base.records import COMMAND, READINGS, TRUTH
from sim.faults import Fault
from sim.plant import PlantParameters

COMMAND_FILE = "plant-command"
REPORT_FILE = "plant-report"
SURROUNDINGS_FILE = "plant-surroundings"


@dataclass(frozen=True)
class PlantPlan:
    """Parameters of the plant process."""

    folder: Path
    """Folder of shared memory, in which the plant creates, replaces and finally removes its files."""
    plant: PlantParameters
    watchdog: float
    """Watchdog time of the valve node, s."""
    angle: Triple | None = None
    """Joint angles at the start, rad; None for the hanging pose."""
    priority: int = 0
    """Requested SCHED_FIFO priority, one below the loop's; 0 for none."""
    cpu: int = -1
    """Processor core; -1 for any."""
    max_catch_up: int = 5
    """Max ticks caught up at once after a stall; the rest slips."""
    orphan_timeout: float = 5.0
    """Time without a command after which an orphaned plant ends, s."""
    faults: tuple[Fault, ...] = ()
    """Faults; no onset by phase, as the plant does not know phases."""


PLANT_COMMAND = np.dtype(
    [
        ("counter", "i8"),
        ("session", "i8"),
        ("mode", "u1"),
        ("command", COMMAND),
    ],
    align=True,
)
"""`counter` changes with every command; `session` and `mode` are explained in `sim.live.valve_watchdog`."""

CONTACT = np.dtype(
    [
        ("struck", "?"),
        ("impact_time", "f8"),
        ("impact_head", "f8", (6,)),
        ("ball_velocity", "f8", (3,)),
        ("ball_spin", "f8", (3,)),
    ],
    align=True,
)
"""Contact with the last ball on the tee, as in PLANT_STATE: `sim.truth.contact_in` reads it."""

NODE = np.dtype(
    [
        ("watchdog", "f8"),
        ("session", "i8"),
        ("operational", "?"),
        ("passive_by_watchdog", "?"),
        ("watchdog_trips", "i8"),
        ("counter", "i8"),
        ("command_tick", "i8"),
        ("passive_tick", "i8"),
        ("applied", COMMAND),
    ],
    align=True,
)
"""The valve node, fields as in `sim.live.valve_watchdog`.

`counter` of the last command received, the ticks of the last applied command and of the last watchdog trip,
and the command in force. `watchdog` is in s.
"""

PLANT_REPORT = np.dtype(
    [
        ("readings", READINGS),
        ("truth", TRUTH),
        ("contact", CONTACT),
        ("contacts", "i8"),
        ("stop_energy", "f8", (3, 2)),
        ("peak_pressure", "f8", (6,)),
        ("lowest_clearance", "f8"),
        ("peak_head_speed", "f8"),
        ("node", NODE),
        ("ticks", "i8"),
        ("plant_slips", "i8"),
        ("slipped_ticks", "i8"),
        ("lateness", "f8"),
        ("max_lateness", "f8"),
    ],
    align=True,
)
"""One tick of the plant. Times are CLOCK_MONOTONIC (s). `contacts` counts struck balls, `ticks` the executed
ticks: the plant's own clock, which stops during a slip. `plant_slips` counts the slips, `slipped_ticks` the
ticks lost in them; `lateness` (s) is the delay of this tick."""

BALL = np.dtype(
    [
        ("mass", "f8"),
        ("radius", "f8"),
        ("inertia_factor", "f8"),
        ("restitution_factor", "f8"),
        ("friction", "f8"),
        ("drag_factor", "f8"),
        ("lift_factor", "f8"),
    ],
    align=True,
)
"""Fields of a `sim.ball.Ball`, same names; all zero for the plan's ball."""

PLANT_SURROUNDINGS = np.dtype(
    [
        ("emergency_stop_clear", "?"),
        ("guard_closed", "?"),
        ("local_reset", "?"),
        ("encoder_valid", "u1", (3,)),
        ("frozen", "?"),
        ("regulated", "f8"),
        ("ball_handled", "i8"),
        ("ball_present", "?"),
        ("ball", BALL),
    ],
    align=True,
)
"""`frozen`: readings and their time stamps freeze. `regulated`: pressure to which the regulator is turned, Pa
absolute, at most that of the plan; 0: that of the plan. Whenever `ball_handled` changes, the ball is placed
or removed according to `ball_present`; `ball` is the next ball."""
