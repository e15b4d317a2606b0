"""One workbench for all: undisturbed runs are kept."""

from __future__ import annotations

from pathlib import Path

import pytest

import bench.swing
from bench.config import load_configuration, shipped_configuration
from bench.faults.case import Workbench
from bench.swing.profile import Profile, load_profile


@pytest.fixture(scope="session")
def profile() -> Profile:
    return load_profile(Path(bench.swing.__path__[0]) / "profiles" / "default.toml")


@pytest.fixture(scope="session")
def workbench(profile: Profile) -> Workbench:
    return Workbench(load_configuration(shipped_configuration()), profile, model_check=True)
