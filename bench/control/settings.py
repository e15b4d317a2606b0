"""Settings of estimator, controllers and envelope, and the records they become."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field, fields, replace
from functools import cache, partial
from math import inf, pi
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from bench.base.lifecycle import (
    EMERGENCIES,
    NEEDS_LEASE,
    Cause,
    Phase,
    Request,
    accepted_table,
    reaction_table,
    transition_table,
)
from bench.control.envelope import ENVELOPE_PARAMETERS
from bench.control.estimate.encoder import design_encoders
from bench.control.estimate.estimator import design_estimator
from bench.control.estimate.residual_monitor import ARMING, BRAKING, KINDS, LEARNING, MODEL_LIMITS, SHOCK
from bench.control.law.feed_forward import CODES, FeedForward
from bench.control.law.force_reference import demand_for
from bench.control.law.gain_scheduling import machine_gains
from bench.control.law.gain_table import Gains, constant_gains
from bench.control.moves import ground_clearance
from bench.control.moves.braking import lifted_angle
from bench.control.moves.pressed_stops import pressed_stops, stop_tolerance
from bench.control.moves.pressure_plan import dither_amplitudes, dither_duties, dither_periods
from bench.control.step_records import CONTROL_PARAMETERS, PROFILE, ControlParameters
from bench.swing.profile import Profile
from drivers.base import JOINTS
from drivers.base.compiled import copy_fields, new_record
from drivers.base.ranges import Above, AtLeast, AtMost
from sim.driver import hanging_pose, joint_travel
from sim.plant import PlantParameters, Site, build_plant

Positive = Annotated[float, Above(0)]
NotNegative = Annotated[float, AtLeast(0)]
Share = Annotated[float, AtLeast(0), AtMost(1)]
JointName = Literal["shoulder", "arm", "wrist"]
Direction = Annotated[int, AtLeast(-1), AtMost(1)]
Triple = tuple[float, float, float]
PositiveTriple = tuple[Positive, Positive, Positive]
NotNegativeTriple = tuple[NotNegative, NotNegative, NotNegative]
GainSource = Literal["machine", "hand"]
_Span = tuple[float, float]


@dataclass(frozen=True)
class EstimatorSettings:
    """Kalman filters; joints in the order shoulder, arm, wrist."""

    noise: NotNegativeTriple = (0.0, 0.0, 0.0)
    """Standard deviation of a sample in addition to its rounding, rad."""
    jitter: NotNegativeTriple = (0.0, 0.0, 0.0)
    """Standard deviation of the sampling instant, s."""
    acceleration_change: PositiveTriple = (50.0, 50.0, 100.0)
    """Standard deviation of the acceleration's change in one tick, rad/s2."""
    velocity_jump: NotNegativeTriple = (0.3, 0.3, 1.0)
    """Standard deviation of the velocity's jumps in one tick of the impact window, rad/s."""


@dataclass(frozen=True)
class PidSettings:
    """One PID per actuator on its joint angle; the output is a valve command."""

    proportional: NotNegativeTriple = (2.0, 0.65, 0.75)
    """Valve command per rad."""
    integral: NotNegativeTriple = (0.5, 0.8, 0.45)
    """Valve command per rad s."""
    derivative: NotNegativeTriple = (0.165, 0.024, 0.028)
    """Valve command per rad/s of reference less filtered velocity."""


@dataclass(frozen=True)
class ControlSettings:
    """Additions to the PIDs, the BRAKE law and the times of moves and stops."""

    gains: GainSource = "machine"
    """Gains of PIDs, damping and slow moves: "machine", by pose from the robot's linearised loops
    (`bench.control.law.gain_scheduling`); "hand", those of `pid`, `damping` and `move_gain`."""
    pid: PidSettings = field(default_factory=PidSettings)
    """Gains set by hand."""
    feed_forward: FeedForward = "planned"
    """Source of the valve commands added to the PIDs in a swing, see `bench.control.law.feed_forward`."""
    force_gain: NotNegativeTriple = (20.0, 10.0, 20.0)
    """Rate at which "kane+pneumatic" corrects the force error of the chambers, 1/s."""
    damping: NotNegativeTriple = (0.0046, 0.00067, 0.0004)
    """Valve command per rad/s2 of acceleration error, set by hand; 0 switches it off."""
    downswing_damping: Share = 0.0
    """Share of `damping` in the downswing. Noise of the estimated acceleration there changes the club's speed
    a little from swing to swing."""
    downswing_gain_factor: Positive = 2.5
    """Factor on the PIDs' proportional and derivative gains in the downswing, which ends before what would
    grow with them has grown."""
    dither: tuple[Share, Share, Share] = (0.1, 0.1, 0.1)
    """Dither amplitude in backswing and top, a valve command. It carries spools through their dead band and
    joints through dry friction, so that every downswing starts in the same pose with the same pressures."""
    dither_period: Positive = 0.03
    """Period of the dither (s)."""
    dither_delay: NotNegative = 0.25
    """Delay from the start of a swing (s): by then the club is away from the ball."""
    move_gain: NotNegativeTriple = (0.08, 0.06, 0.02)
    """Valve command per rad/s of reference speed in slow moves, set by hand."""
    brake_gain: NotNegativeTriple = (0.170, 0.065, 0.093)
    """Valve command per rad/s against the motion in BRAKE; found with `golfbench profile check`."""
    brake_damping: NotNegativeTriple = (0.0035, 0.0002, 0.00012)
    """Valve command per rad/s2 against the motion in BRAKE."""
    brake_fade_speed: PositiveTriple = (1.2, 1.0, 1.5)
    """Speed below which BRAKE eases off, rad/s."""
    turf_lift_gain: NotNegative = 6.0
    """Valve command per rad by which the follow-through pulls the right arm in on turf or a mat, until a
    straight club passes above the ground; found with `golfbench --config bag profile check`."""
    rest_speed: PositiveTriple = (0.05, 0.05, 0.10)
    """Speed below which a joint rests (rad/s)."""
    rest_time: Positive = 0.05
    """Rest that counts as standstill, s."""
    brake_timeout: Positive = 1.5
    """A brake that takes longer ends in VENT all the same, s."""
    open_loop_settling_time: NotNegative = 0.6
    """Time with centred spools between an open-loop brake and venting, s."""
    precharge_time: Positive = 2.0
    """Duration of soft start and precharge before the first move (s)."""
    precharge_opening: Annotated[float, Above(0), AtMost(1)] = 0.12
    """Amplitude of the alternating valve command during precharge."""
    precharge_period: Positive = 0.02
    """Time between two reversals during precharge (s)."""
    move_speed: PositiveTriple = (1.2, 0.6, 1.5)
    """Greatest speed of slow moves, rad/s."""
    move_timeout: Positive = 6.0
    """Longest slow move, s."""
    address_deadband: NotNegativeTriple = (0.003, 0.002, 0.005)
    """Error at address that is left alone, rad: dry friction would make an integral hunt."""
    address_tolerance: PositiveTriple = (0.015, 0.010, 0.020)
    """Error at address below which a swing may begin, rad."""
    impact_speed_drop: Annotated[float, Above(0), AtMost(0.5)] = 0.05
    """Share of head speed whose loss in the impact window says that a ball was struck."""


@dataclass(frozen=True)
class LifecycleSettings:
    """Times and proofs between the states of the bench."""

    warning_time: NotNegative = 2.0
    """Beacon before the air comes on, s."""
    armed_timeout: Positive = 120.0
    """Holding the address for longer disarms, s."""
    vented_pressure: Positive = 1.3e5
    """Max pressure of chambers and manifold for a reset, homing and arming, Pa absolute. Access requires a
    pressure that holds nothing up, about 1.05 bar, which follows from the plant."""
    vent_timeout: Positive = 10.0
    """Max time until the chambers are empty; without their sensors the proof itself (s)."""
    rest_time_vented: NotNegative = 2.0
    """Time at rest with empty chambers until they count as vented (s)."""
    rest_time_without_encoders: NotNegative = 10.0
    """The same without trusted encoders: as long as a raised arm may take to sink, s."""
    access_delay: NotNegative = 7.0
    """Min time for which chambers must hold nothing up before access, regardless of encoder readings, s; the
    time that they took to vent, if that was longer."""
    pressure_tolerance: Positive = 1.0e4
    """Max deviation of a chamber from its planned pressure at the address when a swing begins, Pa."""
    pressure_timeout: Positive = 20.0
    """Longest time for which the address is held until the chambers are as planned, s."""
    local_reset: bool = False
    """Reset and secure also need a press of the local reset; required with a real robot."""
    local_reset_time: Positive = 10.0
    """Validity of a press of the button for one reset or secure (s)."""
    hold_between_swings: bool = False
    """Whether the robot holds the address after a swing, instead of venting."""
    supervisor_timeout: Positive = 0.5
    """Timeout of the supervisor heartbeat (s)."""


@dataclass(frozen=True)
class HomingSettings:
    """How the encoders' zeros are proven."""

    method: Literal["absolute", "index"] = "absolute"
    """Compare absolute encoders with a mechanical reference, or search the index slowly, valves bounded."""
    reference: Literal["travel", "pose"] = "travel"
    """Reference of absolute encoders: the range between the stops, or the hanging pose, into which a person
    moves the robot by hand. It seldom reaches that pose alone: venting chambers and friction leave it up to
    3 rad off. The pose also finds a coupling that slipped by less than the travel."""
    tolerance: PositiveTriple = (0.15, 0.10, 0.15)
    """Max angle beyond the travel or from the pose (rad)."""
    time: Positive = 0.5
    """Time for which the readings must agree (s)."""
    stops: bool = True
    """Then turn each joint to its end stop, which must be where the encoder says; required with a real robot.
    Reference and index do not show a coupling that slipped by less than the tolerance, or a moved index."""
    head_tolerance: Positive = 0.010
    """Max shift of the head at the ball by the error of one encoder zero (m). It sets the angle within which
    a joint pressed against its stop must rest."""
    stop_contact_speed: PositiveTriple = (0.8, 0.5, 1.2)
    """Speed towards the stop and back (rad/s)."""
    stop_contact_lead: PositiveTriple = (0.15, 0.12, 0.20)
    """Lag of a joint behind its reference at its stop, which presses it there firmly (rad)."""
    stop_contact_time: Positive = 0.15
    """Time of rest at the stop (s)."""
    order: tuple[JointName, JointName, JointName] = ("wrist", "arm", "shoulder")
    """Order in which the joints search, one at a time."""
    direction: tuple[Direction, Direction, Direction] = (-1, -1, -1)
    """Direction of the search and to the stop; -1 lowers the angle, which lifts the club off the ground."""
    travel: PositiveTriple = (1.5, 0.7, 1.5)
    """Max angle of the search in either direction; the way from stop to index, if that is longer (rad)."""
    speed: PositiveTriple = (0.3, 0.2, 0.4)
    """Speed of the search (rad/s)."""
    opening: Annotated[float, Above(0), AtMost(0.5)] = 0.15
    """Max valve command of the search."""
    timeout: Positive = 60.0
    """Timeout of search and stops together (s)."""

    def __post_init__(self) -> None:
        """Raise ValueError if a joint occurs twice or a direction is 0."""
        if len(set(self.order)) < len(self.order):
            raise ValueError("order: each joint once")
        if 0 in self.direction:
            raise ValueError("direction: 1 or -1 for each joint")


@cache
def _limit_tables() -> dict[str, dict[str, Triple]]:
    text = Path(__file__).with_name("default_limits.toml").read_text(encoding="utf-8")
    tables = tomllib.loads(text).items()
    return {kind: {row: (a, b, c) for row, (a, b, c) in rows.items()} for kind, rows in tables}


def _default_limits(kind: str) -> dict[str, Triple]:
    return dict(_limit_tables()[kind])


@dataclass(frozen=True)
class ModelSettings:
    """The model-based check (`bench.control.estimate.residual_monitor`) and its limits by phase.

    These hold for profiles without separate limits (`bench.control.residual_thresholds`).
    """

    check: Literal["off", "simulated", "always"] = "off"
    """Stop when measurements deviate from the plant's model; "simulated": only with the `sim` driver;
    "always": with each driver, for a robot that was measured."""
    off_reason: str = ""
    """Why a real robot moves without the check, or without a sensor in each chamber. Needed there; each
    record has it."""
    standard_errors: dict[str, NotNegative] = field(default_factory=dict)
    """Standard errors of measured values, by their keys below [plant]; limits are made with them."""
    air: dict[str, PositiveTriple] = field(default_factory=partial(_default_limits, "air"))
    """Chamber pressures from the observer's, Pa."""
    flow: dict[str, PositiveTriple] = field(default_factory=partial(_default_limits, "flow"))
    """The same smoothed over 50 ms, Pa."""
    velocity: dict[str, PositiveTriple] = field(default_factory=partial(_default_limits, "velocity"))
    """Joint velocities from their reference, rad/s."""
    jump: dict[str, PositiveTriple] = field(default_factory=partial(_default_limits, "jump"))
    """Samples from their prediction, rad."""
    effort: dict[str, PositiveTriple] = field(default_factory=partial(_default_limits, "effort"))
    """Torque from the chambers' pressures from that of the motion, N m."""

    @property
    def knows_learning(self) -> bool:
        """Whether there are limits for a robot or reference that differs from the planned one on purpose."""
        return "learning_blow" in self.air


@dataclass(frozen=True)
class EnvelopeSettings:
    """Limits of every motion; assumptions, all: they follow from plant and profile."""

    max_speed: PositiveTriple = (26.0, 6.0, 48.0)
    """Shoulder rad/s, rod m/s, wrist rad/s."""
    max_following_error: dict[str, PositiveTriple] = field(
        default_factory=lambda: {
            "homing": (0.35, 0.20, 0.50),
            "hold": (0.10, 0.08, 0.15),
            "backswing": (0.30, 0.15, 0.40),
            "top": (0.15, 0.10, 0.25),
            "downswing": (0.20, 0.12, 0.45),
            "committed": (0.25, 0.15, 0.45),
            "follow_through": (0.80, 0.40, 1.0),
            "return": (0.35, 0.20, 0.50),
        }
    )
    """Max following error by phase, rad."""
    min_deceleration: PositiveTriple = (60.0, 15.0, 150.0)
    """Deceleration that braking can count on: rad/s2, m/s2, rad/s2."""
    end_stop_max_speed: PositiveTriple = (9.0, 5.2, 34.0)
    """Speed at the end of the range that the absorber alone stops: rad/s, m/s, rad/s."""
    max_opening: Annotated[float, Above(0), AtMost(1)] = 1.0
    """Max valve command."""
    max_slew: Positive = 400.0
    """Max slew rate of a valve command (1/s)."""
    encoder_timeout: Positive = 0.0045
    """Time without a fresh reading after which an encoder is lost, s; five ticks at 1 kHz."""
    max_tick_interval: Positive = 0.010
    """Longest tick while moving, s."""
    spool_tolerance: Annotated[float, Above(0), AtMost(1)] = 0.1
    """Max deviation of a measured spool position from its model, share of the full opening."""
    spool_timeout: Annotated[float, Above(0), AtMost(0.1)] = 0.005
    """Max time of a greater deviation, s."""
    min_supply_pressure: Positive = 6.5e5
    """Pressure below which no swing begins (Pa absolute)."""
    max_supply_pressure: Positive = 8.8e5
    """Pressure above which no swing begins, at most where the manifold's relief valve opens (Pa absolute);
    above it the robot becomes faster than its profile."""
    clearance: NotNegative = 0.015
    """Head over ground outside the ball's window, m in the swing plane."""
    ball_window: Positive = 0.60
    """Half width of the ball's window along the target line, m."""
    ball_clearance: NotNegative = 0.005
    """Head over ground inside that window, m; where the site allows a divot, its depth below the ground."""
    min_frame_distance: NotNegative = 0.10
    """Radius around R1 that the club keeps clear of, m."""
    min_lever: Annotated[float, AtLeast(0), AtMost(1)] = 0.15
    """Min |sin beta| of the wrist's lever (thesis figure 11)."""
    absorber_travel_fraction: Annotated[float, AtLeast(0), AtMost(1)] = 0.9
    """Fraction of the absorber travel that counts as working range in the range check."""
    model: ModelSettings = field(default_factory=ModelSettings)

    def clearance_by_ball(self, site: Site) -> float:
        """Return the least height (m) of the sole over the ground by the ball; negative in a divot."""
        return -site.divot if site.divot > 0.0 else self.ball_clearance

    def with_model_check(self, check: Literal["off", "simulated", "always"]) -> EnvelopeSettings:
        """Return these limits with the model-based check as `check` says."""
        return replace(self, model=replace(self.model, check=check))


_CREEP = 1e-3
"""Min travel of a joint that does not count as rest, rad; more for coarse or noisy encoders."""
_HELD_BY_AIR = 0.2
"""Max force of a chamber that counts as empty, as a fraction of the joint's static friction."""
_RESOLVED = 3.0e3
"""Pressure over the atmosphere that a sensor is sure to show (Pa)."""
_ZERO_SHARE = 0.75
"""Fraction of that pressure allowed for a sensor's zero error: the rest is noise and leakage."""
_FOLLOWED = {phase.name.lower(): phase for phase in Phase if phase not in (Phase.STANDING, Phase.IMPACT)}
_WATCHED = _FOLLOWED | {"impact": Phase.IMPACT}
MODEL_PHASES = {kind: _WATCHED | ({"standing": Phase.STANDING} if kind == "jump" else {}) for kind in KINDS}
"""Phases that have a limit, by comparison. While the robot stands only a jump means something."""
_ROWS = {name: phase.value for name, phase in MODEL_PHASES["jump"].items()} | {
    **{f"braking_{name}": BRAKING + phase for name, phase in _WATCHED.items()},
    "blow": SHOCK,
    "arming": ARMING,
}
MODEL_ROWS = _ROWS | {f"learning_{name}": LEARNING + row for name, row in _ROWS.items()}
"""Row of the limits, by its name in a table."""
OPTIONAL_ROWS = MODEL_ROWS.keys() - MODEL_PHASES["jump"].keys()
"""Rows that a table may leave out: those of BRAKE, of blows, of arming, and of learning."""

SIMULATED = LifecycleSettings(warning_time=0.0, hold_between_swings=True)
"""Settings of a bench without people near it: no warning, and the address is held after a swing."""


def build_controller(
    plant: PlantParameters,
    profile: Profile,
    control: ControlSettings | None = None,
    envelope: EnvelopeSettings | None = None,
    estimator: EstimatorSettings | None = None,
    lifecycle: LifecycleSettings = SIMULATED,
    homing: HomingSettings | None = None,
    *,
    read_only: bool = False,
) -> ControlParameters:
    """Turn settings, the machine's data and a profile into the records that `step` takes.

    With `read_only` nothing but the passive command is ever given.

    Raises:
        ValueError: a gain, an estimator's value or a joint's travel is outside its meaning.
    """
    control, envelope = control or ControlSettings(), envelope or EnvelopeSettings()
    estimator = estimator or EstimatorSettings()
    machine = build_plant(plant).plant
    demand = demand_for(control.feed_forward, plant, profile)
    return ControlParameters(
        control=_control_record(control, lifecycle, homing or HomingSettings(), plant, profile, read_only),
        encoder=design_encoders(
            counts_per_revolution=plant.encoders.counts_per_revolution,
            zero_count=plant.encoders.zero_count,
            sign=plant.encoders.sign,
            travel=angle_travel(plant),
        ),
        estimator=estimator_record(estimator, plant),
        pid=pid_record(control, estimator, plant),
        envelope=_envelope_record(envelope, plant, profile),
        model=_model_record(envelope.model, learning=profile.corrected),
        robot=plant.robot.record,
        plant=machine,
        profile=_profile_record(profile, plant, machine),
        angle=profile.angle,
        velocity=profile.velocity,
        valve=profile.valve,
        phase=profile.phases,
        blind_brake=profile.blind_brake,
        force=demand.force,
        force_rate=demand.rate,
    )


def pid_record(control: ControlSettings, estimator: EstimatorSettings, plant: PlantParameters) -> np.ndarray:
    """Return the PIDs' PID_PARAMETERS record."""
    if control.gains == "machine":
        filters = estimator_record(estimator, plant)
        found = machine_gains(plant, filters, control.address_tolerance, control.move_timeout)
        return found.table.copy()
    pid = control.pid
    return constant_gains(
        Gains(pid.proportional, pid.integral, pid.derivative, control.damping, control.move_gain)
    )


def estimator_record(estimator: EstimatorSettings, plant: PlantParameters) -> np.ndarray:
    """Return the Kalman filters' record."""
    return design_estimator(
        period=plant.tick,
        counts_per_revolution=plant.encoders.counts_per_revolution,
        noise=estimator.noise,
        jitter=estimator.jitter,
        acceleration_change=estimator.acceleration_change,
        velocity_jump=estimator.velocity_jump,
    )


def for_learning(parameters: ControlParameters, settings: ModelSettings) -> ControlParameters:
    """Return `parameters` with the limits of learning.

    Without such limits those of known robots hold for one that was measured; for another nothing is compared.
    """
    record = _model_record(settings, learning=True)
    record["check"] = settings.check == "always" or (settings.check != "off" and settings.knows_learning)
    return parameters._replace(model=record)


def angle_travel(plant: PlantParameters) -> tuple[_Span, _Span, _Span]:
    """Return each joint's travel (rad) including its absorbers, to unwrap the encoder counts."""
    shoulder, _, wrist = plant.actuators
    return (
        (shoulder.lower - 2 * shoulder.stop.travel, shoulder.upper + 2 * shoulder.stop.travel),
        (np.pi, 1.6 * np.pi),
        (wrist.lower - 2 * wrist.stop.travel, wrist.upper + 2 * wrist.stop.travel),
    )


def with_tables_of(
    parameters: ControlParameters, profile: Profile, control: ControlSettings, plant: PlantParameters
) -> ControlParameters:
    """Return `parameters`, built with `control` for `plant`, with the tables of `profile`."""
    demand = demand_for(control.feed_forward, plant, profile)
    return parameters._replace(
        angle=profile.angle,
        velocity=profile.velocity,
        valve=profile.valve,
        force=demand.force,
        force_rate=demand.rate,
    )


def with_correction(
    parameters: ControlParameters,
    profile: Profile,
    control: ControlSettings,
    envelope: EnvelopeSettings,
    plant: PlantParameters,
) -> ControlParameters:
    """Return `parameters` with the tables of `profile`, and the limits of learning if it is corrected."""
    record = _model_record(envelope.model, learning=profile.corrected)
    return with_tables_of(parameters, profile, control, plant)._replace(model=record)


def holding_pressure(plant: PlantParameters) -> float:
    """Return the pressure up to which the air of a chamber holds nothing up, Pa absolute.

    Its force is then a fifth of the least static friction, which alone decides whether an arm hangs or sinks.
    """
    least = min(a.friction.static / max(a.area_a, a.area_b) for a in plant.actuators)
    return plant.supply.atmosphere + max(_HELD_BY_AIR * least, _RESOLVED)


def zero_tolerance(plant: PlantParameters) -> float:
    """Return the max deviation of a pressure sensor from the atmosphere with its chamber empty (Pa).

    A sensor further above it refuses each access; one further below it shows held air as none.
    """
    return _ZERO_SHARE * (holding_pressure(plant) - plant.supply.atmosphere)


_CODED = frozenset(
    {
        *("feed_forward", "gains", "pid", "damping", "move_gain", "turf_lift_gain"),
        "supervisor_timeout",
        *("order", "method", "reference", "head_tolerance"),
    }
)
"""Settings in another form in the step: control, lifecycle, homing."""


def _control_record(
    control: ControlSettings,
    lifecycle: LifecycleSettings,
    homing: HomingSettings,
    plant: PlantParameters,
    profile: Profile,
    read_only: bool,
) -> np.ndarray:
    record = new_record(CONTROL_PARAMETERS)
    for prefix, settings in (("", control), ("", lifecycle), ("home_", homing)):
        for setting in fields(settings):
            if setting.name not in _CODED:  # any other one without a field of its name is an error
                record[prefix + setting.name] = getattr(settings, setting.name)
    record["feed_forward"] = CODES.index(control.feed_forward)
    if plant.site.surface != "none":
        record["lift_gain"], record["lift_angle"] = control.turf_lift_gain, lifted_angle(plant)
        record["escape_opening"], record["escape_time"] = ground_clearance.OPENINGS, ground_clearance.TIMES
    record["home_order"] = [JOINTS.index(joint) for joint in homing.order]
    record["home_stop"] = pressed_stops(plant, homing.direction)
    record["home_stop_tolerance"] = stop_tolerance(plant, profile, homing.direction, homing.head_tolerance)
    if control.gains == "machine":
        record["move_band"] = [actuator.valve.dead_band for actuator in plant.actuators]
    record["home_by_index"] = homing.method == "index"
    lower, upper = joint_travel(plant)
    encoders = plant.encoders
    if encoders.incremental:
        index = -2.0 * pi * np.multiply(encoders.sign, encoders.zero_count) / encoders.counts_per_revolution
        stop = np.where(np.less(homing.direction, 0), lower, upper)
        record["home_travel"] = np.maximum(homing.travel, np.abs(index - stop))
    if homing.reference == "pose":
        record["home_pose"] = hanging_pose(plant)
    else:
        record["home_pose"] = (lower + upper) / 2
        record["home_tolerance"] += (upper - lower) / 2
    record["holding_pressure"] = holding_pressure(plant)
    record["vent_delay"] = plant.supply.vent_delay
    record["vented_creep"] = max(_CREEP, 4.0 * pi / encoders.counts_per_revolution + 6.0 * encoders.noise)
    record["shut_off_delay"] = plant.supply.shut_off_delay
    # No absolute pressure is lower, as a cut cable reads 0, and no chamber survives twice its rating.
    record["lowest_pressure"] = 0.1 * plant.supply.atmosphere
    # Weather, height and a sensor's tolerance stay above it.
    record["rest_pressure"] = plant.supply.atmosphere - 0.25e5
    record["highest_pressure"] = 2.0 * max(actuator.pressure_rating for actuator in plant.actuators)
    record["reactions"], record["accepted"] = reaction_table(), accepted_table()
    record["transitions"] = transition_table()
    record["needs_lease"] = [request in NEEDS_LEASE for request in Request]
    record["emergencies"] = [cause in EMERGENCIES for cause in Cause]
    record["read_only"] = read_only
    return record


def _envelope_record(settings: EnvelopeSettings, plant: PlantParameters, profile: Profile) -> np.ndarray:
    record = new_record(ENVELOPE_PARAMETERS)
    for i, actuator in enumerate(plant.actuators):
        margin = settings.absorber_travel_fraction * actuator.stop.travel
        record["lower"][0, i] = actuator.lower - margin
        record["upper"][0, i] = actuator.upper + margin
    record["max_following_error"] = inf
    for name, errors in settings.max_following_error.items():
        record["max_following_error"][0, _FOLLOWED[name]] = errors
    copy_fields(record, settings, "max_speed max_slew max_opening max_tick_interval min_supply_pressure")
    copy_fields(record, settings, "min_lever min_deceleration end_stop_max_speed encoder_timeout")
    copy_fields(record, settings, "spool_tolerance spool_timeout clearance ball_window min_frame_distance")
    # Above it the relief valve opens, and hides a regulator that fails.
    record["max_supply_pressure"] = min(settings.max_supply_pressure, plant.supply.manifold_relief_pressure)
    record["ball_clearance"] = settings.clearance_by_ball(plant.site)
    record["ground"], record["sole_depth"] = plant.site.ground, plant.site.sole_depth
    record["ball_x"], record["lever_angle"] = profile.ball[0], plant.wrist_lever_angle
    return record


def _model_record(settings: ModelSettings, *, learning: bool) -> np.ndarray:
    """Return the limits; those of `learning`, if they are given, are in force.

    If not given BRAKE has the limits of its phase, a blow those of the follow-through, arming those of the
    return.
    """
    record = new_record(MODEL_LIMITS)
    record["check"] = settings.check != "off"
    record["first_row"] = LEARNING if learning and settings.knows_learning else 0
    for kind, phases in MODEL_PHASES.items():
        table, limits = getattr(settings, kind), record[kind][0]
        limits[:] = inf
        limits[[SHOCK, LEARNING + SHOCK]] = table["follow_through"]
        limits[[ARMING, LEARNING + ARMING]] = table.get("arming", table["return"])
        for name, phase in phases.items():
            if name in table:
                for first in (0, LEARNING):
                    limits[first + phase] = limits[first + BRAKING + phase] = table[name]
        for name in table.keys() - phases.keys():
            limits[MODEL_ROWS[name]] = table[name]
    return record


def _profile_record(profile: Profile, plant: PlantParameters, machine: np.ndarray) -> np.ndarray:
    record = new_record(PROFILE)
    record["samples"], record["period"] = len(profile.angle), profile.period
    record["blind_spacing"], record["blind_rows"] = profile.blind_spacing, len(profile.blind_brake)
    if profile.air:
        record["air_planned"] = True
        record["air"], record["air_supply"] = profile.air, profile.air_supply
        record["dither_amplitude"] = dither_amplitudes(plant, machine, profile.angle[0])
        record["dither_period"] = dither_periods(plant)
        record["dither_duty"] = dither_duties(plant, record["dither_amplitude"][0])
    return record
