"""Gates of the import: each refuses a recording with file, frame, marker and action."""

from __future__ import annotations

import numpy as np

from bench.golfer.capture import Array, Capture
from bench.golfer.measured_swing import MeasuredSwing
from bench.golfer.signals import MAX_GAP, missing_runs, second_differences

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

Markers = dict[str, tuple[str, ...]]


def check_jumps(capture: Capture, raw: dict[str, Array], markers: Markers, impact: float) -> None:
    """Raise BenchError where a marker but the head's jumps before the ball (raw paths in m)."""
    first, end = max(int(impact - _CHECKED * capture.rate), 0), int(impact) + 1
    for role, path in raw.items():
        if role == "head":
            continue
        # A jump to and fro shows twice its length in the second difference, one that stays once.
        jumps = second_differences(path)[first:end]
        limit = _JUMP + 400.0 / capture.rate**2
        if jumps.max(initial=0.0) > limit:
            frame = first + int(np.argmax(jumps > limit))
            found = f"a jump of {1e3 * jumps[frame - first]:.0f} mm in a frame, or swapped sides"
            raise capture.error(found, f"jumps below {1e3 * _JUMP:.0f} mm", _RECORD, frame, markers[role][0])


def check_exchanges(capture: Capture, raw: dict[str, Array], markers: Markers, impact: float) -> None:
    """Raise BenchError where the markers of two sides are exchanged from one frame to the next."""
    first, end = max(int(impact - _CHECKED * capture.rate), 2), int(impact) + 1
    for part in ("shoulder", "wrist", "hip"):
        pair = [raw[f"{side}_{part}"] for side in ("lead", "trail") if f"{side}_{part}" in raw]
        if len(pair) < 2:
            continue
        here = np.stack(pair)[:, first:end]
        ahead = np.stack([2.0 * path[first - 1 : end - 1] - path[first - 2 : end - 2] for path in pair])
        kept = np.linalg.norm(here - ahead, axis=2).sum(axis=0)
        exchanged = np.linalg.norm(here[::-1] - ahead, axis=2).sum(axis=0)
        wrong = np.flatnonzero((kept > _EXCHANGE) & (exchanged < 0.5 * kept))
        if len(wrong):
            found = f"sides swapped: the two {part}s are exchanged"
            expected = "each marker on its side in all frames"
            raise capture.error(found, expected, _RECORD, first + int(wrong[0]), markers[f"lead_{part}"][0])


def check_losses(capture: Capture, raw: dict[str, Array], markers: Markers, impact: float) -> None:
    """Raise BenchError where head or lead wrist are lost near the ball."""
    for role in ("head", "lead_wrist"):
        for first, end in missing_runs(raw[role]) if role in raw else ():
            near = _AT_BALL * capture.rate
            if first <= impact + near and end - 1 >= impact - near:
                found = f"marker lost in frames {first + 1} to {end}, at the ball"
                expected = f"{role.replace('_', ' ')} seen within {1e3 * _AT_BALL:.0f} ms of the ball"
                raise capture.error(found, expected, _RECORD, first, markers[role][0])


def check_arm(capture: Capture, raw: dict[str, Array], markers: Markers, impact: float) -> None:
    """Raise BenchError where lead arm or club change their length: swapped wrists, another marker."""
    part = slice(max(int(impact - 0.25 * capture.rate), 0), int(impact) + 1)
    for start, to, limit in (("lead_shoulder", "lead_wrist", _ARM_CHANGE), ("grip", "head", 0.15)):
        if start not in raw or to not in raw:
            continue
        length = np.linalg.norm(raw[to][part] - raw[start][part], axis=1)
        middle = float(np.nanmedian(length))
        wrong = np.flatnonzero(np.abs(length - middle) > limit)
        if len(wrong) > 0.2 * len(length):
            parts = f"{start} to {to}".replace("_", " ")
            found = f"{length[wrong[0]]:.2f} m from {parts}, {middle:.2f} m in the median"
            raise capture.error(
                found,
                "a constant length",
                "Correct the markers of these roles.",
                part.start + int(wrong[0]),
                markers[to][0],
            )
    if "head" in raw:
        grip, head = (
            np.nanmedian(np.linalg.norm((raw[role] - raw["lead_wrist"])[part], axis=1))
            for role in ("grip", "head")
        )
        if head < grip + 0.2:
            found = f"head {head:.2f} m and grip {grip:.2f} m from the lead wrist"
            raise capture.error(
                found,
                "the head further away",
                "Correct the markers of grip and head.",
                part.start,
                markers["head"][0],
            )
    if "trail_wrist" in raw and "head" in raw:
        lead, trail = (
            np.linalg.norm(raw[f"{side}_wrist"][part] - raw["head"][part], axis=1)
            for side in ("lead", "trail")
        )
        if float(np.nanmedian(lead - trail)) < -0.02:
            raise capture.error(
                "sides swapped: the trail wrist is above the lead wrist on the club",
                "the lead wrist nearer to the end of the grip",
                "Correct the markers of the wrists.",
                part.start,
                markers["lead_wrist"][0],
            )


def check_swing(
    capture: Capture,
    swing: MeasuredSwing,
    markers: Markers,
    gaps: dict[str, list[tuple[int, int]]],
    impact: float,
) -> None:
    """Raise BenchError where the motion is no golf swing, or a gap in the downswing is too long to fill."""
    top = impact + swing.time[swing.top_row] * capture.rate
    for role, runs in gaps.items():
        for first, end in runs:
            if (
                first <= impact
                and end > top
                and (end - first) > MAX_GAP * capture.rate
                and not role.endswith("hip")
            ):
                found = f"a gap of {1e3 * (end - first) / capture.rate:.0f} ms in the downswing"
                expected = f"gaps of at most {1e3 * MAX_GAP:.0f} ms"
                raise capture.error(found, expected, _RECORD, first, markers[role][0])
    angle = np.degrees(swing.angle[swing.downswing])
    seen = [
        ("plane", np.degrees(swing.plane), 25.0, 80.0, "°"),
        ("turn of the shoulders in the downswing", angle[-1, 0] - angle[0, 0], 30.0, 220.0, "°"),
        (
            "swing of the lead arm in the downswing",
            angle[-1, :2].sum() - angle[0, :2].sum(),
            60.0,
            260.0,
            "°",
        ),
        ("hand speed", float(swing.speed["lead_wrist"].max()), 3.0, 20.0, " m/s"),
    ]
    if swing.has_club:
        seen += [
            ("head speed", float(swing.speed["head"][-1]), 12.0, 75.0, " m/s"),
            ("turn of the shaft in the downswing", angle[-1].sum() - angle[0].sum(), 120.0, 360.0, "°"),
        ]
    for what, value, low, high, unit in seen:
        if not low <= value <= high:
            found = f"no golf swing: {what} {value:.0f}{unit}"
            action = "Import a recording of one full swing; check the markers of the roles."
            raise capture.error(found, f"{low:g} to {high:g}{unit}", action, int(impact))
