from __future__ import annotations

import os
import resource
from collections.abc import Callable
from dataclasses import replace
from math import cos, radians, sin
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from bench.base.atomic_file import NotStored
from bench.base.lifecycle import Phase
from bench.records.shot.shot import ShotRecord
from bench.records.shot.strike import SWINGING
from bench.records.telemetry.cycle_record import CYCLE
from bench.viewer.drawing.drawing import ball_at_rest, body_poses, draw, plane_to_golf
from bench.viewer.rerun_recording import layout_for, swing_span, write_recording
from sim.ball import Ball
from sim.kinematics import joint_positions
from sim.plant import PlantParameters, Site
from sim.robot import RobotParameters
from tests.bench.golfer.synthetic import golfer_swing
from tests.bench.records.telemetry.read_recording import Recording

Records = Callable[[int], list[ShotRecord]]
SITE = Site(ball_x=0.2315, ball_y=-1.514, ground=-1.57)
RADIUS = 0.0213


@pytest.fixture(scope="module")
def plant(robot: RobotParameters) -> PlantParameters:
    return replace(PlantParameters(), robot=robot, site=SITE, ball=Ball(radius=RADIUS))


@pytest.fixture(scope="module")
def three(
    tmp_path_factory: pytest.TempPathFactory, make_records: Records, plant: PlantParameters
) -> Recording:
    path = tmp_path_factory.mktemp("recording") / "demo.rrd"
    write_recording(path, make_records(3), plant, name="three swings")
    assert os.listdir(path.parent) == ["demo.rrd"]
    return Recording(path)


def test_recording_signals_equal_cycles_at_full_rate(three: Recording, make_records: Records) -> None:
    cycles = np.concatenate([record.cycles for record in make_records(3)])
    for entity, field in (("actual", "angle"), ("reference", "reference_angle")):
        time, rows = three.read(f"/signals/angle_deg/{entity}", "Scalars:scalars")
        assert np.array_equal(rows, np.degrees(cycles[field]))
        assert len(time) == 6300
    _, valves = three.read("/signals/valve/applied", "Scalars:scalars")
    assert np.array_equal(valves, cycles["applied_valve"])
    _, pressures = three.read("/signals/pressure_bar", "Scalars:scalars")
    assert np.array_equal(np.array(pressures)[:, :6], cycles["chamber_pressure"] / 1e5)


def test_layout_for_one_shot_selects_swing_span(make_records: Records) -> None:
    record = make_records(1)[0]
    lead = np.tile(record.cycles[:1], 9000)  # on its way to the address
    lead["phase"] = Phase.RETURN
    lead["time"] = record.cycles["time"][0] - 1e-3 * np.arange(9000, 0, -1)
    late = replace(record, cycles=np.concatenate([lead, record.cycles]))
    swinging = np.isin(record.cycles["phase"], SWINGING)
    at = 9.0 + record.cycles["time"][swinging] - record.cycles["time"][0]
    span = swing_span(late)
    assert span == pytest.approx((at[0] - 0.3, at[-1] + 0.3))
    panel = layout_for([late]).blueprint.time_panel
    assert panel is not None
    assert panel.time_selection is not None
    assert int(panel.time_selection.min.value) == round(1e9 * span.start)
    assert int(panel.time_selection.max.value) > round(1e9 * span.end)  # with the flight
    standing = replace(record, cycles=lead, flight=None)
    assert swing_span(standing) == pytest.approx((0.0, 9.3), abs=2e-3)
    assert swing_span(replace(record, cycles=lead[:0])) == (0.0, 1.0)


def test_recording_swings_are_ordered_in_time(three: Recording, make_records: Records) -> None:
    time, _ = three.read("/signals/head_speed_mps", "Scalars:scalars")
    assert np.all(np.diff(time) > 0)
    swings = time.reshape(3, -1)
    assert np.allclose(swings - swings[:, :1], make_records(1)[0].cycles["time"], atol=1e-9)
    for record, start, following in zip(make_records(2), swings[:2, 0], swings[1:, 0], strict=True):
        assert record.flight is not None
        assert following > start + 1.1 + record.flight.total_time


def test_recording_club_follows_kinematics(
    three: Recording, make_records: Records, robot: RobotParameters
) -> None:
    time, rows = three.read("/scene/robot/club", "Transform3D:translation")
    cycles = make_records(1)[0].cycles
    ticks = np.round(time[time < 2.1] * 1000).astype(int)
    wrist = joint_positions(robot, cycles["angle"][ticks])[:, 2]
    assert np.allclose(np.array(rows)[: len(ticks), 0, :2], wrist, atol=1e-6)
    quick = np.flatnonzero(np.isin(cycles["phase"], [Phase.DOWNSWING, Phase.IMPACT]))
    assert set(quick) <= set(ticks)


def test_recording_ball_rests_on_tee_and_follows_flight(three: Recording, make_records: Records) -> None:
    record = make_records(1)[0]
    assert record.flight is not None
    time, rows = three.read("/range/ball", "Points3D:positions")
    first = time < time[0] + record.flight.total_time + 1e-6
    assert np.allclose(np.array(rows)[first, 0], record.flight.path[:, 1:], atol=1e-4)
    assert time[0] == pytest.approx(1.186, abs=2e-3)  # the head crosses the ball then
    _, speed = three.read("/signals/ball_speed_mps", "Scalars:scalars")
    assert record.shot.ball_speed_mps is not None
    assert speed[0][0] == pytest.approx(record.shot.ball_speed_mps, rel=0.01)
    _, near = three.read("/scene/ball", "Points3D:positions")
    assert near[0][0][1] == pytest.approx((1.57 - 1.514) * sin(radians(53)) + RADIUS * sin(radians(15.0)))


def test_recording_shot_text_shows_figures(three: Recording) -> None:
    _, texts = three.read("/shot", "TextDocument:text")
    joined = "\n".join(text[0] for text in texts)
    assert "Shot 3: Pro V" in joined
    assert "216.8 yd" in joined


def test_recording_shot_without_ball_is_shown(
    tmp_path: Path, make_records: Records, plant: PlantParameters
) -> None:
    missed = make_records(4)[3]
    stopped = ShotRecord(missed.shot, np.zeros(0, CYCLE))
    write_recording(tmp_path / "x.rrd", [missed, stopped], plant)
    recording = Recording(tmp_path / "x.rrd")
    assert not any("range/shots" in entity for entity in recording.entities)
    _, texts = recording.read("/shot", "TextDocument:text")
    assert "no ball seen on the tee" in texts[0][0]


def test_recording_without_pressure_sensors_shows_gaps(
    tmp_path: Path, make_records: Records, plant: PlantParameters
) -> None:
    record = make_records(1)[0]
    for name in ("chamber_pressure", "plant_pressure"):
        record.cycles[name] = np.nan
    write_recording(tmp_path / "x.rrd", [record], plant)
    _, rows = Recording(tmp_path / "x.rrd").read("/signals/pressure_bar", "Scalars:scalars")
    assert np.isnan(np.array(rows)[:, :6]).all()


def test_recording_golfer_meets_ball_with_robot(
    tmp_path: Path, make_records: Records, plant: PlantParameters
) -> None:
    record, golfer = make_records(1)[0], golfer_swing()
    stopped = ShotRecord(record.shot, record.cycles[:300])
    write_recording(tmp_path / "x.rrd", [record, stopped], plant, golfer=golfer)
    recording = Recording(tmp_path / "x.rrd")
    struck = recording.read("/range/ball", "Points3D:positions")[0][0]
    time, clubs = recording.read("/scene/golfer/club", "LineStrips3D:strips")
    _, bodies = recording.read("/scene/golfer/body", "LineStrips3D:strips")
    assert time[-1] == pytest.approx(struck, abs=1e-6)
    assert time[0] >= 0.0  # the golfer's address is before the record
    assert clubs[-1][0][-1] == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
    shoulders = [golfer.position[f"{side}_shoulder"][-1] for side in ("trail", "lead")]
    assert np.allclose(bodies[-1][0][:2], shoulders, atol=1e-6)
    assert np.diff(time[time > struck - golfer.downswing_time]) == pytest.approx(1e-3, abs=1e-6)
    time, angles = recording.read("/signals/angle_deg/golfer", "Scalars:scalars")
    assert np.isnan(angles[-1]).all()
    at_ball = record.cycles["angle"][np.searchsorted(record.cycles["time"], struck)]
    turns = (np.radians(angles[-2]) - golfer.angle[-1]) / (2 * np.pi)
    assert turns == pytest.approx(np.round((at_ball - golfer.angle[-1]) / (2 * np.pi)))
    _, speeds = recording.read("/signals/golfer_head_speed_mps", "Scalars:scalars")
    assert speeds[-2][0] == pytest.approx(golfer.head_speed, rel=0.02)


def test_plane_to_golf_places_ball_above_origin(robot: RobotParameters) -> None:
    axes, origin = plane_to_golf(robot, SITE)
    assert np.allclose(axes @ axes.T, np.eye(3))
    assert np.linalg.det(axes) == pytest.approx(1)
    assert np.allclose(axes[:, 1], [0, sin(robot.lie), -cos(robot.lie)])  # up the plane, towards the golfer
    contact = axes @ [SITE.ball_x, SITE.ball_y, 0] + origin
    assert contact == pytest.approx([0, (SITE.ball_y - SITE.ground) * sin(robot.lie), 0])
    assert ball_at_rest(robot, SITE, RADIUS)[0] > 0  # ahead of the face


def test_body_poses_right_arm_points_from_wrist_to_shoulder(plant: PlantParameters) -> None:
    q = np.random.default_rng(2).uniform([-1, 3.3, 4.8], [2, 4.6, 6.3], (50, 3))
    poses = body_poses(plant, q)
    points = joint_positions(plant.robot, q)
    _, quaternion = poses["right_arm_rod"]
    angle = 2 * np.arctan2(quaternion[:, 2], quaternion[:, 3])
    length = np.linalg.norm(points[:, 3] - points[:, 2], axis=1)
    tip = points[:, 2] + length[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    assert np.allclose(tip, points[:, 3])


def test_write_recording_write_failure_leaves_no_file(
    tmp_path: Path, make_records: Records, plant: PlantParameters
) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))
    try:
        with pytest.raises(NotStored, match="nothing was stored"):
            write_recording(tmp_path / "x.rrd", make_records(2), plant)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert os.listdir(tmp_path) == []


def test_write_recording_full_disk_leaves_no_file(
    tmp_path: Path, make_records: Records, plant: PlantParameters, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise RuntimeError("Failed to write: No space left on device (os error 28)")

    monkeypatch.setattr(rr.RecordingStream, "save", full)
    with pytest.raises(NotStored, match="No space left"):
        write_recording(tmp_path / "x.rrd", make_records(1), plant)
    assert os.listdir(tmp_path) == []


def test_write_recording_without_shots_or_folder_is_refused(
    tmp_path: Path, make_records: Records, plant: PlantParameters
) -> None:
    with pytest.raises(ValueError, match="at least one shot"):
        write_recording(tmp_path / "x.rrd", [], plant)
    with pytest.raises(NotStored, match="No such file"):
        write_recording(tmp_path / "absent" / "x.rrd", make_records(1), plant)


def test_recording_time_is_relative_to_record_start(
    tmp_path: Path, make_records: Records, plant: PlantParameters
) -> None:
    record = make_records(1)[0]
    later = record.cycles.copy()
    later["time"] += 5.0
    write_recording(tmp_path / "x.rrd", [replace(record, cycles=later)], plant)
    time, _ = Recording(tmp_path / "x.rrd").read("/range/ball", "Points3D:positions")
    assert time[0] == pytest.approx(1.186, abs=2e-3)


def test_recording_meshes_are_static_and_poses_move(three: Recording, plant: PlantParameters) -> None:
    drawing = draw(plant)
    moving = {f"/scene/robot/{body.name}/drawn" for body in (*drawing.moving, *drawing.fixed_in_plane)}
    fixed = {f"/scene/{body.name}" for body in drawing.fixed}
    assert moving | fixed <= three.static
    for body in drawing.moving:
        time, _ = three.read(f"/scene/robot/{body.name}", "Transform3D:translation")
        assert len(time) > 100
