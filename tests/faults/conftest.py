"""One workbench for all: undisturbed runs are kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import bench.swing
from bench.config import Configuration, load_configuration, shipped_configuration
from bench.faults.matrix import Workbench
from bench.swing.profile import Profile, load_profile

PROFILE = Path(bench.swing.__path__[0]) / "profiles" / "default.toml"


@pytest.fixture(scope="session")
def profile() -> Profile:
    return load_profile(PROFILE)


@pytest.fixture(scope="session")
def configuration(profile: Profile) -> Configuration:
    """The shipped configuration with the profile's own limits, as `golfbench faults run` uses it."""
    shipped = load_configuration(shipped_configuration())
    checked = replace(shipped, envelope=shipped.envelope.with_model_check("always"))
    return checked.for_profile(profile, PROFILE)


@pytest.fixture(scope="session")
def workbench(configuration: Configuration, profile: Profile) -> Workbench:
    return Workbench(configuration, profile, model_check=True)
