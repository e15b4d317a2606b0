"""The plant behind the nodes, without nodes and process."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.records.telemetry.cycle_record import CYCLE
from drivers.base import PASSIVE, Command
from drivers.base.compiled import new_record
from drivers.base.records import READINGS, TRUTH, pack_readings, unpack_command
from sim.ball import Ball
from sim.driver import SimDriver
from sim.exchange import BALL, CONTACT, PLANT_SURROUNDINGS
from sim.impact import impact_parameters
from sim.kinematics import forward_kinematics, inverse_kinematics
from sim.nodes.wall_plant import NodesPlan, WallPlant
from sim.plant import PlantParameters
from sim.sensors import contact_in

START = (0.2, 4.3, 6.0)
MOVING = Command(valve=(0.3, -0.2, 0.1), supply_enable=True, exhaust_closed=True, beacon=True)
PERIOD = PlantParameters().tick
PLAN = NodesPlan("virtual", "none", 125_000, (1, 2, 3), 10, PlantParameters(), Path(), START)


@pytest.fixture
def plant() -> WallPlant:
    return WallPlant(PLAN)


def surroundings(**changes: Any) -> np.ndarray[Any, Any]:
    record = new_record(PLANT_SURROUNDINGS)
    for name, value in {
        "emergency_stop_clear": True,
        "guard_closed": True,
        "encoder_valid": 1,
        **changes,
    }.items():
        record[name] = value
    return record


def live(plant: WallPlant, ticks: int) -> Any:
    """Move the plant on as its process does and return its report."""
    for _ in range(ticks):
        plant.move((plant.ticks + 1) * PERIOD)
        plant.update_report()
    return plant.report[0]


def test_wall_plant_equals_sim_driver_in_lock_step(plant: WallPlant) -> None:
    driver, packed = SimDriver(PlantParameters(), START), new_record(READINGS)
    driver.open()
    driver.read(0.0)
    for k in range(1, 60):
        command = MOVING._replace(valve=(math.sin(0.1 * k), 0.3, -0.2))
        driver.write(command)
        plant.applied = command
        report = live(plant, 1)
        pack_readings(driver.read(k * PERIOD), packed)
        for name in ("encoder_count", "supply_pressure", "chamber_pressure", "encoder_valid"):
            assert report["readings"][name].tobytes() == packed[name].tobytes(), name
        assert report["readings"]["time"] == k * PERIOD
        assert report["truth"]["plant_angle"].tobytes() == driver.plant_state["angle"].tobytes()


def test_truth_record_matches_plant_fields_of_cycle() -> None:
    fields: Any = CYCLE.fields
    wanted = {name: fields[name][0] for name in CYCLE.names or () if name.startswith("plant_")}
    assert {name: TRUTH[name] for name in TRUTH.names or ()} == wanted


def test_wall_plant_passive_command_vents(plant: WallPlant) -> None:
    plant.applied = MOVING
    report = live(plant, 20)
    assert unpack_command(plant.report["node"]["applied"]) == MOVING
    supply = report["readings"]["supply_pressure"]
    plant.applied = PASSIVE
    report = live(plant, 2000)
    assert unpack_command(plant.report["node"]["applied"]) == PASSIVE
    assert report["readings"]["supply_pressure"] < supply
    assert max(report["truth"]["plant_pressure"]) < 1.3e5


def test_wall_plant_readings_follow_surroundings(plant: WallPlant) -> None:
    quiet = live(plant, 1)["readings"]
    assert all(quiet[name] for name in ("emergency_stop_clear", "guard_closed", "guard_locked"))
    assert not quiet["local_reset"]
    assert not quiet["ball_present"]
    plant.set_surroundings(
        surroundings(
            emergency_stop_clear=False,
            guard_closed=False,
            local_reset=True,
            encoder_valid=(1, 0, 1),
            ball_handled=1,
            ball_present=True,
        )
    )
    seen = live(plant, 1)["readings"]
    assert not seen["emergency_stop_clear"]
    assert not seen["guard_closed"]
    assert not seen["guard_locked"]
    assert seen["local_reset"]
    assert seen["encoder_valid"].tolist() == [1, 0, 1]
    assert seen["ball_present"]
    plant.set_surroundings(surroundings(ball_handled=1, ball_present=False))
    assert live(plant, 1)["readings"]["ball_present"]  # nobody's hand was there again
    plant.set_surroundings(surroundings(ball_handled=2, ball_present=False))
    assert not live(plant, 1)["readings"]["ball_present"]
    plant.applied = MOVING._replace(tee=True)
    assert live(plant, 1)["readings"]["ball_present"]


def test_wall_plant_frozen_holds_readings_and_moves_plant(plant: WallPlant) -> None:
    before = live(plant, 3)["readings"].tobytes()
    plant.set_surroundings(surroundings(frozen=True))
    report = live(plant, 50)
    assert report["readings"].tobytes() == before
    assert report["ticks"] == 53
    plant.set_surroundings(surroundings())
    assert live(plant, 1)["readings"]["time"] == 54 * PERIOD


def test_wall_plant_other_ball_changes_impact_parameters(plant: WallPlant) -> None:
    robot, own = PLAN.plant.robot, plant.plant.impact.tobytes()
    other = Ball(restitution_factor=0.9, mass=0.04)
    record = surroundings()
    for name in BALL.names or ():
        record["ball"][name] = getattr(other, name)
    plant.set_surroundings(record)
    assert plant.plant.impact.tobytes() == impact_parameters(robot.club, other, robot.lie).tobytes()
    record["ball"]["mass"] = math.nan
    plant.set_surroundings(record)
    assert plant.plant.impact.tobytes() == impact_parameters(robot.club, other, robot.lie).tobytes()
    plant.set_surroundings(surroundings())
    assert plant.plant.impact.tobytes() == own


def test_wall_plant_counts_and_reports_contacts(plant: WallPlant) -> None:
    plant.set_surroundings(surroundings(ball_handled=1, ball_present=True))
    # The head just before the ball, on its way: what counts here is the telling.
    site = PLAN.plant.site
    q, u = at_the_ball(PLAN.plant, site.ball_x - 0.01, site.ball_y)
    plant.state["angle"], plant.state["speed"], plant.state["history"] = q, u, q
    report = live(plant, 5)
    contact = contact_in(plant.report["contact"])
    assert report["contacts"] == 1
    assert contact is not None
    assert contact == contact_in(plant.state)
    assert contact.launch.speed > 1.0
    assert 0.0 < contact.time < 5 * PERIOD
    plant.set_surroundings(surroundings(ball_handled=2, ball_present=True))
    plant.state["speed"] = 0.0
    report = live(plant, 1)
    assert contact_in(plant.report["contact"]) is None
    assert report["contacts"] == 1
    assert {"struck", *(CONTACT.names or ())} <= set(plant.state.dtype.names or ())


def at_the_ball(
    plant: PlantParameters, x: float, y: float, speed: float = 8.0
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return joint angles (rad) and speeds (rad/s) of a head at `x`, `y` (m), level at `speed` (m/s)."""
    robot = plant.robot
    q = np.asarray(inverse_kinematics(robot, np.array([x, y, 1.5 * math.pi])))
    step = 1e-6
    jacobian = np.stack(
        [
            (forward_kinematics(robot, q + step * e) - forward_kinematics(robot, q - step * e)) / (2 * step)
            for e in np.eye(3)
        ],
        axis=1,
    )
    return q, np.linalg.solve(jacobian, np.array([speed, 0.0, 0.0]))


@pytest.mark.parametrize("angle", [(0.0, math.nan, 0.0), (0.0, 1.0)])
def test_wall_plant_invalid_start_angles_raise(angle: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=r"start angles"):
        WallPlant(replace(PLAN, angle=angle))  # type: ignore[arg-type]


def test_wall_plant_random_surroundings_keeps_angles_finite(plant: WallPlant) -> None:
    random = np.random.default_rng(5)
    plant.applied = MOVING
    for _ in range(200):
        around = np.frombuffer(random.bytes(PLANT_SURROUNDINGS.itemsize), PLANT_SURROUNDINGS)
        with np.errstate(all="ignore"):
            plant.set_surroundings(around)
        report = live(plant, 1)
        assert np.all(np.isfinite(report["truth"]["plant_angle"]))
