"""What calibration changes of a configuration, and that a swing of the plant shows it."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from math import pi, radians
from pathlib import Path

import numpy as np
import pytest

from bench.base.errors import BenchError
from bench.calibration.calibration import (
    KINDS,
    BallPosition,
    Calibration,
    ClubInMount,
    EncoderZeros,
    Entry,
    Values,
    ValveCentres,
    apply,
    require_plausible,
    zero_counts,
)
from bench.config import Configuration, load_configuration
from bench.control.settings import build_controller
from bench.control.step_records import ControlParameters
from bench.simulation.lockstep import Lockstep
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.driver import hanging_pose
from sim.plant import PlantParameters, build_plant

NOW = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)


@pytest.fixture(scope="module")
def shipped() -> Configuration:
    return load_configuration(Path("shipped"))


def in_force(*values: Values, club: str = "driver") -> Calibration:
    entries = tuple(
        Entry(
            i,
            "bench1",
            next(kind for kind, of_kind in KINDS.items() if isinstance(value, of_kind)),
            i,
            NOW,
            NOW + timedelta(days=1),
            "me",
            "rule",
            "",
            value,
        )
        for i, value in enumerate(values, 1)
    )
    return Calibration("bench1", club, NOW, entries)


def test_apply_without_calibration_changes_nothing(shipped: Configuration) -> None:
    assert apply(in_force(), shipped) == shipped
    assert in_force().summary() == "nominal: encoders, ball, club, valves, inputs"


def test_apply_sets_parameters_of_every_kind(shipped: Configuration) -> None:
    c = apply(
        in_force(
            EncoderZeros((10.0, 20.0, 30.0), (1, -1, 1), 131072, 0.0),
            BallPosition(0.26, -1.55, 0.0),
            ClubInMount("driver", 1.10, 0.2, 0.9, 0.0, 0.0),
            ValveCentres((0.01, 0.02, 0.03), (0.04, 0.05, 0.06), 0.0),
        ),
        shipped,
    )
    assert c.plant.encoders == replace(shipped.plant.encoders, zero_count=(10.0, 20.0, 30.0), sign=(1, -1, 1))
    assert (c.plant.site.ball_x, c.plant.site.ball_y) == (0.26, -1.55)
    club, before = c.plant.robot.club, shipped.plant.robot.club
    assert (club.length_to_face, club.loft, club.lie) == (1.10, 0.2, 0.9)
    assert club.shaft_length - before.shaft_length == pytest.approx(0.01)
    assert c.clubs["driver"] == club
    assert [a.valve.centre for a in c.plant.actuators] == [0.01, 0.02, 0.03]
    assert [a.valve.dead_band for a in c.plant.actuators] == [0.04, 0.05, 0.06]


def test_apply_unmounted_club_leaves_plant_unchanged(shipped: Configuration) -> None:
    c = apply(in_force(ClubInMount("iron7", 0.88, 0.5, 1.0, 0.0, 0.0), club="iron7"), shipped)
    assert c.clubs["iron7"].length_to_face == 0.88
    assert c.plant == shipped.plant


@pytest.mark.parametrize(
    "values", [EncoderZeros((0, 0, 0), (1, 1, 1), 4096, 0.0), ClubInMount("hickory", 1.0, 0.2, 0.9, 0.0, 0.0)]
)
def test_apply_mismatched_calibration_is_refused(shipped: Configuration, values: Values) -> None:
    with pytest.raises(BenchError, match="version 1"):
        apply(in_force(values), shipped)


def test_calibration_record_is_complete_json() -> None:
    calibration = in_force(BallPosition(0.26, -1.55, 1e-3), ValveCentres((0, 0, 0), (0, 0, 0), 0.0))
    record = json.loads(json.dumps(calibration.record(), allow_nan=False))
    assert [(e["kind"], e["id"], e["version"], e["date"]) for e in record["in_force"]] == [
        ("ball", 1, 1, NOW.isoformat()),
        ("valves", 2, 2, NOW.isoformat()),
    ]
    assert record["in_force"][0]["values"] == {
        "x": 0.26,
        "y": -1.55,
        "uncertainty": 1e-3,
        "club": "",
    }
    assert record["nominal"] == ["encoders", "club", "inputs"]
    assert record["expired"] == []
    assert replace(calibration, when=NOW + timedelta(days=1)).record()["expired"] == ["ball", "valves"]


# Encoder zeros ---------------------------------------------------------------------------------------


def test_zero_counts_known_pose_recovers_zeros(shipped: Configuration) -> None:
    """Unknown zeros, one encoder the other way around: locked at a known pose they are found again."""
    true_zero, sign = (130000.3, 7.9, 65000.0), (1, -1, 1)
    encoders = replace(shipped.plant.encoders, zero_count=true_zero, sign=sign, latency=0.0)
    machine = replace(shipped.plant, encoders=encoders)
    pose = (radians(-30.0), radians(237.0), radians(350.0))
    bench = Lockstep(build_plant(machine), _controller(shipped, machine), np.array(pose))
    a, b, c = bench.advance(1)["encoder_count"][0].tolist()
    zeros = zero_counts((a, b, c), pose, sign, 131072)
    for found, true in zip(zeros, true_zero, strict=True):
        assert abs(found - true) <= 0.5 + 1e-6  # the resolution of a reading


def test_lockstep_calibrated_zeros_give_true_pose(shipped: Configuration) -> None:
    zeros = EncoderZeros((130000.3, 700.9, 65000.0), (-1, 1, -1), 131072, 1e-4)
    plant = apply(in_force(zeros), shipped).plant
    pose = hanging_pose(plant)
    bench = Lockstep(build_plant(plant), _controller(shipped, plant), pose)
    cycles = bench.advance(5)
    assert (
        cycles["encoder_count"][0].tolist()
        != Lockstep(build_plant(shipped.plant), _controller(shipped, shipped.plant), pose)
        .advance(1)["encoder_count"][0]
        .tolist()
    )
    assert cycles["angle"][-1] == pytest.approx(pose, abs=3 * 2 * pi / 131072)
    # The nominal bench on this machine would be far off.
    wrong = Lockstep(build_plant(plant), _controller(shipped, shipped.plant), pose).advance(5)
    assert np.abs(wrong["angle"][-1] - pose).min() > 0.001


def _controller(c: Configuration, plant: PlantParameters) -> ControlParameters:
    profile = load_profile(find_profile("default"))
    return build_controller(plant, profile, c.control, c.envelope, c.estimator)


# Plausibility ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "location"),
    [
        (BallPosition(0.60, -1.56, 1e-3), "calibrate ball"),
        (ClubInMount("driver", 1.20, 0.18, 0.92, 1e-3, 1e-3), "calibrate club driver"),
        (ClubInMount("hickory", 1.09, 0.18, 0.92, 1e-3, 1e-3), "calibrate club"),
        (EncoderZeros((0, 0, 0), (1, 1, 1), 4096, 0.0), "calibrate encoders"),
        (ClubInMount("driver", 1.09, radians(0.2), 0.92, 1e-3, 1e-3), "calibrate club driver"),
        (ClubInMount("driver", 1.09, radians(33.0), 0.92, 1e-3, 1e-3), "calibrate club driver"),
        (ClubInMount("iron7", 0.87, radians(33.0), radians(53.0), 1e-3, 1e-3), "calibrate club iron7"),
        (ValveCentres((0.0, 0.15, 0.0), (0.02, 0.02, 0.02), 0.01), "calibrate valves: arm"),
        (ValveCentres((0.0, 0.0, 0.0), (0.02, 0.02, 0.4), 0.01), "calibrate valves: wrist"),
    ],
)
def test_require_plausible_implausible_values_are_refused(
    shipped: Configuration, values: Values, location: str
) -> None:
    with pytest.raises(BenchError) as refusal:
        require_plausible(values, shipped)
    assert refusal.value.location == location


def test_require_plausible_loft_in_radians_names_degrees(shipped: Configuration) -> None:
    with pytest.raises(BenchError, match=r"loft 0\.2 deg, 14\.8 deg from clubs\.driver\.loft_deg.*degrees"):
        require_plausible(ClubInMount("driver", 1.09, radians(0.2), 0.92, 1e-3, 1e-3), shipped)


def test_require_plausible_valve_far_from_commissioned_value_is_refused(shipped: Configuration) -> None:
    measured = ValveCentres((-0.03, 0.0, 0.0), (0.02, 0.02, 0.02), 0.001)
    require_plausible(measured, shipped)
    model = replace(shipped.envelope.model, standard_errors={"shoulder.valve.centre": 1e-4})
    commissioned = replace(shipped, envelope=replace(shipped.envelope, model=model))
    with pytest.raises(BenchError, match=r"centre -0\.03, commissioned as 0 \(plant\.shoulder\.valve"):
        require_plausible(measured, commissioned)
    require_plausible(replace(measured, centre=(-0.01, 0.0, 0.0)), commissioned)


def test_require_plausible_ball_far_from_site_of_club_names_site() -> None:
    with pytest.raises(BenchError) as refusal:
        require_plausible(BallPosition(0.5, -1.5, 0.0), load_configuration(Path("bag")).with_club("iron7"))
    assert "plant.site or sites.iron7" in refusal.value.found


def test_require_plausible_ball_below_ground_is_refused(shipped: Configuration) -> None:
    with pytest.raises(ExceptionGroup) as group:
        require_plausible(BallPosition(0.25, -1.62, 1e-3), shipped)
    assert "ball_y" in str(group.value.exceptions[0])


def test_require_plausible_values_near_configuration_pass(shipped: Configuration) -> None:
    for values in (BallPosition(0.26, -1.55, 1e-3), ClubInMount("iron7", 0.88, 0.57, 1.09, 1e-3, 1e-3)):
        require_plausible(values, shipped)


def test_kinds_are_not_subclasses_of_each_other() -> None:
    for a, b in pairwise(KINDS.values()):
        assert not issubclass(a, b)
