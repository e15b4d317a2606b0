"""The downswing as an optimal control problem on arms and air, solved by direct collocation.

States: joint angles and speeds, six chamber pressures, the manifold's pressure, three valve commands;
controls: the rates of the commands. Radau collocation turns the differential equations into equality
constraints of a sparse nonlinear program that IPOPT solves with exact derivatives from CasADi. Why
collocation: the motion along the way is a separate unknown. A poor guess of the valve commands does not send
the club somewhere else, as it does in shooting. Limits along the way (stops, lever, valve commands) are plain
bounds. The same input gives a bit-identical answer.

The model is that of the plant with derivatives everywhere: dry friction, flow and metering edges are rounded
off, spools follow at once, stops are bounds. `bench.design._refine` then works on the plant itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import BenchError, load_extra
from bench.base.interrupt import deferred_interrupt
from bench.control.settings import ControlSettings, EnvelopeSettings
from sim.plant import PlantParameters
from sim.pneumatics import FLOW_TO_PRESSURE, Actuator


def load_casadi() -> Any:
    """Return the package. Raises BenchError if it is not installed."""
    return load_extra("casadi", "design", "profile design")


def require_planned_openings(control: ControlSettings) -> None:
    """Raise BenchError unless `control` feeds the profile's valve commands forward."""
    if control.feed_forward != "planned":
        raise BenchError(
            "control.feed_forward",
            repr(control.feed_forward),
            '"planned": designing and learning change the planned valve commands',
            'Set feed_forward = "planned" for it.',
        )


Array = NDArray[np.float64]
Expression = Any
"""A CasADi expression."""

BAR = 1e5
STATES, CONTROLS = 16, 3
_KINDS = (
    ("joint ranges",) * 3
    + ("joint speeds",) * 3
    + ("chamber pressure",) * 6
    + ("supply",)
    + ("shoulder valve", "right arm's valve", "wrist's valve")
)
_FREE = 1e-6
"""Price of a m/s below which no limit holds the speed back."""
_LIMITS = ("rod speed", "rod range", "cushion of the right arm", "cushion of the wrist", "shoulder braking")
_PRICE = {"time": 5.0, "rise": 10.0, "speed": 10.0}
"""Prices of concessions, where deviations cost about one: a downswing twice as long, a rad, a m/s. They are
linear, so that only necessary concessions are made, the speed last: a degree is worth some m/s."""
_ITERATIONS = 600
_OPTIONS: dict[str, Any] = {
    "ipopt": {"print_level": 0, "sb": "yes", "max_iter": _ITERATIONS, "tol": 1e-5, "acceptable_tol": 1e-4}
    | {"acceptable_iter": 8, "mu_strategy": "monotone", "linear_solver": "mumps"},
    "print_time": False,
    "error_on_fail": False,
    "expand": True,
}
_SLEW = 150.0
"""Max slew rate of a valve command (1/s)."""
_RADAU = 2
_FRICTION_WIDTH = 0.02
"""Speed over which dry friction changes its sign, m/s or rad/s times ten: a step in the plant."""
_EDGE_WIDTH = 0.01
_FLOW_WIDTH = 1e-3
_FEED_RATIO = 0.3


class Equations(NamedTuple):
    """CasADi functions of the robot with its air."""

    derivative: Any
    """(state, control) -> d state/dt; pressures in bar."""
    head: Any
    """(q, u) -> x, y (m), theta_t (rad), vx, vy (m/s)."""
    extension: Any
    """q -> rod extension, m."""
    carried: Any
    """state -> energy of right arm and wrist at their upper stops: kinetic, and work of the pressures (J)."""


def _positive(value: Expression, width: float) -> Expression:
    """Return max(value, 0), rounded off over `width`."""
    ca = load_casadi()
    return (value + ca.sqrt(value**2 + width**2)) / 2


def _larger(a: Expression, b: Expression, width: float) -> Expression:
    return b + _positive(a - b, width)


def _flow(conductance: Expression, upstream: Expression, downstream: Expression, ratio: float) -> Expression:
    """Return m' R T over 1e5 (W) for pressures in bar: ISO 6358 without its corners."""
    ca = load_casadi()
    high = _larger(upstream, downstream, 0.02)
    low = upstream + downstream - high
    low = _larger(low, ratio * high, 0.02)
    # With low = b high this is the choked flow; the sign is that of the pressures.
    share = (high - low) * (low + (1 - 2 * ratio) * high)
    driving = ca.sqrt(share + (_FLOW_WIDTH * high) ** 2) / (1 - ratio)
    sign = (upstream - downstream) / ca.sqrt((upstream - downstream) ** 2 + (0.005 * high) ** 2)
    return conductance * FLOW_TO_PRESSURE * driving * sign


def _kinetics(plant: PlantParameters, q: Expression, u: Expression) -> tuple[Expression, Expression]:
    """Return mass matrix and bias forces from the bodies' positions, by differentiation."""
    ca = load_casadi()
    robot, club = plant.robot, plant.robot.club
    a1, a2, a3 = q[0], q[0] + q[1], q[0] + q[1] + q[2]

    def ray(length: float, angle: Expression) -> Expression:
        return length * ca.vertcat(ca.cos(angle), ca.sin(angle))

    r2 = ray(robot.l12, a1)
    r3, r6 = r2 + ray(robot.l23, a2), ray(-robot.l16, a1)
    arm = r6 - r3
    along, angle = arm / ca.norm_2(arm), ca.atan2(arm[1], arm[0])
    bodies = (
        (robot.shoulder_link, ray(robot.shoulder_link.centre_of_mass, a1), a1),
        (robot.left_arm, r2 + ray(robot.left_arm.centre_of_mass, a2), a2),
        (club, r3 + ray(club.centre_of_mass, a3), a3),
        (robot.rod, r3 + robot.rod.centre_of_mass * along, angle),
        (robot.cylinder, r6 - robot.cylinder.centre_of_mass * along, angle),
    )
    matrix, bias = ca.SX.zeros(3, 3), ca.SX.zeros(3, 1)
    for body, place, turn in bodies:
        way, spin = ca.jacobian(place, q), ca.jacobian(turn, q)
        matrix += body.mass * way.T @ way + body.inertia * spin.T @ spin
        lift = ca.jtimes(way @ u, q, u) + ca.vertcat(0.0, robot.in_plane_gravity)
        bias += body.mass * way.T @ lift + body.inertia * spin.T @ ca.jtimes(spin @ u, q, u)
    return matrix, bias


def _air(
    plant: PlantParameters,
    i: int,
    pressures: Expression,
    supply: Expression,
    opening: Expression,
    position: Expression,
    speed: Expression,
) -> tuple[Expression, Expression, Expression]:
    """Return actuator i's force, its pressure rates (bar/s) and its demand on the supply (W / 1e5)."""
    ca = load_casadi()
    actuator, atmosphere = plant.actuators[i], plant.supply.atmosphere / BAR
    valve, exponent = actuator.valve, plant.supply.polytropic_exponent
    pa, pb = pressures[0], pressures[1]
    edge_a, edge_b = (
        valve.conductance
        * (valve.leakage + _positive((side * opening - valve.dead_band) / (1 - valve.dead_band), _EDGE_WIDTH))
        for side in (1.0, -1.0)
    )
    ratio = valve.critical_ratio
    into_a, into_b = _flow(edge_a, supply, pa, ratio), _flow(edge_b, supply, pb, ratio)
    across = _flow(actuator.cross_leakage, pa, pb, ratio)
    out_a, out_b = _flow(edge_b, pa, atmosphere, ratio), _flow(edge_a, pb, atmosphere, ratio)
    lowest, highest = actuator.chamber_ends
    if i == 2:  # in its own coordinate, m
        lowest, highest = float(plant.wrist_stroke(lowest)), float(plant.wrist_stroke(highest))
    volume_a = actuator.dead_volume + actuator.area_a * (position - lowest)
    volume_b = actuator.dead_volume + actuator.area_b * (highest - position)
    rate_a = exponent / volume_a * (into_a - across - out_a - pa * actuator.area_a * speed)
    rate_b = exponent / volume_b * (into_b + across - out_b + pb * actuator.area_b * speed)
    force = BAR * ((pa - atmosphere) * actuator.area_a - (pb - atmosphere) * actuator.area_b)
    return force, ca.vertcat(rate_a, rate_b), into_a + into_b


def _friction(actuator: Actuator, speed: Expression) -> Expression:
    ca = load_casadi()
    friction = actuator.friction
    width = max(_FRICTION_WIDTH, friction.stribeck_speed)
    return friction.viscous * speed + friction.coulomb * ca.tanh(speed / width)


def build_equations(plant: PlantParameters) -> Equations:
    """Return the equations of `plant` (rigid shaft) as CasADi functions."""
    ca = load_casadi()
    robot = plant.robot
    state, control = ca.SX.sym("state", STATES), ca.SX.sym("control", CONTROLS)
    q, u, pressures, supply, opening = state[:3], state[3:6], state[6:12], state[12], state[13:16]
    matrix, bias = _kinetics(plant, q, u)
    length = ca.sqrt(robot.l62**2 + robot.l23**2 + 2 * robot.l62 * robot.l23 * ca.cos(q[1]))
    extension, lever = length - robot.l56, -robot.l62 * robot.l23 * ca.sin(q[1]) / length
    turned = q[2] + plant.wrist_lever_angle if plant.wrist_lever_angle else q[2]
    places = (q[0], extension, plant.wrist_lever * ca.sin(turned))
    levers = (1.0, lever, plant.wrist_lever * ca.cos(turned))
    forces, rates, taken = [], [], 0.0
    for i, actuator in enumerate(plant.actuators):
        speed = levers[i] * u[i]
        force, rate, needed = _air(
            plant, i, pressures[2 * i : 2 * i + 2], supply, opening[i], places[i], speed
        )
        forces.append(levers[i] * (force - _friction(actuator, speed)))
        rates.append(rate)
        taken += needed
    fed = _flow(plant.supply.feed_conductance, plant.supply.pressure / BAR, supply, _FEED_RATIO)
    supply_rate = plant.supply.polytropic_exponent / plant.supply.volume * (fed - taken)
    acceleration = _solved(matrix, ca.vertcat(*forces) - bias)
    derivative = ca.vertcat(u, acceleration, *rates, supply_rate, control)
    a1, a2, a3 = q[0], q[0] + q[1], q[0] + q[1] + q[2]
    reach = robot.club.length_to_face
    place = ca.vertcat(
        robot.l12 * ca.cos(a1) + robot.l23 * ca.cos(a2) + reach * ca.cos(a3),
        robot.l12 * ca.sin(a1) + robot.l23 * ca.sin(a2) + reach * ca.sin(a3),
    )
    head = ca.vertcat(place, a3, ca.jacobian(place, q) @ u)
    carried = []
    for i, travel in ((1, plant.right_arm.stop.travel / lever), (2, plant.wrist.stop.travel)):
        moving = u[i] ** 2 / (2 * _solved(matrix, ca.SX(np.eye(3)[i]))[i])
        carried.append(moving + _positive(forces[i], 1.0) * travel)
    return Equations(
        ca.Function("derivative", [state, control], [derivative]),
        ca.Function("head", [q, u], [head]),
        ca.Function("extension", [q], [extension]),
        ca.Function("carried", [state], [ca.vertcat(*carried)]),
    )


def _solved(m: Expression, f: Expression) -> Expression:
    """Return x with m x = f for a symmetric 3x3 matrix."""
    ca = load_casadi()
    l21, l31 = m[0, 1] / m[0, 0], m[0, 2] / m[0, 0]
    d2, t32 = m[1, 1] - l21 * m[0, 1], m[1, 2] - l31 * m[0, 1]
    l32 = t32 / d2
    d3 = m[2, 2] - l31 * m[0, 2] - l32 * t32
    y2 = f[1] - l21 * f[0]
    y3 = f[2] - l31 * f[0] - l32 * y2
    x3 = y3 / d3
    x2 = y2 / d2 - l32 * x3
    return ca.vertcat(f[0] / m[0, 0] - l21 * x2 - l31 * x3, x2, x3)


class Concessions(NamedTuple):
    """Max concessions of a demand that is out of reach."""

    time: float = 0.0
    """Longer downswing, s."""
    rise: float = 0.0
    """Steeper path upwards in the plane, rad."""
    speed: float = 0.0
    """Lower head speed, m/s."""


NO_CONCESSIONS = Concessions()


@dataclass(frozen=True)
class SwingDemand:
    """Demand on a swing: the delivery, the loads and the times."""

    head_speed: float | None = 45.0
    """Head speed at impact (m/s); None: the robot's highest."""
    attack: float = 0.0
    """Angle of the head's path to the ground at the ball, rad, positive rising."""
    lean: float | None = None
    """Shaft lean at the ball, rad, in the swing plane, negative with leading hands; None: the easiest within
    1.5 deg; on turf, where the path falls, up to 10 deg of leading hands."""
    before_stop: float = 0.0012
    """Least time from the ball to where the wrist, at its speed, would meet its stop, s. With 0 the fastest
    swings meet it there: a robot that came a little otherwise met it before the ball, 0.7 % slower in every
    other swing. On drawn robots it comes up to 0.6 ms nearer than planned."""
    strike: float = 0.0
    """Ball off the face's centre along the cut of swing plane and face, m."""
    margin: float = 0.15
    """Fraction of each valve's range that is left to feedback."""
    struck_share: float = 0.8
    """Max fraction of the absorbers' rated energy when the ball is struck."""
    missed_share: float = 0.97
    """Max fraction with a missed ball or after loss of communication."""
    backswing_time: float = 0.85
    top_time: float = 0.25
    downswing_time: tuple[float, float] = (0.15, 0.25)
    """Shortest and longest, s."""
    address_cock: float = 0.14
    """Wrist at address, rad short of its stop."""
    address_shoulder: float = 0.45
    """Angle at a ball on a tee, with the rod short of its stop; on turf it follows from the ball's place."""
    top_shoulder: float = -1.30
    top_extension: float = 0.02
    top_cock: float | None = None
    """Wrist at the top, rad short of its stop; None: as far as its lever turns it."""
    follow_time: float = 0.7
    """Time from the ball to the end of the profile (s); braking takes about 0.3 s of it."""
    no_return_time: float = 0.06
    """Time before the impact window from which on the ball is struck in any case, s."""
    least_lever: float = 0.25
    """Min |sin beta| of the plan; the envelope trips at 0.15."""
    pressure: float = 1.0e6
    """Max chamber pressure, Pa absolute."""
    shoulder_speed: float = 16.0
    """Max shoulder speed at the ball, to be braked in the follow-through, rad/s."""
    follow: Array | None = None
    """(n, 3) joint angles to keep close to, evenly spaced over the downswing up to the ball, rad; rows of NaN
    do not count."""
    ranges: Array | None = None
    """(3,) units of the deviations from them, rad."""
    nearest: bool = False
    """Whether a demand out of reach gives way: in the downswing's time, the path's rise, the head speed."""


@dataclass(frozen=True)
class DownswingProblem:
    """A demand on a downswing, and its limits."""

    demand: SwingDemand
    envelope: EnvelopeSettings
    start: Array
    """(16,) state at the top."""
    slope: float
    """Angle of the head's path in the plane, positive rising (rad)."""
    theta_t: tuple[float, float]
    """Range of the shaft's angle at the ball, rad."""
    opening: float
    """Max valve command."""
    shoulder: float
    """Min theta1 before the ball, rad."""
    shoulder_back: float
    """Max speed of the shoulder backwards, rad/s."""
    wrist: tuple[float, float]
    """Range of theta3 before the ball, rad."""
    committed: float
    """Time before the ball from which on stopping before the end stops is not required, s."""
    cushions: tuple[float, float]
    """Max energy in the upper absorbers of right arm and wrist when the ball is missed (J)."""
    concessions: Concessions = NO_CONCESSIONS

    @property
    def speed_limits(self) -> tuple[float, float, float]:
        """Shoulder rad/s, rod m/s, wrist rad/s."""
        a, b, c = self.envelope.max_speed
        return 0.96 * a, 0.96 * b, 0.96 * c


class DownswingPlan(NamedTuple):
    """A downswing found by collocation."""

    time: Array
    """(n,) s from the top, ends of the intervals."""
    state: Array
    """(n, 16)"""
    speed: float
    solved: bool
    status: str
    binding: dict[str, float]
    """Head speed gained for one per cent more of each limit (m/s); at a demanded speed at equal effort."""
    carried: Array
    """Energies (2,) that the model brings to the upper absorbers of right arm and wrist (J)."""


def solve_downswing(
    plant: PlantParameters,
    problem: DownswingProblem,
    guess_time: float,
    guess: Array,
    intervals: int = 50,
) -> DownswingPlan:
    """Solve `problem` from `guess` (intervals + 1, 16)."""
    ca = load_casadi()
    equations = build_equations(plant)
    tau = np.array(ca.collocation_points(_RADAU, "radau"))
    slopes = _radau_slopes(tau)
    d, n = _RADAU, intervals
    # One column an interval end: states; one an interior point; controls are constant in an interval.
    z, z0, lower, upper = [], [], [], []
    g, g_lower, g_upper = [], [], []
    kinds: list[str] = []
    names: list[str] = []

    def variable(name: str, value: Any, low: Any, high: Any, kind: tuple[str, ...]) -> Expression:
        value, low, high = (
            np.broadcast_to(np.asarray(v, float), np.shape(value)) for v in (value, low, high)
        )
        symbol = ca.MX.sym(name, len(value))
        z.append(symbol)
        z0.append(np.clip(value, low, high))
        lower.append(low)
        upper.append(high)
        kinds.extend(kind)
        return symbol

    def require(name: str, expression: Expression, low: Any, high: Any) -> None:
        size = expression.shape[0]
        g.append(expression)
        g_lower.append(np.broadcast_to(np.asarray(low, float), size))
        g_upper.append(np.broadcast_to(np.asarray(high, float), size))
        names.extend([name] * size)

    p, demand = problem, problem.demand
    slew = np.array([_SLEW] * 3)

    def advance(
        name: str, state: Expression, step: Expression, guess: Array, rate: Array, low: Array, high: Array
    ) -> tuple[list[Expression], Expression]:
        """Add an interval from `state`; return the states at its points and its control."""
        control = variable(f"c{name}", rate, -slew, slew, ("how fast valves open",) * 3)
        points = [variable(f"x{name}_{j}", guess, low, high, _KINDS) for j in range(d)]
        for j in range(d):
            slope = slopes[0, j] * state
            for i in range(d):
                slope += slopes[i + 1, j] * points[i]
            require("model", step * equations.derivative(points[j], control) - slope, 0.0, 0.0)
        return points, control

    low, high = _state_bounds(plant, p)
    longest = demand.downswing_time[1] + p.concessions.time
    duration = variable("duration", np.array([guess_time]), demand.downswing_time[0], longest, ("time",))
    cost: Expression = 0.0
    given: Expression = np.zeros(3)
    if any(p.concessions):
        given = variable("given", np.zeros(3), np.zeros(3), np.array(p.concessions), ("concessions",) * 3)
        require("tempo", duration - given[0], *demand.downswing_time)
        cost += ca.dot(given, [_PRICE["time"] / demand.downswing_time[1], _PRICE["rise"], _PRICE["speed"]])
    state = variable("x0", guess[0], p.start, p.start, ("the top",) * STATES)
    step = duration / n
    states, controls = [state], []
    for k in range(n):
        rate = (guess[k + 1, 13:] - guess[k, 13:]) / (guess_time / n)
        points, control = advance(str(k), state, step, guess[k + 1], rate, low, high)
        state = points[-1]  # Radau: the last point is the interval's end
        states.append(state)
        controls.append(control)
        cost += 1e-6 * ca.sumsqr(control) / n
        require(
            "rod speed",
            (equations.extension(state[:3]) - equations.extension(states[k][:3])) / step,
            -p.speed_limits[1],
            p.speed_limits[1],
        )
        if (1 - (k + 1) / n) * longest > p.committed:
            rod = (equations.extension(state[:3]) - equations.extension(states[k][:3])) / step
            place = ca.vertcat(state[0], equations.extension(state[:3]), state[2])
            spare = _stop_distance(plant, p, place, ca.vertcat(state[3], rod, state[5]))
            require("stop distance", spare, 0.0, np.inf)
        require(
            "rod range", equations.extension(state[:3]), plant.right_arm.lower, plant.right_arm.upper + 1e-3
        )
    head = equations.head(state[:3], state[3:6])
    site = plant.site
    require("ball", head[:2], [site.ball_x, site.ball_y], [site.ball_x, site.ball_y])
    require("shaft lean", head[2], p.theta_t[0], p.theta_t[1])
    if demand.before_stop > 0.0:
        require("wrist's stop", state[2] + demand.before_stop * state[5], -np.inf, plant.wrist.upper)
    slope = p.slope + given[1]
    along = ca.cos(slope) * head[3] + ca.sin(slope) * head[4]
    require("slope", -ca.sin(slope) * head[3] + ca.cos(slope) * head[4], 0.0, 0.0)
    require("shoulder braking", state[3], -demand.shoulder_speed, demand.shoulder_speed)
    if demand.head_speed is None:
        cost += -along
    else:
        require("speed", along + given[2], demand.head_speed, demand.head_speed)
    if demand.follow is not None and demand.ranges is not None:
        for k in range(n + 1):
            row = demand.follow[round(k * (len(demand.follow) - 1) / n)]
            if np.isfinite(row).all():
                cost += ca.sumsqr((states[k][:3] - row) / demand.ranges) / n * 10.0
        # Valve commands that jump are easy to plan and hard to follow.
        cost += (
            sum(0.1 * ca.sumsqr(s[13:]) for s in states) / n + sum(1e-5 * ca.sumsqr(c) for c in controls) / n
        )
    elif demand.head_speed is not None:
        cost += sum(ca.sumsqr(s[13:]) for s in states) / n

    carried = equations.carried(state)
    require("cushion of the right arm", carried[0], -1.0, p.cushions[0])
    require("cushion of the wrist", carried[1], -1.0, p.cushions[1])
    program: dict[str, Any] = {"x": ca.vertcat(*z), "f": cost, "g": ca.vertcat(*g)}
    solver = ca.nlpsol("downswing", "ipopt", program, _OPTIONS)
    with deferred_interrupt():  # the solver takes KeyboardInterrupt for a failed evaluation, and continues
        found = solver(
            x0=np.concatenate(z0),
            lbx=np.concatenate(lower),
            ubx=np.concatenate(upper),
            lbg=np.concatenate(g_lower),
            ubg=np.concatenate(g_upper),
        )
    stats = solver.stats()
    values = ca.Function("values", [program["x"]], [duration, ca.horzcat(*states), along, carried])(
        found["x"]
    )
    total = float(values[0])
    return DownswingPlan(
        np.linspace(0.0, total, n + 1),
        np.array(values[1]).T,
        float(values[2]),
        bool(stats["success"]),
        str(stats["return_status"]),
        _gains(found, kinds, names, np.concatenate(lower), np.concatenate(upper)),
        np.array(values[3]).ravel(),
    )


def _stop_distance(
    plant: PlantParameters, p: DownswingProblem, place: Expression, speed: Expression
) -> Expression:
    """Return the margin of each joint, in speed squared, to stop before its upper and lower end.

    As in the envelope (`bench.control.envelope`), a tenth less.
    """
    ca = load_casadi()
    towards = speed * ca.sqrt(speed**2 + 0.01)
    at_end = np.array(p.envelope.end_stop_max_speed) ** 2
    braking = 2.0 * np.array(p.envelope.min_deceleration)
    ends = np.array([[a.lower, a.upper] for a in plant.actuators])
    scale = np.tile(at_end, 2)
    upwards = 0.9 * (at_end + braking * (ends[:, 1] - place)) - towards
    downwards = 0.9 * (at_end + braking * (place - ends[:, 0])) + towards
    return ca.vertcat(upwards, downwards) / scale


def _gains(found: Any, kinds: list[str], names: list[str], lower: Array, upper: Array) -> dict[str, float]:
    """Return the head speed (m/s) that one per cent more of each limit would give, from its multipliers."""
    gains: dict[str, float] = {}
    by_row = np.array(found["lam_g"]).ravel()
    # The effort of a m/s if the speed is demanded; else the cost is the speed itself.
    price = abs(float(by_row[names.index("speed")])) if "speed" in names else 1.0
    if price < _FREE:
        return {}
    multipliers = np.array(found["lam_x"]).ravel() / price
    for kind, value, low, high in zip(kinds, multipliers, lower, upper, strict=True):
        bound = high if value > 0 else low
        if kind not in {"the top", "concessions"} and high > low and np.isfinite(bound):
            gains[kind] = gains.get(kind, 0.0) + 0.01 * abs(value * bound)
    reached = np.array(found["g"]).ravel()
    for name, value, at in zip(names, by_row / price, reached, strict=True):
        if name in _LIMITS:
            gains[name] = gains.get(name, 0.0) + 0.01 * abs(value * at)
    return {name: gain for name, gain in sorted(gains.items(), key=lambda item: -item[1]) if gain > 1e-3}


def _state_bounds(plant: PlantParameters, p: DownswingProblem) -> tuple[Array, Array]:
    atmosphere, fastest = plant.supply.atmosphere / BAR, p.speed_limits
    low = np.array(
        [p.shoulder, pi + 0.05, p.wrist[0], -p.shoulder_back, -60.0, -fastest[2]]
        + [0.9 * atmosphere] * 6
        + [2.0]
        + [-p.opening] * 3
    )
    high = np.array(
        [plant.shoulder.upper, 1.6 * pi, p.wrist[1], fastest[0], 60.0, fastest[2]]
        + [p.demand.pressure / BAR] * 6
        + [1.05 * plant.supply.pressure / BAR]
        + [p.opening] * 3
    )
    return low, high


def _radau_slopes(tau: Array) -> Array:
    """Return slopes (d + 1, d) at `tau` of the Lagrange polynomials through 0 and `tau`."""
    nodes = np.concatenate([[0.0], tau])
    slopes = np.empty((len(nodes), len(tau)))
    for i, node in enumerate(nodes):
        others = np.delete(nodes, i)
        slopes[i] = np.polyder(np.poly1d(np.poly(others) / np.prod(node - others)))(tau)
    return slopes
