"""A measured golfer next to the robot: stick figure with club, joint angles, head speed; on the same clock.

The golfer's plane is turned into the robot's swing plane, and the head's position at the ball is the ball's:
only the difference of the motions remains.
"""

from __future__ import annotations

import numpy as np
import rerun as rr

from bench.drawing.placement import plane_to_golf
from bench.golfer import GolferSwing
from bench.viewer.signals import COLOURS, Array, Times, send_scalars
from sim.plant import PlantParameters

_BODY = ("trail_shoulder", "lead_shoulder", "lead_arm", "lead_wrist")
_CLUB = ("lead_wrist", "grip", "head")
_COLOUR = COLOURS[3]
_EVERY = 5
"""Rows of 1 ms between two poses before the downswing."""


def log_golfer_scene(recording: rr.RecordingStream, golfer: GolferSwing, plant: PlantParameters) -> None:
    """Log place, colours and head path of `golfer` once."""
    axes, origin = plane_to_golf(plant.robot, plant.site)
    ball = axes @ np.array([plant.site.ball_x, plant.site.ball_y, 0.0]) + origin
    recording.log("scene/golfer", rr.Transform3D(translation=ball, mat3x3=axes), static=True)
    for name, radius in (("body", 0.018), ("club", 0.008)):
        style = rr.LineStrips3D.from_fields(colors=_COLOUR, radii=radius)
        recording.log(f"scene/golfer/{name}", style, static=True)
    head = golfer.position["head"][golfer.top_row :]
    path = rr.LineStrips3D([head], colors=[_COLOUR], radii=0.004)
    recording.log("scene/golfer/head_path", path, static=True)
    label = rr.Points3D([head[0]], labels=[golfer.name], colors=[_COLOUR], radii=0.02, show_labels=True)
    recording.log("scene/golfer/top", label, static=True)
    for entity, names in (
        ("angle_deg/golfer", [f"golfer {joint}" for joint in ("shoulders", "arm", "wrist")]),
        ("golfer_head_speed_mps", ["golfer's club head"]),
    ):
        lines = rr.SeriesLines(names=names, colors=[_COLOUR] * len(names), widths=[1.5] * len(names))
        recording.log(f"signals/{entity}", lines, static=True)


def log_golfer(
    recording: rr.RecordingStream,
    times: Times,
    golfer: GolferSwing,
    span: tuple[float, float],
    at_ball: Array,
) -> None:
    """Log the motion of `golfer` from the start of `span` (s) to the ball at its end.

    `at_ball` are the robot's joint angles there (3,), rad: the golfer's are drawn within half a turn of them.
    """
    start, struck = span
    rows = np.arange(len(golfer.time))
    shown = (rows >= golfer.top_row) | (rows % _EVERY == 0)
    shown &= golfer.time >= start - struck
    shown &= np.isfinite(np.column_stack(list(golfer.position.values()))).all(axis=1)
    columns = times(struck + golfer.time[shown])
    for name, roles in (("body", _BODY), ("club", _CLUB)):
        chain = [golfer.position[role][shown] for role in roles if role in golfer.position]
        strips = rr.LineStrips3D.columns(strips=list(np.stack(chain, axis=1)))
        recording.send_columns(f"scene/golfer/{name}", columns, strips)
    turns = np.round((at_ball - golfer.angle[-1]) / (2 * np.pi))
    speed = np.linalg.norm(np.gradient(golfer.position["head"], golfer.time, axis=0), axis=1)
    end = times(np.array([struck + 1e-3]))  # interrupts the lines before the next swing
    for entity, values in (
        ("angle_deg/golfer", np.degrees(golfer.angle + 2 * np.pi * turns)),
        ("golfer_head_speed_mps", speed[:, None]),
    ):
        send_scalars(recording, f"signals/{entity}", columns, values[shown])
        send_scalars(recording, f"signals/{entity}", end, np.full_like(values[:1], np.nan))
