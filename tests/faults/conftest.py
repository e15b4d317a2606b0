"""One workbench for all: undisturbed runs are kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import bench.swing
from bench.config import Configuration, load_configuration, shipped_configuration
from bench.faults._verdict import CaseOutcome
from bench.faults.catalogue import Breakage, Event, Instant
from bench.faults.matrix import Workbench
from bench.swing.profile import Profile, load_profile
from sim.faults import Fault
from tests.faults.made_matrix import BREAKAGE, instant

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


@pytest.fixture(scope="session")
def run(workbench: Workbench, profile: Profile) -> Callable[..., CaseOutcome]:
    """Return what runs a fault, or a breakage of the matrix by its name, at an instant or its name."""

    def run_case(fault: Fault | str, at: Instant | str, event: Event = "") -> CaseOutcome:
        when = instant(profile, at) if isinstance(at, str) else at
        family = "access" if when.phase == "access" else "one fault"
        what = BREAKAGE[fault] if isinstance(fault, str) else Breakage(fault, event, family)  # type: ignore[arg-type]
        return workbench.run(what, when)

    return run_case
