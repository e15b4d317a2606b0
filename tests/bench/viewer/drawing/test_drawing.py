"""The drawn bodies are those of the configured robot, and fit each other."""

from __future__ import annotations

from dataclasses import replace
from math import pi, sin

import numpy as np
import pytest

from bench.base.errors import BenchError
from bench.viewer.drawing.bodies import Bar, DrawnBody, Ellipsoid, Solid, Tube
from bench.viewer.drawing.drawing import Drawing, address, body_poses, draw, placed, plane_to_golf, wrist_ways
from sim.kinematics import forward_kinematics, joint_positions, right_arm_length
from sim.plant import PlantParameters
from tests.bench.viewer.drawing.conftest import PLANTS, SIZED, mesh_volume

INCH = 0.0254


def all_bodies(plant: PlantParameters) -> list[DrawnBody]:
    return [body for group in draw(plant) for body in group]


def body(plant: PlantParameters, name: str) -> DrawnBody:
    (found,) = [body for body in draw(plant).moving if body.name == name]
    return found


def part(plant: PlantParameters, of: str, name: str) -> Solid:
    (found,) = [part.solid for part in body(plant, of).parts if part.name == name]
    return found


def bar(plant: PlantParameters, of: str, name: str) -> Bar:
    found = part(plant, of, name)
    assert isinstance(found, Bar)
    return found


def tube(plant: PlantParameters, of: str, name: str) -> Tube:
    found = part(plant, of, name)
    assert isinstance(found, Tube)
    return found


# Solids ----------------------------------------------------------------------------------------------

SOLIDS: dict[str, Solid] = {
    "bar": Bar((0.3, 0.1, 0.05), (1.0, 2.0, 3.0), ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))),
    "tube": Tube((0.1, 0.2, 0.3), (0.4, -0.1, 0.9), 0.05, 0.03),
    "rod": Tube((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.05),
    "ball": Ellipsoid((0.02, 0.02, 0.02), (1.0, 0.0, 0.0)),
    "cut": Ellipsoid((0.06, 0.03, 0.05), (0.0, 0.0, 0.0), cut=0.035),
}


def sampled(solid: Solid) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, centroid and inertia of the solid's mesh, from signed tetrahedra about the origin."""
    a, b, c = np.moveaxis(solid.mesh.vertices[solid.mesh.triangles], 1, 0)
    volume = (a * np.cross(b, c)).sum(axis=1) / 6
    total = volume.sum()
    centroid = (volume[:, None] * (a + b + c) / 4).sum(axis=0) / total
    corners = np.stack([a, b, c, np.zeros_like(a)], axis=1) - centroid
    along = corners.sum(axis=1)
    second = np.einsum("n,nki,nkj->ij", volume, corners, corners) + np.einsum(
        "n,ni,nj->ij", volume, along, along
    )
    second /= 20
    return total, centroid, np.trace(second) * np.eye(3) - second


@pytest.mark.parametrize("name", SOLIDS)
def test_solid_volume_and_inertia_match_mesh(name: str) -> None:
    solid = SOLIDS[name]
    volume, centroid, inertia = sampled(solid)
    assert volume == pytest.approx(solid.volume.volume, rel=0.02)  # circles of 32 pieces
    assert centroid == pytest.approx(solid.volume.centroid, abs=2e-4)
    scale = np.abs(solid.volume.inertia).max()
    assert inertia == pytest.approx(solid.volume.inertia, abs=0.04 * scale)


@pytest.mark.parametrize("name", SOLIDS)
def test_solid_mesh_is_closed_with_outward_normals(name: str) -> None:
    mesh = SOLIDS[name].mesh
    assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1.0)
    points, corner = np.unique(np.round(mesh.vertices, 9), axis=0, return_inverse=True)
    edges = corner[mesh.triangles][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    there = {(int(a), int(b)) for a, b in edges if a != b}
    assert all((b, a) in there for a, b in there)
    assert len(points) > 4
    assert mesh_volume(mesh) > 0


# Masses ----------------------------------------------------------------------------------------------


def test_drawn_links_match_mass_and_inertia_of_dynamics(plant: PlantParameters) -> None:
    for name in ("shoulder_link", "left_arm"):
        drawn = body(plant, name)
        assert drawn.assumed is not None
        found = drawn.without_joints
        assert found.volume == pytest.approx(drawn.assumed.mass, rel=1e-12)
        assert found.centroid[:2] == pytest.approx((drawn.assumed.centre_of_mass, 0.0), abs=1e-12)
        assert found.inertia[2, 2] == pytest.approx(drawn.assumed.inertia, rel=1e-9)


def test_drawn_right_arm_matches_mass_and_centre_of_dynamics(plant: PlantParameters) -> None:
    for name in ("right_arm_rod", "right_arm_cylinder"):
        drawn = body(plant, name)
        assert drawn.assumed is not None
        assert drawn.weighed.volume == pytest.approx(drawn.assumed.mass, rel=1e-9)
        assert drawn.weighed.centroid[0] == pytest.approx(drawn.assumed.centre_of_mass, abs=1e-9)


def test_drawn_club_matches_mass_and_balance(plant: PlantParameters) -> None:
    drawn, club = body(plant, "club"), plant.robot.club
    assert drawn.weighed.volume == pytest.approx(club.mass, rel=1e-9)
    assert drawn.weighed.centroid[0] == pytest.approx(club.centre_of_mass, abs=0.02)
    assert drawn.weighed.inertia[2, 2] == pytest.approx(club.inertia, rel=0.1)


def test_drawn_links_match_thesis_sections(shipped: PlantParameters) -> None:
    link, arm = bar(shipped, "shoulder_link", "link"), bar(shipped, "left_arm", "arm")
    assert link.size == pytest.approx((17 * INCH, 2 * INCH, 3 / 8 * INCH))
    assert arm.size == pytest.approx((24.5 * INCH, 1.5 * INCH, 5 / 8 * INCH))


def test_drawn_links_follow_mass_and_length(shipped: PlantParameters) -> None:
    robot = shipped.robot
    heavy = replace(
        robot.shoulder_link, mass=2 * robot.shoulder_link.mass, inertia=2 * robot.shoulder_link.inertia
    )
    other = replace(shipped, robot=replace(robot, shoulder_link=heavy, l23=0.60))
    assert bar(other, "shoulder_link", "link").size[2] == pytest.approx(3 / 4 * INCH)
    bores = bar(other, "left_arm", "arm").bores
    assert bores[1].x - bores[0].x == pytest.approx(0.60)


# Fit -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plant", (PLANTS | SIZED).values(), ids=PLANTS | SIZED)
def test_drawn_piston_stays_within_right_arm(plant: PlantParameters) -> None:
    cylinder, end = body(plant, "right_arm_cylinder"), plant.robot.l56
    rear = tube(plant, "right_arm_cylinder", "right-arm rear cap").end[0]
    front = tube(plant, "right_arm_cylinder", "right-arm front cap").start[0]
    piston = tube(plant, "right_arm_rod", "right-arm piston")
    assert cylinder.parts[0].solid.volume.volume > 0
    for extension in plant.right_arm.chamber_ends:
        length = end + extension
        assert length - piston.start[0] <= front + 1e-9
        assert length - piston.end[0] >= rear


def test_drawn_wrist_yoke_holds_lever_pin(plant: PlantParameters) -> None:
    low, high = wrist_ways(plant)
    for theta3 in np.linspace(plant.wrist.lower, plant.wrist.upper, 9):
        along, across = float(plant.wrist_stroke(float(theta3))), -float(plant.wrist_slope(theta3))
        assert low - 1e-12 <= along <= high + 1e-12
        # The pin drawn on the club, turned with it, is where the yoke stands.
        turn = np.array([[np.cos(theta3), -np.sin(theta3)], [np.sin(theta3), np.cos(theta3)]])
        pin = tube(plant, "club", "lever pin").start[:2]
        assert turn @ pin == pytest.approx((along, across), abs=1e-12)


def test_drawn_wrist_cylinder_and_plate_lie_on_left_arm(plant: PlantParameters) -> None:
    cylinder = tube(plant, "left_arm", "wrist cylinder")
    assert cylinder.start[0] >= -1e-9
    assert cylinder.end[0] < plant.robot.l23 + wrist_ways(plant)[0]
    assert 0 < bar(plant, "left_arm", "plate").centre[0] <= plant.robot.l23


def test_drawn_sole_matches_sole_depth_of_site(plant: PlantParameters) -> None:
    """At address, upright lie: the head's lowest drawn point against the sole of the clearance checks."""
    if abs(plant.robot.lie - plant.robot.club.lie) > 1e-9:
        pytest.skip("the club does not stand on its sole in this plane")
    head = part(plant, "club", "head")
    axes, _ = plane_to_golf(plant.robot, plant.site)
    q = address(plant)
    turn = np.sum(q)
    c, s = np.cos(turn), np.sin(turn)
    rotation = axes @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    height = (head.mesh.vertices - [plant.robot.club.length_to_face, 0, 0]) @ rotation.T[:, 1]
    depth = plant.site.sole_depth * sin(plant.robot.lie)
    # A blade is tilted back by its loft, so that its edge reaches lower.
    assert -height.min() == pytest.approx(depth, abs=0.0025 if isinstance(head, Ellipsoid) else 0.012)


def test_drawn_bodies_are_clear_along_plane_normal(plant: PlantParameters) -> None:
    heights = {
        b.name: (b.mesh.vertices[:, 2].min(), b.mesh.vertices[:, 2].max()) for b in draw(plant).fixed_in_plane
    }
    arm, clamp = bar(plant, "left_arm", "arm"), bar(plant, "club", "mount")
    link, cylinder = bar(plant, "shoulder_link", "link"), tube(plant, "right_arm_cylinder", "right-arm tube")
    assert arm.centre[2] - arm.size[2] / 2 > max(clamp.size[2], link.size[2]) / 2
    assert cylinder.start[2] + cylinder.outer < -max(clamp.size[2], link.size[2]) / 2
    housing = draw(plant).fixed_in_plane[0].parts[0].solid.mesh.vertices[:, 2].max()
    assert housing < cylinder.start[2] - cylinder.outer
    assert heights["drive"][0] < housing


# Placement -------------------------------------------------------------------------------------------


def test_address_puts_face_at_ball(plant: PlantParameters) -> None:
    q = address(plant)
    pose = forward_kinematics(plant.robot, q)
    assert pose[:2] == pytest.approx((plant.site.ball_x, plant.site.ball_y))
    assert np.cos(pose[2]) == pytest.approx(0.0, abs=1e-12)
    assert abs(q[2] - (plant.wrist.lower + plant.wrist.upper) / 2) <= pi


def test_address_ball_out_of_reach_is_refused(shipped: PlantParameters) -> None:
    far = replace(shipped, site=replace(shipped.site, ball_x=1.5))
    with pytest.raises(BenchError, match=r"plant\.site"):
        address(far)


def test_body_poses_joints_coincide(plant: PlantParameters) -> None:
    q = np.random.default_rng(3).uniform([-1, 3.5, 4.9], [2, 4.4, 6.2], (20, 3))
    poses = body_poses(plant, q)
    points = joint_positions(plant.robot, q)
    for row, angles in enumerate(q):
        arm, rod, cylinder = (
            poses[n][0][row][:2] for n in ("left_arm", "right_arm_rod", "right_arm_cylinder")
        )
        assert arm == pytest.approx(points[row, 1])
        assert rod == pytest.approx(points[row, 2])
        assert cylinder == pytest.approx(points[row, 3])
        assert np.linalg.norm(rod - cylinder) == pytest.approx(
            float(right_arm_length(plant.robot, angles[1]))
        )


def test_placed_bodies_stand_above_ground(plant: PlantParameters) -> None:
    assert {b.body.name for b in placed(plant)} == {b.name for b in all_bodies(plant)}
    for one in placed(plant):
        assert one.mesh.vertices[:, 1].min() > -0.03, one.body.name
    assert isinstance(draw(plant), Drawing)
