"""Unit, up axis and sides of a recording by the golfer in it; the swing plane and directions in it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bench.errors import BenchError
from bench.golfer.roles import SIDED, Array, Capture, Roles


class SwingPlane(NamedTuple):
    """A plane through the ball: axes as unit vectors in the file's directions."""

    target: Array
    """Level, towards the target (3,)."""
    up: Array
    """Up in the plane (3,)."""
    normal: Array
    """Normal of the plane, upwards (3,)."""

    @property
    def axes(self) -> Array:
        """The three unit vectors as rows (3, 3)."""
        return np.stack([self.target, self.up, self.normal])

    def inclination(self, vertical: Array) -> float:
        """Return the angle between the plane and the ground (rad)."""
        return float(np.arccos(np.clip(abs(self.normal @ vertical), 0.0, 1.0)))


def fitted_plane(arc: Array, vertical: Array) -> SwingPlane:
    """Return the plane of least squares through `arc` (n, 3), which moves towards the target at its end."""
    _, _, axes = np.linalg.svd(arc - arc.mean(axis=0), full_matrices=False)
    normal = axes[2] * (1.0 if axes[2] @ vertical >= 0.0 else -1.0)
    up = vertical - (vertical @ normal) * normal
    up /= np.linalg.norm(up)
    target = np.cross(up, normal)
    moving = arc[-1] - arc[-min(len(arc), 6)]
    return SwingPlane(target * (1.0 if target @ moving >= 0.0 else -1.0), up, normal)


def last_level_row(from_: Array, to: Array, vertical: Array) -> int:
    """Return the last row in which the line between two paths (n, 3) turns below level; 0 if never."""
    above = (to - from_) @ vertical > 0.0
    rows = np.flatnonzero(above)
    return int(rows[-1]) if len(rows) else 0


def projected_angle(vectors: Array, plane: SwingPlane) -> Array:
    """Return the angles (n,) of `vectors` (n, 3) in the plane from the level towards the target (rad)."""
    found: Array = np.unwrap(np.arctan2(vectors @ plane.up, vectors @ plane.target))
    return found


def turn_about(vectors: Array, target: Array, front: Array) -> Array:
    """Return how far level lines (n, 3) are turned away from the target (rad), the lead side to `front`."""
    found: Array = np.unwrap(np.arctan2(vectors @ front, vectors @ target))
    return found


_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
_ALIASES = {
    "meter": "m",
    "meters": "m",
    "metre": "m",
    "metres": "m",
    "centimeters": "cm",
    "centimetres": "cm",
    "millimeters": "mm",
    "millimetres": "mm",
    "inch": "in",
    "inches": "in",
}
_FOUND = ("m", "cm", "mm")
"""Units that sizes alone decide."""
_ARM = 0.42, 0.80
"""Shoulder to wrist of a person, straightest of the swing (m)."""
_SHOULDERS = 0.20, 0.60
"""Shoulder to shoulder, widest of the swing (m)."""
_CLEAR = 1.2
"""Min ratio of the longest to the second component of an up axis."""


class Orientation(NamedTuple):
    """Unit, axes and sides of a recording."""

    unit: str
    """Unit, and how it was found."""
    scale: float
    """Factor to m."""
    up: str
    """Up axis, and how it was found."""
    lead: str
    """Lead side, left or right."""
    lead_clue: str
    """How the sides were found."""


def find_scale(capture: Capture, roles: Roles) -> tuple[float, str]:
    """Return the factor to m and the words for it: the unit that the file declares, else by the sizes.

    Raises:
        BenchError: the sizes are not a person's, or the unit is unknown.
    """
    arm, shoulders = _sizes(roles)
    fits = [unit for unit, scale in _UNITS.items() if _is_person(scale * arm, scale * shoulders)]
    declared = capture.unit.lower()
    declared = _ALIASES.get(declared, declared)
    if declared:
        if declared not in _UNITS:
            raise capture.error(f"unit {capture.unit[:20]}", f"one of {', '.join(_UNITS)}", "Export in mm.")
        if declared not in fits:
            found = f"an arm of {arm:.3g} and shoulders of {shoulders:.3g} {declared}"
            fitting = f"; they would fit {fits[0]}" if fits else ""
            action = f"Correct the unit in the file{fitting}."
            raise capture.error(found, "sizes of a person", action, marker=_arm_markers(roles))
        return _UNITS[declared], f"{declared}, declared by the file"
    known = [unit for unit in fits if unit in _FOUND]
    if not known:
        found = f"an arm of {arm:.3g} and shoulders of {shoulders:.3g} in the file's unit"
        action = "Export in m, cm or mm; or correct the markers of the roles."
        raise capture.error(found, "sizes of a person in m, cm or mm", action, marker=_arm_markers(roles))
    return _UNITS[known[0]], f"{known[0]}, by an arm of {_UNITS[known[0]] * arm:.2f} m"


def _sizes(roles: Roles) -> tuple[float, float]:
    """Return arm and width of the shoulders in the file's unit, each when it is long."""

    def long(a: str, b: str) -> float:
        apart = np.linalg.norm(roles.path[a] - roles.path[b], axis=1)
        return float(np.nanpercentile(apart, 75)) if np.isfinite(apart).any() else float("nan")

    first, second = ("left", "right") if roles.by_side else ("lead", "trail")
    arms = [
        long(f"{side}_shoulder", f"{side}_wrist") for side in (first, second) if f"{side}_wrist" in roles.path
    ]
    return max(arms), long(f"{first}_shoulder", f"{second}_shoulder")


def _is_person(arm: float, shoulders: float) -> bool:
    return _ARM[0] <= arm <= _ARM[1] and _SHOULDERS[0] <= shoulders <= _SHOULDERS[1]


def _arm_markers(roles: Roles) -> str:
    side = "left" if roles.by_side else "lead"
    return " to ".join(roles.markers[f"{side}_{part}"][0] for part in ("shoulder", "wrist"))


def find_vertical(capture: Capture, whole: dict[str, Array], frame: int, stated: str) -> tuple[Array, str]:
    """Return the unit vector upwards and the words for it: as `stated`, else from club or hands to shoulders.

    Raises:
        BenchError: no axis is clearly up.
    """
    shoulders = np.mean([path[frame] for role, path in whole.items() if role.endswith("shoulder")], axis=0)
    low = "head" if "head" in whole else next(role for role in whole if role.endswith("wrist"))
    rising = shoulders - whole[low][frame]
    if stated:
        axis = "xyz".index(stated[-1])
        vertical = np.zeros(3)
        vertical[axis] = -1.0 if stated.startswith("-") else 1.0
        if rising @ vertical <= 0.0:
            raise BenchError(
                "--up",
                stated,
                f"an axis in which the shoulders are above the {low}",
                "Leave --up out, or correct it.",
            )
        return vertical, f"{stated.upper()}, by --up"
    sizes = np.abs(rising)
    axis = int(np.argmax(sizes))
    if sizes[axis] < _CLEAR * float(np.sort(sizes)[1]):
        found = f"shoulders {np.round(rising, 2).tolist()} m from the {low}"
        raise capture.error(found, "one axis that is clearly up", "Give --up x, y or z.", frame)
    vertical = np.zeros(3)
    vertical[axis] = np.sign(rising[axis])
    name = ("-" if vertical[axis] < 0.0 else "") + "XYZ"[axis]
    return vertical, f"{name}, from {'club' if low == 'head' else 'hands'} to shoulders at the ball"


def find_sides(
    capture: Capture, whole: dict[str, Array], frame: int, vertical: Array, stated: str, by_side: bool
) -> tuple[dict[str, str], tuple[str, str]]:
    """Return the roles by lead and trail (new name to old), the lead side and the words for it.

    Raises:
        BenchError: left and right, or lead and trail, are swapped in the file.
    """
    first, second = ("left", "right") if by_side else ("lead", "trail")
    line = whole[f"{first}_shoulder"][frame] - whole[f"{second}_shoulder"][frame]
    low = "head" if "head" in whole else f"{first}_wrist"
    moving = whole[low][frame] - whole[low][max(frame - 3, 0)]
    to_ball = whole[low][frame] - np.mean([whole[f"{s}_shoulder"][frame] for s in (first, second)], axis=0)
    lead_is_first = bool(line @ (moving - (moving @ vertical) * vertical) > 0.0)
    # A person whose left is at `line` looks along line x up: the ball is there.
    faces_ball = bool(np.cross(line, vertical) @ to_ball > 0.0)
    if by_side:
        lead = "left" if lead_is_first else "right"
        clue = "by the shoulder nearer to the target at the ball"
        if not faces_ball:
            clue += "; the file's axes are left-handed, or its left and right are swapped"
    else:
        if not lead_is_first:
            raise capture.error(
                "sides swapped: the trail shoulder is nearer to the target",
                "the lead shoulder nearer",
                "Swap lead_ and trail_ in the map.",
                frame,
                "shoulders",
            )
        lead = "left" if faces_ball else "right"
        clue = "by the map and the side of the ball"
    if stated and stated != lead:
        raise capture.error(
            f"lead {lead}, {clue}",
            f"lead {stated} as in --lead",
            "Leave --lead out, or correct the markers.",
            frame,
        )
    lead_side, trail_side = (first, second) if lead_is_first else (second, first)
    named = {
        f"{new}_{part}": f"{old}_{part}"
        for new, old in (("lead", lead_side), ("trail", trail_side))
        for part in SIDED
        if f"{old}_{part}" in whole
    }
    return named | {role: role for role in ("grip", "head") if role in whole}, (lead, clue)
