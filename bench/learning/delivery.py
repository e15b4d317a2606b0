"""Delivery of a swing: its four figures, measured by the declared source."""

from __future__ import annotations

from collections.abc import Callable
from math import asin, cos, degrees, isnan, radians, sin
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from bench.base.errors import BenchError
from bench.base.lifecycle import Phase
from bench.records.shot.recorded_shot import delivery_in_motion
from bench.simulation.simulated_bench import Bench
from sim.impact import Delivery, face_axes, face_gap, impact_parameters
from sim.kinematics import forward_kinematics
from sim.plant import PlantParameters

Array = NDArray[np.float64]


class Figures(NamedTuple):
    """A delivery in figures of the swing plane, SI and rad; NaN where the source has no value."""

    strike: float
    """Strike point on the face, along its cut with the swing plane, m, up the plane."""
    speed: float
    """Head speed, m/s."""
    lean: float
    """Shaft lean, rad."""
    attack: float
    """Attack angle (rad)."""

    @property
    def array(self) -> Array:
        """All four in order."""
        return np.array(self)

    @property
    def shown(self) -> dict[str, float | None]:
        """The figures with their units in the names; None where unknown."""
        values = {"strike_mm": 1e3 * self.strike, "head_speed_mps": self.speed}
        values |= {"shaft_lean_deg": degrees(self.lean), "attack_angle_deg": degrees(self.attack)}
        return {name: None if isnan(value) else float(value) for name, value in values.items()}


UNKNOWN = Figures(*[float("nan")] * 4)


class Tolerance(NamedTuple):
    """Errors within which a figure counts as learned."""

    strike: float = 0.002
    """Distance of the strike from the target (m)."""
    speed: float = 0.003
    """Share of the target."""
    lean: float = radians(0.3)
    attack: float = radians(0.3)

    def scale(self, target: Figures) -> Array:
        """Return the tolerances (4,) in the figures' units."""
        return np.array([self.strike, self.speed * target.speed, self.lean, self.attack])


def figures_of(delivery: Delivery | None) -> Figures:
    """Return the figures of `delivery`; all unknown without one."""
    if delivery is None:
        return UNKNOWN
    return Figures(delivery.in_plane_error, delivery.speed, delivery.shaft_lean, delivery.attack_angle)


def planned_figures(bench: Bench) -> Figures:
    """Return the delivery that the profile plans: what learning aims at.

    Raises:
        BenchError: its file lacks it.
    """
    delivery, lie = bench.profile.delivery, bench.plant.robot.lie
    wanted = ("in_plane_error_mm", "head_speed_mps", "shaft_lean_deg", "path_slope_deg")
    missing = [key for key in wanted if key not in delivery]
    if missing:
        location, action = f"{bench.profile.name}: delivery", "Take a profile of `golfbench profile design`."
        raise BenchError(location, f"no {missing[0]}", "the planned delivery", action)
    strike, speed, lean, slope = (delivery[key] for key in wanted)
    return Figures(1e-3 * strike, speed, radians(lean), asin(sin(radians(slope)) * sin(lie)))


Cycles = np.ndarray[Any, Any]


_BEFORE = 0.015
"""Distance (m) of face and ball at which the last reading before the contact is looked for. The contact may
come so far before the model's: off the face's centre, with lengths known to 2 mm, with a ball teed up by
hand. A reading after it would take the impact for the club's speed."""
_LOW = 0.1
"""Height above the ball below which the head is at the bottom of the swing (m)."""
_READINGS = 16
"""Number of readings before the contact for a polynomial through their difference to the modelled swing."""
_ORDER = 3
"""Order of the polynomial. The curvature of the difference changes where the right arm breaks away, some 10
ms before the ball: a parabola had an error of 0.2 to 0.3 % of the speed with the driver, a cubic 0.1 %."""
_LATE = 60
"""Ticks by which a robot may come later or earlier than the modelled one."""
_SEARCHED = (-0.0015, 0.0035)
"""Searched time around the last reading (s)."""
_DOWN = (Phase.DOWNSWING, Phase.COMMITTED, Phase.IMPACT, Phase.FOLLOW_THROUGH)


def delivery_from_encoders(cycles: Cycles, plant: PlantParameters, plan: Array) -> Delivery | None:
    """Return how the club came to the ball, from the raw counts before the contact; None without a crossing.

    The angles of the last readings are carried on to where face and ball touch: an estimator that has to be
    ready for the impact's jump says less. A cubic is that of their difference to `plan` (k, 3), the modelled
    swing without a ball tick by tick, laid where its head is where the robot's is: a robot that comes later
    is not compared with a model that has run into its cushions. A latency that all encoders share does not
    matter.
    """
    robot, site, encoders = plant.robot, plant.site, plant.encoders
    per_rad = np.array(encoders.sign) * encoders.counts_per_revolution / (2 * np.pi)
    angle = (cycles["encoder_count"] + 0.5 - np.array(encoders.zero_count)) / per_rad
    angle += 2 * np.pi * np.round((cycles["angle"] - angle) / (2 * np.pi))
    head = forward_kinematics(robot, angle)
    # The first crossing forwards at the bottom of the swing; the club also comes by above.
    ahead, low = site.ball_x - head[:, 0] > _BEFORE, head[:, 1] < site.ball_y + _LOW
    crossings = np.flatnonzero(ahead[:-1] & ~ahead[1:] & low[1:] & np.isin(cycles["phase"], _DOWN)[1:])
    if not crossings.size or crossings[0] < _READINGS:
        return None
    last = int(crossings[0]) + 1
    curve = _beside(plan, plant, last, float(head[last - 1, 0]))
    if curve is None:
        return None
    times: Array = plant.tick * np.arange(1 - _READINGS, 1, dtype=np.float64)
    powers = np.vander(times, _ORDER + 1, increasing=True)
    fitted = np.linalg.lstsq(powers, angle[last - _READINGS : last] - curve(times), rcond=None)[0]
    face = impact_parameters(robot.club, plant.ball, robot.lie)

    def pose(at: float) -> Any:
        return forward_kinematics(robot, np.asarray(curve(at)) + at ** np.arange(_ORDER + 1) @ fitted)

    def gap(at: float) -> float:
        x, y, theta = map(float, pose(at))
        return float(face_gap(x, y, theta, site.ball_x, site.ball_y, face))

    if not gap(_SEARCHED[0]) > 0.0 > gap(_SEARCHED[1]):
        return None
    contact = float(brentq(gap, *_SEARCHED))
    return delivery_in_motion(plant, lambda time: pose(contact + time))


def _beside(
    plan: Array, plant: PlantParameters, last: int, x: float
) -> Callable[[Array | float], Array] | None:
    """Return the angles of `plan` (k, 3) by the time (s) from where its head comes to `x` (m) on.

    That is looked for around row `last`; None where it does not come. Rows of `plan` after that count
    no more, it is carried on instead: soon after the ball's place, a swing without a ball is in its cushions.
    """
    first = max(last - _LATE - _READINGS, 0)
    near = plan[first : last + _LATE]
    head = forward_kinematics(plant.robot, near)
    low = head[:, 1] < plant.site.ball_y + _LOW
    crossings = np.flatnonzero((head[:-1, 0] <= x) & (x < head[1:, 0]) & low[1:])
    if not crossings.size:
        return None
    k = int(crossings[0])
    row = k + (x - head[k, 0]) / (head[k + 1, 0] - head[k, 0])
    if row < _READINGS:
        return None
    used = near[: k + 2]
    spline = CubicSpline(np.arange(len(used)), used)
    return lambda time: np.asarray(spline(row + np.asarray(time) / plant.tick))


def strike_from_mark(toe_mm: float, high_mm: float, plant: PlantParameters) -> float:
    """Return the in-plane strike (m) of a mark on the face, mm towards the toe and up from its centre.

    A planar robot can strike along one line of the face only; the mark is projected on it.
    """
    robot = plant.robot
    normal, up, toe = face_axes(1.5 * np.pi, impact_parameters(robot.club, plant.ball, robot.lie))
    line = np.cross((0.0, cos(robot.lie), sin(robot.lie)), normal)
    line /= np.linalg.norm(line)
    return 1e-3 * float(toe_mm * (line @ np.array(toe)) + high_mm * (line @ np.array(up)))


def figures_from(
    cycles: Cycles,
    plant: PlantParameters,
    plan: Array,
    *,
    mark: tuple[float, float] | None = None,
    club_speed: float | None = None,
    attack_deg: float | None = None,
) -> Figures:
    """Return the figures of the swing in `cycles`; those not given come from the encoders.

    `mark`: mm towards the toe and up. `club_speed` (m/s) and `attack_deg` are a launch monitor's.
    """
    figures = figures_of(delivery_from_encoders(cycles, plant, plan))
    if figures is UNKNOWN:
        return figures
    return figures._replace(
        strike=figures.strike if mark is None else strike_from_mark(*mark, plant),
        speed=figures.speed if club_speed is None else club_speed,
        attack=figures.attack if attack_deg is None else radians(attack_deg),
    )
