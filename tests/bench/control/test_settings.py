"""Each number of the settings reaches the records of the compiled step: they are copied by name."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from bench.config import Configuration
from bench.control.settings import build_controller
from bench.swing.library import find_profile
from bench.swing.profile import load_profile

ELSEWHERE = {
    "control.damping": "manual gains only",
    "control.move_gain": "manual gains only",
    "control.turf_lift_gain": "turf only",
    "lifecycle.supervisor_timeout": "loop process only",
}
"""Settings that act elsewhere than in the step of the default configuration, and where."""


def built(c: Configuration) -> list[bytes]:
    """Return the records of the controller of `c`, as bytes."""
    profile = load_profile(find_profile("default"))
    made = build_controller(c.plant, profile, c.control, c.envelope, c.estimator, c.lifecycle, c.homing)
    return [np.asarray(record).tobytes() for record in made if isinstance(record, np.ndarray)]


def more(value: Any) -> Any:
    """Return slightly larger numbers; None for other types."""
    if isinstance(value, float):
        return 1.01 * value + 1e-3
    if isinstance(value, tuple) and all(isinstance(one, float) for one in value):
        return tuple(1.01 * one + 1e-3 for one in value)
    return None


@pytest.mark.parametrize("section", ["control", "lifecycle", "homing", "envelope"])
def test_build_controller_each_setting_changes_records(configuration: Configuration, section: str) -> None:
    before, settings = built(configuration), getattr(configuration, section)
    lost = {
        field.name
        for field in fields(settings)
        if (value := more(getattr(settings, field.name))) is not None
        and built(replace(configuration, **{section: replace(settings, **{field.name: value})})) == before
    }
    assert {f"{section}.{name}" for name in lost} <= ELSEWHERE.keys()
