"""What a loop and the software plant in its own process have in common: a plan, and three shared records.

All lie in one folder of memory. `PLANT_COMMAND` goes from the loop to the plant, `PLANT_REPORT` back, and
`PLANT_SURROUNDINGS` comes from whoever plays the operator and the faults (`sim.live.surroundings`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.base import COMMAND, READINGS, Triple
from sim.faults import Fault
from sim.plant import PlantParameters

COMMAND_FILE = "plant-command"
REPORT_FILE = "plant-report"
SURROUNDINGS_FILE = "plant-surroundings"


@dataclass(frozen=True)
class PlantPlan:
    """What the plant's process is started with."""

    folder: Path
    """Of shared memory; the plant makes its files in it, replaces those of a dead one, and removes them."""
    plant: PlantParameters
    watchdog: float
    """Silence after which the valve node goes passive by itself, s."""
    angle: Triple | None = None
    """Joint angles at the start, rad; as the robot hangs when None."""
    priority: int = 0
    """SCHED_FIFO priority asked for, one below the loop's; 0: none."""
    cpu: int = -1
    """The core it stays on; -1: any."""
    burst: int = 5
    """Most ticks made up at once after a stall; what is left slips."""
    lonely: float = 5.0
    """Without a command for so long (s), and without the process that started it, the plant ends."""
    faults: tuple[Fault, ...] = ()
    """What breaks; no onset by phase, as the plant knows none."""


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

TRUTH = np.dtype(
    [
        ("plant_angle", "f8", (3,)),
        ("plant_velocity", "f8", (3,)),
        ("plant_pressure", "f8", (6,)),
        ("plant_effort", "f8", (3,)),
        ("plant_head_position", "f8", (2,)),
        ("plant_head_speed", "f8"),
    ],
    align=True,
)
"""The fields of a cycle record that only the plant knows, same names."""

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
"""How the ball that was last on the tee was struck, as in PLANT_STATE: `sim.truth.contact_in` reads it."""

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

`counter` of the command heard last, the ticks at which one was obeyed last and at which the watchdog struck
last, and the command in force. `watchdog` is in s.
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
        ("greatest_lateness", "f8"),
    ],
    align=True,
)
"""One tick of the plant. Times are CLOCK_MONOTONIC (s). `contacts` counts struck balls, `ticks` those that
the plant has lived through: its own clock, which stands still where it slips. `plant_slips` counts the slips,
`slipped_ticks` the ticks lost in them; `lateness` (s) is how long after its instant this tick began."""

BALL = np.dtype(
    [
        ("mass", "f8"),
        ("radius", "f8"),
        ("inertia_factor", "f8"),
        ("restitution_factor", "f8"),
        ("friction", "f8"),
    ],
    align=True,
)
"""What the impact needs of a `sim.ball.Ball`, same names; all zero: the plan's ball."""

PLANT_SURROUNDINGS = np.dtype(
    [
        ("emergency_stop_clear", "?"),
        ("guard_closed", "?"),
        ("local_reset", "?"),
        ("encoder_valid", "u1", (3,)),
        ("frozen", "?"),
        ("ball_handled", "i8"),
        ("ball_present", "?"),
        ("ball", BALL),
    ],
    align=True,
)
"""`frozen`: readings stay as they are, with their old time stamps. Whenever `ball_handled` changes, the tee
is made full or empty as `ball_present` says; `ball` is what lies there next."""
