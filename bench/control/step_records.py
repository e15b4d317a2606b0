"""Records of the control step: its parameters, its memory, and the profile's tables."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from bench.base.lifecycle import Cause, Phase, Request, State
from bench.control.estimate.air import AIR_STATE
from bench.control.estimate.encoder import ENCODER_STATE
from bench.control.estimate.estimator import ESTIMATOR_STATE
from bench.control.estimate.residual_monitor import MODEL_STATE
from bench.control.law.pid import PID_STATE
from drivers.base.compiled import fields, new_record

CONTROL_PARAMETERS = np.dtype(
    [
        # Swing, slow moves and brake
        *fields("f8", "downswing_damping downswing_gain_factor dither_period dither_delay"),
        *fields("f8", "lift_gain lift_angle rest_time brake_timeout open_loop_settling_time"),
        *fields("f8", "dither move_band force_gain", (3,)),
        ("feed_forward", "u1"),
        *fields("f8", "precharge_time precharge_opening precharge_period move_timeout impact_speed_drop"),
        *fields("f8", "move_speed address_tolerance address_deadband rest_speed", (3,)),
        *fields("f8", "brake_gain brake_damping brake_fade_speed escape_time", (3,)),
        ("escape_opening", "f8", (3, 3)),
        # Lifecycle
        ("reactions", "u1", (len(Phase), 6)),
        ("accepted", "u1", (len(Request), len(State))),
        ("transitions", "u1", (len(State), len(State))),
        ("needs_lease", "u1", (len(Request),)),
        ("emergencies", "u1", (len(Cause),)),
        *fields("f8", "warning_time armed_timeout vented_pressure holding_pressure vent_timeout"),
        *fields("f8", "rest_time_vented rest_time_without_encoders access_delay vented_creep"),
        *fields("f8", "vent_delay shut_off_delay lowest_pressure highest_pressure rest_pressure"),
        *fields("f8", "pressure_tolerance pressure_timeout local_reset_time"),
        *fields("?", "local_reset hold_between_swings read_only"),
        # Homing
        *fields("?", "home_by_index home_stops"),
        ("home_order", "i8", (3,)),
        *fields("f8", "home_pose home_tolerance home_direction home_travel home_speed", (3,)),
        *fields("f8", "home_time home_opening home_timeout home_stop_contact_time"),
        *fields("f8", "home_stop home_stop_tolerance home_stop_contact_speed home_stop_contact_lead", (3,)),
    ],
    align=True,
)
"""Gains and times. `downswing_damping` is the fraction of the damping left in the downswing, `dither` the
amplitude of the dither up to the top. `feed_forward` is a code of `bench.control.law.feed_forward`;
`move_band` are the valve commands that overcome the dead bands in slow moves; `brake_gain`, `brake_damping`
are gains of the BRAKE law."""


def _nested(*members: tuple[Any, ...]) -> np.dtype[Any]:
    return np.dtype(list(members), align=True)


HOMING = _nested(
    ("agreed_since", "f8"),  # s: from when on all angles agree with the vented robot's pose
    ("began", "f8"),  # s: when the joints are first turned
    ("turn", "i8"),  # place in the order of the joint that is turned; 3: all are home
    ("since", "f8"),  # s: when this joint set off in its direction
    ("start", "f8", (3,)),  # rad: where each joint set off
    ("origin", "f8", (3,)),  # rad: where homing began, and to where it goes back
    ("free", "u1", (3,)),  # the joint's index was forgotten since homing began
    ("way", "f8"),  # -1 once the index is searched for in the other direction, else 1
    ("touching", "?"),  # the joint looks for its stop
    ("pushed_since", "f8"),  # s: from when on it rests against its reference
    ("pushed_at", "f8"),  # rad: where it does
    ("zero_shift", "f8", (3,)),  # rad: added to an angle by a zero that was set in this tick
    ("index_wrong", "i4"),  # cause that names an encoder whose count was wrong at its index, or 0
)
"""Memory of `bench.control.moves.homing`."""

FIRST_MOTION = _nested(
    ("answered", "u1", (3,)),  # the joint moved along since power-up and the guard's last opening
    ("way", "f8", (3,)),  # direction in which its reference moves, or 0
    ("start", "f8", (3,)),  # rad: where that began
    ("bound", "f8", (3,)),  # max valve command beyond the dead band
)
"""Memory of `bench.control.moves.first_motion`."""

VENTING = _nested(
    ("emptied", "?"),  # chambers and manifold are proven empty
    ("empty_since", "f8"),  # s: from when on the time for sinking counts
    ("drained_at", "f8"),  # s: when working sensors last showed no pressure that may hold an arm up
    ("trapped", "?"),  # air stayed in the chambers: a person reads the gauges before access
    ("rest_angle", "f8", (3,)),  # rad: where the joints came to rest
    ("start", "f8"),  # s: when the vents were opened
    ("timer", "f8"),  # s for which the vents have been without power
)
"""Memory of `bench.control._standstill_monitor`."""

SENSORS = _nested(
    ("seen", "u1", (7,)),  # the sensor was once believable
    ("shown", "f8", (7,)),  # Pa: its last believable value
    ("emptied", "u1", (7,)),  # it was seen to fall at this venting
    ("doubt", "f8", (7,)),  # s for which it has not been believable
    ("dead", "u1", (7,)),  # for too long
)
"""Memory of `bench.control.monitor.pressure_monitor`: sensors of the manifold and the six chambers."""

VENTS = _nested(
    ("fitted", "u1", (2,)),  # the vent has reported its position
    ("agreed", "f8", (2,)),  # s: when that last agreed with the command
    ("wrong", "u1", (2,)),  # it has disagreed for too long
)
"""Memory of `bench.control.monitor.pressure_monitor`: the vents' positions."""

SHUT_OFF = _nested(
    ("fitted", "?"),  # the shut-off valve has reported its position
    ("agreed", "f8"),  # s: when that last agreed with the command
    ("wrong", "?"),  # it has disagreed for too long
)
"""Memory of `bench.control.monitor.pressure_monitor`: the shut-off valve's position."""

MANIFOLD = _nested(
    ("shut", "f8"),  # s since the supply was shut
    ("start", "f8"),  # Pa: the pressure then
    ("slow", "f8"),  # Pa: bound of the slowest venting
    ("fast", "f8"),  # Pa: bound of the fastest
    ("before", "f8"),  # Pa: last reading
    ("late", "f8"),  # s for which the slow bound has been broken
    ("early", "f8"),  # s for which the fast one has
    ("wrong", "?"),  # it empties too slowly
    ("unproven", "?"),  # its sensor has to prove itself at the next venting
    ("excused", "?"),  # a reset has taken notice of that
)
"""Memory of `bench.control.monitor.venting_monitor`."""

EXHAUSTS = _nested(
    ("bound", "f8", (13,)),  # Pa, as in AIR_STATE
    ("rate", "f8", (13,)),  # Pa/s
    ("late", "f8", (6,)),  # s for which a chamber has been above its bound
    ("slow", "u1", (6,)),  # its exhaust was found too slow since the last reset
)
"""Memory of `bench.control.monitor.venting_monitor`."""

SPOOLS = _nested(
    ("fitted", "u1", (3,)),  # the valve has reported its spool's position
    ("spool", "f8", (3,)),  # modelled spool position
    ("spool_speed", "f8", (3,)),  # 1/s: its rate
    ("recent", "f8", (4, 3)),  # modelled spool positions of this and the ticks before, the latest first
    ("late", "f8", (3,)),  # s for which the position has been off the model
    ("wrong", "u1", (3,)),  # off the model for too long, and not back on it since
)
"""Memory of `bench.control.monitor.position_monitor`."""

LOCK = _nested(
    ("agreed", "f8"),  # s: when the guard's lock last agreed with its command
    ("wrong", "?"),  # it did not for too long, and has not been seen to since
)
"""Memory of `bench.control.monitor.position_monitor`."""

ADDRESS_AIR = _nested(
    ("held", "u1", (3,)),  # the joint is in its band: its valve serves its air
    ("swung", "u1", (3,)),  # its spool is being swung
    ("trim", "f8", (3,)),  # valve command that keeps its pressure difference
    ("good", "f8"),  # s: when the air was last not as planned
    ("since", "f8"),  # s: since when it is waited for
    ("ready", "?"),  # a swing may begin
)
"""Memory of `bench.control.moves.address_pressure`."""

MOVE = _nested(
    ("start", "f8"),  # s
    ("duration", "f8"),  # s
    *fields("f8", "origin target", (3,)),  # rad
    ("gain", "f8", (3,)),  # valve command per rad/s of reference speed, of the last tick's pose
    ("arm_first", "?"),  # arm and wrist move before the shoulder
    ("is_test", "?"),  # joints that may reach the address without an answer move there and back first
)
"""Memory of `bench.control.moves.motion`: the slow move under way."""

SWING = _nested(
    ("start", "f8"),  # s
    ("sample", "i8"),  # of the profile
    ("fastest_head", "f8"),  # m/s
    ("struck", "?"),  # the head has lost speed to a ball
)
"""Memory of the swing under way."""

CONTROL_STATE = np.dtype(
    [
        # From outside, before a tick.
        ("request", "u1"),
        ("request_number", "i8"),
        *fields("?", "lease_held support_ready supervisor_alive device_operational"),
        ("is_warmed_up", "?"),  # STARTING is over
        ("first_cause", "i4"),  # of the ESTOP after it
        # This tick, and what its readings are worth.
        ("tick", "i8"),
        ("time", "f8"),  # s
        ("measured_step", "f8"),  # s since the last tick
        ("started", "?"),  # there was one
        ("encoder_fault", "i4"),  # cause that names readings which are not to be trusted, or 0
        ("encoders_suspect", "?"),  # since the last reset they were wrong or did not fit the model
        ("encoders_seen_valid", "?"),  # they were trusted once
        # The answer to a request.
        ("handled_request", "u1"),
        ("answered_number", "i8"),
        *fields("u1", "answer refusal"),
        # The lifecycle.
        ("state", "u1"),
        ("state_since", "f8"),  # s
        *fields("u1", "phase reaction"),
        ("reaction_start", "f8"),  # s
        ("still_since", "f8"),  # s: when a joint last moved
        ("cause", "i4"),  # latched first
        ("latest_cause", "i4"),
        ("emergency", "?"),  # the stop under way ends in ESTOP
        ("homed", "?"),
        ("vented", "?"),  # nothing can move or sink any more
        ("air", "?"),  # the supply is on
        ("air_from", "f8"),  # s: when it comes on, after the warning
        ("exhaust_closed", "?"),  # commanded last
        *fields("?", "swinging moving disarming securing"),
        ("guard_was_opened", "?"),  # seen open in ACCESS: a person may be inside until SECURE ends it
        ("reset_was_low", "?"),
        ("reset_pressed", "f8"),  # s
        ("gauge_refused", "f8"),  # s, the last refusal for the gauges
        ("tee", "?"),
        ("swings", "i8"),
        # Motion and commands.
        ("reference", "f8", (3,)),  # rad
        ("reference_velocity", "f8", (3,)),  # rad/s
        ("reference_acceleration", "f8", (3,)),  # rad/s2
        ("feed_forward", "f8", (3,)),  # valve command
        ("desired", "f8", (3,)),  # valve command
        ("applied", "f8", (3,)),  # valve command, within the limits
        ("head", "f8", (6,)),  # x, y, theta (m, m, rad) and their speeds
        ("clearance_relief", "f8"),  # m less than the clearance that are enough, of a head that rested low
        ("filtered_velocity", "f8", (3,)),  # rad/s by which rest is judged
        ("stopped_at", "f8"),  # s: time of the last stop request
        ("moved_at", "f8"),  # s: when a joint last did not rest
        ("turf_override", "u1", (3,)),  # actuators that `moves.ground_clearance` moves even in PASSIVE
        ("open_loop_joints", "u1", (3,)),  # joints that BLIND_BRAKE brakes without their encoder
        ("blind_row", "i8"),  # of its patterns; -1: none
        # One record for each monitor and move.
        ("homing", HOMING),
        ("first_motion", FIRST_MOTION),
        ("venting", VENTING),
        ("sensors", SENSORS),
        ("vents", VENTS),
        ("shut_off", SHUT_OFF),
        ("manifold", MANIFOLD),
        ("exhausts", EXHAUSTS),
        ("spools", SPOOLS),
        ("lock", LOCK),
        ("address_air", ADDRESS_AIR),
        ("move", MOVE),
        ("swing", SWING),
    ],
    align=True,
)
"""Memory of the step."""

PROFILE = np.dtype(
    [
        ("samples", "i8"),
        ("period", "f8"),
        *fields("i8", "blind_spacing blind_rows"),
        ("air_planned", "?"),
        ("air", "f8", (6,)),
        ("air_supply", "f8"),
        *fields("f8", "dither_amplitude dither_period dither_duty", (3,)),
    ],
    align=True,
)
"""`air_planned`: whether the chambers have planned pressures at the address: `air` (Pa) where the supply has
`air_supply` (Pa). `dither_amplitude` are the valve commands to either side of the dither there, in
`dither_period` (3,) s; `dither_duty` is the resulting mean fraction of the stroke to each side."""


class ControlState(NamedTuple):
    """Memory of the step, as records that it changes in place."""

    control: Any
    encoder: Any
    estimator: Any
    pid: Any
    model: Any
    """Memory of the model-based check."""
    air: Any
    """Memory of the chamber-pressure observer; updated only where feed-forward or address use it."""


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
    """(m, 6) valve commands and durations (s)."""


def new_control_state(state: State = State.READY) -> ControlState:
    """Return the state at power-up: standing, nothing read yet.

    A simulation begins in READY, homed and with the lease; a bench begins in State.STARTING.
    """
    kinds = CONTROL_STATE, ENCODER_STATE, ESTIMATOR_STATE, PID_STATE, MODEL_STATE, AIR_STATE
    made = ControlState(*map(new_record, kinds))
    control, powered = made.control, state != State.STARTING
    venting, moves = control["venting"], control["first_motion"]
    control["state"], control["first_cause"] = state, Cause.POWER_UP
    control["homed"] = moves["answered"] = moves["bound"] = powered and state != State.SAFE
    for name in ("lease_held", "support_ready", "supervisor_alive"):
        control[name] = powered
    control["device_operational"] = True
    control["sensors"]["emptied"] = 1  # before air was on there is no decay to be seen
    venting["rest_angle"] = np.nan
    for name in ("reset_pressed", "gauge_refused", "stopped_at", "moved_at", "still_since"):
        control[name] = -np.inf
    for name in ("start", "empty_since", "drained_at"):
        venting[name] = -np.inf
    return made
