"""A swing's record as a shot: read from its file with plant and results, for the viewer and exports.

A series stores the shot's figures in the record's metadata. A record of the daemon has no figures: then the
delivery is that of the estimated angles, and models compute launch and flight, as their sources state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from math import pi, radians
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.base.errors import BenchError
from bench.base.from_toml import recorded_tables
from bench.base.json_schema import require_fit
from bench.base.lifecycle import CAUSE_TEXT, Cause
from bench.records.shot.shot import (
    COLUMNS,
    Shot,
    ShotRecord,
    ShotStatus,
    delivery_columns,
    flight_columns,
    launch_columns,
)
from bench.records.shot.strike import ball_struck, time_at_ball
from bench.records.telemetry.record_file import read_swing
from drivers.base import Launch
from sim.ball import REFERENCE_BALL, Air, Ball
from sim.flight import Aerodynamics, Flight, Wind, fly
from sim.ground import Turf
from sim.impact import Delivery, delivery_from_plane, strike
from sim.kinematics import forward_kinematics
from sim.plant import PlantParameters

Cycles = np.ndarray[Any, Any]


@dataclass(frozen=True)
class FlightConditions:
    """Air, wind and turf of a flight."""

    air: Air = field(default_factory=Air)
    wind: Wind = field(default_factory=Wind)
    turf: Turf = field(default_factory=Turf)

    def fly(self, launch: Launch, ball: Ball, model: Aerodynamics = Aerodynamics.LIBGOLF) -> Flight:
        """Return the flight of `ball` with `launch`; raises as `sim.flight.fly`."""
        return fly(launch, self.air, ball, self.wind, self.turf, model)


class RecordedShot(NamedTuple):
    """Content of a record."""

    record: ShotRecord
    plant: PlantParameters
    metadata: dict[str, Any]


def read_shot(path: Path, number: int = 1) -> RecordedShot:
    """Return the shot in the record at `path`; `number` is used if the record has no number.

    Raises:
        BenchError: the file is missing, damaged or no record.
        ExceptionGroup: one BenchError per value of its configuration that this program rejects.
    """
    return recorded_shot(*read_swing(path), str(path), number)


def recorded_shot(cycles: Cycles, metadata: dict[str, Any], location: str, number: int = 1) -> RecordedShot:
    """Return the shot of a record's `cycles` and `metadata`; `location` names it. Raises as `read_shot`."""
    plant, around = plant_of(metadata, location)
    if (given := metadata.get("shot")) is not None:
        shot = shot_from_json(given, f"{location}: shot")
        return RecordedShot(ShotRecord(shot, cycles, flight_of(shot, plant, around)), plant, metadata)
    time = metadata.get("time_utc")
    record = shot_of_cycles(
        cycles,
        plant,
        around,
        number=int(metadata.get("number", number)),
        time_utc=datetime.fromisoformat(time) if isinstance(time, str) else datetime.fromtimestamp(0, UTC),
    )
    return RecordedShot(record, plant, metadata)


def warm_up_shots(plant: PlantParameters, around: FlightConditions) -> None:
    """Run the compiled code of delivery, impact and flight once: the first time takes many seconds."""
    robot = plant.robot
    forward_kinematics(robot, np.array([[0.571, 4.141, 2 * pi]]))
    forward_kinematics(robot, np.array([0.571, 4.141, 2 * pi]))
    head, motion = (0.0, -1.5, 1.5 * pi), (40.0, 0.0, 30.0)
    delivery = delivery_from_plane(head, motion, (0.0, -1.5), robot.club, robot.lie, "encoders+model")
    around.fly(strike(delivery, robot.club, plant.ball), plant.ball)


def plant_of(metadata: Mapping[str, Any], location: str) -> tuple[PlantParameters, FlightConditions]:
    """Return the plant and the surroundings in a record's configuration, today's defaults for missing keys.

    Raises:
        ExceptionGroup: one BenchError per value that this program rejects.
    """
    given = metadata.get("configuration")
    configuration: dict[str, Any] = dict(given) if isinstance(given, Mapping) else {}
    if isinstance(around := configuration.get("surroundings"), Mapping):
        configuration |= around
    kinds = {"plant": PlantParameters, "air": Air, "wind": Wind, "turf": Turf}
    action = "Read it with the version of golfbench that wrote it."
    built, _ = recorded_tables(configuration, kinds, location, action)
    return built["plant"], FlightConditions(built["air"], built["wind"], built["turf"])


def shot_from_json(given: Any, location: str) -> Shot:
    """Return the shot with the JSON object `given`: the names of the shot table.

    Raises:
        BenchError: a column is missing or of another type, or the shot is invalid.
    """
    action = "Restore it, or use the version of golfbench that wrote it."
    require_fit(given, Shot, location, action)
    values = {name: given[name] for name in COLUMNS}
    try:
        time = datetime.fromisoformat(given["time_utc"])
        return Shot(**values | {"status": ShotStatus(given["status"]), "time_utc": time})
    except ValueError as error:
        raise BenchError(location, str(error), "a shot", action) from None


def shot_to_json(shot: Shot) -> dict[str, Any]:
    """Return `shot` as the JSON object that `shot_from_json` takes."""
    return vars(shot) | {"status": str(shot.status), "time_utc": shot.time_utc.isoformat()}


def flight_of(shot: Shot, plant: PlantParameters, around: FlightConditions) -> Flight | None:
    """Return the flight of the launch in `shot`; None without a launch that can be flown.

    In simulation it is the plant's ball that flies; on hardware the reference ball.
    """
    names = ("ball_speed_mps", "launch_angle_deg", "direction_deg", "spin_rpm", "spin_axis_deg")
    given = [getattr(shot, name) for name in names]
    if shot.status is ShotStatus.FAILED or any(value is None for value in given):
        return None
    speed, angle, direction, spin, axis = (float(value or 0.0) for value in given)
    launch = Launch(speed, radians(angle), radians(direction), spin * pi / 30, radians(axis))
    modelled = shot.carry_source in {"", "simulated", "model"} or shot.flight_source == "simulated"
    return flown(launch, plant.ball if modelled else REFERENCE_BALL, around)


def shot_of_cycles(
    cycles: Cycles, plant: PlantParameters, around: FlightConditions, *, number: int, time_utc: datetime
) -> ShotRecord:
    """Return the shot in `cycles`: the delivery as estimated, launch and flight as modelled.

    A ball counts as struck if it was on the tee before the head passed its position and not afterwards.
    """
    trips = cycles["cause"][cycles["cause"] != 0]
    delivery = delivery_of_cycles(cycles, plant)
    launch = flight = None
    if delivery is not None and ball_struck(cycles):
        try:
            launch = strike(delivery, plant.robot.club, plant.ball)
        except ValueError:
            launch = None
        flight = None if launch is None else flown(launch, plant.ball, around)
    reason = "" if delivery is not None else "no swing through the ball's place"
    if len(trips) and Cause(int(trips[0])) is not Cause.POWER_UP:
        reason = CAUSE_TEXT[Cause(int(trips[0]))]
    elif launch is None and not reason:
        reason = "no ball struck"
    club, ball = plant.robot.club.name, plant.ball.name if launch is not None else ""
    status = ShotStatus.FAILED if reason else ShotStatus.VALID
    columns = delivery_columns(delivery) | launch_columns(launch, "model") | flight_columns(flight, "model")
    shot = Shot(number, 1, 1, club, ball, status, reason, time_utc=time_utc, **columns)
    return ShotRecord(shot, cycles, flight)


def delivery_of_cycles(cycles: Cycles, plant: PlantParameters) -> Delivery | None:
    """Return the delivery of the estimated head at the ball's place; None if it does not arrive there."""
    robot, site = plant.robot, plant.site
    at_ball = time_at_ball(robot, cycles, site.ball_x, estimated=True)
    if at_ball is None:
        return None
    last = int(np.searchsorted(cycles["time"], at_ball)) - 1
    angle, velocity = cycles["angle"][last], cycles["velocity"][last]
    ahead = angle + (at_ball - cycles["time"][last]) * velocity
    return delivery_in_motion(plant, lambda time: forward_kinematics(robot, ahead + time * velocity))


def delivery_in_motion(plant: PlantParameters, pose: Callable[[float], Any]) -> Delivery | None:
    """Return the delivery at time 0 of a head whose `pose` (x, y, angle) follows the time (s).

    None if it does not come to the ball.
    """
    step, site, robot = 1e-6, plant.site, plant.robot
    motion = (pose(step) - pose(-step)) / (2 * step)
    ball = site.ball_x, site.ball_y
    try:
        return delivery_from_plane(
            tuple(pose(0.0)), tuple(motion), ball, robot.club, robot.lie, "encoders+model"
        )
    except ValueError:
        return None


def flown(launch: Launch, ball: Ball, around: FlightConditions) -> Flight | None:
    """Return the flight of `ball`; None if it cannot be flown."""
    try:
        return around.fly(launch, ball)
    except ValueError:
        return None
