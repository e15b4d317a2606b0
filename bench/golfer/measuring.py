"""From recorded markers to a golfer's swing: unit, axes, sides, events, plane, angles on 1 ms.

The filter sees frames before the ball only.
"""

from __future__ import annotations

import numpy as np

from bench.base.errors import BenchError
from bench.golfer.events import (
    GIVEN,
    PLACE,
    Impact,
    at_times,
    check_arm,
    check_exchanges,
    check_jumps,
    check_losses,
    check_swing,
    continued,
    filled,
    find_impact,
    find_top,
    missing_runs,
    smooth,
)
from bench.golfer.golfer_file import HANDS_CUTOFF, STEP, ImportOptions, MeasuredSwing
from bench.golfer.roles import (
    Array,
    Capture,
    Orientation,
    Roles,
    SwingPlane,
    find_scale,
    find_sides,
    find_vertical,
    fitted_plane,
    last_level_row,
    projected_angle,
    turn_about,
)

_CLEAR = 0.001
"""Time before the ball from which frames are left out, since the ball may have touched the head (s)."""
_MAX_LENGTH = 2.5
"""Max duration before the ball that is kept (s)."""


def measure(capture: Capture, roles: Roles, options: ImportOptions) -> MeasuredSwing:
    """Return the golfer's swing in `capture`.

    Raises:
        BenchError: the recording fails a gate; the place has file, frame and marker.
    """
    scale, unit = find_scale(capture, roles)
    raw = {role: path * scale for role, path in roles.path.items()}
    for role, path in raw.items():
        if np.count_nonzero(~np.isnan(path[:, 0])) < 12:
            raise capture.error(
                "less than 12 frames with this marker",
                "a marker in most frames",
                "Record again, or assign another marker.",
                marker=roles.markers[role][0],
            )
    whole = {role: filled(path, capture.rate) for role, path in raw.items()}
    impact = _impact(capture, roles, whole, options)
    vertical, up_words = find_vertical(capture, whole, int(impact.frame), options.up)
    named, sides = find_sides(capture, whole, int(impact.frame), vertical, options.lead, roles.by_side)
    names = {new: roles.markers[old] for new, old in named.items()}
    raw = {new: raw[old] for new, old in named.items()}
    check_exchanges(capture, raw, names, impact.frame)
    check_jumps(capture, raw, names, impact.frame)
    check_losses(capture, raw, names, impact.frame)
    check_arm(capture, raw, names, impact.frame)
    grid = _Grid(capture, impact, options.cutoff)
    paths = {role: grid.path(role, filled(path, capture.rate), raw) for role, path in raw.items()}
    orientation = Orientation(unit, scale, up_words, *sides)
    swing = _in_plane(capture, paths, grid, vertical, orientation, options, raw)
    check_swing(capture, swing, names, {role: missing_runs(path) for role, path in raw.items()}, impact.frame)
    return swing


def _impact(capture: Capture, roles: Roles, whole: dict[str, Array], options: ImportOptions) -> Impact:
    """Return the impact by the events of `options` or by the clues.

    Raises:
        BenchError: the file has no impact.
    """
    if options.impact is not None:
        frame = (options.impact - capture.start) * capture.rate
        if not 12 <= frame <= len(capture.points) - 1:
            raise BenchError(
                "--events impact",
                f"{options.impact:g} s",
                "a time within the file",
                "Correct it to that of the ball.",
            )
        return Impact(frame, GIVEN)
    role = "head" if "head" in whole else next(role for role in whole if role.endswith("wrist"))
    found = find_impact(whole[role], capture.rate, is_head=role == "head")
    if found is None or found.frame < 12:
        last = int(np.flatnonzero(~np.isnan(roles.path[role][:, 0]))[-1])
        action = "Export the recording from address to follow-through, or give --events impact=S."
        found_text = "no impact: neither a loss of head speed nor a pass of the position at address"
        raise capture.error(found_text, "the ball within the file", action, last, roles.markers[role][0])
    return found


class _Grid:
    """Rows of 1 ms up to the ball, and the paths on them."""

    def __init__(self, capture: Capture, impact: Impact, cutoff: tuple[float, float]) -> None:
        self.rate, self.cutoff, self.impact = capture.rate, cutoff, impact
        self.first = max(int(np.ceil(impact.frame - _MAX_LENGTH * self.rate)), 0)
        self.last = int(np.ceil(impact.frame - _CLEAR * self.rate)) - 1
        rows = int((impact.frame - self.first) / self.rate / STEP)
        self.time: Array = -STEP * np.arange(rows, -1, -1, dtype=float)
        self.velocity: dict[str, Array] = {}

    def path(self, role: str, whole: Array, raw: dict[str, Array]) -> Array:
        """Return the smoothed path (n, 3) of `role` at the rows, and store its velocity."""
        part = slice(self.first, self.last + 1)
        body, club = self.cutoff
        is_body = role.endswith(("shoulder", "arm", "hip"))
        centre = None
        if not is_body:
            shoulders = [filled(raw[name], self.rate)[self.last] for name in raw if name.endswith("shoulder")]
            centre = np.mean(shoulders, axis=0)
        cutoff = club if role in ("head", "grip") else body if is_body else body * HANDS_CUTOFF
        ahead = continued(whole[part], self.rate, centre)
        smoothed = smooth(ahead, self.rate, cutoff)
        start = (self.first - self.impact.frame) / self.rate
        places, self.velocity[role] = at_times(smoothed, self.rate, start, self.time)
        return places


def _in_plane(
    capture: Capture,
    paths: dict[str, Array],
    grid: _Grid,
    vertical: Array,
    orientation: Orientation,
    options: ImportOptions,
    raw: dict[str, Array],
) -> MeasuredSwing:
    """Return the swing as seen in its plane."""
    has_club = "head" in paths
    far, near = ("head", "grip") if has_club else ("lead_wrist", "lead_shoulder")
    level = min(last_level_row(paths[near], paths[far], vertical), len(grid.time) - 20)
    plane = fitted_plane(paths[far][max(level, 0) :], vertical)
    arm = "lead_arm" if "lead_arm" in paths else "lead_shoulder"
    lines = [("trail_shoulder", "lead_shoulder"), (arm, "lead_wrist")]
    lines += [("grip", "head")] if has_club else []
    turned = [projected_angle(paths[to] - paths[start], plane) for start, to in lines]
    speed: dict[str, Array] = {
        role: np.linalg.norm(grid.velocity[role], axis=1) for role in ("lead_wrist", "head") if role in paths
    }
    top, clue = _top(capture, grid, speed["lead_wrist"], options)
    club_top = None
    if has_club:
        club_top = find_top(grid.time, np.abs(np.gradient(turned[2])), longest=-float(grid.time[top]) + 0.10)
    turned[0] = turned[0] - 2 * np.pi * np.round(turned[0][top] / (2 * np.pi))
    angle = np.full((len(grid.time), 3), np.nan)
    angle[:, 0] = turned[0]
    for joint in range(1, len(turned)):
        relative = turned[joint] - turned[joint - 1]
        angle[:, joint] = relative - 2 * np.pi * np.floor(relative[top] / (2 * np.pi))
    origin = paths[far][-1]
    position = {role: (path - origin) @ plane.axes.T for role, path in paths.items()}
    missing = [] if has_club else ["wrist angle, head path, head speed: no club in the file"]
    separation = _separation(paths, vertical, plane)
    missing += [] if separation is not None else ["X-factor: no pelvis in the file"]
    before = slice(grid.first, grid.last + 1)
    return MeasuredSwing(
        time=grid.time,
        angle=angle,
        position=position,
        speed=speed,
        separation=separation,
        top_row=top,
        club_top_row=club_top,
        top_clue=clue,
        impact_time=capture.start + grid.impact.frame / capture.rate,
        impact_clue=grid.impact.clue
        if has_club or grid.impact.clue != PLACE
        else "hands at their position at address",
        plane=plane.inclination(vertical),
        orientation=orientation,
        gaps={role: int(np.count_nonzero(np.isnan(path[before, 0]))) for role, path in raw.items()},
        not_measured=tuple(missing),
        rate=capture.rate,
        frames=len(capture.points),
        options=options,
    )


def _top(capture: Capture, grid: _Grid, hands: Array, options: ImportOptions) -> tuple[int, str]:
    """Return row and clue of the top.

    Raises:
        BenchError: the hands never slow down before impact.
    """
    if options.top is not None:
        before = options.top - capture.start - grid.impact.frame / capture.rate
        row = (before - grid.time[0]) / STEP
        if not 0.5 < row < len(grid.time) - 50.5:
            raise BenchError(
                "--events top",
                f"{options.top:g} s",
                "a time before the ball, within the file",
                "Correct it to the time of the top of the backswing.",
            )
        return round(row), GIVEN
    row_ = find_top(grid.time, hands)
    if row_ is None:
        action = "Export the recording from address on, or give --events top=S."
        raise capture.error(
            "no swing: the hands do not slow down before the ball",
            "a top 0.1 to 0.75 s before the ball",
            action,
            int(grid.impact.frame),
        )
    return row_, "slowest hands"


def _separation(paths: dict[str, Array], vertical: Array, plane: SwingPlane) -> Array | None:
    """Return the X-factor (n,) in rad, None without a pelvis."""
    if "lead_hip" not in paths or "trail_hip" not in paths:
        return None
    front = plane.normal - (plane.normal @ vertical) * vertical  # upwards is away from the golfer
    front /= np.linalg.norm(front)
    shoulders, hips = (
        turn_about(paths[f"lead_{part}"] - paths[f"trail_{part}"], plane.target, front)
        for part in ("shoulder", "hip")
    )
    found: Array = shoulders - hips
    return found
