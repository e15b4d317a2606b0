"""The bag's launches against tour averages: fitted on every other row, judged on the others."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.config import load_configuration
from sim.robot import Club
from tests.sim.tour_averages import club_of, error_of, fit, lofted_averages, rms, stiffness_of, tour_averages


@pytest.fixture(scope="module")
def bag() -> dict[str, Club]:
    return load_configuration(Path("bag")).clubs


def test_bag_launches_match_held_out_rows(bag: dict[str, Club]) -> None:
    held = [a for a in tour_averages() if a.held_out]
    assert len(held) == 11
    errors = [error_of(a, club_of(a.club, bag)) for a in held]
    found = rms(errors)
    assert found.ball_speed < 0.015
    assert found.launch < 0.7
    assert found.spin < 0.10


def test_bag_launches_match_rows_with_published_loft(bag: dict[str, Club]) -> None:
    # Amateurs' averages hold their misses, which cost ball speed.
    averages = lofted_averages()
    errors = [error_of(a, club_of(a.club, bag)) for a in averages]
    assert rms(errors).launch < 0.7
    assert rms(errors).spin < 0.15
    tours = [e for a, e in zip(averages, errors, strict=True) if "PGA" in a.group]
    assert rms(tours).ball_speed < 0.015


def test_bag_holds_fitted_values(bag: dict[str, Club]) -> None:
    fitted = fit(tour_averages(), bag)
    groups = {
        ("wood1",): fitted.driver,
        ("wood3", "hybrid"): fitted.fairway,
        ("iron5", "iron7", "iron9", "pitching", "wedge56", "wedge56_wet"): fitted.solid,
    }
    for names, restitution in groups.items():
        for name in names:
            club = bag[name]
            assert club.restitution == pytest.approx(restitution, abs=1e-3)
            assert club.restitution_slope == pytest.approx(fitted.slope, abs=1e-4)
            assert club.tangential_loss == pytest.approx(fitted.loss, abs=0.01)
            expected = stiffness_of(club.restitution, bag["iron7"].restitution)
            assert club.tangential_stiffness == pytest.approx(expected, abs=1e-3)


def test_bag_driver_equals_default_driver(bag: dict[str, Club]) -> None:
    assert bag["driver"] == Club.driver()
