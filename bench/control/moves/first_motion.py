"""First motion after power-up and after each opening of the guard, with the valves hardly open.

A person inside may have exchanged hoses, cables or a coupling. A loop whose valve or encoder is reversed
runs away from its reference, as fast as its valve lets it. So a joint's valve opens no further than a little
beyond its dead band until the joint has answered: until it has moved along with its reference. Meanwhile its
speed is limited, and its bound grows slowly: a worn valve has a wider band. Chambers are hardly charged
before: air without a joint that obeys would drive it. A joint that rests too near to its address to answer on
the way there first makes a test motion: the hold and the swing do not bound it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base.lifecycle import Cause, Phase, State
from bench.control.envelope import joint_coordinates
from drivers.base.compiled import compiled

_ANSWER = 0.05
"""Travel in the reference's direction that counts as a joint's response (rad)."""
_MIN_OPENING = 0.005
"""Initial bound of a valve command beyond the dead band."""
_GROWTH, _LIFT = 0.02, 0.12
"""Growth of the bound while the reference moves, before and after the answer (1/s): chambers that are hardly
charged would throw a joint whose valve opens at once."""
_FASTER = 3.0
"""Max speed of a joint that has not answered, in terms of its speed towards its stop."""
_NEAR, _TEST, TEST_TIME = 0.15, 0.10, 1.0
"""Distance from the address within which a joint makes a test motion (rad); its travel (rad) and min time
(s)."""
_WAIT = 4.0
"""Time after a test motion in which its joints must have answered (s)."""
_THROWN = 1.9
"""Speed (rad/s) at which the others, at their stops, throw a joint whose reference has not moved yet."""


@compiled
def note_answers(s: Any, d: Any, e: Any) -> None:
    """Note the joints that move along with their references; `d` is PID_STATE."""
    m = s.first_motion
    for i in range(3):
        way = np.sign(s.reference_velocity[i])
        m.start[i] += s.homing.zero_shift[i]
        if way not in (0.0, m.way[i]):  # a waiting reference keeps its direction
            m.way[i], m.start[i] = way, e.angle[i]
        elif m.answered[i] == 0 and way * (e.angle[i] - m.start[i]) >= _ANSWER:
            m.answered[i] = 1
            d.integral[i] = 0.0  # grown against the bound, it would throw the joint
        if m.way[i] != 0.0 and s.measured_step > 0.0:
            m.bound[i] += s.measured_step * (_LIFT if m.answered[i] != 0 else _GROWTH)


@compiled
def forget_answers(s: Any) -> None:
    """Have all joints answer again: the guard is open."""
    for i in range(3):
        s.first_motion.answered[i], s.first_motion.way[i], s.first_motion.bound[i] = 0, 0.0, 0.0


@compiled
def owes_answer(s: Any, i: int) -> bool:
    """Return whether joint `i` has to answer before the move ends; a test motion waits for those it moves."""
    moved = not s.move.is_test or s.move.target[i] != s.move.origin[i]
    return bool(s.first_motion.answered[i] == 0 and moved)


@compiled
def _backswing_raises(parameters: Any, i: int) -> bool:
    """Return whether angle `i` is larger at the end of the backswing than at the address."""
    top = 0
    while top < parameters.profile[0].samples - 1 and parameters.phase[top] <= Phase.TOP:
        top += 1
    return bool(parameters.angle[top, i] > parameters.angle[0, i])


@compiled
def choose_target(s: Any, parameters: Any, start: Any) -> None:
    """Set the target of a move from angles `start` (3,) rad: the address, or that of a test motion.

    A test motion goes as the backswing does, away from ground and ball, unless a stop is in its way.
    """
    p, address, m = parameters.envelope[0], parameters.angle[0], s.move
    m.is_test = False
    for i in range(3):
        m.target[i] = start[i]
        if s.state == State.ARMED and s.first_motion.answered[i] == 0 and abs(address[i] - start[i]) < _NEAR:
            travel = _TEST if _backswing_raises(parameters, i) else -_TEST
            m.target[i], m.is_test = start[i] + travel, True
            position, _ = joint_coordinates(parameters.robot, m.target, m.target, i)
            if not p.lower[i] <= position <= p.upper[i]:
                m.target[i] = start[i] - travel
    if not m.is_test:
        for i in range(3):
            m.target[i] = address[i]


@compiled
def is_free(s: Any, p: Any, i: int) -> bool:
    """Return whether the valve of joint `i` is allowed to open as far as homing does."""
    return bool(s.first_motion.bound[i] >= p.home_opening)


@compiled
def bound_first(s: Any, p: Any, i: int, opening: float) -> float:
    """Return the valve command `opening` of joint `i` within its bound; NaN stays NaN, for the envelope."""
    free = s.first_motion.answered[i] != 0 and is_free(s, p, i)
    if free or not (s.moving or s.phase == Phase.HOMING) or not np.isfinite(opening):
        return opening
    most: float = p.move_band[i] + _MIN_OPENING + s.first_motion.bound[i]
    return min(max(opening, -most), most)


@compiled
def centre_unanswered(s: Any) -> None:
    """Centre the valves of joints that have not answered: a brake would drive on a reversed one."""
    slow = s.phase in (Phase.HOMING, Phase.HOLD, Phase.RETURN)
    for i in range(3):
        if slow and s.first_motion.answered[i] == 0:
            s.desired[i] = 0.0


@compiled
def first_motion_cause(s: Any, p: Any, velocity: Any) -> int:
    """Return the cause that ends a first motion: a joint that has not answered and is fast or late; or 0."""
    late = s.moving and s.move.is_test and s.time - s.move.start - s.move.duration > _WAIT
    for i in range(3):
        thrown = _THROWN if s.first_motion.way[i] == 0.0 else 0.0
        most = max(_FASTER * p.home_stop_contact_speed[i], thrown)
        if (late and owes_answer(s, i)) or (s.first_motion.answered[i] == 0 and not abs(velocity[i]) <= most):
            return Cause.SHOULDER_FOLLOWING + i
    return 0
