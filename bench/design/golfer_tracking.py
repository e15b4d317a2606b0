"""A golfer's motion as a demand on the designer: as close as the robot can, at the golfer's head speed.

The robot starts from the human's top as far as its ranges go, takes his or her time for the backswing and
about as long for the downswing. It keeps close to the human's joint angles by least squares, each counted in
its range. A golfer's downswing starts from rest and is followed unmodified. Hunt's functions alone begin it
at full speed, which no machine does: where the shoulder has room behind their top, the robot begins there,
`RUN_UP` earlier. A motion out of reach is not scaled; the deviation shows it. If the demand itself is out of
reach, a nearest swing gives way, in the downswing's time and the path's rise first, in head speed last;
`gave_way` says where and by how much.

A robot's swing is followed in the same way, more closely (`demand_near`). Without one to follow a plan takes
the smallest valve commands, which leaves much of the head's speed to the wrist's release. Its delivery
then depends more on the instant of release than with a shoulder that still drives.
"""

from __future__ import annotations

from dataclasses import replace
from math import degrees

import numpy as np
from numpy.typing import NDArray

from bench.design.designer import downswing_rows, furthest_cock, wrist_range
from bench.design.optimal_control import SwingDemand
from bench.golfer.comparison import require_club
from bench.golfer.golfer_file import GolferSwing
from bench.swing.golfers import Golfer, HumanDownswing
from bench.swing.profile import Profile
from sim.kinematics import right_arm_length, theta2_from_right_arm
from sim.plant import PlantParameters

Array = NDArray[np.float64]

_TIME = 0.9, 1.2
"""Shortest and longest downswing, as ratios to a robot's or Hunt's."""
TEMPO = 0.004
"""Max difference of a downswing from the demanded time, or below a golfer's (s)."""
SLOWER = 1.06
"""Longest downswing as a ratio to a golfer's: a longer one stays behind the golfer. In the time of the
fastest golfer a shoulder valve that sticks open overloads the arm's stop."""
RUN_UP = 0.08
"""Time in which the shoulder reaches the golfer's speed before his or her top, 156 rad/s2 at the most (s)."""
_MIN_RUN_UP = 0.02
_INSIDE = 0.15, 0.012
"""Distances from the ends of shoulder (rad) and rod (m) at the top: the loop needs room, and from a rod
pressed against its stop there is no plan. The wrist cocks no further than where its lever still holds it."""

_WRIST_INSIDE = 0.1
"""Distance of the wrist at the top from where its lever holds it (rad): the swing up ends up to 0.06 off."""
_NEAR = 0.2
"""Unit of the deviation from a robot's swing, as a fraction of that swing's ranges."""
_ROWS = 41
"""Poses of a robot's downswing."""

_REPORTED = 0.003, 0.1, 0.1
"""Deviations from the demand that are reported, s, degrees, m/s: smaller ones come from the plant."""


def demand_like(
    plant: PlantParameters,
    golfer: Golfer,
    human: HumanDownswing,
    demand: SwingDemand,
    speed: float | None = None,
) -> SwingDemand:
    """Return `demand` with the motion of `human`, at `speed` (m/s), or at the golfer's.

    From rest, another speed takes another time: the golfer turns faster, not further.
    """
    demand = replace(
        demand,
        head_speed=golfer.head_speed if speed is None else speed,
        backswing_time=golfer.backswing,
        top_cock=demand.top_cock if golfer.as_hunt else _furthest_of_range(plant, demand),
    )
    lasting = float(human.time[-1])
    if not golfer.as_hunt:
        return _from_rest(plant, demand, human.angle, lasting, human.head_speed)
    followed = _following(plant, demand, human.angle, lasting, np.ptp(human.angle, axis=0))
    turning = float((human.angle[1, 0] - human.angle[0, 0]) / (human.time[1] - human.time[0]))
    room = float(human.angle[0, 0]) - (plant.shoulder.lower + _INSIDE[0])
    run_up = min(RUN_UP, 2.0 * room / turning)
    if run_up < _MIN_RUN_UP:
        return followed
    time, table = np.linspace(0.0, lasting, len(human.angle)), followed.follow
    at = np.linspace(-run_up, lasting, _ROWS)
    rows = np.column_stack([np.interp(at, time, column) for column in np.asarray(table).T])
    rows[at < 0.0] = np.nan
    # Poses are compared at the same time before the ball, so the downswing lasts exactly so long.
    return replace(
        followed,
        downswing_time=(lasting + run_up, lasting + run_up),
        top_shoulder=float(human.angle[0, 0]) - turning * run_up / 2,
        follow=rows,
    )


def demand_measured(
    plant: PlantParameters,
    golfer: GolferSwing,
    demand: SwingDemand,
    speed: float | None = None,
    attack: float | None = None,
) -> SwingDemand:
    """Return `demand` with the body motion and the tempo of a measured `golfer`.

    `speed` (m/s) and `attack` (rad) are the golfer's where they are None; another speed takes another time.
    A measured downswing starts from rest and needs no run-up. The wrist may cock nearly to the end of its
    range.

    Raises:
        BenchError: shaft and head were not measured.
    """
    require_club(golfer)
    angle = golfer.angle[golfer.top_row :]
    demand = replace(
        demand,
        head_speed=golfer.head_speed if speed is None else speed,
        attack=golfer.attack if attack is None else attack,
        backswing_time=golfer.backswing or demand.backswing_time,
        top_cock=_furthest_of_range(plant, demand),
    )
    return _from_rest(plant, demand, angle, golfer.downswing_time, golfer.head_speed)


def _from_rest(
    plant: PlantParameters, demand: SwingDemand, angle: Array, time: float, speed: float
) -> SwingDemand:
    """Return `demand` with the downswing `angle` (n, 3; rad) of a golfer, of `time` (s) at `speed` (m/s)."""
    time *= speed / (demand.head_speed or speed)
    rows = np.linspace(0, len(angle) - 1, _ROWS).round().astype(int)
    followed = _following(plant, demand, angle[rows], time, np.ptp(angle, axis=0))
    return replace(followed, downswing_time=(time - TEMPO, SLOWER * time))


def _furthest_of_range(plant: PlantParameters, demand: SwingDemand) -> float:
    """Return the cock at the top (rad) nearly at the end of the wrist's range."""
    return plant.wrist.upper - wrist_range(plant, demand)[0] - _WRIST_INSIDE


def demand_near(plant: PlantParameters, profile: Profile, demand: SwingDemand) -> SwingDemand:
    """Return `demand` with a downswing near that of `profile`, from its top and in about its time."""
    angle = downswing_rows(profile, profile.angle, _ROWS)
    return _following(plant, demand, angle, profile.downswing_time, _NEAR * np.ptp(angle, axis=0))


def _following(
    plant: PlantParameters, demand: SwingDemand, angle: Array, time: float, ranges: Array
) -> SwingDemand:
    """Return `demand` with a downswing of about `time` (s) close to `angle` (n, 3), rad by `ranges`."""
    robot, wrist = plant.robot, plant.wrist.upper
    rods = np.array([plant.right_arm.lower + _INSIDE[1], plant.right_arm.upper])
    arms = theta2_from_right_arm(robot, robot.l56 + rods)
    furthest = furthest_cock(plant) if demand.top_cock is None else demand.top_cock
    lowest = plant.shoulder.lower + _INSIDE[0], arms[0], wrist - furthest
    follow = np.clip(angle, lowest, [plant.shoulder.upper, arms[1], wrist])
    shoulder, arm, cocked = follow[0].tolist()
    extension = float(right_arm_length(robot, arm)) - robot.l56
    return replace(
        demand,
        downswing_time=(_TIME[0] * time, _TIME[1] * time),
        top_shoulder=shoulder,
        top_extension=min(extension, plant.right_arm.upper - _INSIDE[1]),
        top_cock=wrist - cocked,
        follow=follow,
        ranges=ranges,
    )


def gave_way(demand: SwingDemand, profile: Profile) -> list[str]:
    """Return the deviations of `profile` from `demand`, with both figures; empty without one."""
    found = []
    longest = demand.downswing_time[1]
    attack, asked = profile.delivery["attack_angle_deg"], degrees(demand.attack)
    reached, wanted = profile.delivery["head_speed_mps"], demand.head_speed
    if profile.downswing_time > longest + _REPORTED[0]:
        found.append(f"a downswing of {profile.downswing_time:.3f} s, {longest:.3f} s at most demanded")
    if abs(attack - asked) > _REPORTED[1]:
        found.append(f"attack {attack:+.1f} deg, {asked:+.1f} deg demanded")
    if wanted is not None and reached < wanted - _REPORTED[2]:
        found.append(
            f"demanded {wanted:.1f} m/s, reached {reached:.1f} m/s, short by {wanted - reached:.1f} m/s"
        )
    return found
