"""Measured golfers: recordings of markers in, swings as joint angles out."""

from bench.golfer.comparison import (
    DEFINITION,
    HUNT_WIENS,
    MotionDeviation,
    SwingMotion,
    beyond_ranges,
    compare_motions,
    deviation_texts,
    followed_golfer,
    followed_texts,
    golfer_motion,
    golfer_named,
    require_club,
    robot_motion,
    with_club_held,
)
from bench.golfer.golfer_file import (
    SUFFIX,
    GolferSwing,
    ImportOptions,
    MeasuredSwing,
    load_golfer,
    save_golfer,
    summary,
)
from bench.golfer.measuring import measure
from bench.golfer.recording import read_capture
from bench.golfer.roles import Capture, Roles, find_roles

__all__ = [
    "DEFINITION",
    "HUNT_WIENS",
    "SUFFIX",
    "Capture",
    "GolferSwing",
    "ImportOptions",
    "MeasuredSwing",
    "MotionDeviation",
    "Roles",
    "SwingMotion",
    "beyond_ranges",
    "compare_motions",
    "deviation_texts",
    "find_roles",
    "followed_golfer",
    "followed_texts",
    "golfer_motion",
    "golfer_named",
    "load_golfer",
    "measure",
    "read_capture",
    "require_club",
    "robot_motion",
    "save_golfer",
    "summary",
    "with_club_held",
]
