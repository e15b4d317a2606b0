"""Learned swings in the database: versioned, only added, used under their own conditions only."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import text
from sqlalchemy.exc import IntegrityError

from bench.config import database_url
from bench.learning.store import Conditions, Learned, drifted, keep, learned_swings, newest_that_holds
from bench.store.database import open_database
from bench.swing.correction import basis_of
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.plant import PlantParameters

NOW = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)
PROFILE, PLANT = load_profile(find_profile("default")), PlantParameters()
HERE = Conditions.of(PROFILE, PLANT, 298.0)


def entry(value: float, **changes: object) -> Learned:
    weights = (value,) * basis_of(PROFILE).size
    made = Learned("b", PROFILE.name, NOW, True, "encoders+model", HERE, True, weights, {"chosen": 3})
    return replace(made, **changes)  # type: ignore[arg-type]


def test_learned_swings_newest_valid_is_found_and_rows_are_immutable(tmp_path: Path) -> None:
    with open_database(database_url("", tmp_path), NOW) as database:
        assert newest_that_holds(database, "b", PROFILE.name, HERE, simulated=True) is None
        assert [keep(database, entry(value)) for value in (0.1, 0.2)] == [1, 2]
        assert keep(database, entry(0.9, within=False)) == 3
        assert keep(database, entry(0.9, conditions=replace(HERE, club="iron7"))) == 4
        assert keep(database, entry(0.9, simulated=False)) == 5
        found = newest_that_holds(database, "b", PROFILE.name, HERE, simulated=True)
        assert found is not None
        assert found.version == 2
        swing = found.correction(PROFILE).applied_to(PROFILE)
        wanted = basis_of(PROFILE).correction(np.full(basis_of(PROFILE).size, 0.2)).applied_to(PROFILE)
        assert np.array_equal(swing.valve, wanted.valve)
        assert np.array_equal(swing.angle, wanted.angle)
        stored = learned_swings(database, "b", PROFILE.name)
        assert [found.version for found in stored] == [1, 2, 3, 4, 5]
        assert stored[0] == replace(entry(0.1), version=1)
        for statement in ("DELETE FROM learned_swings", "UPDATE learned_swings SET within = 1"):
            with pytest.raises(IntegrityError, match="only added"), database.begin() as connection:
                connection.execute(text(statement))


@pytest.mark.parametrize(
    ("change", "holds"),
    [
        ({}, True),
        ({"supply_pressure": HERE.supply_pressure * 1.015}, True),
        ({"supply_pressure": HERE.supply_pressure * 0.95}, False),
        ({"temperature": 303.0}, True),
        ({"temperature": 285.0}, False),
        ({"club": "iron7"}, False),
        ({"digest": "0"}, False),
    ],
)
def test_conditions_hold_for_tolerated_changes_only(change: dict[str, float], holds: bool) -> None:
    assert HERE.hold_for(replace(HERE, **change)) is holds  # type: ignore[arg-type]


def test_conditions_changed_profile_changes_digest() -> None:
    assert Conditions.of(replace(PROFILE, valve=PROFILE.valve + 1e-6), PLANT, 298.0).digest != HERE.digest


def test_conditions_other_simulated_robot_does_not_hold() -> None:
    worn = replace(PLANT, shoulder=replace(PLANT.shoulder, dead_volume=2 * PLANT.shoulder.dead_volume))
    nominal = Conditions.of(PROFILE, PLANT, 298.0, PLANT)
    assert not nominal.hold_for(Conditions.of(PROFILE, PLANT, 298.0, worn))
    weaker = replace(PLANT, supply=replace(PLANT.supply, pressure=0.99 * PLANT.supply.pressure), seed=9)
    assert nominal.hold_for(Conditions.of(PROFILE, PLANT, 298.0, weaker))


def test_newest_that_holds_until_date_ignores_later_versions(tmp_path: Path) -> None:
    with open_database(database_url("", tmp_path), NOW) as database:
        keep(database, entry(0.1))
        keep(database, entry(0.2, date=NOW + timedelta(hours=1)))
        for until, version in ((None, 2), (NOW, 1), (NOW - timedelta(hours=1), 0)):
            found = newest_that_holds(database, "b", PROFILE.name, HERE, simulated=True, until=until)
            assert (found.version if found else 0) == version


@pytest.mark.parametrize(
    ("errors", "refresh"),
    [
        ([], False),
        ([[0.4, -0.3]] * 8, False),
        ([[0.4, -2.0], [0.4, -1.6], [0.1, -1.9], [0.3, -1.2]], True),
        ([[0.4, -1.2]], False),
    ],
)
def test_drifted_detects_mean_error_beyond_scatter(errors: list[list[float]], refresh: bool) -> None:
    assert drifted((0.5, 0.5), errors) is refresh
