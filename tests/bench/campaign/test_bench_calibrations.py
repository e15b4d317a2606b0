"""Calibrations in force when a campaign begins, from the bench's own archive."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from math import hypot
from pathlib import Path

import pytest

from bench.calibration.archive import add_calibration
from bench.calibration.calibration import ClubInMount, EncoderZeros
from bench.campaign.interruptions import changed
from bench.campaign.run.plan_requirements import (
    calibration_versions,
    calibration_warnings,
    calibrations_in_force,
    require_swings,
    speed_sensitivities,
)
from bench.campaign.run.runner_control import bench_calibrations, new_entry, run_start
from bench.config import database_url
from bench.store.campaigns import CampaignStore
from bench.store.database import open_database
from sim.kinematics import head_motion
from tests.bench.campaign.plans import SHIPPED, shipped_plan

NOW = datetime(2026, 11, 22, 12, 0, tzinfo=UTC)


def test_bench_calibrations_keep_newest_of_campaign_clubs(tmp_path: Path) -> None:
    plan = shipped_plan("clubs")
    begun = NOW - timedelta(days=10)

    def add(values: ClubInMount | EncoderZeros, days: int) -> None:
        date, expires = begun + timedelta(days=days), NOW + timedelta(days=80)
        add_calibration(engine, bench, values, date=date, expires=expires, by="Ann", method="jig")

    bench = SHIPPED.bench.id
    with open_database(database_url("", tmp_path)) as engine:
        add(EncoderZeros((1, 2, 3), (1, 1, 1), 65536, 1e-3), 0)
        add(EncoderZeros((4, 5, 6), (1, 1, 1), 65536, 2e-3), 1)
        add(ClubInMount("driver", 1.09, 0.18, 1.0, 5e-4, 1e-3), 2)
        add(ClubInMount("driver-9", 1.09, 0.16, 1.0, 6e-4, 1e-3), 3)
        add(ClubInMount("iron", 0.95, 0.5, 1.0, 7e-4, 1e-3), 4)
        found = calibrations_in_force(engine, SHIPPED, plan.design.clubs, NOW)
        names = [(one["kind"], one["subject"], one["version"]) for one in found["in_force"]]
        assert names == [("encoders", "", 2), ("club", "driver", 1), ("club", "driver-9", 2)]
        assert found["nominal"] == ["ball", "club driver-12", "inputs", "valves"]
        versions = calibration_versions(engine, SHIPPED, plan.design.clubs, NOW)
        assert versions == {"encoders": "version 2", "club driver": "version 1", "club driver-9": "version 2"}
        kept = bench_calibrations(plan, SHIPPED, CampaignStore(engine), NOW)
    one, two = (
        run_start("Ann", SHIPPED, {"driver": "daq", "calibrations": known})
        for known in (versions, versions | {"encoders": "version 3"})
    )
    assert changed(one.facts, two.facts) == ["calibrations.encoders version 2 → version 3"]
    entry = new_entry(plan, SHIPPED, NOW, simulated=False, calibrated=kept)
    assert entry.calibrations["bench"]["in_force"] == found["in_force"]
    assert {one["club"] for one in entry.calibrations["bench"]["club_speed"]} == set(plan.design.clubs)


def test_calibration_warnings_report_expired_and_expiring(tmp_path: Path) -> None:
    clubs, begun = shipped_plan("clubs").design.clubs, NOW - timedelta(days=10)

    def add(values: ClubInMount | EncoderZeros, expires: datetime) -> None:
        add_calibration(engine, SHIPPED.bench.id, values, date=begun, expires=expires, by="Ann", method="jig")

    def warnings(hours: float, *, required: bool = False) -> list[str]:
        end = NOW + timedelta(hours=hours)
        return calibration_warnings(engine, SHIPPED, clubs, NOW, end, required=required)

    with open_database(database_url("", tmp_path)) as engine:
        add(EncoderZeros((1, 2, 3), (1, 1, 1), 65536, 1e-3), NOW - timedelta(days=1))
        add(ClubInMount("driver", 1.09, 0.18, 1.0, 5e-4, 1e-3), NOW + timedelta(hours=2))
        expired, *others = warnings(1.0)
        assert "encoders version 1" in expired
        assert "expired on 2026-11-21 12:00 UTC: golfbench calibrate encoders, then start" in expired
        assert others == []
        _, ending = warnings(3.0)
        assert "expires on 2026-11-22 14:00 UTC: golfbench calibrate club, before the expected end" in ending
        never = [text for text in warnings(1.0, required=True) if "never calibrated" in text]
        assert sum("Club driver-" in text for text in never) == len(clubs) - 1
        assert any("Valves of bench" in text for text in never)


def test_speed_sensitivities_length_matches_club_angular_rate() -> None:
    plan = shipped_plan("two-balls")
    robot, profiles = SHIPPED.plant.robot, require_swings(plan, SHIPPED)
    (one,) = speed_sensitivities(profiles, plan.clubs, robot)
    profile = profiles["default", "driver"]
    at = round(profile.impact_time / profile.period)
    robot = replace(robot, club=plan.clubs["driver"])
    motion = head_motion(robot.record[0], *profile.angle[at], *profile.velocity[at])
    # The club's own speed about the wrist is nearly in the direction of the head's.
    assert 0.9 * abs(motion[5]) <= one["length"] <= abs(motion[5])
    assert 0 < one["zeros"] < 0.5 * hypot(motion[3], motion[4])


@pytest.mark.parametrize("clubs", [(), ("driver",)])
def test_calibrations_in_force_empty_archive_is_nominal(tmp_path: Path, clubs: tuple[str, ...]) -> None:
    with open_database(database_url("", tmp_path)) as engine:
        found = calibrations_in_force(engine, SHIPPED, clubs, NOW)
    assert found["in_force"] == []
    assert ("club driver" in found["nominal"]) == bool(clubs)
