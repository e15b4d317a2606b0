"""From recorded markers to a golfer's swing: unit, axes, sides, events, plane, angles on 1 ms. SI units.

Paths over time, the events of a swing in them, and the gates that refuse a recording. The filter sees frames
before the ball only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, filtfilt

from bench.base.errors import BenchError
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
    turn_about,
)

MAX_GAP = 0.040
"""Max length of a gap in the downswing that is filled (s)."""
_AHEAD = 0.060
"""Duration of the continuation beyond the last frame (s); the filter needs it, the result does not."""


def missing_runs(path: Array) -> list[tuple[int, int]]:
    """Return the gaps of `path` (n, 3) as (first missing frame, first frame after it)."""
    lost = np.isnan(path[:, 0]).astype(int)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost, [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def filled(path: Array, rate: float) -> Array:
    """Return `path` (n, 3) without gaps: cubic up to MAX_GAP, linear beyond, constant at its ends.

    `rate` is the frame rate (Hz). At least four frames must be present.
    """
    seen = np.flatnonzero(~np.isnan(path[:, 0]))
    frames = np.arange(len(path))
    whole = np.column_stack([np.interp(frames, seen, path[seen, i]) for i in range(path.shape[1])])
    curve = CubicSpline(seen, path[seen])
    for first, end in missing_runs(path):
        if first > seen[0] and end - 1 < seen[-1] and end - first <= MAX_GAP * rate:
            whole[first:end] = curve(frames[first:end])
    return whole


def smooth(path: Array, rate: float, cutoff: float) -> Array:
    """Return `path` (n, k) through a second-order Butterworth filter, forth and back; `cutoff` in Hz."""
    b, a = butter(2, min(cutoff, 0.4 * rate) / (rate / 2.0))
    smoothed: Array = filtfilt(b, a, path, axis=0, padlen=min(len(path) - 2, int(rate)))
    return smoothed


def continued(path: Array, rate: float, centre: Array | None = None) -> Array:
    """Return `path` (n, 3) with its motion continued, as if there were no ball.

    With a `centre` (3,) its angle and distance in the plane of the last frames are continued, else its
    coordinates: each by a polynomial through the last frames.
    """
    count = int(np.ceil(_AHEAD * rate))
    if centre is None:
        return np.concatenate([path, _polynomial(path, rate, count, 0.080, 3)])
    last = path[-max(int(0.080 * rate), 8) :] - centre
    _, _, axes = np.linalg.svd(last - last.mean(axis=0), full_matrices=False)
    x, y, off = (last @ axes.T).T
    polar = np.column_stack([np.unwrap(np.arctan2(y, x)), np.hypot(x, y), off])
    angle, distance, off = _polynomial(polar, rate, count, 0.015, 2).T
    turned = np.column_stack([distance * np.cos(angle), distance * np.sin(angle), off])
    return np.concatenate([path, centre + turned @ axes])


def _polynomial(values: Array, rate: float, count: int, span: float, degree: int) -> Array:
    """Return the next `count` rows of `values`, by least squares over the last `span` (s)."""
    fit = min(max(round(span * rate), degree + 3), len(values))
    at = np.arange(1 - fit, 1) / rate
    next_ = np.arange(1, count + 1) / rate
    found: Array = np.vander(next_, degree + 1) @ np.polyfit(at, values[-fit:], degree)
    return found


LOSS = "loss of head speed"
PLACE = "position at address"
GIVEN = "--events"
_MIN_LOSS = 0.06
"""Min loss of speed at a ball, as a fraction."""
_BEGUN = 0.15
"""Fraction of the loss that marks its start."""
_STILL = 0.35
"""Max speed of a club that stands at the ball (m/s)."""
_STILL_TIME = 0.050
"""Time over which this speed is measured (s)."""
_NEAR_BALL = 0.3
"""Max distance of the position at address from the path around the fastest frame (m)."""
_SPREAD = 0.012
"""Max time between the two clues that mean one ball (s)."""
_HEAD_FASTEST = 0.080, 0.080
"""Max time of the ball before and after the fastest frame of the head (s)."""
_HANDS_FASTEST = 0.020, 0.200
"""Max time of the ball before and after the fastest frame of the hands (s)."""


class Impact(NamedTuple):
    """Instant of the ball."""

    frame: float
    """Frame and its fraction."""
    clue: str


def find_impact(path: Array, rate: float, *, is_head: bool = True) -> Impact | None:
    """Return where `path` (n, 3; m) meets the ball, None without either clue; hands lose no speed.

    A recording that ends before the ball has neither a loss of speed nor a pass of the address.
    """
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) * rate
    steady = np.median(np.stack([speed[:-2], speed[1:-1], speed[2:]]), axis=0)
    fastest = int(np.argmax(steady)) + 1
    before, after = (max(int(t * rate), 2) for t in (_HEAD_FASTEST if is_head else _HANDS_FASTEST))
    rows = range(max(fastest - before, 1), min(fastest + after, len(path) - 1))
    place = _passing(path, fastest, rows, rate)
    loss = _loss(speed, rows, rate) if is_head else None
    if loss is not None and (place is None or abs(loss - place) <= _SPREAD * rate):
        return Impact(loss, LOSS)
    return None if place is None else Impact(place, PLACE)


def _passing(path: Array, fastest: int, rows: range, rate: float) -> float | None:
    """Return the frame in which `path` passes its position at address on its way to the target."""
    over = max(round(_STILL_TIME * rate), 1)
    moved = np.linalg.norm(path[over:] - path[:-over], axis=1)
    still = np.flatnonzero(moved[: max(fastest - over, 0)] < _STILL * _STILL_TIME)
    if not len(rows) or not len(still):
        return None
    # The top is also a pause, but the path to the ball does not come near it.
    apart = np.linalg.norm(path[still, None] - path[None, rows.start : rows.stop], axis=2).min(axis=1)
    if not (apart < _NEAR_BALL).any():
        return None
    address = np.median(path[still[apart < _NEAR_BALL][-len(rows) :]], axis=0)
    nearest = rows.start + int(np.argmin(np.linalg.norm(path[rows.start : rows.stop] - address, axis=1)))
    along = path[nearest + 1] - path[nearest - 1]
    ahead = (path - address) @ along
    for k in range(max(nearest - 2, 0), min(nearest + 2, len(path) - 1)):
        if ahead[k] < 0.0 <= ahead[k + 1]:
            return float(k + ahead[k] / (ahead[k] - ahead[k + 1]))
    return None


def _loss(speed: Array, rows: range, rate: float) -> float | None:
    """Return the frame (with its fraction) between which `speed` (m/s, per interval) falls at once."""
    few, more = max(2, round(0.008 * rate)), max(3, round(0.020 * rate))
    falls = np.zeros(len(speed))
    for k in range(max(rows.start, few), min(rows.stop, len(speed) - 3)):
        before = float(np.median(speed[k - few : k]))
        fall = before - float(np.median(speed[k + 1 : k + 1 + more]))
        if fall > max(_MIN_LOSS * before, 3.0 * _scatter(speed[max(k - 4 * few, 0) : k])):
            falls[k] = fall
    if not falls.any():
        return None
    most = int(np.argmax(falls))
    before = float(np.median(speed[most - few : most]))
    after = float(np.median(speed[most + 1 : most + 1 + more]))
    first = max(most - 2 * few, few)
    peak = first + int(np.argmax([np.median(speed[k - 1 : k + 2]) for k in range(first, most + 1)]))
    # A marker may take more than one frame to slow down: the ball is where the fall begins.
    scatter = _scatter(speed[max(most - 5 * few, 0) : most])
    low = before - max(_BEGUN * (before - after), min(3.0 * scatter, 0.4 * (before - after)))
    found = peak + int(np.argmax(speed[peak : most + 2] < low))
    before = float(np.median(speed[found - few : found]))
    return found + float(np.clip((speed[found] - after) / (before - after), 0.0, 1.0))


def _scatter(speed: Array) -> float:
    """Return the standard deviation of the noise in `speed` (m/s), by its second differences."""
    return float(np.std(np.diff(speed, 2))) / 2.4 if len(speed) > 4 else 0.0


def find_top(time: Array, speed: Array, longest: float = 0.75) -> int | None:
    """Return the row of the slowest hands before the ball, None where they slow down nowhere.

    `time` (s) ends at the ball with 0, `speed` (m/s) is that of the hands or the turning of the club.
    """
    rows = np.flatnonzero((time >= -longest) & (time <= -0.10))
    if len(rows) < 3:
        return None
    row = int(rows[np.argmin(speed[rows])])
    return row if rows[0] < row < rows[-1] else None


_JUMP = 0.050
"""Max jump of a marker in a frame (m)."""
_EXCHANGE = 0.060
"""Min sum of the jumps of two markers that may be exchanged (m)."""
_AT_BALL = 0.020
"""Time around the ball in which head and lead wrist must be seen (s)."""
_CHECKED = 1.2
"""Time before the ball in which jumps are refused (s)."""
_ARM_CHANGE = 0.12
"""Max change of the distance from lead shoulder to lead wrist in the downswing (m)."""
_RECORD = "Repair the marker in the recording's software, or record the swing again."


class _Gates(NamedTuple):
    """What refuses a recording: each gate raises BenchError where it fails."""

    capture: Capture
    path: dict[str, Array]
    """Path (frames, 3) of each role, NaN in gaps (m)."""
    markers: dict[str, tuple[str, ...]]
    """Markers of each role."""
    impact: float
    """Frame of the ball, with its fraction."""

    def _refusal(self, role: str, frame: int, found: str, expected: str, action: str = _RECORD) -> BenchError:
        return self.capture.error(found, expected, action, frame, self.markers[role][0])

    def no_exchange(self) -> None:
        """Refuse markers of two sides that are exchanged from one frame to the next."""
        first, end = max(int(self.impact - _CHECKED * self.capture.rate), 2), int(self.impact) + 1
        for part in ("shoulder", "wrist", "hip"):
            sides = [role for role in (f"lead_{part}", f"trail_{part}") if role in self.path]
            if len(sides) < 2:
                continue
            pair = np.stack([self.path[role] for role in sides])
            here = pair[:, first:end]
            ahead = 2.0 * pair[:, first - 1 : end - 1] - pair[:, first - 2 : end - 2]
            kept = np.linalg.norm(here - ahead, axis=2).sum(axis=0)
            exchanged = np.linalg.norm(here[::-1] - ahead, axis=2).sum(axis=0)
            wrong = np.flatnonzero((kept > _EXCHANGE) & (exchanged < 0.5 * kept))
            if len(wrong):
                found = f"sides swapped: the two {part}s are exchanged"
                expected = "each marker on its side in all frames"
                raise self._refusal(sides[0], first + int(wrong[0]), found, expected)

    def no_jump(self) -> None:
        """Refuse a marker but the head's that jumps before the ball."""
        rate = self.capture.rate
        first, end = max(int(self.impact - _CHECKED * rate), 0), int(self.impact) + 1
        for role, path in self.path.items():
            # A jump to and fro shows twice its length in the second difference, one that stays once.
            bends = np.nan_to_num(np.linalg.norm(np.diff(path, 2, axis=0), axis=1))
            jumps = np.pad(bends, 1)[first:end]
            limit = _JUMP + 400.0 / rate**2
            if role != "head" and jumps.max(initial=0.0) > limit:
                frame = first + int(np.argmax(jumps > limit))
                found = f"a jump of {1e3 * jumps[frame - first]:.0f} mm in a frame, or swapped sides"
                raise self._refusal(role, frame, found, f"jumps below {1e3 * _JUMP:.0f} mm")

    def no_loss(self) -> None:
        """Refuse head or lead wrist that are lost near the ball."""
        near = _AT_BALL * self.capture.rate
        for role in ("head", "lead_wrist"):
            for first, end in missing_runs(self.path[role]) if role in self.path else ():
                if first <= self.impact + near and end - 1 >= self.impact - near:
                    found = f"marker lost in frames {first + 1} to {end}, at the ball"
                    expected = f"{role.replace('_', ' ')} seen within {1e3 * _AT_BALL:.0f} ms of the ball"
                    raise self._refusal(role, first, found, expected)

    def constant_lengths(self) -> None:
        """Refuse lead arm or club that change their length: swapped wrists, another marker."""
        path, begin = self.path, max(int(self.impact - 0.25 * self.capture.rate), 0)

        def apart(one: str, other: str) -> Array:
            rows = slice(begin, int(self.impact) + 1)
            return np.asarray(np.linalg.norm(path[other][rows] - path[one][rows], axis=1))

        for start, to, limit in (("lead_shoulder", "lead_wrist", _ARM_CHANGE), ("grip", "head", 0.15)):
            if start not in path or to not in path:
                continue
            length = apart(start, to)
            middle = float(np.nanmedian(length))
            wrong = np.flatnonzero(np.abs(length - middle) > limit)
            if len(wrong) > 0.2 * len(length):
                parts = f"{start} to {to}".replace("_", " ")
                found = f"{length[wrong[0]]:.2f} m from {parts}, {middle:.2f} m in the median"
                action = "Correct the markers of these roles."
                raise self._refusal(to, begin + int(wrong[0]), found, "a constant length", action)
        if "head" not in path:
            return
        grip, head = (np.nanmedian(apart("lead_wrist", role)) for role in ("grip", "head"))
        if head < grip + 0.2:
            found = f"head {head:.2f} m and grip {grip:.2f} m from the lead wrist"
            action = "Correct the markers of grip and head."
            raise self._refusal("head", begin, found, "the head further away", action)
        if "trail_wrist" in path:
            nearer = float(np.nanmedian(apart("head", "lead_wrist") - apart("head", "trail_wrist")))
            if nearer < -0.02:
                found = "sides swapped: the trail wrist is above the lead wrist on the club"
                expected = "the lead wrist nearer to the end of the grip"
                action = "Correct the markers of the wrists."
                raise self._refusal("lead_wrist", begin, found, expected, action)

    def golf_swing(self, swing: MeasuredSwing) -> None:
        """Refuse a motion that is no golf swing, or a gap in the downswing that is too long to fill."""
        rate = self.capture.rate
        top = self.impact + swing.time[swing.top_row] * rate
        for role, path in self.path.items():
            for first, end in missing_runs(path):
                in_downswing = first <= self.impact and end > top
                if in_downswing and end - first > MAX_GAP * rate and not role.endswith("hip"):
                    found = f"a gap of {1e3 * (end - first) / rate:.0f} ms in the downswing"
                    raise self._refusal(role, first, found, f"gaps of at most {1e3 * MAX_GAP:.0f} ms")
        angle = np.degrees(swing.angle[swing.downswing])
        turned = np.cumsum(angle[-1] - angle[0])
        seen = [
            ("plane", np.degrees(swing.plane), 25.0, 80.0, "°"),
            ("turn of the shoulders in the downswing", turned[0], 30.0, 220.0, "°"),
            ("swing of the lead arm in the downswing", turned[1], 60.0, 260.0, "°"),
            ("hand speed", float(swing.speed["lead_wrist"].max()), 3.0, 20.0, " m/s"),
        ]
        if swing.has_club:
            seen += [
                ("head speed", float(swing.speed["head"][-1]), 12.0, 75.0, " m/s"),
                ("turn of the shaft in the downswing", turned[2], 120.0, 360.0, "°"),
            ]
        for what, value, low, high, unit in seen:
            if not low <= value <= high:
                found = f"no golf swing: {what} {value:.0f}{unit}"
                action = "Import a recording of one full swing; check the markers of the roles."
                raise self.capture.error(found, f"{low:g} to {high:g}{unit}", action, int(self.impact))


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
            found, action = "less than 12 frames with this marker", "Record again, or assign another marker."
            raise capture.error(found, "a marker in most frames", action, marker=roles.markers[role][0])
    whole = {role: filled(path, capture.rate) for role, path in raw.items()}
    impact = _impact(capture, roles, whole, options)
    vertical, up_words = find_vertical(capture, whole, int(impact.frame), options.up)
    named, sides = find_sides(capture, whole, int(impact.frame), vertical, options.lead, roles.by_side)
    names = {new: roles.markers[old] for new, old in named.items()}
    raw = {new: raw[old] for new, old in named.items()}
    gates = _Gates(capture, raw, names, impact.frame)
    gates.no_exchange()
    gates.no_jump()
    gates.no_loss()
    gates.constant_lengths()
    grid = _Grid(capture, impact, options)
    paths = {role: grid.path(role, filled(path, capture.rate), raw) for role, path in raw.items()}
    orientation = Orientation(unit, scale, up_words, *sides)
    swing = _in_plane(grid, paths, vertical, orientation, raw)
    gates.golf_swing(swing)
    return swing


def _impact(capture: Capture, roles: Roles, whole: dict[str, Array], options: ImportOptions) -> Impact:
    """Return the impact by the events of `options` or by the clues; BenchError where the file has none."""
    if options.impact is not None:
        frame = (options.impact - capture.start) * capture.rate
        if not 12 <= frame <= len(capture.points) - 1:
            given, action = f"{options.impact:g} s", "Correct it to that of the ball."
            raise BenchError("--events impact", given, "a time within the file", action)
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

    def __init__(self, capture: Capture, impact: Impact, options: ImportOptions) -> None:
        self.capture, self.rate, self.impact, self.options = capture, capture.rate, impact, options
        self.first = max(int(np.ceil(impact.frame - _MAX_LENGTH * self.rate)), 0)
        self.last = int(np.ceil(impact.frame - _CLEAR * self.rate)) - 1
        rows = int((impact.frame - self.first) / self.rate / STEP)
        self.time: Array = -STEP * np.arange(rows, -1, -1, dtype=float)
        self.velocity: dict[str, Array] = {}

    def path(self, role: str, whole: Array, raw: dict[str, Array]) -> Array:
        """Return the smoothed path (n, 3) of `role` at the rows, and store its velocity."""
        part = slice(self.first, self.last + 1)
        body, club = self.options.cutoff
        is_body = role.endswith(("shoulder", "arm", "hip"))
        centre = None
        if not is_body:
            shoulders = [filled(raw[name], self.rate)[self.last] for name in raw if name.endswith("shoulder")]
            centre = np.mean(shoulders, axis=0)
        cutoff = club if role in ("head", "grip") else body if is_body else body * HANDS_CUTOFF
        ahead = continued(whole[part], self.rate, centre)
        smoothed = smooth(ahead, self.rate, cutoff)
        start = (self.first - self.impact.frame) / self.rate
        curve = CubicSpline(start + np.arange(len(smoothed)) / self.rate, smoothed)
        self.velocity[role] = curve(self.time, 1)
        places: Array = curve(self.time)
        return places


def _in_plane(
    grid: _Grid, paths: dict[str, Array], vertical: Array, orientation: Orientation, raw: dict[str, Array]
) -> MeasuredSwing:
    """Return the swing as seen in its plane."""
    has_club, capture = "head" in paths, grid.capture
    far, near = ("head", "grip") if has_club else ("lead_wrist", "lead_shoulder")
    level = min(last_level_row(paths[near], paths[far], vertical), len(grid.time) - 20)
    plane = fitted_plane(paths[far][max(level, 0) :], vertical)
    arm = "lead_arm" if "lead_arm" in paths else "lead_shoulder"
    lines = [("trail_shoulder", "lead_shoulder"), (arm, "lead_wrist")]
    lines += [("grip", "head")] if has_club else []
    turned = [turn_about(paths[to] - paths[start], plane.target, plane.up) for start, to in lines]
    speed: dict[str, Array] = {
        role: np.linalg.norm(grid.velocity[role], axis=1) for role in ("lead_wrist", "head") if role in paths
    }
    top, clue = _top(grid, speed["lead_wrist"])
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
    before, by_hands = slice(grid.first, grid.last + 1), not has_club and grid.impact.clue == PLACE
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
        impact_clue="hands at their position at address" if by_hands else grid.impact.clue,
        plane=plane.inclination(vertical),
        orientation=orientation,
        gaps={role: int(np.count_nonzero(np.isnan(path[before, 0]))) for role, path in raw.items()},
        not_measured=tuple(missing),
        rate=capture.rate,
        frames=len(capture.points),
        options=grid.options,
    )


def _top(grid: _Grid, hands: Array) -> tuple[int, str]:
    """Return row and clue of the top; BenchError where the `hands` (m/s) never slow down before impact."""
    capture, given = grid.capture, grid.options.top
    if given is not None:
        before = given - capture.start - grid.impact.frame / capture.rate
        row = (before - grid.time[0]) / STEP
        if not 0.5 < row < len(grid.time) - 50.5:
            wanted = "a time before the ball, within the file"
            action = "Correct it to the time of the top of the backswing."
            raise BenchError("--events top", f"{given:g} s", wanted, action)
        return round(row), GIVEN
    if (slowest := find_top(grid.time, hands)) is None:
        found = "no swing: the hands do not slow down before the ball"
        action = "Export the recording from address on, or give --events top=S."
        raise capture.error(found, "a top 0.1 to 0.75 s before the ball", action, int(grid.impact.frame))
    return slowest, "slowest hands"


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
    return np.asarray(shoulders - hips)
