"""Measured golfers: recordings of markers in, swings as joint angles out."""

from bench.golfer.capture import Capture, read_capture
from bench.golfer.golfer_file import GolferSwing, load_golfer, save_golfer, summary
from bench.golfer.measured_swing import ImportOptions, MeasuredSwing, measure
from bench.golfer.reach import beyond_ranges
from bench.golfer.roles import Roles, find_roles

__all__ = [
    "Capture",
    "GolferSwing",
    "ImportOptions",
    "MeasuredSwing",
    "Roles",
    "beyond_ranges",
    "find_roles",
    "load_golfer",
    "measure",
    "read_capture",
    "save_golfer",
    "summary",
]
