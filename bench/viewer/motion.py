"""The robot's motion as Rerun entities: poses of its bodies, the club head's trace, the ball near the tee."""

from __future__ import annotations

import numpy as np
import rerun as rr
from matplotlib import colormaps
from numpy.typing import NDArray

from bench.drawing.placement import body_poses, plane_to_golf
from bench.lifecycle import Phase
from bench.viewer.signals import Array, Cycles, Times, head_motion
from sim.plant import PlantParameters

MAX_SPEED = 50.0
"""Club head speed shown red in the trace, m/s; blue is standstill."""

_QUICK = (Phase.DOWNSWING, Phase.COMMITTED, Phase.IMPACT, Phase.FOLLOW_THROUGH)
_TRACE_WIDTH = 0.009


def poses_to_draw(cycles: Cycles, every: int) -> NDArray[np.bool_]:
    """Return which cycles are drawn: all while the robot is fast, every `every`-th tick otherwise."""
    shown: NDArray[np.bool_] = np.isin(cycles["phase"], _QUICK) | (cycles["tick"] % every == 0)
    return shown


def log_motion(
    recording: rr.RecordingStream,
    times: Times,
    time: Array,
    cycles: Cycles,
    plant: PlantParameters,
    shown: NDArray[np.bool_],
    before: Array | None = None,
) -> Array | None:
    """Log the bodies' poses and the trace of the head for the cycles `shown`.

    The trace continues from its end `before` (x, y of the swing plane in m, speed in m/s); returns the new
    end.
    """
    if not shown.any():
        return before
    time, cycles = time[shown], cycles[shown]
    columns = times(time)
    for name, (translation, quaternion) in body_poses(plant, cycles["angle"]).items():
        poses = rr.Transform3D.columns(translation=translation, quaternion=quaternion)
        recording.send_columns(f"scene/robot/{name}", columns, poses)
    head, speed = head_motion(plant.robot, cycles)
    ways = np.column_stack([head, speed])
    if before is not None:
        ways, time = np.vstack([before, ways]), np.append(time[:1], time)
    if len(ways) > 1:
        axes, origin = plane_to_golf(plant.robot, plant.site)
        points = ways[:, :2] @ axes[:, :2].T + origin
        segments = np.stack([points[:-1], points[1:]], axis=1)
        share = np.clip((ways[:-1, 2] + ways[1:, 2]) / 2 / MAX_SPEED, 0, 1)
        colours = (colormaps["turbo"](share * 0.9 + 0.05)[:, :3] * 255).astype(np.uint8)
        trace = rr.LineStrips3D.columns(
            strips=list(segments), colors=colours, radii=np.full(len(segments), _TRACE_WIDTH, np.float32)
        )
        recording.send_columns("scene/trace", times(time[1:]), trace)
    last: Array = ways[-1]
    return last


def log_ball(recording: rr.RecordingStream, times: Times, time: Array, position: Array) -> None:
    """Log the positions of the ball in the scene, (n, 3) m."""
    recording.send_columns("scene/ball", times(time), rr.Points3D.columns(positions=position))
