"""One trial of a downswing: valve openings played on the plant, to the ball and past it.

Every trial runs on the plant itself with its air, stops, valves, friction and impact, which needs no second
model of the robot. A trial gives the arrival of the head at the ball and the cushions' loads: ball struck,
ball missed, and loss of communication on the way.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.control.law.gain_table import DERIVATIVE, PROPORTIONAL
from bench.control.moves.braking import brake_opening
from bench.control.settings import ControlSettings
from bench.simulation.safety import reset_peaks
from drivers.base import PASSIVE
from drivers.base.compiled import compiled, new_record
from drivers.base.records import pack_command
from sim.impact import in_plane_error
from sim.plant import PLANT_STATE, Plant, advance

Array = NDArray[np.float64]

SHAFT_DOWN = 3.5 * np.pi
"""theta_t of a shaft straight down, in the range the joints have there (rad)."""
AFTER_CONTACT = 5
"""Ticks for which the openings continue after impact before the braking law takes over."""
_FOLLOWED = 0.25
_SILENT_FOR = 0.12
"""Time for which a trial follows braking and silence, s: by then the cushions have taken their load."""
_BELOW = -0.9
"""Height of the head (m) below which passing the ball's place counts."""

BRAKE_LAW = np.dtype([("gain", "f8", (3,)), ("damping", "f8", (3,)), ("fade", "f8", (3,))], align=True)
"""The braking law of the controller (`bench.control.moves.braking`)."""


class Arrival(NamedTuple):
    """The robot as the head passes the ball's place, with no ball there."""

    head: Array
    """x, y (m), theta_t (rad), vx, vy (m/s), omega (rad/s)."""
    error: float
    """Ball off the face's centre along the cut of swing plane and face, m."""


class ShootingTrial(NamedTuple):
    """Outcome of one trial."""

    contact: int
    """Tick in which the head passes the ball; the number of openings if it does not."""
    struck: bool
    head: Array
    """x, y (m), theta_t (rad), vx, vy (m/s), omega (rad/s) there."""
    angle: Array
    """(contact, 3) rad at the start of each tick."""
    speed: Array
    """(contact, 3) rad/s."""
    struck_energy: Array
    """(3, 2) J, lower and upper cushions."""
    missed_energy: Array
    silent_energy: Array
    """(m, 3, 2) J."""


@compiled
def swing_down(robot: Any, plant: Any, impact: Any, states: Any, command: Any, valve: Any) -> int:
    """Play openings `valve` (n, 3) from `states[0]`; return the tick in which the head passes the ball, or n.

    `states` (n + 1,) gets the plant's state at the start of each tick.
    """
    for k in range(len(valve)):
        states[k + 1] = states[k]
        for i in range(3):
            command[0].valve[i] = valve[k, i]
        advance(robot, plant, impact, states[k + 1 : k + 2], command)
        before, after = states[k].head, states[k + 1].head
        if before[0] < plant[0].ball_x <= after[0] and after[1] < _BELOW:
            return k
    return len(valve)


@compiled
def follow_plan(
    robot: Any,
    plant: Any,
    impact: Any,
    state: Any,
    command: Any,
    valve: Any,
    angle: Any,
    speed: Any,
    gains: Any,
    highest: float,
) -> None:
    """Play openings `valve` (n, 3) with feedback on the joints of a plan, `angle` and `speed` (n, 3).

    `gains` (n, 5, 3) are those along it. `valve` is overwritten with the openings played, at most `highest`.
    """
    s = state[0]
    for k in range(len(valve)):
        for i in range(3):
            opening = valve[k, i] + gains[k, PROPORTIONAL, i] * (angle[k, i] - s.angle[i])
            opening += gains[k, DERIVATIVE, i] * (speed[k, i] - s.speed[i])
            valve[k, i] = min(max(opening, -highest), highest)
            command[0].valve[i] = valve[k, i]
        advance(robot, plant, impact, state, command)


@compiled
def brake(
    robot: Any, plant: Any, impact: Any, state: Any, command: Any, valve: Any, law: Any, ticks: int
) -> None:
    """Play openings `valve` (m, 3), then the braking `law` (BRAKE_LAW) for `ticks` ticks."""
    s, b, period, before = state[0], law[0], plant[0].tick, np.zeros(3)
    for k in range(len(valve) + ticks):
        for i in range(3):
            if k < len(valve):
                command[0].valve[i] = valve[k, i]
            else:
                rate = (s.speed[i] - before[i]) / period
                opening = brake_opening(b.gain[i], b.damping[i], b.fade[i], s.speed[i], rate)
                command[0].valve[i] = min(max(opening, -1.0), 1.0)
            before[i] = s.speed[i]
        advance(robot, plant, impact, state, command)


@compiled
def hold_command(robot: Any, plant: Any, impact: Any, state: Any, command: Any, ticks: int) -> None:
    """Let the plant run for `ticks` ticks with `command` as it is."""
    for _ in range(ticks):
        advance(robot, plant, impact, state, command)


class Shooter:
    """Plays downswings from one state of the plant; safe to use from several threads at once."""

    def __init__(
        self,
        plant: Plant,
        state: NDArray[Any],
        command: NDArray[Any],
        control: ControlSettings,
        silences: tuple[float, ...],
    ) -> None:
        """Start from `state` and `command` (one-element arrays); `silences` are s before the ball."""
        self.plant, self.command = plant, command.copy()
        self.state = without_history(state)
        self.silences = silences
        self.law = new_record(BRAKE_LAW)
        self.law["gain"], self.law["damping"] = control.brake_gain, control.brake_damping
        self.law["fade"] = control.brake_fade_speed
        self.passive = command.copy()
        pack_command(PASSIVE, self.passive)

    def _down(self, valve: Array) -> tuple[NDArray[Any], NDArray[Any], int]:
        states = new_record(PLANT_STATE, len(valve) + 1)
        states[0] = self.state[0]
        states["ball_present"] = False
        command = self.command.copy()
        return states, command, int(swing_down(*self.plant.records, states, command, valve))

    def follow(self, valve: Array, angle: Array, speed: Array, gains: Array, highest: float) -> Array:
        """Return openings (n, 3), at most `highest`, with which the plant keeps near a plan.

        `valve`, `angle`, `speed` (n, 3) are the plan's, one row a tick, `gains` (n, 5, 3) along it.
        """
        state, played = self.state.copy(), valve.copy()
        state["ball_present"] = False
        follow_plan(*self.plant.records, state, self.command.copy(), played, angle, speed, gains, highest)
        return played

    def arrive(self, valve: Array) -> Arrival:
        """Play openings `valve` (n, 3), one row a tick, to the ball's place."""
        states, command, contact = self._down(valve)
        last = min(contact, len(valve) - 1)
        # The plant itself finds where the face meets the ball; where the head misses it, `_passing` does.
        hit = states[last : last + 1].copy()
        hit["ball_present"] = contact < len(valve)
        hold_command(*self.plant.records, hit, command, 2)
        head = self._at_ball(hit, states, last)
        site = self.plant.parameters.site
        error = in_plane_error(head[0], head[1], head[2], site.ball_x, site.ball_y, self.plant.impact)
        return Arrival(head, float(error))

    def _at_ball(self, hit: NDArray[Any], states: NDArray[Any], last: int) -> Array:
        """Return the head where it strikes the ball of `hit`, else passes its place."""
        if hit["struck"][0]:
            return np.array(hit["impact_head"][0])
        return _passing(states[last], states[last + 1], self.plant)

    def shoot(self, valve: Array) -> ShootingTrial:
        """Play openings `valve` (n, 3), one row per tick, with each continuation: struck, missed, silent."""
        records, period = self.plant.records, self.plant.parameters.tick
        states, command, contact = self._down(valve)
        followed, quiet = round(_FOLLOWED / period), round(_SILENT_FOR / period)
        last = min(contact, len(valve) - 1)
        rest = np.ascontiguousarray(valve[last : last + AFTER_CONTACT])

        hit = states[last : last + 1].copy()
        hit["ball_present"] = contact < len(valve)
        brake(*records, hit, command.copy(), rest, self.law, followed)
        missed = states[last : last + 1].copy()
        brake(*records, missed, command.copy(), rest, self.law, followed)
        silent = np.zeros((len(self.silences), 3, 2))
        for row, silence in enumerate(self.silences):
            begin = max(last - round(silence / period), 0)
            left = states[begin : begin + 1].copy()
            hold_command(*records, left, self.passive.copy(), quiet)
            silent[row] = left["stop_energy"][0]

        return ShootingTrial(
            contact,
            bool(hit["struck"][0]),
            self._at_ball(hit, states, last),
            np.array(states["angle"][: last + 1]),
            np.array(states["speed"][: last + 1]),
            np.array(hit["stop_energy"][0]),
            np.array(missed["stop_energy"][0]),
            silent,
        )


def without_history(state: NDArray[Any]) -> NDArray[Any]:
    """Return a copy of `state` without earlier loads and impact."""
    fresh = state.copy()
    reset_peaks(fresh)
    fresh["struck"] = False
    return fresh


def _passing(before: Any, after: Any, plant: Plant) -> Array:
    """Return the head as it passes the ball's place between two ticks: cubic path, straight lines else."""
    one, two = np.array(before["head"]), np.array(after["head"])
    span = two[0] - one[0]
    part = float(np.clip((plant.parameters.site.ball_x - one[0]) / span, 0.0, 1.0)) if span else 0.0
    period = plant.parameters.tick
    head = one + part * (two - one)
    chord = (two[:2] - one[:2]) / period
    head[:2] += period * part * (1 - part) * ((1 - part) * (one[3:5] - chord) - part * (two[3:5] - chord))
    return np.asarray(head)
