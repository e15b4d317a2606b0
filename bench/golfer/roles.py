"""Recorded marker positions, the roles of markers, and unit, up axis, sides and swing plane by them.

Recorded marker positions, and the roles of markers: which of a file's names are shoulders, hips, club. A
built-in map or a TOML file gives each role a list of markers, whose mean is taken. Built-in maps name sides
left and right; a TOML map may name them lead and trail instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import BenchError, did_you_mean
from bench.base.from_toml import read_toml
from drivers.base.ranges import read_number

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Capture:
    """Marker positions over time in the unit and axes of the file."""

    names: tuple[str, ...]
    points: Array
    """Positions (frames, markers, 3), NaN where a marker is missing."""
    rate: float
    """Frame rate (Hz)."""
    unit: str = ""
    """Unit that the file declares, empty without one."""
    start: float = 0.0
    """Time of the first frame (s)."""
    path: Path = field(default_factory=Path)
    """Source file."""
    digest: str = ""
    """SHA-256 of the source file."""

    def error(
        self, found: str, expected: str, action: str, frame: int | None = None, marker: str = ""
    ) -> BenchError:
        """Return the refusal of this file, with the 0-based `frame` and the `marker` in its place."""
        location = str(self.path)
        if frame is not None:
            location += f", frame {frame + 1} ({self.start + frame / self.rate:.3f} s)"
        return BenchError(location + (f", marker {marker}" if marker else ""), found, expected, action)


def damaged(path: Path, found: str, where: str = "", expected: str = "a complete recording") -> BenchError:
    """Return the error of a file that cannot be decoded; `where` is a line or part of it."""
    location = f"{path}, {where}" if where else str(path)
    return BenchError(location, found, expected, "Export or copy the file again.")


def number(path: Path, text: str, where: str) -> float:
    """Return the number in a cell of a text file, NaN where it is empty.

    Raises:
        BenchError: the cell is no number.
    """
    try:
        return read_number(text) if text.strip() else float("nan")
    except ValueError:
        raise damaged(path, repr(text.strip()[:40]), where, "a number or an empty cell") from None


SIDED = ("shoulder", "arm", "wrist", "hip")
"""Roles on both sides; `arm` is the start of the arm, where the line of the shoulders has another marker."""
CLUB = ("grip", "head")
_MAX_MISSING = 0.2
"""Max fraction of missing frames for a marker to count in the mean of its role."""
_FORM = 'lead_shoulder = ["NAME"], trail_shoulder, lead_wrist; with a club: grip, head'

_LEFT: Mapping[str, Sequence[tuple[str, ...]]] = {
    "shoulder": [("LSHO",), ("LShoulderBack",), ("LeftArm",)],
    "arm": [("LShoulderTop", "LShoulderBack")],
    "wrist": [("LWRI",), ("LWRA", "LWRB"), ("LWristTop",), ("LeftHand",)],
    "hip": [("LHIP",), ("LASI",), ("WaistLeft",), ("LeftUpLeg",)],
}
"""Names of the left side: joint centres, plug-in gait, GEARS, BVH; those of the right side follow."""
_CLUB: Mapping[str, Sequence[tuple[str, ...]]] = {
    "grip": [("GRIP",), ("LWristTop", "RWristTop")],
    # The hands: GEARS' cluster on the shaft is off its axis.
    "head": [("HEAD",), ("Marker_2:2:1", "Marker_2:2:2", "Marker_2:2:3")],
}


class Roles(NamedTuple):
    """Paths of the roles in a recording."""

    path: dict[str, Array]
    """Position (frames, 3) by role with its side, left or lead, NaN where missing."""
    markers: dict[str, tuple[str, ...]]
    """Markers of each role."""
    dropped: tuple[str, ...]
    """Markers left out because they are missing in too many frames."""
    by_side: bool
    """Whether sides are left and right; else they are lead and trail."""


def find_roles(capture: Capture, map_path: Path | None = None) -> Roles:
    """Return the markers of each role in `capture`, by the map in `map_path` or by the built-in ones.

    Raises:
        BenchError: the map is damaged, or a role has no marker; the file's names are listed.
    """
    chosen = _built_in(capture) if map_path is None else _read_map(capture, map_path)
    by_side = not any(role.startswith(("lead", "trail")) for role in chosen)
    sides = ("left", "right") if by_side else ("lead", "trail")
    needed = [f"{sides[0]}_shoulder", f"{sides[1]}_shoulder"]
    needed += [f"{side}_wrist" for side in (sides if by_side else sides[:1])]
    club = [role for role in CLUB if role in chosen]
    needed += CLUB if club else ()
    for role in needed:
        if role not in chosen:
            found = f"no marker for {role} among {_listed(capture)}"
            action = f"Assign the markers with --markers MAP.toml: {_FORM}."
            raise capture.error(found, "a marker of each role", action)
    for name in {name for names in chosen.values() for name in names}:
        if capture.names.count(name) > 1:
            found, action = "two markers of this name", "Rename one of them."
            raise capture.error(found, "different names", action, marker=name)
    path, markers, dropped = {}, {}, list[str]()
    for role, names in chosen.items():
        lost = np.isnan(capture.points[:, [capture.names.index(name) for name in names], 0]).mean(axis=0)
        # Those present in most frames, else the one present longest.
        kept = tuple(name for name, share in zip(names, lost, strict=True) if share <= _MAX_MISSING)
        kept = kept or (names[int(np.argmin(lost))],)
        dropped += [name for name in names if name not in kept]
        columns = [capture.names.index(name) for name in kept]
        path[role], markers[role] = np.mean(capture.points[:, columns], axis=1), kept
    return Roles(path, markers, tuple(dict.fromkeys(dropped)), by_side)


def _listed(capture: Capture) -> str:
    names = ", ".join(capture.names)
    return names if len(names) <= 600 else names[:600] + " …"


def _find(capture: Capture, wanted: str) -> str | None:
    """Return the marker called `wanted`, also behind the name of a subject (`Anna:LSHO`)."""
    if wanted in capture.names:
        return wanted
    behind = [name for name in capture.names if name.rpartition(":")[2] == wanted]
    return behind[0] if len(behind) == 1 else None


def _first(capture: Capture, choices: Sequence[tuple[str, ...]]) -> tuple[str, ...] | None:
    for names in choices:
        found = [name for name in (_find(capture, one) for one in names) if name is not None]
        if len(found) == len(names):
            return tuple(found)
    return None


def _right(name: str) -> str:
    """Return the name on the right side that belongs to `name` on the left."""
    return name.replace("Left", "Right") if "Left" in name else "R" + name[1:]


def _built_in(capture: Capture) -> dict[str, tuple[str, ...]]:
    found: dict[str, tuple[str, ...] | None] = {}
    for part, choices in _LEFT.items():
        found[f"left_{part}"] = _first(capture, choices)
        found[f"right_{part}"] = _first(capture, [tuple(map(_right, names)) for names in choices])
    for part, choices in _CLUB.items():
        found[part] = _first(capture, choices)
    return {role: names for role, names in found.items() if names}


def _read_map(capture: Capture, path: Path) -> dict[str, tuple[str, ...]]:
    raw = read_toml(path, "a map from roles to markers", f"Write one: {_FORM}.")
    known = [f"{side}_{part}" for side in ("lead", "trail", "left", "right") for part in SIDED] + list(CLUB)
    found: dict[str, tuple[str, ...]] = {}
    for role, value in raw.items():
        location = f"{path}, {role}"
        if role not in known:
            action = did_you_mean(role, known, "Correct the role.")
            raise BenchError(location, "no such role", f"one of {', '.join(known)}", action)
        names = [value] if isinstance(value, str) else value
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            raise BenchError(location, repr(value)[:60], "a list of names of markers", f"Write {_FORM}.")
        for name in names:
            if _find(capture, name) is None:
                action = did_you_mean(name, capture.names, f"The file has {_listed(capture)}.")
                raise capture.error("no such marker", f"a marker of the file for {role}", action, marker=name)
        found[role] = tuple(str(_find(capture, name)) for name in names)
    sides = {role.split("_")[0] for role in found} & {"lead", "left"}
    if len(sides) > 1:
        action = "Replace left by lead and right by trail, or the reverse."
        raise BenchError(str(path), "left and lead together", "left and right, or lead and trail", action)
    return found


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
    """Return the least-squares plane through `arc` (n, 3), whose end moves towards the target."""
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


def turn_about(vectors: Array, target: Array, front: Array) -> Array:
    """Return the angles (n,) of `vectors` (n, 3) from the target towards `front`, in their plane (rad)."""
    found: Array = np.unwrap(np.arctan2(vectors @ front, vectors @ target))
    return found


_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
_ALIASES = {"meter": "m", "centimeter": "cm", "millimeter": "mm", "inch": "in", "inche": "in"}
"""Units written out, without the plural's s and in American spelling."""
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
    fits = [
        unit
        for unit, scale in _UNITS.items()
        if _ARM[0] <= scale * arm <= _ARM[1] and _SHOULDERS[0] <= scale * shoulders <= _SHOULDERS[1]
    ]
    declared = capture.unit.lower()
    declared = _ALIASES.get(declared.removesuffix("s").replace("metre", "meter"), declared)
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

    sides = ("left", "right") if roles.by_side else ("lead", "trail")
    with_wrist = [side for side in sides if f"{side}_wrist" in roles.path]
    arm = max(long(f"{side}_shoulder", f"{side}_wrist") for side in with_wrist)
    return arm, long(*(f"{side}_shoulder" for side in sides))


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
            wanted = f"an axis in which the shoulders are above the {low}"
            raise BenchError("--up", stated, wanted, "Leave --up out, or correct it.")
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
    """Return the roles by lead and trail (new name to old), the lead side and its description.

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
            found, action = "the trail shoulder is nearer to the target", "Swap lead_ and trail_ in the map."
            raise capture.error(
                f"sides swapped: {found}", "the lead shoulder nearer", action, frame, "shoulders"
            )
        lead = "left" if faces_ball else "right"
        clue = "by the map and the side of the ball"
    if stated and stated != lead:
        action = "Leave --lead out, or correct the markers."
        raise capture.error(f"lead {lead}, {clue}", f"lead {stated} as in --lead", action, frame)
    lead_side, trail_side = (first, second) if lead_is_first else (second, first)
    named = {
        f"{new}_{part}": f"{old}_{part}"
        for new, old in (("lead", lead_side), ("trail", trail_side))
        for part in SIDED
        if f"{old}_{part}" in whole
    }
    return named | {role: role for role in CLUB if role in whole}, (lead, clue)
