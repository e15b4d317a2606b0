"""The swing designer: finds a swing that this robot's air can do, by shooting on the plant itself.

Decision variables are valve openings at knots, so that every trial is feasible for the air by
construction; the covariance matrix adaptation evolution strategy (Hansen 2016, package `cma`) needs no
gradients of stops, valves and impact. The profile's reference is the motion that the best openings give on
the nominal plant, and the openings are its feed-forward: on that plant the PIDs have nothing to do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import cma  # type: ignore[import-untyped]
import numpy as np
from numpy.typing import NDArray

from bench.control.settings import ControlSettings, EnvelopeSettings, build_controller
from bench.control.step import SWING
from bench.lifecycle import CAUSE_TEXT, Cause, Phase
from bench.lockstep import Lockstep
from bench.swing.profile import Profile
from sim.compiled import compiled
from sim.kinematics import theta2_from_right_arm
from sim.plant import Plant, PlantParameters, advance, build_plant

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

_SHAFT_DOWN = 3.5 * np.pi  # theta_t with the shaft straight down, in the range the joints have there
_UNTIL_WRIST_STOPS = 0.03
_WATCHED = 0.08  # s after the ball that the downswing's search looks at
_BEFORE_CONTACT, _AFTER_CONTACT = 3, 5  # ticks of the impact window
_SILENCES = (0.02, 0.045)  # s before the ball at which the bench may fall silent
_LEAST_LEVER = 0.25  # |sin beta| the plan keeps to; the envelope trips at 0.15
_BLIND_SPACING = 20
_BLIND_WATCHED = 0.9  # s
_LONGEST_BLIND = 0.4  # s


class DesignFailed(RuntimeError):
    """No swing was found that meets the demand; the text says where the search ended."""


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
    top_cock: float = np.deg2rad(65.0).item()
    knot: float = 0.03
    """Time between valve knots, s."""
    downswing_knots: int = 11
    follow_time: float = 0.7
    """From the ball to the end of the profile, s; braking takes about 0.3 s of it."""
    no_return_time: float = 0.06
    """Before the impact window: later than this the ball is struck whatever is done, s."""


@dataclass(frozen=True)
class _Start:
    """The nominal swing up to the top: where it leaves the plant, and the tables that lead there."""

    plant_state: NDArray[Any]
    command: NDArray[Any]
    opening: Array
    """Openings applied last."""
    integral: Array
    """The controllers' integrals, which go on acting in the downswing."""
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
        "sketch", "", "", "", period, begins, angle, velocity, velocity * gain, 20,
        np.zeros((len(angle) // 20 + 1, 6)), (0.25, -1.560), n * period,
    )  # fmt: skip


def _swing_up(plant: Plant, demand: Demand, control: ControlSettings) -> _Start:
    """Let the controller itself take the plant to the top; what it did is the nominal motion."""
    parameters = plant.parameters
    period = parameters.tick
    address, top = address_pose(parameters, demand), top_pose(parameters, demand)
    sketch = _sketch(demand, period, address, top, np.array(control.move_gain))
    bench = Lockstep(plant, build_controller(parameters, sketch, control), address)
    if not bench.arm():
        raise DesignFailed("the robot does not come to rest at address")
    n = round((demand.backswing_time + demand.top_time) / period)
    cycles = bench.advance(n, SWING)
    state = bench.state.control[0]
    if state["phase"] not in {Phase.BACKSWING, Phase.TOP} or state["cause"]:
        raise DesignFailed(f"the backswing stopped in phase {state['phase']} by cause {state['cause']}")
    return _Start(
        bench.plant_state.copy(),
        bench.command.copy(),
        cycles["applied_valve"][-1].copy(),
        bench.state.pid["integral"][0].copy(),
        sketch.angle[:n],
        sketch.velocity[:n],
        sketch.valve[:n],
        (0, 1, round(demand.backswing_time / period)),
    )


@compiled
def play(
    robot: Any, plant: Any, impact: Any, state: Any, command: Any, valve: Any, trace: Any, after: float
) -> int:
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
    cost: Callable[[Array], float],
    start: Array,
    spread: float,
    evaluations: int,
    seed: int,
    progress: Progress,
    what: str,
) -> Array:
    """Return the best point an evolution strategy finds from `start` within `evaluations` trials."""
    strategy = cma.CMAEvolutionStrategy(
        start,
        spread,
        {"seed": seed, "verbose": -9, "popsize": 24, "bounds": [-1.0, 1.0], "maxfevals": evaluations},
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
    shooter = _Shooter(
        plant, start.plant_state, start.command, round(demand.downswing_knots * demand.knot / period)
    )
    ratings = np.array([[a.stop.energy] for a in parameters.actuators]) * demand.greatest_stop_share
    miss_ratings = ratings * demand.greatest_miss_share / demand.greatest_stop_share
    begin = float(start.plant_state["time"][0])
    least_wrist = 1.5 * np.pi + np.arcsin(_LEAST_LEVER)
    last = start.opening

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
        total += 2000 * max(least_wrist - float(shooter.trace[:played, 2].min()), 0.0)
        total += 8.0 * abs(float(np.hypot(head[3], head[4])) - demand.head_speed)
        total += 120 * max(abs(head[2] - _SHAFT_DOWN - demand.lean) - 0.01, 0.0)
        total += 400 * max(abs(float(np.arctan2(head[4], head[3])) - demand.slope) - 0.008, 0.0)
        total += 400 * max(abs(head[1] - site.ball_y) - 0.0003, 0.0)
        # Without a ball the head keeps its momentum, and the wrist meets its stop faster.
        contact = int((float(state["impact_time"]) - begin) / period)
        until = contact + round(_UNTIL_WRIST_STOPS / period)
        missed, _ = shooter.shoot(valve[:until], ball=False)
        total += 0.5 * _excess(state["stop_energy"], ratings) + 0.5 * _excess(
            missed["stop_energy"], miss_ratings
        )
        for silence in _SILENCES:
            silent = valve[:until].copy()
            silent[max(contact - round(silence / period), 0) :] = 0.0
            left, _ = shooter.shoot(silent, ball=False)
            total += 0.5 * _excess(left["stop_energy"], miss_ratings)
        total += 100 * max(0.012 - float(state["lowest_clearance"]), 0.0)
        total += 5e-5 * _excess(state["peak_pressure"], 1.0e6)
        # What the shoulder carries past the ball must be braked before its stop.
        return float(total + 0.5 * max(abs(float(state["speed"][0])) - 16.0, 0.0))

    guess = np.zeros((demand.downswing_knots, 3))
    guess[:, 0], guess[:, 1], guess[:, 2] = (
        0.8,
        0.6,
        np.where(np.arange(demand.downswing_knots) < 4, -0.1, 0.6),
    )
    # Wide first, then narrow from the best: the second search settles what the first only traded off.
    best = _search(cost, guess.ravel(), 0.3, evaluations * 3 // 5, seed, progress, "downswing")
    best = min(
        (best, _search(cost, best, 0.05, evaluations * 2 // 5, seed, progress, "downswing, refined")),
        key=cost,
    )
    state, _ = shooter.shoot(openings(best), ball=True, after=_WATCHED)
    if not state["struck"]:
        raise DesignFailed(
            "no downswing found that reaches the ball; raise the evaluations or ease the demand"
        )
    return openings(best), int((float(state["impact_time"]) - float(start.plant_state["time"][0])) / period)


def _assemble(
    plant: Plant, demand: Demand, start: _Start, downswing: Array, contact: int, name: str
) -> Profile:
    """Return the profile up to the ball, with the robot left where it is for the follow-through."""
    parameters, period = plant.parameters, plant.parameters.tick
    shooter = _Shooter(plant, start.plant_state.copy(), start.command, contact + _AFTER_CONTACT)
    state, _ = shooter.shoot(downswing[: contact + _AFTER_CONTACT], ball=True)
    head, top = state["impact_head"], len(start.angle)
    follow = round(demand.follow_time / period)
    angle = np.vstack([start.angle, shooter.trace[:, :3], np.tile(state["angle"], (follow, 1))])
    begins = (*start.begins, top, 0, top + contact - _BEFORE_CONTACT, top + contact + _AFTER_CONTACT)
    return Profile(
        name=name,
        text=f"{float(np.hypot(head[3], head[4])):.1f} m/s at the ball, found by shooting on the plant",
        golfer="robot",
        club=parameters.robot.club.name,
        period=period,
        begins=(*begins[:4], begins[5] - round(demand.no_return_time / period), *begins[5:]),
        angle=angle,
        velocity=np.vstack([start.velocity, shooter.trace[:, 3:6], np.zeros((follow, 3))]),
        valve=np.vstack([start.valve, shooter.trace[:, 6:9] - start.integral, np.zeros((follow, 3))]),
        blind_spacing=_BLIND_SPACING,
        blind_brake=np.zeros(((len(angle) - 1) // _BLIND_SPACING + 1, 6)),
        ball=(parameters.site.ball_x, parameters.site.ball_y),
        impact_time=top * period + float(state["impact_time"]) - float(start.plant_state["time"][0]),
        delivery=_delivery(head, parameters.site.ball_y),
        limits={
            "supply_pressure_pa": parameters.supply.pressure,
            "greatest_opening": demand.greatest_opening,
        },
    )


class _Rehearsal:
    """The profile under closed loop on the nominal plant, from vented to the end of the follow-through."""

    def __init__(self, plant: Plant, profile: Profile, control: ControlSettings, *, ball: bool) -> None:
        free = EnvelopeSettings(following={})  # the follow-through's reference is what is being found
        self.bench = Lockstep(
            plant, build_controller(plant.parameters, profile, control, free), profile.angle[0]
        )
        if not self.bench.arm():
            raise DesignFailed("the robot does not come to rest at address")
        self.bench.state.control["tee"] = ball
        self.first = True

    def advance(self, ticks: int) -> NDArray[Any]:
        """Return the CYCLE records of the next `ticks` ticks of the swing."""
        cycles = self.bench.advance(ticks, SWING if self.first else 0)
        self.first = False
        cause = Cause(int(self.bench.state.control["cause"][0]))
        if cause:
            raise DesignFailed(f"the rehearsal stopped: {CAUSE_TEXT[cause]}")
        return cycles


def _with_follow_through(plant: Plant, profile: Profile, control: ControlSettings) -> Profile:
    """Return `profile` with the follow-through that the braking law gives, and the delivery it truly has."""
    rehearsal = _Rehearsal(plant, profile, control, ball=True)
    cycles = rehearsal.advance(len(profile.angle))
    angle, velocity, valve = profile.angle.copy(), profile.velocity.copy(), profile.valve.copy()
    follow = profile.begins[-1]
    angle[follow:], velocity[follow:] = cycles["plant_angle"][follow:], cycles["plant_velocity"][follow:]
    valve[follow:] = cycles["applied_valve"][follow:]
    state, site = rehearsal.bench.plant_state[0], plant.parameters.site
    if not state["struck"]:
        raise DesignFailed("under closed loop the head misses the ball; design with another seed")
    return replace(
        profile,
        angle=angle,
        velocity=velocity,
        valve=valve,
        impact_time=float(state["impact_time"]) - (float(state["time"]) - len(angle) * profile.period),
        delivery=_delivery(state["impact_head"], site.ball_y),
        limits=profile.limits | {
            "stop_share": float(
                np.max(state["stop_energy"] / np.array([[a.stop.energy] for a in plant.parameters.actuators]))
            ),
            "peak_pressure_pa": float(state["peak_pressure"].max()),
        },
    )  # fmt: skip


def _delivery(head: Any, ball_y: float) -> dict[str, float]:
    return {
        "head_speed_mps": float(np.hypot(head[3], head[4])),
        "path_slope_deg": float(np.degrees(np.arctan2(head[4], head[3]))),
        "shaft_lean_deg": float(np.degrees(head[2] - _SHAFT_DOWN)),
        "in_plane_error_mm": 1e3 * float(head[1] - ball_y),
    }


@compiled
def play_blind(
    robot: Any, plant: Any, impact: Any, state: Any, command: Any, pattern: Any, ticks: int
) -> tuple[float, float, float]:
    """Apply a blind-brake `pattern` (6,): openings, durations (s); then spools centred.

    Returns lowest and highest theta1 (rad) and the mean speed over the last fifth (rad/s).
    """
    period = plant[0].tick
    lowest, highest, speed, counted = 1e9, -1e9, 0.0, 0
    for k in range(ticks):
        s = state[0]
        for i in range(3):
            command[0].valve[i] = pattern[i] if k * period < pattern[3 + i] else 0.0
        advance(robot, plant, impact, state, command)
        lowest, highest = min(lowest, s.angle[0]), max(highest, s.angle[0])
        if k >= ticks - ticks // 5:
            speed += abs(s.speed[0]) + abs(s.speed[1]) + abs(s.speed[2])
            counted += 1
    return lowest, highest, speed / max(counted, 1)


def _design_blind_brake(
    plant: Plant, profile: Profile, control: ControlSettings, seed: int, evaluations: int, progress: Progress
) -> Array:
    """Return a blind-brake pattern for each instant, found from the nominal states there."""
    parameters, spacing = plant.parameters, profile.blind_spacing
    ratings = np.array([[a.stop.energy] for a in parameters.actuators])
    shoulder = parameters.shoulder
    ticks = round(_BLIND_WATCHED / profile.period)
    rehearsals = [_Rehearsal(plant, profile, control, ball=ball) for ball in (True, False)]
    patterns = np.zeros((len(profile.blind_brake), 6))
    guess = np.array([0.0, 0.0, 0.0, 0.3, 0.3, 0.3])
    for row in range(len(patterns)):
        states = []
        for rehearsal in rehearsals:
            state = rehearsal.bench.plant_state.copy()
            state["stop_energy"] = state["stop_work"] = 0.0
            state["lowest_clearance"] = np.inf
            states.append((state, rehearsal.bench.command.copy()))
            rehearsal.advance(min(spacing, len(profile.angle) - row * spacing))
        past_contact = row * spacing * profile.period > profile.impact_time - 0.01
        considered = states if past_contact else states[1:]

        def cost(point: Array, considered: list[Any] = considered) -> float:
            pattern = np.concatenate(
                [np.clip(point[:3], -1, 1), _LONGEST_BLIND * np.clip(np.abs(point[3:]), 0, 1)]
            )
            total = 0.02 * float(np.sum(np.abs(point)))
            for state, command in considered:
                trial, applied = state.copy(), command.copy()
                low, high, speed = play_blind(*plant.records, trial, applied, pattern, ticks)
                total += 40 * _excess(trial["stop_energy"][0] / ratings, 0.5)
                total += 10 * max(high - shoulder.upper, 0.0) + 10 * max(shoulder.lower - low, 0.0)
                total += 5e-5 * _excess(trial["peak_pressure"], 1.1e6) + 0.5 * speed
                total += 50 * max(-float(trial["lowest_clearance"][0]), 0.0)
            return total

        best = _search(cost, guess, 0.4, evaluations, seed, lambda what, part: None, "")
        best = min((best, np.zeros(6)), key=cost)
        patterns[row] = [*np.clip(best[:3], -1, 1), *(_LONGEST_BLIND * np.clip(np.abs(best[3:]), 0, 1))]
        guess = np.clip(best, -0.95, 0.95)
        progress("blind brakes", (row + 1) / len(patterns))
    return patterns


def design_swing(
    parameters: PlantParameters,
    demand: Demand,
    name: str,
    *,
    control: ControlSettings | None = None,
    seed: int = 1,
    evaluations: int = 9000,
    blind_evaluations: int = 160,
    progress: Progress = lambda what, part: None,
) -> Profile:
    """Return a profile that meets `demand` on the plant of `parameters`.

    Raises:
        DesignFailed: the backswing trips the envelope, or no downswing reaches the ball.
    """
    plant = build_plant(parameters)
    control = control or ControlSettings()
    start = _swing_up(plant, demand, control)
    downswing, contact = _design_downswing(plant, demand, start, seed, evaluations, progress)
    profile = _assemble(plant, demand, start, downswing, contact, name)
    profile = _with_follow_through(plant, profile, control)
    return replace(
        profile, blind_brake=_design_blind_brake(plant, profile, control, seed, blind_evaluations, progress)
    )
