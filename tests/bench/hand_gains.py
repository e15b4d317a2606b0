"""Gains found by hand on the simulated robot: for tests, and for the comparison with the machine's."""

from __future__ import annotations

from bench.control.settings import ControlSettings, PidSettings

HAND = ControlSettings(
    gains="hand",
    pid=PidSettings(proportional=(2.0, 0.65, 0.5), integral=(0.5, 0.8, 0.3), derivative=(0.165, 0.024, 0.04)),
    damping=(0.0046, 0.00067, 0.001),
    dither=(0.12, 0.12, 0.12),
    downswing_gain_factor=1.0,
    precharge_opening=0.25,
)
"""Alike in every pose and at every pressure; the wrist rests at the top of the backswing with them."""
