"""The swing designer: finds a swing that this robot's air can do, by shooting on the plant itself.

Decision variables are valve openings at knots, so that every trial is feasible for the air by
construction; the covariance matrix adaptation evolution strategy (Hansen 2016, package `cma`) needs no
gradients of stops, valves and impact. The profile's reference is the motion that the best openings give on
the nominal plant, and the openings are its feed-forward: on that plant the PIDs have nothing to do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cma
import numpy as np
from numpy.typing import NDArray

from bench.control.settings import ControlSettings, build_controller
from bench.control.step import ARM, SWING
from bench.lifecycle import Phase
from bench.lockstep import Lockstep
from bench.swing.profile import Profile
from drivers.base import COMMAND
from sim.compiled import compiled, new_record
from sim.kinematics import theta2_from_right_arm
from sim.plant import Plant, PlantParameters, advance, build_plant

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

_SHAFT_DOWN = 3.5 * np.pi  # theta_t with the shaft straight down, in the range the joints have there
_UNTIL_WRIST_STOPS = 0.03
_WATCHED = 0.08  # s after the ball that the downswing's search looks at


@dataclass(frozen=True)
class Demand:
    """What the swing is to do at the ball, and how gently."""

    head_speed: float = 45.0
    """m/s"""
    slope: float = 0.0
    """In-plane angle of the head's path at the ball, rad, positive rising."""
    lean: float = 0.0
    """Shaft lean at the ball, rad."""
    greatest_opening: float = 0.85
    """Leaves feedback its share of the valves."""
    greatest_stop_share: float = 0.6
    """Share of the cushions' rated energy that the plan may use."""
    greatest_miss_share: float = 0.85
    """The same when the ball is missing."""
    backswing_time: float = 0.85
    top_time: float = 0.25
    address_cock: float = 0.14
    """Wrist at address, rad short of its stop."""
    address_shoulder: float = 0.45
    address_extension: float = 0.200
    top_shoulder: float = -1.30
    top_extension: float = 0.02
    top_cock: float = np.deg2rad(72.0).item()
    knot: float = 0.03
    """Time between valve knots, s."""
    downswing_knots: int = 11
    follow_knots: int = 16
    settle_time: float = 0.25
    """Spools at rest after the follow-through, s."""


@dataclass(frozen=True)
class _Start:
    """The nominal motion up to the top of the swing."""

    plant_state: NDArray[Any]
    command: NDArray[Any]
    angle: Array
    velocity: Array
    valve: Array
    begins: tuple[int, int, int]


def address_pose(parameters: PlantParameters, demand: Demand) -> Array:
    """Return the joint angles at address (rad)."""
    robot = parameters.robot
    return np.array(
        [
            demand.address_shoulder,
            float(theta2_from_right_arm(robot, robot.l56 + demand.address_extension)),
            parameters.wrist.upper - demand.address_cock,
        ]
    )


def top_pose(parameters: PlantParameters, demand: Demand) -> Array:
    """Return the joint angles at the top of the backswing (rad)."""
    robot = parameters.robot
    return np.array(
        [
            demand.top_shoulder,
            float(theta2_from_right_arm(robot, robot.l56 + demand.top_extension)),
            parameters.wrist.upper - demand.top_cock,
        ]
    )


def _quintic(start: Array, end: Array, duration: float, samples: int) -> tuple[Array, Array]:
    part = (np.arange(samples) / samples)[:, None]
    shape = part**3 * (10 - 15 * part + 6 * part**2)
    slope = 30 * part**2 * (1 - part) ** 2 / duration
    return start + (end - start) * shape, (end - start) * slope


def _sketch(demand: Demand, period: float, address: Array, top: Array, gain: Array) -> Profile:
    """Return a provisional profile: smooth reference from address to top, then hold."""
    n, hold = round(demand.backswing_time / period), round((demand.top_time + 0.5) / period)
    angle, velocity = _quintic(address, top, demand.backswing_time, n)
    angle = np.vstack([angle, np.tile(top, (hold, 1))])
    velocity = np.vstack([velocity, np.zeros((hold, 3))])
    begins = (0, 1, n, n + hold - 4, n + hold - 3, n + hold - 2, n + hold - 1)
    return Profile(
        "sketch", "", "", "", period, begins, angle, velocity, velocity * gain, 20, np.zeros((len(angle) // 20 + 1, 6)),
        (0.25, -1.56), n * period,
    )  # fmt: skip


def _swing_up(plant: Plant, demand: Demand, control: ControlSettings) -> _Start:
    """Let the controller itself take the plant to the top; what it did is the nominal motion."""
    parameters = plant.parameters
    period = parameters.tick
    address, top = address_pose(parameters, demand), top_pose(parameters, demand)
    sketch = _sketch(demand, period, address, top, np.array(control.move_gain))
    bench = Lockstep(plant, build_controller(parameters, sketch, control), address)
    bench.advance(round(6.0 / period), ARM)
    n = round((demand.backswing_time + demand.top_time) / period)
    cycles = bench.advance(n, SWING)
    state = bench.state.control[0]
    if state["phase"] not in {Phase.BACKSWING, Phase.TOP} or state["cause"]:
        raise RuntimeError(f"the backswing stopped in phase {state['phase']} by cause {state['cause']}")
    return _Start(
        bench.plant_state.copy(),
        bench.command.copy(),
        cycles["plant_angle"].copy(),
        cycles["plant_velocity"].copy(),
        cycles["applied_valve"].copy(),
        (0, 1, round(demand.backswing_time / period)),
    )


@compiled
def play(robot: Any, plant: Any, impact: Any, state: Any, command: Any, valve: Any, trace: Any, after: float) -> int:
    """Apply openings `valve` (n, 3) tick by tick; return how many ticks were played.

    `trace` (n, 10) gets angles, speeds, openings and the head's height before each tick. Ends early `after`
    seconds past an impact.
    """
    for k in range(len(valve)):
        s = state[0]
        for i in range(3):
            trace[k, i], trace[k, 3 + i], trace[k, 6 + i] = s.angle[i], s.speed[i], valve[k, i]
            command[0].valve[i] = valve[k, i]
        trace[k, 9] = s.head[1]
        advance(robot, plant, impact, state, command)
        if s.struck and s.time > s.impact_time + after:
            return k + 1
    return len(valve)


@dataclass
class _Shooter:
    """Plays openings from one state of the plant, again and again."""

    plant: Plant
    state: NDArray[Any]
    command: NDArray[Any]
    ticks: int
    trace: Array = field(init=False)

    def __post_init__(self) -> None:
        self.trace = np.zeros((self.ticks, 10))
        for name in ("stop_energy", "stop_work", "stop_depth"):
            self.state[name] = 0.0
        self.state["lowest_clearance"] = np.inf
        self.state["peak_pressure"] = self.state["pressure"]
        self.state["peak_head_speed"] = 0.0

    def shoot(self, valve: Array, *, ball: bool, after: float = np.inf) -> tuple[Any, int]:
        """Return the plant's state after `valve` (n, 3), and the ticks played."""
        state, command = self.state.copy(), self.command.copy()
        if not self.state["struck"][0]:
            state["ball_present"] = ball
        played = play(*self.plant.records, state, command, valve, self.trace, after)
        return state[0], played


def _table(knots: Array, first: Array, spacing: float, period: float) -> Array:
    """Return openings per tick: straight lines through `first` and the rows of `knots`."""
    corners = np.vstack([first, knots])
    at = np.arange(round(len(knots) * spacing / period)) * period
    times = np.arange(len(corners)) * spacing
    return np.column_stack([np.interp(at, times, corners[:, i]) for i in range(3)])


def _search(
    cost: Callable[[Array], float], start: Array, spread: float, evaluations: int, seed: int, progress: Progress, what: str
) -> Array:
    """Return the best point an evolution strategy finds from `start` within `evaluations` trials."""
    strategy = cma.CMAEvolutionStrategy(
        start, spread, {"seed": seed, "verbose": -9, "popsize": 24, "bounds": [-1.0, 1.0], "maxfevals": evaluations}
    )
    while not strategy.stop():
        trials = strategy.ask()
        strategy.tell(trials, [cost(trial) for trial in trials])
        progress(what, min(strategy.countevals / evaluations, 1.0))
    return np.asarray(strategy.best.x)


def _excess(value: Any, allowed: Any) -> float:
    return float(np.sum(np.maximum(np.asarray(value) - allowed, 0.0)))


def _design_downswing(
    plant: Plant, demand: Demand, start: _Start, seed: int, evaluations: int, progress: Progress
) -> tuple[Array, int]:
    """Return openings (n, 3) from the top past the ball, and the tick of contact."""
    parameters, period = plant.parameters, plant.parameters.tick
    site, opening = parameters.site, demand.greatest_opening
    shooter = _Shooter(plant, start.plant_state, start.command, round(demand.downswing_knots * demand.knot / period))
    ratings = np.array([[a.stop.energy] for a in parameters.actuators]) * demand.greatest_stop_share
    miss_ratings = ratings * demand.greatest_miss_share / demand.greatest_stop_share
    begin = float(start.plant_state["time"][0])
    last = start.valve[-1]

    def openings(point: Array) -> Array:
        return _table(opening * point.reshape(-1, 3), last, demand.knot, period)

    def cost(point: Array) -> float:
        valve = openings(point)
        state, played = shooter.shoot(valve, ball=True, after=_WATCHED)
        knots = point.reshape(-1, 3)
        total = 0.15 * float(np.sum(np.diff(knots, axis=0) ** 2))
        if not state["struck"]:
            return total + 200 - 0.1 * float(state["peak_head_speed"]) + 10 * min(
                float(np.abs(shooter.trace[:played, 9] - site.ball_y).min()), 1.0
            )  # fmt: skip
        head = state["impact_head"]
        total += 8.0 * abs(float(np.hypot(head[3], head[4])) - demand.head_speed)
        total += 120 * max(abs(head[2] - _SHAFT_DOWN - demand.lean) - 0.01, 0.0)
        total += 120 * max(abs(float(np.arctan2(head[4], head[3])) - demand.slope) - 0.01, 0.0)
        total += 400 * max(abs(head[1] - site.ball_y) - 0.0003, 0.0)
        # Without a ball the head keeps its momentum, and the wrist meets its stop faster.
        contact = int((float(state["impact_time"]) - begin) / period)
        missed, _ = shooter.shoot(valve[: contact + round(_UNTIL_WRIST_STOPS / period)], ball=False)
        total += 0.5 * _excess(state["stop_energy"], ratings) + 0.5 * _excess(missed["stop_energy"], miss_ratings)
        total += 100 * max(0.012 - float(state["lowest_clearance"]), 0.0)
        total += 5e-5 * _excess(state["peak_pressure"], 1.0e6)
        # What the shoulder carries past the ball must be braked before its stop.
        return total + 0.5 * max(abs(float(state["speed"][0])) - 16.0, 0.0)

    guess = np.zeros((demand.downswing_knots, 3))
    guess[:, 0], guess[:, 1], guess[:, 2] = 0.8, 0.6, np.where(np.arange(demand.downswing_knots) < 4, -0.5, 0.7)
    best = _search(cost, guess.ravel(), 0.3, evaluations, seed, progress, "downswing")
    state, _ = shooter.shoot(openings(best), ball=True, after=_WATCHED)
    if not state["struck"]:
        raise RuntimeError("no downswing found that reaches the ball; raise the evaluations or ease the demand")
    return openings(best), int((float(state["impact_time"]) - float(start.plant_state["time"][0])) / period)


def _design_follow_through(
    plant: Plant, demand: Demand, start: _Start, downswing: Array, contact: int, seed: int, evaluations: int,
    progress: Progress,
) -> Array:  # fmt: skip
    """Return openings (n, 3) from the ball to rest that brake the robot with and without a ball."""
    parameters, period = plant.parameters, plant.parameters.tick
    ratings = np.array([[a.stop.energy] for a in parameters.actuators]) * demand.greatest_stop_share
    n = round((demand.follow_knots * demand.knot + demand.settle_time) / period)
    cases = []
    for ball in (True, False):
        lead = _Shooter(plant, start.plant_state.copy(), start.command, contact)
        state, _ = lead.shoot(downswing[:contact], ball=ball)
        at_ball = start.plant_state.copy()
        at_ball[0] = state
        cases.append(_Shooter(plant, at_ball, start.command, n))
    rest = np.zeros((round(demand.settle_time / period), 3))
    shoulder = parameters.shoulder
    first = downswing[contact]

    def openings(point: Array) -> Array:
        return np.vstack([_table(point.reshape(-1, 3), first, demand.knot, period), rest])

    def cost(point: Array) -> float:
        valve, total = openings(point), 0.05 * float(np.sum(np.diff(point.reshape(-1, 3), axis=0) ** 2))
        for shooter, ball in zip(cases, (True, False), strict=True):
            state, _ = shooter.shoot(valve, ball=ball)
            trace = shooter.trace
            total += 0.5 * _excess(state["stop_energy"], ratings)
            total += 30 * max(float(trace[:, 0].max()) - (shoulder.upper - 0.1), 0.0)
            total += 200 * max(0.02 - float(state["lowest_clearance"]), 0.0)
            total += 5e-5 * _excess(state["peak_pressure"], 1.1e6)
            total += 3.0 * float(np.mean(np.abs(trace[-300:, 3:6]))) + 0.2 * float(np.mean(np.abs(trace[120:, 3])))
            total += 2.0 * float(np.abs(trace[-1, 3:6]).sum())
        return total

    guess = np.zeros((demand.follow_knots, 3))
    guess[1:9, 0] = -0.8
    best = _search(cost, guess.ravel(), 0.3, evaluations, seed, progress, "follow-through")
    return openings(best)


def design_swing(
    parameters: PlantParameters,
    demand: Demand,
    name: str,
    *,
    control: ControlSettings | None = None,
    seed: int = 1,
    evaluations: int = 9000,
    progress: Progress = lambda what, part: None,
) -> Profile:
    """Return a profile that meets `demand` on the plant of `parameters`, without blind-brake patterns.

    Raises:
        RuntimeError: the backswing trips the envelope, or no downswing reaches the ball.
    """
    plant = build_plant(parameters)
    period = parameters.tick
    start = _swing_up(plant, demand, control or ControlSettings())
    downswing, contact = _design_downswing(plant, demand, start, seed, evaluations, progress)
    follow = _design_follow_through(plant, demand, start, downswing, contact, seed, evaluations, progress)
    valve = np.vstack([downswing[:contact], follow])
    shooter = _Shooter(plant, start.plant_state.copy(), start.command, len(valve))
    state, _ = shooter.shoot(valve, ball=True)
    top = len(start.angle)
    # The impact window: from two ticks before planned contact until the jump has been followed.
    begins = (*start.begins, top, top + contact - 60, top + contact - 3, top + contact + 12)
    head = state["impact_head"]
    spacing = 10
    n = top + len(valve)
    return Profile(
        name=name,
        text=f"{float(np.hypot(head[3], head[4])):.1f} m/s at the ball, found by shooting on the nominal plant",
        golfer="robot",
        club=parameters.robot.club.name,
        period=period,
        begins=begins,
        angle=np.vstack([start.angle, shooter.trace[:, :3]]),
        velocity=np.vstack([start.velocity, shooter.trace[:, 3:6]]),
        valve=np.vstack([start.valve, valve]),
        blind_spacing=spacing,
        blind_brake=np.zeros(((n - 1) // spacing + 1, 6)),
        ball=(parameters.site.ball_x, parameters.site.ball_y),
        impact_time=top * period + float(state["impact_time"]) - float(start.plant_state["time"][0]),
        delivery={
            "head_speed_mps": float(np.hypot(head[3], head[4])),
            "path_slope_deg": float(np.degrees(np.arctan2(head[4], head[3]))),
            "shaft_lean_deg": float(np.degrees(head[2] - _SHAFT_DOWN)),
            "in_plane_error_mm": 1e3 * float(head[1] - parameters.site.ball_y),
        },
        limits={
            "supply_pressure_pa": parameters.supply.pressure,
            "greatest_opening": demand.greatest_opening,
            "wrist_stop_energy_j": float(state["stop_energy"][2].max()),
            "peak_pressure_pa": float(state["peak_pressure"].max()),
        },
    )


def new_command() -> NDArray[Any]:
    """Return the command of a powered bench with centred spools."""
    command = new_record(COMMAND)
    command["supply_enable"] = command["exhaust_closed"] = command["guard_lock"] = True
    return command
