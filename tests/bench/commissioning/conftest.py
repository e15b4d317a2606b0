"""The shipped bench and its swing, which most tests of commissioning begin with."""

from __future__ import annotations

import pytest

from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile


@pytest.fixture(scope="session")
def default() -> Profile:
    return load_profile(find_profile("default"))
