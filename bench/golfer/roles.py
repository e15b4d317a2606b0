"""Recorded marker positions, and the roles of markers: which of a file's names are shoulders, hips, club.

A built-in map or a TOML file gives each role a list of markers, whose mean is taken. Built-in maps name sides
left and right; a TOML map may name them lead and trail instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError, did_you_mean
from bench.from_toml import read_toml

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Capture:
    """Marker positions over time in the unit and axes of the file."""

    names: tuple[str, ...]
    """Names of the markers."""
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
        place = str(self.path)
        if frame is not None:
            place += f", frame {frame + 1} ({self.start + frame / self.rate:.3f} s)"
        return BenchError(place + (f", marker {marker}" if marker else ""), found, expected, action)


def damaged(path: Path, found: str, where: str = "", expected: str = "a complete recording") -> BenchError:
    """Return the error of a file that cannot be decoded; `where` is a line or part of it."""
    place = f"{path}, {where}" if where else str(path)
    return BenchError(place, found, expected, "Export or copy the file again.")


def number(path: Path, text: str, where: str) -> float:
    """Return the number in a cell of a text file, NaN where it is empty.

    Raises:
        BenchError: the cell is no number.
    """
    try:
        return float(text) if text.strip() else float("nan")
    except ValueError:
        raise damaged(path, repr(text.strip()[:40]), where, "a number or an empty cell") from None


SIDED = ("shoulder", "arm", "wrist", "hip")
"""Roles on both sides; `arm` is the start of the arm, where the line of the shoulders has another marker."""
CLUB = ("grip", "head")
_MAX_MISSING = 0.2
"""Max fraction of frames without a marker that counts in the mean of its role."""
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
    # The hands: GEARS' cluster on the shaft stands beside it.
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
    """Return the roles in `capture`, by the map in `map_path` or by the built-in ones.

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
            action = f"Assign the markers with --markers MAP.toml: {_FORM}."
            raise capture.error(
                f"no marker for {role} among {_listed(capture)}", "a marker of each role", action
            )
    for name in {name for names in chosen.values() for name in names}:
        if capture.names.count(name) > 1:
            raise capture.error(
                "two markers of this name", "different names", "Rename one of them.", marker=name
            )
    path, markers, dropped = {}, {}, list[str]()
    for role, names in chosen.items():
        kept = _kept(capture, names)
        dropped += [name for name in names if name not in kept]
        columns = [capture.names.index(name) for name in kept]
        path[role], markers[role] = np.mean(capture.points[:, columns], axis=1), kept
    if "pelvis" in chosen:
        _split_pelvis(capture, chosen["pelvis"], sides, path, markers)
    return Roles(path, markers, tuple(dict.fromkeys(dropped)), by_side)


def _split_pelvis(
    capture: Capture,
    names: tuple[str, ...],
    sides: tuple[str, str],
    path: dict[str, Array],
    markers: dict[str, tuple[str, ...]],
) -> None:
    """Replace the role `pelvis` by its two sides; a single marker has no line."""
    del path["pelvis"], markers["pelvis"]
    if len(names) < 2:
        return
    halves = names[: len(names) // 2], names[len(names) // 2 :]
    one, other = (
        np.mean(capture.points[:, [capture.names.index(n) for n in half]], axis=1) for half in halves
    )
    shoulders = path[f"{sides[0]}_shoulder"] - path[f"{sides[1]}_shoulder"]
    is_first = float(np.nansum((one - other) * shoulders)) >= 0.0
    for side, position, half in zip(
        sides, (one, other) if is_first else (other, one), halves if is_first else halves[::-1], strict=True
    ):
        path[f"{side}_hip"], markers[f"{side}_hip"] = position, half


def _kept(capture: Capture, names: Sequence[str]) -> tuple[str, ...]:
    """Return the markers among `names` that are present in most frames, else the one present longest."""
    missing = {
        name: float(np.mean(np.isnan(capture.points[:, capture.names.index(name), 0]))) for name in names
    }
    kept = tuple(name for name in names if missing[name] <= _MAX_MISSING)
    return kept or (min(missing, key=lambda name: missing[name]),)


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
        if role not in (*known, "pelvis"):
            raise BenchError(
                f"{path}, {role}",
                "no such role",
                f"one of {', '.join(known)}, pelvis",
                did_you_mean(role, known, "Correct the role."),
            )
        names = [value] if isinstance(value, str) else value
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            raise BenchError(
                f"{path}, {role}", repr(value)[:60], "a list of names of markers", f"Write {_FORM}."
            )
        for name in names:
            if _find(capture, name) is None:
                action = did_you_mean(name, capture.names, f"The file has {_listed(capture)}.")
                raise capture.error("no such marker", f"a marker of the file for {role}", action, marker=name)
        found[role] = tuple(str(_find(capture, name)) for name in names)
    sides = {role.split("_")[0] for role in found} & {"lead", "left"}
    if len(sides) > 1:
        raise BenchError(
            str(path), "left and lead together", "left and right, or lead and trail", "Use one pair."
        )
    return found
