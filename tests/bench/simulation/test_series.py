"""Swings in a series: the operator's actions after a stop."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bench.base.errors import Refused
from bench.base.lifecycle import Cause, Request
from bench.config import load_configuration, shipped_configuration
from bench.control.estimate.residual_monitor import LEARNING
from bench.simulation.simulated_bench import ADDRESS_TRIES, Bench, Series
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from tests.compiled_only import needs_speed

pytestmark = needs_speed


class StoppedAtTheAddress(Series):
    """A robot that is stopped at its address, `stops` times: there friction may let a joint slip."""

    stops = 0

    def rest(self) -> None:
        """Rest, and be stopped."""
        super().rest()
        if self.stops:
            self.stops -= 1
            self._engine.request(Request.STOP)


@pytest.fixture(scope="module")
def series() -> StoppedAtTheAddress:
    c = load_configuration(shipped_configuration())
    bench = Bench(load_profile(find_profile(c.swing.profile)), c.plant, c.control, c.envelope)
    return StoppedAtTheAddress(bench, c.plant)


def test_series_stop_at_address_arms_again(series: StoppedAtTheAddress) -> None:
    series.stops = ADDRESS_TRIES - 1
    made = series.swing(series.bench.profile)
    assert series.stops == 0
    assert made.cause is Cause.NONE
    assert made.delivery is not None


def test_series_repeated_stop_at_address_is_refused(series: StoppedAtTheAddress) -> None:
    series.stops = ADDRESS_TRIES
    with pytest.raises(Refused, match="does not come to rest"):
        series.swing(series.bench.profile)


def test_bench_as_known_checks_model_from_first_row(series: StoppedAtTheAddress) -> None:
    c, file = load_configuration(shipped_configuration()), find_profile("default")
    limited = replace(series.bench, envelope=c.for_profile(series.bench.profile, file).envelope)
    benches = limited, replace(limited, as_known=True)
    rows = [int(one.series_controller().model["first_row"][0]) for one in benches]
    assert rows == [LEARNING, 0]
