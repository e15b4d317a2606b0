from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.base.errors import BenchError
from bench.base.lifecycle import Cause, Phase
from bench.records.shot.recorded_shot import (
    FlightConditions,
    delivery_of_cycles,
    plant_of,
    read_shot,
    shot_from_json,
    shot_of_cycles,
    shot_to_json,
)
from bench.records.shot.shot import ShotRecord, ShotStatus
from bench.records.telemetry.record_file import write_swing
from bench.viewer._scene import effort_limits, efforts, limits_of, signals_of
from sim.ball import Air
from sim.flight import Wind
from sim.ground import Turf
from sim.plant import PlantParameters, Site
from sim.robot import RobotParameters

Cycles = np.ndarray[Any, Any]
Records = Callable[[int], list[ShotRecord]]


@pytest.fixture(scope="module")
def plant(robot: RobotParameters) -> PlantParameters:
    return replace(PlantParameters(), robot=robot, site=Site(ball_x=0.2315, ball_y=-1.514, ground=-1.57))


def as_json(value: Any) -> Any:
    return json.loads(json.dumps(asdict(value)))


def test_shot_from_json_restores_shot(make_records: Records) -> None:
    for record in make_records(4):
        told = json.loads(json.dumps(shot_to_json(record.shot)))
        assert shot_from_json(told, "x") == record.shot


@pytest.mark.parametrize(
    "wrong",
    [
        {"shot": "1"},
        {"shot": True},
        {"status": "good"},
        {"time_utc": "now"},
        {"carry_m": "far"},
        {"time_utc": "2026-11-01T09:30:00"},
        {"carry_m": float("nan")},
        {"ball": None},
    ],
)
def test_shot_from_json_invalid_value_reports_location(wrong: dict[str, Any], make_records: Records) -> None:
    told = shot_to_json(make_records(1)[0].shot) | wrong
    with pytest.raises(BenchError, match="here"):
        shot_from_json(told, "here")
    with pytest.raises(BenchError, match="an object"):
        shot_from_json([1], "here")


def test_read_shot_series_record_restores_shot_and_flight(
    tmp_path: Path, make_records: Records, plant: PlantParameters
) -> None:
    record = make_records(1)[0]
    around = FlightConditions(Air(temperature=290.0), Wind((3.0, 0.0, 0.0)), Turf())
    configuration = {
        "plant": as_json(plant),
        "surroundings": {k: as_json(v) for k, v in vars(around).items()},
    }
    metadata = {"shot": shot_to_json(record.shot), "configuration": configuration}
    write_swing(tmp_path / "1.parquet", record.cycles, metadata)
    read = read_shot(tmp_path / "1.parquet")
    assert read.record.shot == record.shot
    assert read.plant == plant
    assert np.array_equal(read.record.cycles["angle"], record.cycles["angle"])
    assert read.record.flight is not None
    assert record.flight is not None
    assert read.record.flight.carry > record.flight.carry + 1.0  # wind from behind


def test_read_shot_daemon_record_derives_shot_from_cycles(
    tmp_path: Path, make_swing: Callable[[int], Cycles], plant: PlantParameters
) -> None:
    metadata = {
        "number": 12,
        "time_utc": "2026-11-01T09:30:00+00:00",
        "configuration": {"plant": as_json(plant)},
    }
    write_swing(tmp_path / "1.parquet", make_swing(1), metadata)
    record = read_shot(tmp_path / "1.parquet").record
    assert record.shot.shot == 12
    assert record.shot.status is ShotStatus.VALID
    assert (record.shot.delivery_source, record.shot.launch_source) == ("encoders+model", "model")
    speeds = make_swing(1)["plant_head_speed"]
    assert record.shot.club_speed_mps == pytest.approx(speeds[1186], rel=0.02)
    assert record.flight is not None


def test_shot_of_cycles_without_ball_or_stopped_gives_reason(
    make_swing: Callable[[int], Cycles], plant: PlantParameters
) -> None:
    def shot(cycles: Cycles) -> ShotRecord:
        from datetime import UTC, datetime

        return shot_of_cycles(
            cycles, plant, FlightConditions(), number=1, time_utc=datetime(2026, 11, 1, tzinfo=UTC)
        )

    no_ball = make_swing(1)
    no_ball["ball_present"] = False
    assert (shot(no_ball).flight, shot(no_ball).shot.reason) == (None, "no ball struck")
    still = make_swing(1)
    still["phase"] = Phase.HOLD
    assert shot(still).shot.reason == "no swing through the ball's place"
    assert delivery_of_cycles(still, plant) is None
    stopped = make_swing(1)
    stopped["cause"][1500:] = Cause.GUARD
    assert shot(stopped).shot.status is ShotStatus.FAILED
    assert "guard" in shot(stopped).shot.reason


def test_plant_of_invalid_configuration_reports_every_mistake() -> None:
    given = {"plant": {"substeps": "four", "tick": -1.0}, "air": {"temperature": "warm"}}
    with pytest.raises(ExceptionGroup) as caught:
        plant_of({"configuration": given}, "x.parquet")
    assert len(caught.value.exceptions) == 3
    assert plant_of({}, "x.parquet") == (PlantParameters(), FlightConditions())


def test_efforts_match_chamber_pressures_and_areas(make_swing: Callable[[int], Cycles]) -> None:
    plant, cycles = PlantParameters(), make_swing(1)[:2]
    cycles["chamber_pressure"][0] = plant.supply.atmosphere
    cycles["chamber_pressure"][1] = plant.supply.atmosphere + 1e5 * np.array([1, 0, 1, 0, 1, 0])
    cycles["angle"][:, 2] = 2 * np.pi
    shoulder, arm, wrist = plant.actuators
    assert np.allclose(efforts(cycles, plant)[0], 0.0)
    expected = 1e5 * np.array([shoulder.area_a, arm.area_a, wrist.area_a * plant.wrist_lever])
    assert np.allclose(efforts(cycles, plant)[1], expected)
    gauge = plant.supply.pressure - plant.supply.atmosphere
    assert effort_limits(plant) == pytest.approx(expected * gauge / 1e5)


def test_limits_of_share_families_with_signals(make_swing: Callable[[int], Cycles]) -> None:
    signals = signals_of(make_swing(1), PlantParameters())
    families = {name.split("/")[0] for name in signals}
    assert {name.split("/")[0] for name in limits_of(PlantParameters())} <= families
    assert all(values.ndim == 2 and len(values) == 2100 for values in signals.values())
