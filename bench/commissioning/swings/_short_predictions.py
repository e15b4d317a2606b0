"""Predictions of a recorded swing over short windows, each from the measured state at its start.

Over a whole swing errors add up, feedback hides them, and dry friction may turn one into another.
Over a window an error stays where it arises: a leak in the pressures of its chambers, friction in the
speed of its joint. Commands are those recorded; the model is the compiled plant.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from copy import copy
from itertools import product
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from bench.commissioning.machine.commissioning_step import count_angles
from bench.commissioning.machine.machine import Array, at_rows
from drivers.base import CHAMBERS, JOINTS
from drivers.base.compiled import compiled, new_record
from drivers.base.records import COMMAND
from sim.plant import ACTUATOR_KEYS, PlantParameters, advance, build_plant, initial_state

Cycles = np.ndarray[Any, Any]

WINDOW = 20
"""Ticks of a window."""
QUANTITIES = 13
"""Values that are predicted: angles and speeds of three joints, pressures of six chambers, the supply's."""
SPEED, PRESSURE, SUPPLY = slice(3, 6), slice(6, 12), 12
"""Indices of joint speeds, chamber pressures and supply pressure among the values."""
_SMOOTH, _ORDER = 9, 3
"""Rows and order of the polynomial that gives a speed."""
_CONTACT = 8
"""Rows around the contact with the ball in which no speed is known."""
SCATTER = np.array([5e-4] * 3 + [0.05] * 3 + [300.0] * 6 + [100.0])
"""Errors of predictions over a window that count as one: rad, rad/s, Pa."""
_OUTLIER = 5.0
"""Error from which it counts less: a joint that breaks loose a little later is no other robot."""
_ROUNDS = 4


class RecordedSwing:
    """Records of a swing, in the units of the plant."""

    def __init__(self, cycles: Cycles, known: PlantParameters) -> None:
        """Take `cycles`, CYCLE records of a swing, one a tick, by the encoders of `known`."""
        c, tick = cycles, known.tick
        self.tick, self._encoders = tick, known.encoders
        raw = count_angles(np.asarray(c["encoder_count"]), known)
        self.raw_angle = _filled(np.where(c["encoder_valid"] != 0, raw, np.nan))
        """(n, 3) rad as the encoders read, late as they are."""
        self.pressure = _filled(np.asarray(c["chamber_pressure"], float))
        """(n, 6) Pa"""
        self.supply = _filled(np.asarray(c["supply_pressure"], float)[:, None])[:, 0]
        self.valve = np.ascontiguousarray(c["applied_valve"], float)
        """(n, 3) openings commanded from each row on."""
        flags = ("supply_enable", "exhaust_closed", "guard_lock")
        self.flags = np.ascontiguousarray(np.stack([c[name] for name in flags], axis=1).astype(bool))
        teed = np.asarray(c["ball_present"]).astype(bool)
        self.contacts = np.flatnonzero(teed[:-1] & ~teed[1:])
        """Rows after which the ball was gone."""

    def __len__(self) -> int:
        return len(self.valve)

    def _moved_zeros(self, plant: PlantParameters) -> Array:
        """Return by how much the angles (3,) rad are others with the zeros of `plant`."""
        moved = np.array(self._encoders.zero_count) - np.array(plant.encoders.zero_count)
        return np.asarray(moved * self._encoders.sign * (2.0 * pi / self._encoders.counts_per_revolution))

    def motion(self, raw_angle: Array, latency: float) -> tuple[Array, Array]:
        """Return angles and speeds (n, 3) rad, rad/s at the rows; encoders read `latency` (s) late."""
        at = np.arange(len(raw_angle)) + latency / self.tick
        smooth = savgol_filter(raw_angle, _SMOOTH, _ORDER, axis=0)
        speed = savgol_filter(raw_angle, _SMOOTH, _ORDER, deriv=1, delta=self.tick, axis=0)
        return at_rows(smooth, at), at_rows(speed, at)

    def jump(self, joint: int) -> int:
        """Return the row at which the reading of `joint` changes least evenly, contacts aside."""
        uneven = np.abs(np.diff(self.raw_angle[:, joint], 2))
        for contact in self.contacts:
            uneven[max(contact - _CONTACT, 0) : contact + _CONTACT] = 0.0
        return int(np.argmax(uneven)) + 2

    def with_pressure(self, chamber: int, added: float) -> RecordedSwing:
        """Return the swing with `added` (Pa) to the pressure of `chamber`."""
        other = copy(self)
        other.pressure = self.pressure.copy()
        other.pressure[:, chamber] += added
        return other

    def starts(self) -> NDArray[np.int64]:
        """Return the rows (k,) at which windows begin that no contact with the ball disturbs."""
        starts = np.arange(_SMOOTH, len(self) - WINDOW - _SMOOTH, WINDOW)
        for contact in self.contacts:
            far = (starts > contact + _CONTACT) | (starts + WINDOW < contact - _CONTACT)
            starts = starts[far]
        return starts

    def errors(
        self, plant: PlantParameters, raw_angle: Array | None = None, valve: Array | None = None
    ) -> Array:
        """Return the measured less the predicted values of `plant`, at the ends of windows (k, QUANTITIES).

        `raw_angle` (n, 3) rad and `valve` (n, 3) replace the recorded ones.
        """
        read = self.raw_angle if raw_angle is None else raw_angle
        angle, speed = self.motion(read + self._moved_zeros(plant), plant.encoders.latency)
        measured = np.column_stack([angle, speed, self.pressure, self.supply])
        built = build_plant(plant)
        state = initial_state(built, angle[0], pressurised=True)
        state["spool"] = self.valve[0] - built.plant["centre"][0]
        predicted = np.empty_like(measured)
        begins = np.zeros(len(self), bool)
        begins[np.arange(_SMOOTH, len(self), WINDOW)] = True
        commands = self.valve if valve is None else np.ascontiguousarray(valve)
        _predict(
            *built.records, state, new_record(COMMAND), measured, commands, self.flags, begins, predicted
        )
        ends = self.starts() + WINDOW
        return np.asarray(measured[ends] - predicted[ends])


@compiled
def _predict(
    robot: Any,
    plant: Any,
    impact: Any,
    state: Any,
    command: Any,
    measured: Any,
    valve: Any,
    flags: Any,
    begins: Any,
    predicted: Any,
) -> None:
    """Write the plant's response (n, QUANTITIES) from `state`; it restarts from `measured` at `begins`."""
    s, c = state[0], command[0]
    for k in range(len(measured)):
        for i in range(3):
            predicted[k, i], predicted[k, 3 + i] = s.angle[i], s.speed[i]
        for i in range(6):
            predicted[k, 6 + i] = s.pressure[i]
        predicted[k, 12] = s.supply_pressure
        if begins[k] or k == 0:
            for i in range(3):
                s.angle[i], s.speed[i] = measured[k, i], measured[k, 3 + i]
            for i in range(6):
                s.pressure[i] = measured[k, 6 + i]
            s.supply_pressure = measured[k, 12]
        for i in range(3):
            c.valve[i] = valve[k, i]
        c.supply_enable, c.exhaust_closed, c.guard_lock = flags[k, 0], flags[k, 1], flags[k, 2]
        advance(robot, plant, impact, state, command)


def explained(errors: Array, effects: Array, moved: Array) -> tuple[Array, Array, Array]:
    """Return the values that explain `errors` (k, QUANTITIES) best, what stays, and their covariance.

    `effects` (k, QUANTITIES, p) are by standard error, as are the result (p,) and its covariance (p, p); the
    values begin `moved` (p,) from their means. What stays (n,) is in units of SCATTER; large errors count
    less.
    """
    wanted = (errors / SCATTER).ravel()
    design = (effects / SCATTER[:, None]).reshape(len(wanted), -1)
    shift, weight = np.zeros(design.shape[1]), np.ones(len(wanted))
    normal, left = np.eye(design.shape[1]), wanted
    for _ in range(_ROUNDS):
        # No threads of a linear algebra library: they wait for each other where others have processors.
        weighted = design * weight[:, None]
        normal = np.einsum("ni,nj->ij", weighted, design) + np.eye(design.shape[1])
        shift = np.linalg.solve(normal, np.einsum("ni,n->i", weighted, wanted) - moved)
        left = wanted - np.einsum("ni,i->n", design, shift)
        weight = 1.0 / np.sqrt(1.0 + (left / _OUTLIER) ** 2)
    return np.asarray(shift), np.asarray(left), np.asarray(np.linalg.inv(normal), np.float64)


def robust_squares(errors: Array) -> Array:
    """Return the squares of `errors`, linear far beyond the scatter."""
    return np.asarray(2.0 * _OUTLIER**2 * (np.sqrt(1.0 + (errors / _OUTLIER) ** 2) - 1.0))


_TABLES: dict[str, Any] = tomllib.loads(Path(__file__).with_name("causes.toml").read_text(encoding="utf-8"))


def table_rows(name: str) -> Iterator[tuple[dict[str, Any], int, int]]:
    """Yield the rows of `causes` or `wear` with joint and chamber, those of each joint after the common ones.

    Their texts have the names of joint and chamber; -1: no joint or chamber.
    """
    for row in _TABLES[name]:
        yield row, -1, -1
    for joint, row in product(range(3), _TABLES[f"joint_{name}"]):
        chambers = (2 * joint, 2 * joint + 1) if "{chamber}" in row["action"] else (-1,)
        for chamber in chambers:
            texts = {"joint": JOINTS[joint], "key": ACTUATOR_KEYS[joint], "side": "AB"[chamber % 2]}
            texts["chamber"] = CHAMBERS[chamber]
            filled = {key: text.format(**texts) for key, text in row.items() if isinstance(text, str)}
            keys = [key.format(**texts) for key in row.get("keys", [])]
            yield {**row, **filled, "keys": keys}, joint, chamber


def _filled(columns: Array) -> Array:
    """Return `columns` (n, k) with the last value in place of missing ones, before it the first."""
    out = np.array(columns)
    for column in out.T:
        good = np.isfinite(column)
        if good.any() and not good.all():
            last = np.maximum.accumulate(np.where(good, np.arange(len(column)), -1))
            column[:] = column[np.where(last < 0, int(np.argmax(good)), last)]
    return np.ascontiguousarray(out)
