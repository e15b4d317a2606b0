"""How `golfbench golfer` shows a measured swing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import isnan
from typing import Any

from rich.table import Table

from bench.commands.common.output import plain_table
from bench.golfer.comparison import DEFINITION, HUNT_WIENS, MotionDeviation, deviation_texts
from bench.golfer.roles import Roles

PIPED_WIDTH = 160
"""Columns of a comparison in a file or pipe."""
_JOINTS = ("shoulders θ1", "lead arm θ2", "wrist θ3")


def import_report(found: Mapping[str, Any], roles: Roles, beyond: Sequence[float]) -> Iterator[Table | str]:
    """Yield the tables and lines of an import; `found` is its summary."""
    yield f"Recording: {found['frames']} frames at {found['rate_hz']:g} Hz"
    yield f"  unit      {found['unit']}"
    yield f"  up        {found['up']}"
    yield f"  lead      {found['lead']}, {found['lead_clue']}"
    yield f"  impact    {found['impact_s']:.3f} s, by {found['impact_clue']}"
    turn = "" if found["club_top_s"] is None else f"; the shaft turns back at {found['club_top_s']:.3f} s"
    yield f"  top       {found['top_s']:.3f} s, by {found['top_clue']}{turn}"
    yield f"  downswing {found['downswing_s']:.3f} s"
    yield f"  plane     {found['plane_deg']:.1f}° from the ground"
    gaps = ", ".join(f"{role} {count}" for role, count in found["gaps_filled"].items() if count)
    yield f"  gaps      {f'{gaps} frames filled' if gaps else 'none'}"
    if roles.dropped:
        yield f"  left out  {', '.join(roles.dropped)}: missing in too many frames"
    yield _angles(found)
    if found["max_cock_deg"] is not None:
        yield f"Largest cock of the wrist {found['max_cock_deg']:.0f}°"
    head = found["head_speed_mps"]
    speed = "" if head is None else f"head {head:.1f} m/s, "
    hands, peak = found["hand_speed_mps"], found["peak_hand_speed_mps"]
    yield f"At the ball: {speed}hands {hands:.1f} m/s (peak {peak:.1f})"
    if found["x_factor_top_deg"] is not None:
        at_top, most = found["x_factor_top_deg"], found["x_factor_max_deg"]
        yield f"X-factor: {at_top:.0f}° at the top, {most:.0f}° at most"
    off = ", ".join(
        f"{role.replace('_', ' ')} {value:.0f}" for role, value in found["off_plane_rms_mm"].items()
    )
    x, y = found["hub_travel_mm"]
    yield f"A planar robot cannot show: {off} mm off the plane (rms); shoulders travel {x:.0f} by {y:.0f} mm"
    yield beyond_text(beyond)
    if found["not_measured"]:
        yield f"Not measured: {'; '.join(found['not_measured'])}"


def _angles(found: Mapping[str, Any]) -> Table:
    figures = ("top, °", "ball, °", "peak, rad/s")
    table = plain_table("joint", *figures, right=figures)
    columns = [found[key] for key in ("theta_top_deg", "theta_ball_deg", "peak_joint_speed_rad_per_s")]
    for joint, name in enumerate(_JOINTS):
        cells = [column[joint] for column in columns]
        table.add_row(name, *("not measured" if cell is None else f"{cell:.1f}" for cell in cells))
    return table


def beyond_text(excess: Sequence[float]) -> str:
    """Return the text of the excess beyond the ranges of shoulder (rad), right arm (m) and wrist (rad)."""
    parts = zip(("shoulder", "right arm", "wrist"), excess, ("rad", "m", "rad"), strict=True)
    out = [f"{name} {value:.2f} {unit}" for name, value, unit in parts if value >= 0.005]
    return f"Beyond the machine's ranges: {', '.join(out) if out else 'nothing that was measured'}"


def comparison_table(rows: Sequence[MotionDeviation]) -> Table:
    """Return a table with a row per deviation: per cent with degrees or mm, speeds and downswings."""
    caption = (
        f"{DEFINITION}; angles in °, head in mm. Hunt and Wiens report {100 * HUNT_WIENS:.1f} % undefined."
    )
    figures = ("shoulder", "arm", "wrist", "head", "m/s", "downswing, s")
    table = plain_table("reference", "swing", *figures, right=figures, caption=caption)
    table.caption_justify = "left"
    for row in rows:
        cells = deviation_texts(row.share, row.error)
        pair = (row.reference, row.other)
        speeds = " ".join("-" if isnan(one.head_speed) else f"{one.head_speed:.1f}" for one in pair)
        lasting = " ".join(f"{one.downswing:.3f}" for one in pair)
        table.add_row(*(f"{one.name}, {one.source}" for one in pair), *cells, speeds, lasting)
    return table
