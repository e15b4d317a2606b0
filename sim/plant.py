"""The software plant: robot, air, friction, stops, encoders, ground, tee and ball in one compiled step.

One call of `advance` moves the plant over one tick with a constant command. Inside, fixed substeps:
the spools by their exact solution, everything else by Runge-Kutta of fourth order with exact sticking
(`sim.dynamics`); the impact is found inside the substep by root finding and applies the same impulse
to ball and robot (`sim._tee`). `sense` (`sim.sensors`) computes the sensor readings.
Identical inputs and seeds give identical bits.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import cos, floor, pi, sin, sqrt
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.base.compiled import compiled, compiled_with_arrays, copy_fields, fields, new_record
from drivers.base.ranges import Range
from sim._tee import find_contact, is_near_ball, strike_ball
from sim.ball import Ball
from sim.dynamics import ANGLES, SCRATCH, STATES, head_geometry, move, stop_coordinate, stop_depth
from sim.ground import SURFACES, SurfaceName
from sim.impact import impact_parameters
from sim.pneumatics import GAS_CONSTANT, REFERENCE_TEMPERATURE, Actuator, EndStop, Friction, Supply
from sim.robot import Length, RobotParameters
from sim.sensors import HISTORY

Array = NDArray[np.float64]

ACTUATOR_KEYS = ("shoulder", "right_arm", "wrist")
"""Fields of the three actuators in PlantParameters, in the order of drivers.base.ACTUATORS."""

ZeroCount = Annotated[float, Range(-(2.0**24), 2.0**24, "counts")]
Sign = Annotated[int, Range(-1, 1, "")]


@dataclass(frozen=True)
class Encoders:
    """Three single-turn rotary encoders on R1, R2, R3."""

    incremental: bool = False
    """Whether encoders are incremental: counting from power-up until their index has passed."""
    counts_per_revolution: Annotated[int, Range(256, 2**24, "counts")] = 2**17
    """Counts of one revolution."""
    zero_count: tuple[ZeroCount, ZeroCount, ZeroCount] = (0.0, 0.0, 0.0)
    """Count at joint angle zero, found by calibration. An incremental encoder's index is at count 0."""
    sign: tuple[Sign, Sign, Sign] = (1, 1, 1)
    """Counting direction relative to the joint angle: 1 or -1."""
    latency: Annotated[float, Range(0.0, 0.005, "s")] = 0.0001
    """Delay from shaft position to reading, s."""
    jitter: Annotated[float, Range(0.0, 0.001, "s")] = 0.0
    """Standard deviation of the sampling instant, s."""
    noise: Annotated[float, Range(0.0, 0.1, "rad")] = 0.0
    """Standard deviation of the angle, rad."""

    def __post_init__(self) -> None:
        """Raise ValueError unless signs are ±1."""
        if 0 in self.sign:
            raise ValueError("sign: 1 or -1 for each joint")


@dataclass(frozen=True)
class Shaft:
    """In-plane bending of the shaft: the head's mass on a spring across the shaft line."""

    flexible: bool = False
    """The head rides on a spring; the thesis' club is rigid."""
    frequency: Annotated[float, Range(0.5, 100.0, "Hz")] = 4.5
    """First clamped mode with the head, Hz."""
    damping_ratio: Annotated[float, Range(0.0, 1.0, "")] = 0.03
    """Damping ratio of that mode."""


@dataclass(frozen=True)
class Site:
    """Positions of ground and ball in the swing plane (m)."""

    ground: Annotated[float, Range(-3.0, 0.0, "m")] = -1.634
    """Height y0 of the ground line, m: the driver's ball on a tee of 38 mm (1.5 in), in a plane at 53 deg."""
    sole_depth: Annotated[float, Range(0.0, 0.2, "m")] = 0.03
    """Depth of the sole below the face centre, m."""
    ball_x: Annotated[float, Range(-1.5, 1.5, "m")] = 0.25
    """x0 of the ball (m)."""
    ball_y: Annotated[float, Range(-3.0, 0.0, "m")] = -1.560
    """Height y0 of the ball centre on its tee, m."""
    ground_stiffness: Annotated[float, Range(1e3, 1e8, "N/m")] = 2.0e5
    """Stiffness of the ground, N/m."""
    surface: SurfaceName = field(default="none", metadata={"optional": True})
    """Surface that the sole may touch: "turf", "mat", or "none", a bare floor."""
    divot: Annotated[float, Range(0.0, 0.05, "m")] = field(default=0.0, metadata={"optional": True})
    """Depth to which the sole may go into the surface by the ball, m in the swing plane."""


def _shoulder() -> Actuator:
    return Actuator(
        area_a=4.0e-4,
        area_b=4.0e-4,
        dead_volume=6.0e-5,
        lower=-1.7,
        upper=2.7,
        clearance=0.15,
        friction=Friction(viscous=0.3, coulomb=6.0, static=8.0),
        stop=EndStop(energy=250.0, travel=0.15),
    )


def _right_arm() -> Actuator:
    return Actuator(
        area_a=19.63e-4,
        area_b=16.49e-4,
        dead_volume=3.0e-5,
        lower=0.0,
        upper=0.22,
        clearance=0.012,
        friction=Friction(viscous=30.0, coulomb=60.0, static=80.0),
        stop=EndStop(energy=40.0, travel=0.01386, damping_speed=0.5),
    )


def _wrist() -> Actuator:
    return Actuator(
        area_a=19.63e-4,
        area_b=16.49e-4,
        dead_volume=3.0e-5,
        lower=2 * pi - np.deg2rad(80.0).item(),
        upper=2 * pi,
        clearance=0.12,
        friction=Friction(viscous=20.0, coulomb=45.0, static=60.0),
        stop=EndStop(energy=90.0, travel=0.174, damping_speed=4.0, rated=120.0),
    )


@dataclass(frozen=True)
class PlantParameters:
    """Parameters of the plant; the defaults are the default plant, assumptions marked in config.toml."""

    robot: RobotParameters = field(default_factory=RobotParameters)
    shoulder: Actuator = field(default_factory=_shoulder)
    right_arm: Actuator = field(default_factory=_right_arm)
    wrist: Actuator = field(default_factory=_wrist)
    wrist_lever: Length = 0.06
    """Lever d of the wrist's cylinder (m)."""
    wrist_lever_angle: Annotated[float, Range(-pi / 2, pi / 2, "rad")] = field(
        default=0.0, metadata={"optional": True}
    )
    """Mounting angle of that lever on the club (rad): it turns the wrist best cocked by so much."""
    supply: Supply = field(default_factory=Supply)
    encoders: Encoders = field(default_factory=Encoders)
    pressure_sensors: bool = True
    """Whether the chambers have pressure sensors; the supply always has one."""
    vent_feedback: bool = True
    """Whether each of the two vents reports its position."""
    shut_off_feedback: bool = field(default=True, metadata={"optional": True})
    """Whether the shut-off valve reports its position."""
    spool_feedback: bool = field(default=False, metadata={"optional": True})
    """Whether the three valves report the positions of their spools."""
    shaft: Shaft = field(default_factory=Shaft)
    site: Site = field(default_factory=Site)
    ball: Ball = field(default_factory=Ball)
    tick: Annotated[float, Range(1e-4, 0.02, "s")] = 0.001
    """Tick period, s."""
    substeps: Annotated[int, Range(1, 256, "")] = 4
    """Internal steps of the plant in a tick; delivery is converged to 0.1 mm, 0.01 % at 0.25 ms."""
    seed: Annotated[int, Range(0, 2**63 - 1, "")] = 1
    """Seed of the encoders' noise and jitter."""

    @property
    def actuators(self) -> tuple[Actuator, Actuator, Actuator]:
        """Actuators in the order of drivers.base.ACTUATORS."""
        return self.shoulder, self.right_arm, self.wrist

    def wrist_stroke(self, theta3: ArrayLike) -> Array:
        """Return the coordinate of the wrist's cylinder (m) at `theta3` (rad), of any shape."""
        return np.asarray(self.wrist_lever * np.sin(np.asarray(theta3) + self.wrist_lever_angle))

    def wrist_slope(self, theta3: ArrayLike) -> Array:
        """Return that coordinate's change by `theta3`, the lever arm of the wrist's cylinder (m)."""
        return np.asarray(self.wrist_lever * np.cos(np.asarray(theta3) + self.wrist_lever_angle))

    def wrist_authority(self, theta3: ArrayLike) -> Array:
        """Return |sin beta| at `theta3` (rad): the share of the lever that turns the wrist.

        beta = theta3 - 3 pi / 2 (thesis Figure 11) and the mounting angle.
        """
        return np.abs(np.sin(np.asarray(theta3) + self.wrist_lever_angle - 1.5 * pi))

    @property
    def valve_centres(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Commands (3,) at which the spools are centred."""
        return np.array([actuator.valve.centre for actuator in self.actuators])


OPEN, SHUT = 1, 2
"""Position in which a vent, the shut-off valve or the safety relay is stuck, in `vent_stuck`,
`shut_off_stuck` and `relay_stuck` of PLANT_PARAMETERS; 0: it obeys."""
RELIEFS = 7
"""Number of relief valves: those of the six chambers, and the manifold's."""
EXHAUSTS = 7
"""Number of exhausts: those of the six chambers, and the manifold's."""

PLANT_PARAMETERS = np.dtype(
    [
        # By actuator
        *fields("f8", "area_a area_b dead_volume lower upper volume_lower volume_upper", (3,)),
        *fields("f8", "viscous coulomb static stribeck_speed", (3,)),
        *fields("f8", "stop_stiffness stop_travel stop_damping_speed", (3,)),
        *fields("f8", "conductance critical_ratio dead_band leakage centre cross_leakage", (3,)),
        ("spool", "f8", (3, 4)),
        *fields("f8", "lever_cos lever_sin"),
        # Supply
        *fields("f8", "regulated feed_conductance manifold dump_conductance"),
        *fields("f8", "relief_pressure relief_conductance relief_leakage", (RELIEFS,)),
        *fields("f8", "soft_start_time vent_conductance vent_delay shut_off_delay atmosphere exponent"),
        # Sensors and stuck parts
        *fields("f8", "encoder_scale encoder_zero", (3,)),
        ("encoder_counts", "i8"),
        ("incremental", "?"),
        *fields("f8", "latency jitter noise"),
        *fields("?", "pressure_sensors vent_feedback"),
        ("vent_stuck", "i8", (2,)),
        *fields("?", "shut_off_feedback spool_feedback"),
        *fields("i8", "shut_off_stuck relay_stuck"),
        ("exhaust", "f8", (EXHAUSTS,)),
        # Shaft, ground and ball
        ("flexible", "?"),
        *fields("f8", "head_mass head_stiffness head_damping head_distance"),
        *fields("f8", "ground ground_stiffness ground_friction ground_strength ground_density sole_depth"),
        *fields("f8", "ball_x ball_y lie tick"),
        ("substeps", "i8"),
    ],
    align=True,
)
"""`exhaust` is the share of its area that each exhaust passes, behind the vents or the manifold's dump valve:
less than 1 with a clogged silencer or a kinked hose."""

PLANT_STATE = np.dtype(
    [
        ("time", "f8"),
        *fields("f8", "angle speed", (3,)),
        ("pressure", "f8", (6,)),
        *fields("f8", "supply_pressure flex flex_speed"),
        *fields("f8", "spool spool_speed", (3,)),
        *fields("f8", "supply_level vent_timer"),
        ("vent_open", "u1", (2,)),
        ("shut_off_timer", "f8"),
        ("shut_off_open", "u1"),
        ("effort", "f8", (3,)),
        ("head", "f8", (6,)),
        ("stop_work", "f8", (3,)),
        *fields("f8", "stop_energy stop_depth", (3, 2)),
        ("peak_pressure", "f8", (6,)),
        *fields("f8", "lowest_clearance peak_head_speed air_used"),
        *fields("?", "emergency_stop_clear guard_closed guard_locked local_reset"),
        *fields("u1", "encoder_valid encoder_indexed", (3,)),
        ("encoder_start", "i8", (3,)),
        ("index_fitted", "u1", (3,)),
        *fields("?", "search_before ball_present tee_before struck"),
        ("impact_time", "f8"),
        ("impact_head", "f8", (6,)),
        *fields("f8", "impulse ball_velocity ball_spin", (3,)),
        ("history", "f8", (HISTORY, 3)),
        ("history_index", "i8"),
        ("random", "u8"),
    ],
    align=True,
)


@dataclass(frozen=True)
class Plant:
    """The plant's parameters as records; pass `records` to the compiled functions."""

    parameters: PlantParameters
    robot: np.ndarray
    plant: np.ndarray
    impact: np.ndarray

    @property
    def records(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Records (robot, plant, impact) in the argument order of the compiled functions."""
        return self.robot, self.plant, self.impact


def build_plant(parameters: PlantParameters) -> Plant:
    """Build the records of compiled code from `parameters`.

    Raises:
        ValueError: the encoders' latency is longer than the plant's history.
    """
    encoders, remembered = parameters.encoders, (HISTORY - 2) * parameters.tick / parameters.substeps
    if encoders.latency + 6 * encoders.jitter > remembered:
        raise ValueError(
            f"encoders.latency: found {encoders.latency:g} s and jitter {encoders.jitter:g} s, expected "
            f"latency plus six times jitter up to {remembered:g} s; lower them, or raise tick / substeps"
        )
    record = new_record(PLANT_PARAMETERS)
    _fill_actuators(record, parameters)
    _fill_shared(record, parameters)
    club, robot = parameters.robot.club, parameters.robot
    if parameters.shaft.flexible:  # the head's mass is on the shaft, not in body C
        robot = replace(robot, club=replace(club, head_mass=1e-9))
    return Plant(parameters, robot.record, record, impact_parameters(club, parameters.ball, robot.lie))


def _fill_actuators(record: np.ndarray, parameters: PlantParameters) -> None:
    """Set the fields of PLANT_PARAMETERS by actuator."""
    half_step = parameters.tick / parameters.substeps / 2
    for i, actuator in enumerate(parameters.actuators):
        for source, prefix, names in (
            (actuator, "", "area_a area_b dead_volume lower upper cross_leakage"),
            (actuator.friction, "", "viscous coulomb static stribeck_speed"),
            (actuator.stop, "stop_", "stiffness travel damping_speed"),
            (actuator.valve, "", "conductance critical_ratio dead_band leakage centre"),
        ):
            for name in names.split():
                record[prefix + name][0, i] = getattr(source, name)
        record["volume_lower"][0, i], record["volume_upper"][0, i] = actuator.chamber_ends
        record["spool"][0, i] = actuator.valve.half_step_matrix(half_step).ravel()
    for name in ("volume_lower", "volume_upper"):
        record[name][0, 2] = parameters.wrist_stroke(record[name][0, 2])


def _fill_shared(record: np.ndarray, parameters: PlantParameters) -> None:
    """Set the fields of PLANT_PARAMETERS that belong to no single actuator."""
    encoders, supply, site = parameters.encoders, parameters.supply, parameters.site
    shaft, club = parameters.shaft, parameters.robot.club
    omega, surface = 2 * pi * shaft.frequency, SURFACES[site.surface]
    for source, names in (
        (parameters, "pressure_sensors vent_feedback shut_off_feedback spool_feedback tick substeps"),
        (encoders, "incremental latency jitter noise"),
        (supply, "feed_conductance dump_conductance soft_start_time atmosphere"),
        (supply, "vent_conductance vent_delay shut_off_delay"),
        (site, "ground ground_stiffness sole_depth ball_x ball_y"),
    ):
        copy_fields(record, source, names)
    for name, value in {
        "lever_cos": parameters.wrist_lever * cos(parameters.wrist_lever_angle),
        "lever_sin": parameters.wrist_lever * sin(parameters.wrist_lever_angle),
        "regulated": supply.pressure,
        "manifold": supply.volume,
        "relief_pressure": (*6 * (supply.relief_pressure,), supply.manifold_relief_pressure),
        "relief_conductance": (*6 * (supply.relief_conductance,), supply.manifold_relief_conductance),
        "exhaust": 1.0,
        "exponent": supply.polytropic_exponent,
        "encoder_scale": np.array(encoders.sign) * (encoders.counts_per_revolution / (2 * pi)),
        "encoder_zero": encoders.zero_count,
        "encoder_counts": encoders.counts_per_revolution,
        "flexible": shaft.flexible,
        "head_mass": club.head_mass,
        "head_stiffness": club.head_mass * omega**2,
        "head_damping": 2 * shaft.damping_ratio * omega * club.head_mass,
        "head_distance": club.shaft_length,
        "ground_friction": surface.friction,
        "ground_strength": surface.strength * surface.width,
        "ground_density": surface.density * surface.width,
        "lie": parameters.robot.lie,
    }.items():
        record[name] = value


def initial_state(plant: Plant, angle: np.ndarray, *, pressurised: bool = False) -> np.ndarray:
    """Return a `PLANT_STATE` array at rest at `angle` (3,) rad, chambers at atmosphere or half the supply."""
    state = new_record(PLANT_STATE)
    supply = plant.parameters.supply
    state["angle"] = angle
    state["pressure"] = (supply.pressure + supply.atmosphere) / 2 if pressurised else supply.atmosphere
    state["supply_pressure"] = supply.pressure if pressurised else supply.atmosphere
    state["supply_level"] = 1.0 if pressurised else 0.0
    state["shut_off_timer"] = 0.0 if pressurised else np.inf
    state["emergency_stop_clear"] = state["guard_closed"] = state["guard_locked"] = True
    state["encoder_valid"] = state["index_fitted"] = 1
    if plant.parameters.encoders.incremental:
        scale, zero = plant.plant["encoder_scale"][0], plant.plant["encoder_zero"][0]
        state["encoder_start"] = np.floor(np.asarray(angle) * scale + zero)
    else:
        state["encoder_indexed"] = 1
    state["history"] = angle
    state["lowest_clearance"] = np.inf
    state["peak_pressure"] = state["pressure"]
    # Spread over all 64 bits; the generator must not start at zero.
    state["random"] = np.random.SeedSequence(plant.parameters.seed).generate_state(1, np.uint64) | np.uint64(
        1
    )
    return state


@compiled
def _note_stops(r: Any, p: Any, s: Any, y: Any) -> None:
    """Record the max energy and compression of each shock absorber."""
    for i in range(3):
        depth = stop_depth(p, i, stop_coordinate(r, y, i))
        if depth == 0.0:
            y[15 + i] = 0.0
        else:
            side = 1 if depth > 0.0 else 0
            s.stop_energy[i, side] = max(s.stop_energy[i, side], y[15 + i])
            s.stop_depth[i, side] = max(s.stop_depth[i, side], abs(depth))


@compiled
def _index_side(p: Any, i: int, angle: float) -> float:
    """Return the turn number of encoder `i`: it changes where the index mark passes."""
    turns: float = (angle * p.encoder_scale[i] + p.encoder_zero[i]) / p.encoder_counts
    return floor(turns)


@compiled_with_arrays
def advance(robot: Any, plant: Any, impact: Any, state: Any, command: Any) -> None:
    """Advance `state` (PLANT_STATE, in place) by one tick with constant `command` (COMMAND).

    Arguments are one-element arrays: ROBOT, PLANT_PARAMETERS, IMPACT, PLANT_STATE, COMMAND.
    """
    r, p, s, c = robot[0], plant[0], state[0], command[0]
    y, trial = np.empty(STATES), np.empty(STATES)
    nodes, scratch = np.empty((3, 3)), np.empty((SCRATCH, STATES))
    scratch[ANGLES] = np.nan
    step = p.tick / p.substeps
    if c.tee and not s.tee_before:
        s.ball_present, s.struck = True, False
    s.tee_before = c.tee
    if c.search_index and not s.search_before and p.incremental:
        for i in range(3):
            if s.encoder_indexed[i] != 0:
                s.encoder_indexed[i] = 0
                s.encoder_start[i] = floor(s.angle[i] * p.encoder_scale[i] + p.encoder_zero[i])
    s.search_before = c.search_index
    s.guard_locked = s.guard_closed and c.guard_lock
    s.supply_level = min(s.supply_level + p.tick / p.soft_start_time, 1.0) if c.supply_enable else 0.0
    clear = s.emergency_stop_clear and s.guard_closed
    relay = p.relay_stuck == SHUT or (clear and p.relay_stuck != OPEN)
    s.vent_timer = 0.0 if c.exhaust_closed and relay else s.vent_timer + p.tick
    s.shut_off_timer = 0.0 if c.supply_enable and c.guard_lock and relay else s.shut_off_timer + p.tick
    holds = s.shut_off_timer <= p.shut_off_delay
    s.shut_off_open = p.shut_off_stuck == OPEN or (holds and p.shut_off_stuck != SHUT)
    feed = p.feed_conductance * s.supply_level if s.shut_off_open else 0.0
    opens = s.vent_timer > p.vent_delay
    for k in range(2):
        s.vent_open[k] = p.vent_stuck[k] == OPEN or (opens and p.vent_stuck[k] != SHUT)
    # The vents stand in parallel behind each chamber's throttle, which alone limits the flow.
    vent = p.vent_conductance if s.vent_open[0] or s.vent_open[1] else 0.0

    for i in range(3):
        y[i], y[3 + i], y[15 + i] = s.angle[i], s.speed[i], s.stop_work[i]
    for i in range(6):
        y[6 + i] = s.pressure[i]
    y[12], y[13], y[14], y[18] = s.supply_pressure, s.flex, s.flex_speed, 0.0
    near_ball = s.ball_present and is_near_ball(r, p, y)

    for n in range(p.substeps):
        for i in range(3):
            nodes[0, i] = s.spool[i]
            for half in range(1, 3):
                wanted = c.valve[i] - p.centre[i]
                offset, rate = s.spool[i] - wanted, s.spool_speed[i]
                s.spool[i] = wanted + p.spool[i, 0] * offset + p.spool[i, 1] * rate
                s.spool_speed[i] = p.spool[i, 2] * offset + p.spool[i, 3] * rate
                nodes[half, i] = s.spool[i]
        move(r, p, y, nodes, 0.0, 1.0, step, feed, vent, scratch, trial)
        if near_ball and s.ball_present:
            part = find_contact(r, p, impact, y, nodes, step, feed, vent, scratch, trial)
            if part >= 0.0:
                for k in range(STATES):
                    y[k] = trial[k]
                s.impact_time = s.time + (n + part) * step
                strike_ball(r, p, impact, s, y)
                move(r, p, y, nodes, part, 1.0, step, feed, vent, scratch, trial)
        for k in range(STATES):
            y[k] = trial[k]
        _note_stops(r, p, s, y)
        s.history_index = (s.history_index + 1) % HISTORY
        for i in range(3):
            s.history[s.history_index, i] = y[i]
    s.time += p.tick
    for i in range(3):
        if p.incremental and s.index_fitted[i] != 0:
            if _index_side(p, i, s.angle[i]) != _index_side(p, i, y[i]):
                s.encoder_indexed[i] = 1
        s.angle[i], s.speed[i], s.stop_work[i], s.effort[i] = y[i], y[3 + i], y[15 + i], scratch[4, 15 + i]
    for i in range(6):
        s.pressure[i] = y[6 + i]
        s.peak_pressure[i] = max(s.peak_pressure[i], y[6 + i])
    s.supply_pressure, s.flex, s.flex_speed = y[12], y[13], y[14]
    s.air_used += y[18] / (GAS_CONSTANT * REFERENCE_TEMPERATURE)
    s.head[0], s.head[1], s.head[2], s.head[3], s.head[4], s.head[5] = head_geometry(r, p, y)
    s.lowest_clearance = min(s.lowest_clearance, s.head[1] - p.sole_depth - p.ground)
    s.peak_head_speed = max(s.peak_head_speed, sqrt(s.head[3] * s.head[3] + s.head[4] * s.head[4]))
