"""The swing designer: optimal control on a model of arms and air, then refinement on the plant itself.

1. The chamber pressures at the address are planned. Simulating the nominal plant in closed loop from there
   to the top gives the initial state of the downswing.
2. `optimal_control` plans the downswing by direct collocation within the machine's limits.
3. `refine` corrects its valve commands on the plant until the head passes the ball as planned. The absorber
   loads (ball struck, missed, or loss of communication) correct the energies that the plan may bring them;
   repeat from 2.
4. `with_follow_through` makes references and feed-forward for the same downswing in closed loop, and the
   braking law finds the follow-through; `_blind_brake` finds the patterns to stop it without encoders.
5. `validate` must find the profile possible on this machine, as `golfbench check` does.

The same input gives the same profile. A demand that cannot be met is refused with the reason.
"""

from __future__ import annotations

from cmath import exp, phase
from collections.abc import Callable
from dataclasses import replace
from math import acos, asin, atan2, degrees, inf, pi, radians, sin
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.config import Configuration
from bench.control.law.gain_table import MOVE, gains_along
from bench.control.moves.pressure_plan import with_planned_air
from bench.control.settings import EnvelopeSettings, pid_record
from bench.design._blind_brake import SPACING, design_blind_brake
from bench.design._refine import (
    AFTER_CONTACT,
    NEAR,
    SHAFT_DOWN,
    UNITS,
    Backswing,
    LoopFailed,
    NotReached,
    Shooter,
    ShootingTrial,
    arrival_errors,
    imprint,
    learned_backswing,
    refine,
    with_follow_through,
)
from bench.design.optimal_control import (
    BAR,
    NO_CONCESSIONS,
    STATES,
    Concessions,
    DownswingPlan,
    DownswingProblem,
    SwingDemand,
    load_casadi,
    solve_downswing,
)
from bench.design.static_checks import profile_faults
from bench.simulation.safety import stop_shares
from bench.simulation.simulated_bench import Bench
from bench.swing.profile import Profile, as_written
from sim.impact import in_plane_error
from sim.kinematics import head_motion, inverse_kinematics, theta2_from_right_arm
from sim.plant import PlantParameters, build_plant

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

BEFORE_CONTACT = 3
"""Ticks of the impact window before the planned contact."""
_SILENCES = (0.01, 0.02, 0.03, 0.045, 0.06)
"""Times of loss of communication before the ball (s)."""
_INTERVALS = 40
"""Collocation intervals of the downswing."""
_CORRECTED = 0.02, 0.06
"""Fractions of the valves' range that designed and given motions leave to the learned correction."""
_GIVES_WAY = Concessions(time=0.1, rise=np.deg2rad(3.0).item(), speed=12.0)
"""Max concessions of a nearest swing: fraction of the longest downswing, rad of attack angle, m/s."""
_SHORT = 0.2
"""Shortfall or gain in speed below which the search for a nearest swing ends, m/s."""
_SAG, _TURN_BACK = 0.05, 1.0
"""Max turn back of a golfer's shoulder from the top while the air builds up, rad and rad/s."""
_ROUNDS = 7
"""Max plans of a downswing."""
_AIMED = 5
"""Max corrections of the aim in closed loop."""
_ADDRESS = (-0.050, 0.022)
"""Place of the face from a ball on turf at the address, m: where the driver's stands from its ball. Its way
back passes neither ball nor turf."""
_SHORT_OF_STOP = 0.020
"""Rod at the address from its upper stop, m."""
_COCKED, _OFF_THE_STOP = radians(65.0), radians(15.0)
"""Wrist at the top from its straight stop, with a lever square to the shaft, and from its other stop, rad."""
_UPRIGHT, _LEADING = 0.026, 0.175
"""Max lean either way of a shaft at a ball on a tee, and with leading hands at one on turf, rad."""
_BROUGHT = (1.2, 0.65)
"""Initial fractions of the absorbers' rated energies that right arm and wrist may bring: the wrist's absorber
also takes the energy that the arm's absorber passes on."""


class DesignFailed(RuntimeError):
    """No swing meets the demand; the text gives the reason."""


class Downswing(NamedTuple):
    """Valve commands found on the plant, and their wanted arrival."""

    opening: Array
    """(n, 3), one row a tick."""
    wanted: Array
    """Arrival at the ball as in `bench.design._refine.arrival_errors`."""
    plan: DownswingPlan
    trial: ShootingTrial


def slope_of(attack: float, lie: float) -> float:
    """Return the in-plane slope (rad) of a path with `attack` (rad) in a plane at `lie` (rad) to the ground.

    Raises:
        ValueError: the plane contains no path that steep.
    """
    if abs(attack) >= lie:
        raise ValueError(f"attack {attack:.3g} rad, steeper than the swing plane's {lie:.3g} rad")
    return asin(sin(attack) / sin(lie))


def address_pose(parameters: PlantParameters, demand: SwingDemand) -> Array:
    """Return the joint angles at address (rad)."""
    robot, wrist = parameters.robot, parameters.wrist.upper - demand.address_cock
    if parameters.site.surface != "none":
        return _behind_the_ball(parameters, wrist)
    extension = parameters.right_arm.upper - _SHORT_OF_STOP
    theta2 = float(theta2_from_right_arm(robot, robot.l56 + extension))
    return np.array([demand.address_shoulder, theta2, wrist])


def _behind_the_ball(parameters: PlantParameters, wrist: float) -> Array:
    """Return the angles (rad), with the `wrist` given, whose head stands `_ADDRESS` from the ball.

    Raises:
        DesignFailed: the arms do not reach there.
    """
    robot, site = parameters.robot, parameters.site
    place = complex(site.ball_x + _ADDRESS[0], site.ball_y + _ADDRESS[1])
    below_elbow = robot.l23 + robot.club.length_to_face * exp(1j * wrist)
    cosine = (abs(place) ** 2 - robot.l12**2 - abs(below_elbow) ** 2) / (2 * robot.l12 * abs(below_elbow))
    if abs(cosine) >= 1.0:
        raise DesignFailed("at the address: the arms do not reach the ball")
    for bend in (-acos(cosine), acos(cosine)):
        theta2 = (bend - phase(below_elbow)) % (2 * pi)
        if pi < theta2 < 1.5 * pi:
            shoulder = phase(place / (robot.l12 + below_elbow * exp(1j * theta2)))
            return np.array([shoulder, theta2, wrist])
    raise DesignFailed("at the address: the right arm does not reach the ball")


def furthest_cock(parameters: PlantParameters) -> float:
    """Return how far (rad) the wrist is cocked at the top: its lever still turns it, and its stop is away."""
    wrist = parameters.wrist
    further = min(parameters.wrist_lever_angle, wrist.upper - wrist.lower - _COCKED - _OFF_THE_STOP)
    return _COCKED + max(further, 0.0)


def top_pose(parameters: PlantParameters, demand: SwingDemand) -> Array:
    """Return the joint angles at the top of the backswing (rad)."""
    robot = parameters.robot
    cock = furthest_cock(parameters) if demand.top_cock is None else demand.top_cock
    theta2 = float(theta2_from_right_arm(robot, robot.l56 + demand.top_extension))
    return np.array([demand.top_shoulder, theta2, parameters.wrist.upper - cock])


def _sketch(
    demand: SwingDemand,
    parameters: PlantParameters,
    address: Array,
    top: Array,
    pid: NDArray[Any] | None = None,
) -> Profile:
    """Return a provisional profile: smooth reference from address to top, then hold.

    With the PIDs' record `pid` its valve commands move the joints at the reference's speed.
    """
    period, site = parameters.tick, parameters.site
    n, hold = round(demand.backswing_time / period), round((demand.top_time + 0.5) / period)
    part = (np.arange(n) / n)[:, None]
    shape = part**3 * (10 - 15 * part + 6 * part**2)
    slope = 30 * part**2 * (1 - part) ** 2 / demand.backswing_time
    angle = np.vstack([address + (top - address) * shape, np.tile(top, (hold, 1))])
    velocity = np.vstack([(top - address) * slope, np.zeros((hold, 3))])
    begins = (0, 1, n, n + hold - 4, n + hold - 3, n + hold - 2, n + hold - 1)
    gain = np.zeros(3) if pid is None else gains_along(pid, angle)[:, MOVE]
    blind, ball = np.zeros((len(angle) // SPACING + 1, 6)), (site.ball_x, site.ball_y)
    tables = angle, velocity, velocity * gain, SPACING, blind
    return Profile("sketch", "", "", "", period, begins, *tables, ball, n * period)


def _first_guess(parameters: PlantParameters, state: Array, demand: SwingDemand) -> tuple[float, Array]:
    """Return time and states of a downswing that speeds up evenly from the top to the ball."""
    site, time = parameters.site, sum(demand.downswing_time) / 2
    ball = inverse_kinematics(parameters.robot, (site.ball_x, site.ball_y, SHAFT_DOWN))
    part = np.linspace(0.0, 1.0, _INTERVALS + 1)[:, None]
    guess = np.tile(state, (_INTERVALS + 1, 1))
    guess[:, :3] += part**2 * (ball - state[:3])
    guess[:, 3:6] = 2 * part * (ball - state[:3]) / time
    guess[:, 13:] = 0.3
    return time, guess


def downswing_rows(profile: Profile, table: Array, count: int) -> Array:
    """Return rows (count, 3) of a `table` (n, 3) of `profile`, evenly spaced from its top to the ball."""
    at = np.linspace(profile.begins[3], profile.impact_time / profile.period, count)
    return np.column_stack([np.interp(at, np.arange(len(table)), column) for column in table.T])


def _guess_from(start: Profile, state: Array, intervals: int = _INTERVALS) -> tuple[float, Array]:
    """Return time and states of the downswing of another profile."""
    guess = np.tile(state, (intervals + 1, 1))
    for first, table in ((0, start.angle), (3, start.velocity), (13, start.valve)):
        guess[:, first : first + 3] = downswing_rows(start, table, intervals + 1)
    return start.downswing_time, guess


def _problem(
    parameters: PlantParameters, demand: SwingDemand, envelope: EnvelopeSettings, state: Array
) -> DownswingProblem:
    wrist, robot, period = wrist_range(parameters, demand), parameters.robot, parameters.tick
    if state[2] < wrist[0] - 0.01:  # less far off a plan may still begin
        comes, held = degrees(state[2]), degrees(wrist[0])
        raise DesignFailed(f"the wrist comes to {comes:.1f} deg at the top; its lever holds from {held:.1f}")
    least = -_UPRIGHT if parameters.site.surface == "none" else -_LEADING
    low, high = (least, _UPRIGHT) if demand.lean is None else (demand.lean, demand.lean)
    shoulder, back = parameters.shoulder.lower, 0.96 * envelope.max_speed[0]
    if demand.follow is not None:
        # A golfer does not swing back again from the top; friction and air may hold the plant short of it.
        shoulder, back = min(demand.top_shoulder, float(state[0])) - _SAG, _TURN_BACK
    return DownswingProblem(
        demand,
        envelope,
        start=state,
        slope=slope_of(demand.attack, robot.lie),
        theta_t=(SHAFT_DOWN + low, SHAFT_DOWN + high),
        opening=1.0 - demand.margin - _CORRECTED[demand.follow is not None],
        shoulder=shoulder,
        shoulder_back=back,
        committed=demand.no_return_time + BEFORE_CONTACT * period,
        wrist=wrist,
        cushions=(_BROUGHT[0] * parameters.right_arm.stop.energy, _BROUGHT[1] * parameters.wrist.stop.energy),
        concessions=_concessions(parameters, demand) if demand.nearest else NO_CONCESSIONS,
    )


def wrist_range(parameters: PlantParameters, demand: SwingDemand) -> tuple[float, float]:
    """Return the range of theta3 (rad) in which the wrist's lever has the demanded fraction of its length."""
    dead, mounted = asin(demand.least_lever), parameters.wrist_lever_angle
    lowest, highest = 1.5 * pi + dead - mounted, 2.5 * pi - dead - mounted
    return max(parameters.wrist.lower, lowest), min(parameters.wrist.upper, highest)


def _concessions(parameters: PlantParameters, demand: SwingDemand) -> Concessions:
    lie, longest = parameters.robot.lie, demand.downswing_time[1]
    rise = slope_of(demand.attack + _GIVES_WAY.rise, lie) - slope_of(demand.attack, lie)
    return Concessions(_GIVES_WAY.time * longest, rise, _GIVES_WAY.speed)


def _delivered(state: NDArray[Any], parameters: PlantParameters) -> Array:
    """Return the arrival of the head in the plant `state` after a struck ball, as `arrival_errors` has it."""
    head, site, impact = state["impact_head"][0], parameters.site, build_plant(parameters).impact
    error = in_plane_error(head[0], head[1], head[2], site.ball_x, site.ball_y, impact)
    return np.array([error, *head[2:6]])


def _said(status: str) -> str:
    return status.lower().replace("_", " ")


def _out_of_reach(
    parameters: PlantParameters,
    problem: DownswingProblem,
    begin: tuple[float, Array],
    status: str,
) -> str:
    """Return why no plan meets `problem`, with the nearest plan and the limits that bind it.

    `begin` is the duration (s) and the states of the guess, `status` that of the attempt.
    """
    demand = problem.demand
    shortest, longest = demand.downswing_time
    speed = "" if demand.head_speed is None else f" to {demand.head_speed:.1f} m/s"
    reason = f"no downswing of {shortest:.3f} to {longest:.3f} s{speed} within the limits ({_said(status)})"
    if demand.nearest:
        return reason
    freed = replace(problem, concessions=_concessions(parameters, demand))
    plan = solve_downswing(parameters, freed, *begin, _INTERVALS)
    if not plan.solved:
        return reason
    binding = " and ".join(list(plan.binding)[:2])
    bound = f", bound by {binding}" if binding else ""
    return f"{reason}; the nearest takes {plan.time[-1]:.3f} s to {plan.speed:.1f} m/s{bound}"


class _Cushions(NamedTuple):
    """Pairs (energy brought by the plan, excess on the plant) that held and that broke, each (2, 2), J."""

    held: Array
    broke: Array

    def learned(self, brought: Array, over: Array) -> _Cushions:
        """Return this with energies `brought` (2,) by a plan and their excess `over` (2,) on the plant, J."""
        pair, broke = np.column_stack([brought, over]), (over > 0.0)[:, None]
        return _Cushions(np.where(broke, self.held, pair), np.where(broke, pair, self.broke))

    def next(self, brought: Array, over: Array) -> Array:
        """Return the energies (2,) that the next plan may bring to the absorbers (J).

        `brought` are the energies in the latest plan, `over` their excess over the limits on the plant (J).
        """
        # The excess of one cushion must come from the other one or the shoulder.
        step = brought - np.where(over > 0, over + 0.3, np.maximum(over, -6.0) / 2)
        low, high = self.held[:, 0], self.broke[:, 0]
        known = (self.held.any(axis=1)) & (self.broke.any(axis=1)) & (low < high)
        share = -self.held[:, 1] / np.where(known, self.broke[:, 1] - self.held[:, 1], 1.0)
        return np.where(known, low + np.clip(share, 0.1, 0.9) * (high - low), step)


def _with_cushions(problem: DownswingProblem, energies: Array) -> DownswingProblem:
    return replace(problem, cushions=(max(float(energies[0]), 1.0), max(float(energies[1]), 1.0)))


class SwingDesigner:
    """Steps of the design of one swing, from the state of the plant at the top of its backswing."""

    def __init__(
        self, bench: Bench, demand: SwingDemand, progress: Progress = lambda what, part: None
    ) -> None:
        """Take the plant of `bench` to the top; DesignFailed if it does not come there."""
        self.bench, self.demand, self.progress = bench, demand, progress
        self.plant, self.highest = bench.plant, 1.0 - demand.margin
        self.pid = pid_record(bench.control, bench.estimator, bench.plant)
        self.begun = self._swing_up()
        top = self.begun.rehearsal.bench
        self.shooter = Shooter(
            build_plant(bench.plant), top.plant_state, top.command, bench.control, _SILENCES
        )
        self.problem = _problem(bench.plant, demand, bench.envelope, _model_state(self.begun))

    def _swing_up(self) -> Backswing:
        """Let the controller take the plant to the top; the result is the nominal motion."""
        plant, demand = self.plant, self.demand
        sketch = _sketch(demand, plant, address_pose(plant, demand), top_pose(plant, demand), self.pid)
        try:
            sketch = with_planned_air(sketch, plant)
        except ValueError as error:
            raise DesignFailed(f"at the address: {error}") from None
        n = round((demand.backswing_time + demand.top_time) / plant.tick)
        try:
            return learned_backswing(replace(self.bench, profile=sketch), self.pid, n, self.highest)
        except LoopFailed as failure:
            raise DesignFailed(f"on the way to the top: {failure}") from None

    def _openings(self, plan: DownswingPlan) -> Array:
        """Return valve commands per tick, until after the ball, with which the plant stays near the plan.

        They are the planned commands, advanced by the spool lag, plus the feedback of the control loop.
        """
        valve, period = self.plant.shoulder.valve, self.plant.tick
        lag = 2 * valve.damping_ratio / valve.natural_frequency
        at = np.arange(round(plan.time[-1] / period) + 40) * period

        def rows(first: int, ahead: float = 0.0) -> Array:
            return np.column_stack(
                [np.interp(at + ahead, plan.time, plan.state[:, first + i]) for i in range(3)]
            )

        # Past the ball the plan ends, the motion does not.
        angle = rows(0) + np.maximum(at - plan.time[-1], 0.0)[:, None] * plan.state[-1, 3:6]
        valve_command = rows(13, lag) + self.plant.valve_centres
        return self.shooter.follow(valve_command, angle, rows(3), gains_along(self.pid, angle), self.highest)

    def _loads(self, trial: ShootingTrial) -> Array:
        """Return the excess energies of the upper absorbers of right arm and wrist over their limits (J)."""
        ratings = np.array([a.stop.energy for a in self.plant.actuators])
        worst = np.maximum(trial.missed_energy, trial.silent_energy.max(axis=0))[:, 1]
        struck = trial.struck_energy[:, 1] - self.demand.struck_share * ratings
        return np.asarray(np.maximum(worst - self.demand.missed_share * ratings, struck)[1:])

    def _initial_guess(self, problem: DownswingProblem, start: Profile | None) -> tuple[float, Array]:
        """Return time and states of a downswing to start from: that of `start`, or the fastest one."""
        if start is not None:
            return _guess_from(start, problem.start)
        time, guess = _first_guess(self.plant, problem.start, self.demand)
        # The fastest swing is found most reliably; a demanded speed is then found from it.
        self.progress("a first swing", 0.0)
        fastest = replace(problem, demand=replace(self.demand, head_speed=None, follow=None))
        plan = solve_downswing(self.plant, fastest, time, guess, _INTERVALS)
        self.progress("a first swing", 1.0)
        return float(plan.time[-1]), plan.state

    def downswing(self, start: Profile | None) -> Downswing:
        """Return a downswing whose valve commands meet the demand on the plant; begins with `start`.

        Raises:
            DesignFailed: no plan that the plant can follow within the ratings of its absorbers.
        """
        plant, demand, shooter, problem = self.plant, self.demand, self.shooter, self.problem
        time, guess = self._initial_guess(problem, start)
        best: tuple[tuple[float, float], Downswing] | None = None
        tried = _Cushions(np.zeros((2, 2)), np.zeros((2, 2)))
        brought: Array | None = None
        reason = ""
        for count in range(_ROUNDS):
            self.progress("downswing", count / _ROUNDS)
            plan = solve_downswing(plant, problem, time, guess, _INTERVALS)
            if not plan.solved:
                if brought is None:
                    reason = reason or _out_of_reach(plant, problem, (time, guess), plan.status)
                    break
                reason = reason or f"no downswing within the limits ({_said(plan.status)})"
                # The limits were too tight: half way back to the last possible ones.
                problem = _with_cushions(problem, (brought + np.array(problem.cushions)) / 2)
                continue
            time, guess = float(plan.time[-1]), plan.state
            head = head_motion(plant.robot.record[0], *plan.state[-1, :6])
            wanted = np.array([demand.strike, *head[2:6]])  # as planned, at the demanded strike point
            try:
                opening = refine(shooter, self._openings(plan), wanted, self.highest)
            except NotReached as missed:
                reason = str(missed)
                break
            trial = shooter.shoot(opening)
            over = self._loads(trial)
            short = 0.0 if demand.head_speed is None else demand.head_speed - plan.speed
            worth = max(float(over.max()), 0.0), short
            gained = inf if best is None or best[0][0] > 0.0 else best[0][1] - short
            if best is None or worth < best[0]:
                best = worth, Downswing(opening, wanted, plan, trial)
            if over.max() <= 0.0 and min(short, gained) < _SHORT:
                break
            reason = (
                f"the absorber energies of right arm and wrist would be {over[0]:+.1f} and {over[1]:+.1f} J "
                "above their limits when the ball is missed"
            )
            brought = np.minimum(problem.cushions, plan.carried)
            tried = tried.learned(brought, over)
            problem = _with_cushions(problem, tried.next(brought, over))
        self.progress("downswing", 1.0)
        rated = min(plant.right_arm.stop.energy, plant.wrist.stop.energy)
        survived = (1.0 - demand.missed_share) * rated
        if best is None or best[0][0] > survived:
            raise DesignFailed(reason or "no downswing found")
        return best[1]

    def _assemble(self, downswing: Downswing) -> Profile:
        """Return the profile with the robot left where it is at the ball for the follow-through."""
        up, top, trial, period = self.begun.profile, len(self.begun.cycles), downswing.trial, self.plant.tick
        demand = self.demand
        contact, past = trial.contact, round(demand.follow_time / period) + AFTER_CONTACT
        angle = np.vstack([up.angle[:top], trial.angle[:contact], np.tile(trial.angle[contact], (past, 1))])
        window = top + contact - BEFORE_CONTACT
        committed, end = window - round(demand.no_return_time / period), top + contact + AFTER_CONTACT
        still = np.zeros((past, 3))
        return replace(
            up,
            name=self.bench.profile.name,
            golfer=self.bench.profile.golfer,
            club=self.plant.robot.club.name,
            begins=(*up.begins[:3], top, committed, window, end),
            angle=angle,
            # At rest in the first row: the tick before the downswing must not depend on it.
            velocity=np.vstack([up.velocity[:top], np.zeros(3), trial.speed[1:contact], still]),
            valve=np.vstack([up.valve[:top], downswing.opening[:contact], still]),
            blind_brake=np.zeros(((len(angle) - 1) // SPACING + 1, 6)),
            impact_time=(top + contact) * period,
        )

    def _with_figures(
        self, profile: Profile, state: NDArray[Any], delivered: Array, trial: ShootingTrial
    ) -> Profile:
        """Return `profile` with the delivery in closed loop, `delivered`, and the limits it was made for."""
        error, lean, *velocity = delivered[:4]
        speed, slope, lie = float(np.hypot(*velocity)), atan2(velocity[1], velocity[0]), self.plant.robot.lie
        return replace(
            profile,
            text=f"{speed:.1f} m/s at the ball in closed loop, designed for this plant",
            delivery={
                "head_speed_mps": speed,
                "attack_angle_deg": degrees(asin(sin(slope) * sin(lie))),
                "path_slope_deg": degrees(slope),
                "shaft_lean_deg": float(np.degrees(lean - SHAFT_DOWN)),
                "in_plane_error_mm": 1e3 * float(error),
            },
            limits={
                "supply_pressure_pa": self.plant.supply.pressure,
                "greatest_opening": self.highest,
                "stop_share": float(stop_shares(state["stop_energy"][0], self.plant).max()),
                "stop_share_missed": float(stop_shares(trial.missed_energy, self.plant).max()),
                "stop_share_silent": float(stop_shares(trial.silent_energy, self.plant).max()),
                "peak_pressure_pa": float(state["peak_pressure"].max()),
            },
        )

    def into_the_loop(self, downswing: Downswing) -> Profile:
        """Return the profile whose swing in closed loop delivers as `downswing` should.

        The aim is corrected by the loop's effect, until the head passes the ball as wanted. The effect is the
        delivery in closed loop less that of the same valve commands in open loop. So the correction's
        remaining error cancels.

        Raises:
            LoopFailed: the swing does not run, or misses the ball.
        """
        bench, shooter, best = self.bench, self.shooter, None
        for count in range(_AIMED):
            self.progress("closed loop", count / _AIMED)
            profile = self._assemble(downswing)
            opening = downswing.opening[: downswing.trial.contact + AFTER_CONTACT]
            profile = imprint(replace(bench, profile=profile), opening)
            profile = as_written(with_follow_through(replace(bench, profile=profile))[0])
            _, state = with_follow_through(replace(bench, profile=profile))
            delivered = _delivered(state, self.plant)
            off = float(np.abs((delivered - downswing.wanted) / UNITS)[:4].max())
            if best is None or off < best[0]:
                best = off, self._with_figures(profile, state, delivered, downswing.trial)
            if off < 1.0:
                break
            alone = arrival_errors(shooter.arrive(downswing.opening), downswing.wanted)
            aim = downswing.wanted - (delivered - downswing.wanted - alone)
            try:
                opening = refine(shooter, downswing.opening, aim, self.highest)
            except NotReached:
                break
            downswing = downswing._replace(opening=opening, trial=shooter.shoot(opening))
        self.progress("closed loop", 1.0)
        if best is None or best[0] > NEAR:
            raise LoopFailed("in closed loop the head does not pass the ball as demanded")
        return best[1]


def plan_at_speed(configuration: Configuration, demand: SwingDemand, start: Profile | None) -> DownswingPlan:
    """Return the plan of a downswing that meets `demand` on the plant; without a speed the fastest one.

    Raises:
        DesignFailed: no plan that the plant can follow within its cushions.
    """
    return SwingDesigner(_bench(configuration), demand).downswing(start).plan


def fastest_plan(configuration: Configuration, demand: SwingDemand) -> DownswingPlan:
    """Return the fastest downswing of the model within `demand`, by collocation alone, solved or not.

    Tracking and absorber loads on the plant are not checked: seconds instead of minutes. Raises BenchError
    without the package casadi, DesignFailed if the plant does not reach the top.
    """
    load_casadi()
    design = SwingDesigner(_bench(configuration), replace(demand, head_speed=None))
    plant, problem = design.plant, design.problem
    return solve_downswing(plant, problem, *_first_guess(plant, problem.start, design.demand), _INTERVALS)


def _model_state(begun: Backswing) -> Array:
    """Return the model's state (16,) at the top, where a joint may still be on its way."""
    before, state = begun.rehearsal.bench.plant_state[0], np.zeros(STATES)
    state[:3], state[3:6] = before["angle"], before["speed"]
    state[6:12] = before["pressure"] / BAR
    state[12] = before["supply_pressure"] / BAR
    return state


def design_swing(
    configuration: Configuration,
    demand: SwingDemand,
    name: str,
    *,
    golfer: str = "robot",
    text: str = "",
    start: Profile | None = None,
    progress: Progress = lambda what, part: None,
) -> Profile:
    """Return a swing that meets `demand` on the configured plant; begins with `start`, or from scratch.

    Raises:
        BenchError: the package casadi is not installed.
        DesignFailed: no swing was found; the text gives the reason.
    """
    load_casadi()  # a missing package must fail before the long part
    bench = _bench(configuration, name, golfer)
    design = SwingDesigner(bench, demand, progress)
    downswing = design.downswing(start)
    try:
        profile = design.into_the_loop(downswing)
        profile = replace(profile, text=text or profile.text)
        patterns = None if start is None else start.blind_brake
        blind = design_blind_brake(
            replace(bench, profile=profile), patterns, lambda part: progress("blind brakes", part)
        )
    except LoopFailed as failure:
        raise DesignFailed(str(failure)) from None
    profile = replace(profile, blind_brake=blind)
    if faults := profile_faults(profile, bench.plant, bench.envelope):
        raise DesignFailed(f"the swing does not pass `golfbench check`: {'; '.join(map(str, faults))}")
    return profile


def _bench(configuration: Configuration, name: str = "", golfer: str = "") -> Bench:
    """Return the bench for the rehearsals, still with an empty profile; there are no limits of it yet."""
    c = configuration
    nothing = replace(_sketch(SwingDemand(), c.plant, np.zeros(3), np.zeros(3)), name=name, golfer=golfer)
    return Bench.of(replace(c, envelope=c.envelope.with_model_check("off")), nothing)
