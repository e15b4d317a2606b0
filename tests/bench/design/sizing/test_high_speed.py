"""The variant `high_speed` is the hardware that its text names, and its swings stop safely."""

from __future__ import annotations

import re
from dataclasses import fields
from math import radians
from pathlib import Path
from typing import Any

import pytest

from bench.config import VARIANTS, load_configuration
from bench.design.sizing.catalogue import Hardware, shipped_catalogue
from bench.design.sizing.search import SizingDemand, candidate_configuration, candidate_text
from bench.design.stop_verification import TRIALS, SwingCheck
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from tests.compiled_only import needs_speed
from tests.sampling import release_except


def named_hardware(variant: str) -> Hardware:
    """Return the hardware that the comment of the variant names."""
    text = (VARIANTS / f"{variant}.toml").read_text()
    found = re.search(r"^# (V\d+-\S+?)-8bar-60mm-(\d+)deg(?:-(\w+))?", text, re.MULTILINE)
    assert found is not None
    names = [field.name for field in fields(Hardware)][:10]
    parts: dict[str, Any] = dict(zip(names, found[1].split("-"), strict=True))
    parts |= {"lever_angle": radians(int(found[2])), "frame": found[3] or "R80"}
    return Hardware(**parts, pressure=8.0e5, lever=0.06)


@pytest.mark.parametrize(("name", "speed"), [("high_speed", 58.1), ("golfers", 51.41)])
def test_variant_matches_hardware_named_in_comment(name: str, speed: float) -> None:
    hardware, shipped = named_hardware(name), load_configuration(Path("shipped"))
    text = candidate_text(shipped_catalogue(), hardware, shipped, SizingDemand(speed))
    made, variant = candidate_configuration(text), load_configuration(Path(name))
    assert made.plant == variant.plant
    assert made.envelope == variant.envelope


@pytest.mark.release
@needs_speed
@pytest.mark.parametrize(
    "name", release_except({"driver-130mph"}, ["driver-115mph", "driver-130mph", "driver-130mph-level"])
)
def test_swing_check_high_speed_trials_end_safely(name: str) -> None:
    c, profile = load_configuration(Path("high_speed")), load_profile(find_profile(name))
    trials = tuple(trial for trial in TRIALS if "stuck" not in trial.name)
    check = SwingCheck(c.plant, profile, c.control, c.envelope.with_model_check("off"), c.estimator)
    outcomes = check.outcomes(trials, spacing=205)
    assert len(outcomes) > 90
    assert [outcome for outcome in outcomes if outcome.unsafe] == []
