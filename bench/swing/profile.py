"""A swing profile: what the robot is to do, tick by tick, and how it stops when it may not go on.

A profile is one TOML file: who and what it is for, the planned delivery, tables per actuator at a fixed
period, the no-return instant, the impact window, blind-brake patterns and the limits it was designed
for. It runs from address to standstill after the follow-through; the return is the controller's.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError, did_you_mean
from bench.from_toml import GREATEST, format_value, read_toml
from bench.lifecycle import Phase

Array = NDArray[np.float64]

SCHEMA = "golfbench-profile/1"
PHASES = (
    Phase.HOLD,
    Phase.BACKSWING,
    Phase.TOP,
    Phase.DOWNSWING,
    Phase.COMMITTED,
    Phase.IMPACT,
    Phase.FOLLOW_THROUGH,
)
"""Phases of a profile in their order; each begins where `begins` says."""


@dataclass(frozen=True)
class Profile:
    """One swing; arrays at `period` s from the start of the swing, n samples, joints in order.

    `angle` (n, 3) rad, `velocity` (n, 3) rad/s, `valve` (n, 3) feed-forward openings, `begins` (7,) the
    sample at which each of PHASES begins, `blind_brake` (m, 6): valve openings and their durations (s) for
    a blind stop begun at sample k * `blind_spacing`.
    """

    name: str
    text: str
    golfer: str
    club: str
    period: float
    begins: tuple[int, ...]
    angle: Array
    velocity: Array
    valve: Array
    blind_spacing: int
    blind_brake: Array
    ball: tuple[float, float]
    """Where the face centre meets the ball in the swing plane (m)."""
    impact_time: float
    """Planned contact, s from the start."""
    delivery: dict[str, float] = field(default_factory=dict)
    """Planned head_speed_mps, attack_angle_deg, shaft_lean_deg, ball_position; for people and checks."""
    limits: dict[str, float] = field(default_factory=dict)
    """What it was designed for: supply_pressure_pa, greatest_opening, ..."""

    @property
    def duration(self) -> float:
        """From start to planned standstill, s."""
        return len(self.angle) * self.period

    @property
    def downswing_time(self) -> float:
        """From the top to the ball, s."""
        return self.impact_time - self.begins[PHASES.index(Phase.DOWNSWING)] * self.period

    def phase_of(self, sample: int) -> Phase:
        """Return the phase at `sample`."""
        return PHASES[int(np.searchsorted(self.begins, sample, side="right")) - 1]

    @property
    def phases(self) -> NDArray[np.uint8]:
        """Phase of each sample."""
        return np.array(PHASES, dtype=np.uint8)[
            np.searchsorted(self.begins, np.arange(len(self.angle)), side="right") - 1
        ]


_TEXT = (str, "a text in quotes")
_SECONDS = (float, "a finite number of seconds, with a decimal point")
_SCALARS: dict[str, tuple[type, str]] = {
    "schema": _TEXT,
    "name": _TEXT,
    "text": _TEXT,
    "golfer": _TEXT,
    "club": _TEXT,
    "period_s": _SECONDS,
    "blind_spacing": (int, "a whole number of samples"),
    "impact_time_s": _SECONDS,
}
_TABLES = {
    "ball_m": 1,
    "begins": 1,
    "angle_rad": 2,
    "velocity_rad_per_s": 2,
    "valve": 2,
    "blind_brake": 2,
}
_GROUPS = ("delivery", "limits")


def load_profile(path: Path) -> Profile:
    """Read and check the profile at `path`.

    Raises:
        BenchError: the file is missing or not TOML, a key is unknown, missing or of the wrong type, a number
            is not finite or outside its physical range, or the tables do not fit together.
    """
    cure = "`golfbench swing list` shows the known ones."
    raw = read_toml(path, "a swing profile", cure)
    return _check(path, raw)


def _check(path: Path, raw: dict[str, Any]) -> Profile:
    known = set(_SCALARS) | set(_TABLES) | set(_GROUPS)
    cure = "Mend the profile or design it anew with `golfbench swing design`."
    for key in sorted(set(raw) - known):
        mend = did_you_mean(key, known, cure)
        raise BenchError(f"{path}: {key}", "an unknown key", f"one of {', '.join(sorted(known))}", mend)
    for key in sorted(known - set(raw)):
        raise BenchError(f"{path}: {key}", "nothing", "this key", cure)
    for key, (kind, text) in _SCALARS.items():
        if type(raw[key]) is not kind or (kind is float and not np.isfinite(raw[key])):
            raise BenchError(f"{path}: {key}", format_value(raw[key]), text, cure)
    if raw["blind_spacing"] < 1:
        raise BenchError(f"{path}: blind_spacing", str(raw["blind_spacing"]), "at least 1 sample", cure)
    if raw["schema"] != SCHEMA:
        raise BenchError(f"{path}: schema", repr(raw["schema"]), repr(SCHEMA), cure)
    for key in _GROUPS:
        group = raw[key]
        if not isinstance(group, dict) or not all(
            type(v) in {int, float} and abs(v) <= GREATEST for v in group.values()
        ):
            raise BenchError(f"{path}: {key}", repr(group), "a table of finite numbers", cure)
    tables: dict[str, Array] = {}
    for key, dimensions in _TABLES.items():
        try:
            if not _only_numbers(raw[key]):
                raise TypeError
            array = np.array(raw[key], dtype=float)
        except (TypeError, ValueError, OverflowError):
            raise BenchError(
                f"{path}: {key}", "rows of different length or not numbers", "a table of numbers", cure
            ) from None
        if array.ndim != dimensions:
            raise BenchError(f"{path}: {key}", f"{array.ndim} dimensions", f"{dimensions}", cure)
        if not np.all(np.isfinite(array)):
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
            raise BenchError(
                f"{path}: {key}[{', '.join(map(str, where))}]", "not a finite number", "a finite number", cure
            )
        tables[key] = array
    n = len(tables["angle_rad"])
    shapes = {
        "ball_m": (2,),
        "begins": (len(PHASES),),
        "angle_rad": (n, 3),
        "velocity_rad_per_s": (n, 3),
        "valve": (n, 3),
        "blind_brake": (max(n - 1, 0) // max(raw["blind_spacing"], 1) + 1, 6),
    }
    for key, shape in shapes.items():
        if tables[key].shape != shape:
            raise BenchError(f"{path}: {key}", f"shape {tables[key].shape}", f"shape {shape}", cure)
    if np.any(tables["begins"] % 1):
        raise BenchError(f"{path}: begins", repr(raw["begins"]), "whole numbers of samples", cure)
    begins = tuple(int(v) for v in tables["begins"])
    ranges: tuple[tuple[str, Array, float, float, str], ...] = (
        ("period_s", np.array([raw["period_s"]]), 1e-4, 0.02, "0.0001 to 0.02 s"),
        ("angle_rad", tables["angle_rad"], -10.0, 10.0, "-10 to 10 rad"),
        ("velocity_rad_per_s", tables["velocity_rad_per_s"], -100.0, 100.0, "-100 to 100 rad/s"),
        ("valve", tables["valve"], -1.0, 1.0, "openings -1 to 1"),
        ("blind_brake", tables["blind_brake"][:, :3], -1.0, 1.0, "openings -1 to 1"),
        ("blind_brake", tables["blind_brake"][:, 3:], 0.0, 2.0, "durations 0 to 2 s"),
        (
            "impact_time_s",
            np.array([raw["impact_time_s"]]),
            0.0,
            n * raw["period_s"],
            "a time within the swing",
        ),
        ("ball_m", tables["ball_m"], -3.0, 3.0, "-3 to 3 m"),
    )
    for key, values, low, high, expected in ranges:
        if np.any(values < low) or np.any(values > high):
            worst = values.flat[int(np.argmax(np.maximum(low - values, values - high)))]
            raise BenchError(f"{path}: {key}", f"{worst:g}", expected, cure)
    if n < 2 or begins[0] != 0 or list(begins) != sorted(begins) or begins[-1] >= n:
        raise BenchError(f"{path}: begins", repr(begins), f"rising samples from 0, all below {n}", cure)
    return Profile(
        name=raw["name"],
        text=raw["text"],
        golfer=raw["golfer"],
        club=raw["club"],
        period=raw["period_s"],
        begins=begins,
        angle=tables["angle_rad"],
        velocity=tables["velocity_rad_per_s"],
        valve=tables["valve"],
        blind_spacing=raw["blind_spacing"],
        blind_brake=tables["blind_brake"],
        ball=(float(tables["ball_m"][0]), float(tables["ball_m"][1])),
        impact_time=raw["impact_time_s"],
        delivery={k: float(v) for k, v in raw["delivery"].items()},
        limits={k: float(v) for k, v in raw["limits"].items()},
    )


def _only_numbers(value: Any) -> bool:
    """Tell whether `value` is a number or (nested) lists of numbers; True, False and texts are none."""
    return all(map(_only_numbers, value)) if isinstance(value, list) else type(value) in {int, float}


_DIGITS = {"angle": 6, "velocity": 4, "valve": 5, "blind_brake": 4}
"""Behind the decimal point in a file."""


def as_written(profile: Profile) -> Profile:
    """Return `profile` with its tables as `save_profile` rounds them."""
    return replace(profile, **{key: np.round(getattr(profile, key), n) for key, n in _DIGITS.items()})


def save_profile(path: Path, profile: Profile) -> None:
    """Write `profile` as TOML that `load_profile` reads back; one row of a table a line."""

    def quoted(text: str) -> str:
        return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")

    def rows(key: str) -> str:
        array, digits = getattr(profile, key), _DIGITS[key]
        lines = ("  [" + ", ".join(f"{value:.{digits}f}" for value in row) + "]," for row in array)
        return "[\n" + "\n".join(lines) + "\n]"

    def group(values: dict[str, float]) -> str:
        return "\n".join(f"{key} = {value!r}" for key, value in values.items())

    text = f'''schema = "{SCHEMA}"
name = {quoted(profile.name)}
text = {quoted(profile.text)}
golfer = {quoted(profile.golfer)}
club = {quoted(profile.club)}
period_s = {profile.period!r}
# Sample at which hold, backswing, top, downswing, committed, impact window, follow-through begin.
begins = {list(profile.begins)!r}
# Face centre at the ball in the swing plane (x0, y0).
ball_m = [{profile.ball[0]!r}, {profile.ball[1]!r}]
impact_time_s = {profile.impact_time!r}
blind_spacing = {profile.blind_spacing}
# Columns: shoulder, arm, wrist.
angle_rad = {rows("angle")}
velocity_rad_per_s = {rows("velocity")}
valve = {rows("valve")}
# Openings of the three valves, then how long each holds (s); one row every blind_spacing samples.
blind_brake = {rows("blind_brake")}

[delivery]
{group(profile.delivery)}

[limits]
{group(profile.limits)}
'''
    path.write_text(text, encoding="utf-8")
