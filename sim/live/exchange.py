"""Records that a simulated plant shares with others, in one folder of shared memory.

`PLANT_REPORT` comes from the plant; `PLANT_SURROUNDINGS` carries operator actions and faults to it
(`sim.live.surroundings`).
"""

from __future__ import annotations

import numpy as np

from drivers.base.records import COMMAND, READINGS, TRUTH

REPORT_FILE = "plant-report"
SURROUNDINGS_FILE = "plant-surroundings"


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
        ("operational", "?"),
        ("watchdog_trips", "i8"),
        ("command_tick", "i8"),
        ("passive_tick", "i8"),
        ("applied", COMMAND),
    ],
    align=True,
)
"""The valve node: the ticks of the last applied command and of the last watchdog trip, and the command in
force."""

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
