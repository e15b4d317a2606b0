"""The strike in a swing's cycles: whether a ball was hit, when, and its drift from swing to swing.

A leak, worn seals or a supply that sags take speed long before anything has to be stopped. And the ball is a
mark in the hall that no encoder knows of: the strike bends the wrist's path, which shows in the raw counts to
0.2 ms, and at that instant the head is at the ball. An encoder whose coupling slipped, or that lost counts,
sees it elsewhere from then on: 0.02 rad are 20 to 35 mm.

Both are compared with the first swings with the same tables, and with their standard deviation, which differs
between swings and robots. A change of speed counts only as a loss that lasts for three swings. A drift is a
warning with the record and in the status, not a cause to stop.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from math import hypot, isfinite
from typing import Any, NamedTuple

import numpy as np

from bench.base.lifecycle import Phase
from sim.kinematics import forward_kinematics
from sim.robot import RobotParameters

Cycles = np.ndarray[Any, Any]

TO_BALL = (Phase.DOWNSWING, Phase.COMMITTED, Phase.IMPACT)
SWINGING = (Phase.BACKSWING, Phase.TOP, *TO_BALL, Phase.FOLLOW_THROUGH)
"""Phases of the swing itself, without the way to the address and back."""


def ball_struck(cycles: Cycles) -> bool:
    """Return whether a ball was on the tee until the head arrived, by the sensor there."""
    swung = np.isin(cycles["phase"], (Phase.DOWNSWING, Phase.COMMITTED))
    after = cycles["phase"] == Phase.FOLLOW_THROUGH
    if not swung.any() or not after.any():
        return False
    return bool(cycles["ball_present"][swung][0] and not cycles["ball_present"][after][-1])


_EARLIEST_CONTACT = 0.004
"""How far (m) before the ball's position an off-centre strike may begin."""


def time_at_ball(
    robot: RobotParameters, cycles: Cycles, ball_x: float, *, estimated: bool = False
) -> float | None:
    """Return the time (s of the record) at which the face's centre is last before `ball_x` (m).

    Plant angles are taken where there are any, else, or if so asked, the `estimated` ones. None when the head
    never crosses `ball_x` in the downswing, as after a stop.

    At 1 kHz the head moves over 40 mm from one record to the next. Between two records the joint angles
    follow the cubic through both angles and both velocities; across the impact, where velocities jump, the
    last record before it is carried on with its own velocity and acceleration.
    """
    down = cycles[np.isin(cycles["phase"], TO_BALL)]
    if len(down) < 3:
        return None
    source = "" if estimated or not np.isfinite(down["plant_angle"]).all() else "plant_"
    angle, velocity = down[f"{source}angle"], down[f"{source}velocity"]
    x = forward_kinematics(robot, angle)[:, 0]
    # Off its centre the face meets the ball up to some millimetres early: a record there may be after impact.
    before = x < ball_x - _EARLIEST_CONTACT
    crossings = np.flatnonzero(before[:-1] & ~before[1:])
    if not crossings.size or not crossings[-1]:
        return None
    last = int(crossings[-1])
    times = down["time"][: last + 2].copy()
    acceleration = (velocity[last] - velocity[last - 1]) / (times[last] - times[last - 1])
    step = 1.25 * (times[last + 1] - times[last])
    times[last + 1] = times[last] + step
    ahead = angle[last] + step * (velocity[last] + step / 2 * acceleration)
    angles = np.vstack([angle[: last + 1], ahead])
    velocities = np.vstack([velocity[: last + 1], velocity[last] + step * acceleration])
    start = max(0, last - 60)
    fine = np.linspace(times[start], times[-1], 50 * (len(times) - start))
    path = _cubics(times[start:], angles[start:], velocities[start:], fine)
    short = np.flatnonzero(forward_kinematics(robot, path)[:, 0] <= ball_x)
    return float(fine[short[-1]]) if len(short) else None


def _cubics(times: Cycles, values: Cycles, slopes: Cycles, at: Cycles) -> Cycles:
    """Return at times `at` (m,) the cubics through `values` (n, 3) with `slopes` at `times` (n,).

    scipy's would cost the process of the recorder 28 MB.
    """
    k = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    step = np.diff(times)[k, None]
    s = (at[:, None] - times[k, None]) / step
    begin, end, rise = values[k], values[k + 1], (values[k + 1] - values[k])
    bend = (1 - s) * (step * slopes[k] - rise) + s * (rise - step * slopes[k + 1])
    return np.asarray((1 - s) * begin + s * end + s * (1 - s) * bend)


SPEED, PLACE = 0.012, 0.015
"""Min tolerance between swings: fraction of the club speed, and strike point along the ground (m)."""
SPEED_SCATTER, PLACE_SCATTER = 8.0, 5.0
"""The same as a number of standard deviations; the larger tolerance of both applies."""
REFERENCE, NEEDED = 20, 10
"""First swings with the same tables that are compared with, at most and at least."""
LASTING = 3
"""Swings for which a loss of speed must last."""
_BEFORE = 6
"""Ticks through which the way to the ball is drawn."""
_NEAR = 12
"""Additional ticks before and after the impact window to search for the strike."""


class ObservedImpact(NamedTuple):
    """The head at the ball, as the encoders saw it."""

    speed: float
    """Speed of the club head, m/s."""
    place: float
    """Position of the head along the ground, m; NaN without a ball."""


class SwingDrift(NamedTuple):
    """A swing compared with the first ones that had the same tables."""

    seen: ObservedImpact
    usual: ObservedImpact
    """Medians of the first swings; NaN until there are enough."""
    warnings: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the comparison for a record's metadata; None for unknown values."""
        figures = {
            "club_speed_mps": self.seen.speed,
            "first_club_speed_mps": self.usual.speed,
            "ball_met_m": self.seen.place,
            "first_ball_met_m": self.usual.place,
        }
        known = {name: value if isfinite(value) else None for name, value in figures.items()}
        return {**known, "warnings": list(self.warnings)}


def strike_seen(cycles: Cycles, counts: int, *, struck: bool) -> ObservedImpact | None:
    """Return speed and place of the head at the strike in `cycles` of a swing; None if it did not come there.

    `counts` is the encoders' range. Without a ball (`struck` is False) the speed is that in the middle of the
    impact window.
    """
    window = np.flatnonzero(cycles["phase"] == Phase.IMPACT)
    if len(window) < 3 or window[0] < _NEAR + _BEFORE or window[-1] + _NEAR >= len(cycles):
        return None
    middle = float(cycles["time"][window[len(window) // 2]])
    instant = _bend(cycles[window[0] - _NEAR : window[-1] + _NEAR], counts) if struck else middle
    end = int(np.searchsorted(cycles["time"], instant))  # the first tick after it
    if not _BEFORE <= end < len(cycles):
        return None
    times, way = cycles["time"][end - _BEFORE : end] - instant, cycles["head_position"][end - _BEFORE : end]
    place = float(np.polyfit(times, way[:, 0], 2)[2])
    return ObservedImpact(hypot(*np.polyfit(times, way, 1)[0]), place if struck else float("nan"))


def _bend(cycles: Cycles, counts: int) -> float:
    """Return the instant (s) in `cycles` at which the wrist's path bends most; NaN if samples are missing.

    A bend between two samples shows in the second differences at both, in the ratio of its distances.
    """
    times = cycles["encoder_time"][:, 2]
    if not (cycles["encoder_valid"][:, 2].all() and (np.diff(times) > 0.0).all()):  # False with NaN
        return float("nan")
    bends = np.diff(np.unwrap(cycles["encoder_count"][:, 2].astype(np.float64), period=counts), 2)
    bends -= np.median(bends)
    at = int(np.argmax(np.abs(bends[:-1] + bends[1:])))
    share = min(max(bends[at + 1] / (bends[at] + bends[at + 1]), 0.0), 1.0) if bends[at] else 1.0
    return float(times[at + 1] + share * (times[at + 2] - times[at + 1]))


class DriftMonitor:
    """Remembers the first and the latest swings of the tables in use."""

    def __init__(self) -> None:
        self._tables: Hashable = None
        self._first: list[ObservedImpact] = []
        self._latest: deque[ObservedImpact] = deque(maxlen=LASTING)

    def take(self, seen: ObservedImpact, tables: Hashable) -> SwingDrift:
        """Compare a swing with the first ones of the same `tables`; changed tables start a new series."""
        if tables != self._tables:
            self._tables = tables
            self._first.clear()
            self._latest.clear()
        self._latest.append(seen)
        drift = self._compared(seen)
        if len(self._first) < REFERENCE:
            self._first.append(seen)
        return drift

    def _compared(self, seen: ObservedImpact) -> SwingDrift:
        speed, speed_scatter = _usual([swing.speed for swing in self._first])
        place, place_scatter = _usual([swing.place for swing in self._first])
        warnings = []
        lasting = float(np.median([swing.speed for swing in self._latest]))
        band = max(SPEED * speed, SPEED_SCATTER * speed_scatter * (1 / LASTING + 1 / NEEDED) ** 0.5)
        if len(self._latest) == LASTING and speed - lasting > band:
            warnings.append(
                f"club speed {lasting:.2f} m/s, {speed:.2f} m/s at first: check supply, valves and seals"
            )
        if abs(seen.place - place) > max(PLACE, PLACE_SCATTER * place_scatter):
            warnings.append(
                f"the head met the ball {1e3 * (seen.place - place):+.0f} mm from where it did at first: "
                "check tee and encoder couplings, then home"
            )
        return SwingDrift(seen, ObservedImpact(speed, place), tuple(warnings))


def _usual(values: list[float]) -> tuple[float, float]:
    """Return median and standard deviation of `values` that are numbers; NaN if they are too few.

    One odd swing, as the first after arming, does not count in the deviation.
    """
    known = np.array(values)[np.isfinite(values)]
    if len(known) < NEEDED:
        return float("nan"), float("nan")
    middle = float(np.median(known))
    return middle, float(np.std(np.delete(known, np.argmax(np.abs(known - middle))), ddof=1))
