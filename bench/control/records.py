"""Records of the control step: its parameters, what it remembers, and the profile's tables."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from bench.control.air import AIR_STATE
from bench.control.encoder import ENCODER_STATE
from bench.control.estimator import ESTIMATOR_STATE
from bench.control.model import MODEL_STATE
from bench.control.pid import PID_STATE
from bench.lifecycle import Cause, Phase, Request, State
from drivers.base.compiled import new_record

CONTROL_PARAMETERS = np.dtype(
    [
        ("downswing_damping", "f8"),
        ("downswing_stiffness", "f8"),
        ("dither", "f8", (3,)),
        ("dither_period", "f8"),
        ("dither_delay", "f8"),
        ("move_band", "f8", (3,)),
        ("brake_gain", "f8", (3,)),
        ("brake_damping", "f8", (3,)),
        ("brake_fade", "f8", (3,)),
        ("escape_opening", "f8", (3, 3)),
        ("escape_time", "f8", (3,)),
        ("lift_gain", "f8"),
        ("lift_angle", "f8"),
        ("feed_forward", "u1"),
        ("force_gain", "f8", (3,)),
        ("rate_opening", "f8", (3,)),
        ("speed_opening", "f8", (3,)),
        ("still_speed", "f8", (3,)),
        ("still_time", "f8"),
        ("brake_time", "f8"),
        ("blind_settle", "f8"),
        ("precharge_time", "f8"),
        ("precharge_opening", "f8"),
        ("precharge_period", "f8"),
        ("move_speed", "f8", (3,)),
        ("move_timeout", "f8"),
        ("address_tolerance", "f8", (3,)),
        ("rest_band", "f8", (3,)),
        ("strike_drop", "f8"),
        ("reactions", "u1", (len(Phase), 6)),
        ("accepted", "u1", (len(Request), len(State))),
        ("transitions", "u1", (len(State), len(State))),
        ("needs_lease", "u1", (len(Request),)),
        ("emergencies", "u1", (len(Cause),)),
        ("warning_time", "f8"),
        ("armed_time", "f8"),
        ("vented_pressure", "f8"),
        ("holding_pressure", "f8"),
        ("vent_time", "f8"),
        ("vented_still", "f8"),
        ("vented_blind", "f8"),
        ("vented_sinking", "f8"),
        ("vented_creep", "f8"),
        ("vent_delay", "f8"),
        ("shut_off_delay", "f8"),
        ("lowest_pressure", "f8"),
        ("highest_pressure", "f8"),
        ("rest_pressure", "f8"),
        ("air_tolerance", "f8"),
        ("air_timeout", "f8"),
        ("local_reset", "?"),
        ("local_reset_time", "f8"),
        ("series", "?"),
        ("read_only", "?"),
        ("home_by_index", "?"),
        ("home_pose", "f8", (3,)),
        ("home_tolerance", "f8", (3,)),
        ("home_time", "f8"),
        ("home_order", "i8", (3,)),
        ("home_direction", "f8", (3,)),
        ("home_travel", "f8", (3,)),
        ("home_speed", "f8", (3,)),
        ("home_opening", "f8"),
        ("home_longest", "f8"),
        ("home_stops", "?"),
        ("home_stop", "f8", (3,)),
        ("home_stop_tolerance", "f8", (3,)),
        ("home_touch_speed", "f8", (3,)),
        ("home_touch_lead", "f8", (3,)),
        ("home_touch_time", "f8"),
    ],
    align=True,
)
"""Gains and times. `downswing_damping` is the share of the damping left in the downswing, `dither` swings the
spools around their openings up to the top. `feed_forward` is a code of `bench.control.feed_forward`,
`rate_opening` and `speed_opening` are its `kane_gains`; `move_band` are the openings that carry the spools
out of their dead bands in slow moves; `brake_gain`, `brake_damping` are the BRAKE law's."""

CONTROL_STATE = np.dtype(
    [
        ("tick", "i8"),
        ("time", "f8"),
        ("measured_step", "f8"),
        ("started", "?"),
        ("lost", "i4"),
        ("distrusted", "?"),
        ("seen", "?"),
        ("request", "u1"),
        ("request_number", "i8"),
        ("lease_held", "?"),
        ("support_ready", "?"),
        ("supervisor_alive", "?"),
        ("device_operational", "?"),
        ("warm", "?"),
        ("first_cause", "i4"),
        ("asked", "u1"),
        ("answered_number", "i8"),
        ("answer", "u1"),
        ("refusal", "u1"),
        ("state", "u1"),
        ("state_since", "f8"),
        ("emergency", "?"),
        ("homed", "?"),
        ("home_good", "f8"),
        ("home_begin", "f8"),
        ("home_turn", "i8"),
        ("home_since", "f8"),
        ("home_from", "f8", (3,)),
        ("home_begun", "f8", (3,)),
        ("home_free", "u1", (3,)),
        ("home_way", "f8"),
        ("home_touching", "?"),
        ("home_pushed", "f8"),
        ("home_at", "f8"),
        ("zero_shift", "f8", (3,)),
        ("answered", "u1", (3,)),
        ("answer_way", "f8", (3,)),
        ("answer_from", "f8", (3,)),
        ("answer_bound", "f8", (3,)),
        ("vented", "?"),
        ("emptied", "?"),
        ("empty_since", "f8"),
        ("drained_at", "f8"),
        ("air_trapped", "?"),
        ("rest_angle", "f8", (3,)),
        ("vent_start", "f8"),
        ("exhaust_closed", "?"),
        ("vent_timer", "f8"),
        ("air", "?"),
        ("air_from", "f8"),
        ("securing", "?"),
        ("entered", "?"),
        ("disarming", "?"),
        ("reset_was_low", "?"),
        ("reset_pressed", "f8"),
        ("tee", "?"),
        ("let_off", "u1", (3,)),
        ("phase", "u1"),
        ("reaction", "u1"),
        ("cause", "i4"),
        ("latest_cause", "i4"),
        ("swinging", "?"),
        ("swing_start", "f8"),
        ("swing_sample", "i8"),
        ("moving", "?"),
        ("move_start", "f8"),
        ("move_time", "f8"),
        ("move_from", "f8", (3,)),
        ("arm_first", "?"),
        ("reaction_start", "f8"),
        ("blind_row", "i8"),
        ("still_since", "f8"),
        ("reference", "f8", (3,)),
        ("reference_velocity", "f8", (3,)),
        ("reference_acceleration", "f8", (3,)),
        ("feed_forward", "f8", (3,)),
        ("move_gain", "f8", (3,)),
        ("desired", "f8", (3,)),
        ("applied", "f8", (3,)),
        ("head", "f8", (6,)),
        ("fastest_head", "f8"),
        ("struck", "?"),
        ("swings", "i8"),
        ("stopped_at", "f8"),
        ("moved_at", "f8"),
        ("calm", "f8", (3,)),
        ("unseen", "u1", (3,)),
        ("sensor_seen", "u1", (7,)),
        ("sensor_shown", "f8", (7,)),
        ("sensor_emptied", "u1", (7,)),
        ("sensor_doubt", "f8", (7,)),
        ("sensor_dead", "u1", (7,)),
        ("vent_fitted", "u1", (2,)),
        ("vent_agreed", "f8", (2,)),
        ("vent_wrong", "u1", (2,)),
        ("shut_off_fitted", "?"),
        ("shut_off_agreed", "f8"),
        ("shut_off_wrong", "?"),
        ("supply_shut", "f8"),
        ("supply_from", "f8"),
        ("supply_slow", "f8"),
        ("supply_fast", "f8"),
        ("supply_before", "f8"),
        ("supply_late", "f8"),
        ("supply_early", "f8"),
        ("supply_wrong", "?"),
        ("supply_unproven", "?"),
        ("supply_excused", "?"),
        ("exhaust_bound", "f8", (13,)),
        ("exhaust_rate", "f8", (13,)),
        ("exhaust_late", "f8", (6,)),
        ("exhaust_slow", "u1", (6,)),
        ("lock_agreed", "f8"),
        ("lock_wrong", "?"),
        ("index_wrong", "i4"),
        ("air_held", "u1", (3,)),
        ("air_swung", "u1", (3,)),
        ("air_trim", "f8", (3,)),
        ("air_good", "f8"),
        ("air_since", "f8"),
        ("air_ready", "?"),
        ("low_head", "f8"),
    ],
    align=True,
)
"""From outside, before a tick: `request`, `request_number`, `lease_held`, `support_ready`,
`supervisor_alive`, `device_operational`, `warm` (STARTING is over), `first_cause` (of the ESTOP after it),
`tee`.
`move_gain` is the opening per rad/s of reference speed in slow moves, of the last tick's pose; `arm_first`
says that arm and wrist move before the shoulder.
`home_begun` are the joints' angles when homing began (rad), `home_free` says whose index was forgotten since,
`home_way` is -1 once the index is searched for in the other direction, `home_touching` says that the joint in
turn looks for its stop, `home_pushed` and `home_at` since when and where it presses against it (s, rad).
`zero_shift` is what a zero that was set in this tick added to the joint's angle (rad).
`answered` are the joints that moved along with their references since power-up and the guard's last opening;
`answer_way` and `answer_from` are its direction and the angle (rad) where it began, `answer_bound` is the
opening beyond the dead band that the joint's valve is allowed.
`stopped_at` is when a stop was last asked for (s), `moved_at` when a joint last did not rest (s),
`let_off` are the actuators that `bench.control.escape` moves even in PASSIVE.
`exhaust_closed` was commanded last, `vent_timer` is for how long the vents have been without power (s).
`calm` are the velocities by which that is judged (rad/s), `rest_angle` where the joints came to rest (rad).
`empty_since` is from when on the time for sinking counts (s), `drained_at` when all living sensors last
showed no more than holds nothing up (s); `air_trapped` says that air stayed in the chambers at this venting:
a person reads the gauges before anybody is let in.
`entered` says that the guard was seen open in ACCESS: until SECURE has ended it, somebody may be inside.
`unseen` are the joints that BLIND_BRAKE brakes without their encoder.
`sensor_…` and `vent_…` are those of `bench.control.air_watch`: whether a sensor was ever believable, its last
such value (Pa), for how long it has been in doubt (s), whether it is dead; whether a vent has feedback, when
it last agreed with its command (s), whether it is wrong.
`supply_…` are those of `bench.control.manifold_watch`: time since the supply was shut (s), the pressure then,
the two bounds and the last reading (Pa), for how long the bounds have been broken (s), whether the manifold
empties too slowly, whether its sensor has to prove itself at the next venting, whether a reset has taken
notice of that. `exhaust_…` are those of `bench.control.exhaust_watch`: bounds and their rates as in AIR_STATE
(Pa, Pa/s), for how long a chamber has been above its bound (s), whether its exhaust was found too slow since
the last reset. `lock_agreed` is when the guard's lock last agreed with its command (s), `lock_wrong` that it
did not and has not been seen to since. `index_wrong` is the cause that names an encoder whose count was wrong
when its index passed, or 0.
`air_…` are those of `bench.control.address_air`: whether a joint is in its band, so that its valve serves its
air, whether its spool is being swung, the opening that keeps its difference, when the air was last not as
planned and since when it is waited for (s), whether a swing may begin. `low_head` is by how much less than
the clearance is enough (m), of a head that rested low.
`lost` is this tick's verdict on the readings, `distrusted` that since the last reset they were found wrong or
did not fit the model, `seen` that they were trusted once; `emergency` says that the stop under way ends in
ESTOP; `air` that the supply is on."""

PROFILE = np.dtype(
    [
        ("samples", "i8"),
        ("period", "f8"),
        ("blind_spacing", "i8"),
        ("blind_rows", "i8"),
        ("air_planned", "?"),
        ("air", "f8", (6,)),
        ("air_supply", "f8"),
        ("air_width", "f8", (3,)),
        ("air_period", "f8", (3,)),
        ("air_share", "f8", (3,)),
    ],
    align=True,
)
"""`air_planned`: whether the chambers have planned pressures at the address: `air` (Pa) where the supply has
`air_supply` (Pa). `air_width` are the openings to either side with which the spools are swung there, in
`air_period` (3,) s; `air_share` is the mean share of the stroke to each side that comes of it."""


class ControlState(NamedTuple):
    """Memory of the step, as records that it changes in place."""

    control: Any
    encoder: Any
    estimator: Any
    pid: Any
    model: Any
    """Of the model-based check."""
    air: Any
    """Of the chamber-pressure observer; moved on only where feed-forward or address take it."""


class ControlParameters(NamedTuple):
    """Inputs of the step that stay as they are: records and the profile's tables."""

    control: Any
    encoder: Any
    estimator: Any
    pid: Any
    envelope: Any
    model: Any
    robot: Any
    plant: Any
    """The machine's data for the model-based check."""
    profile: Any
    angle: Any
    """(n, 3) rad, reference at the profile's period."""
    velocity: Any
    valve: Any
    phase: Any
    """(n,) Phase of each sample."""
    force: Any
    """(n, 3) demanded of the actuators, N, shoulder N m; zeros where the feed-forward does not take it."""
    force_rate: Any
    """(n, 3) N/s, N m/s"""
    blind_brake: Any
    """(m, 6) openings and durations (s)."""


def new_control_state(state: State = State.READY) -> ControlState:
    """Return the state at power-up: standing, nothing read yet.

    A simulation begins in READY, homed and with the lease; a bench begins in State.STARTING.
    """
    made = ControlState(
        new_record(CONTROL_STATE),
        new_record(ENCODER_STATE),
        new_record(ESTIMATOR_STATE),
        new_record(PID_STATE),
        new_record(MODEL_STATE),
        new_record(AIR_STATE),
    )
    control, begun = made.control, state != State.STARTING
    control["state"], control["first_cause"] = state, Cause.POWER_UP
    control["homed"] = control["answered"] = control["answer_bound"] = begun and state != State.SAFE
    for name in ("lease_held", "support_ready", "supervisor_alive"):
        control[name] = begun
    control["device_operational"] = True
    control["rest_angle"] = np.nan
    control["sensor_emptied"] = 1  # before air was on there is no decay to be seen
    for name in (
        "reset_pressed",
        "stopped_at",
        "moved_at",
        "vent_start",
        "still_since",
        "empty_since",
        "drained_at",
    ):
        control[name] = -np.inf
    return made
