"""Gains that are set by hand, in and out of the settings."""

from __future__ import annotations

from dataclasses import replace

from bench.control.gains import Gains
from bench.control.settings import ControlSettings, PidSettings


def gains_of(control: ControlSettings) -> Gains:
    """Return the gains that `control` sets by hand."""
    pid = control.pid
    return Gains(pid.proportional, pid.integral, pid.derivative, control.damping, control.move_gain)


def with_gains(control: ControlSettings, gains: Gains) -> ControlSettings:
    """Return `control` with `gains` set by hand."""
    pid = PidSettings(gains.proportional, gains.integral, gains.derivative)
    return replace(control, gains="hand", pid=pid, damping=gains.damping, move_gain=gains.move)
