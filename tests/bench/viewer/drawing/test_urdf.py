"""The URDF is the bench's robot: independent simulators read it and accelerate as `sim.kane` says."""

from __future__ import annotations

import json
from math import pi, sin
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from bench.viewer.drawing.bodies import Tube
from bench.viewer.drawing.drawing import address, lever_parts, plane_to_golf
from bench.viewer.drawing.model_files import CLOSURE, joints, write_urdf
from sim.kane import forward_dynamics
from sim.plant import PlantParameters
from sim.robot import Body, Club
from tests.bench.viewer.drawing.conftest import PLANTS, SIZED
from tests.benchmarks.right_arm import with_right_arm

FRAME_RADIUS = 0.1
STATES = 100
NAMES = ("shoulder", "arm", "wrist", "rod", "cylinder")
Array = np.ndarray[Any, Any]


@pytest.fixture(params=PLANTS | SIZED, scope="module")
def plant(request: pytest.FixtureRequest) -> PlantParameters:
    """Every shipped robot, the sized ones too."""
    return (PLANTS | SIZED)[request.param]


@pytest.fixture(scope="module")
def folder(plant: PlantParameters, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("urdf")
    files = write_urdf(path, plant, FRAME_RADIUS)
    assert all(file.is_file() for file in files)
    return path


@pytest.fixture(scope="module")
def root(folder: Path) -> ElementTree.Element:
    return ElementTree.parse(folder / "golfbench.urdf").getroot()  # noqa: S314 - our own


def states(plant: PlantParameters) -> list[tuple[Array, Array, Array]]:
    """Random states of the robot and efforts, far beyond those of a swing."""
    random = np.random.default_rng(11)
    low = (plant.shoulder.lower, pi + 0.2, plant.wrist.lower)
    high = (plant.shoulder.upper, 1.6 * pi, plant.wrist.upper)
    return [
        (
            random.uniform(low, high),
            random.uniform(-15.0, 15.0, 3),
            random.uniform(-1.0, 1.0, 3) * (300.0, 1000.0, 100.0),
        )
        for _ in range(STATES)
    ]


def generalised(effort: Array) -> Array:
    """Effort of the five joints: the right arm's force moves the cylinder along the rod."""
    return np.array([effort[0], 0.0, effort[2], 0.0, effort[1]])


def relative(found: Array, expected: Array) -> float:
    return float(np.abs(found - expected).max() / np.abs(expected).max())


# The file --------------------------------------------------------------------------------------------


def test_urdf_links_match_bodies_of_dynamics(plant: PlantParameters, root: ElementTree.Element) -> None:
    robot = plant.robot
    bodies: dict[str | None, Body | Club] = {
        "shoulder_link": robot.shoulder_link,
        "left_arm": robot.left_arm,
        "club": robot.club,
        "right_arm_rod": robot.rod,
        "right_arm_cylinder": robot.cylinder,
    }
    heavy = {link.get("name"): link for link in root.iter("link") if link.find("inertial") is not None}
    assert heavy.keys() == bodies.keys()
    for name, body in bodies.items():
        inertial = heavy[name].find("inertial")
        assert inertial is not None
        mass, inertia, origin = (inertial.find(key) for key in ("mass", "inertia", "origin"))
        assert mass is not None
        assert inertia is not None
        assert origin is not None
        assert float(mass.get("value", "")) == body.mass
        assert float(inertia.get("izz", "")) == body.inertia
        assert float(origin.get("xyz", "").split()[0]) == body.centre_of_mass
        moments = sorted(float(inertia.get(key, "")) for key in ("ixx", "iyy", "izz"))
        assert moments[0] > 0
        assert moments[0] + moments[1] >= moments[2] * (1 - 1e-12)


def test_urdf_origins_have_three_numbers_each(root: ElementTree.Element) -> None:
    for origin in root.iter("origin"):
        for name in ("xyz", "rpy"):
            assert len([float(number) for number in origin.get(name, "0 0 0").split()]) == 3, name


def test_urdf_joint_limits_contain_working_range(plant: PlantParameters) -> None:
    limits = {hinge.name: (hinge.lower, hinge.upper) for hinge in joints(plant)}
    for name, actuator in (("shoulder", plant.shoulder), ("wrist", plant.wrist)):
        assert limits[name][0] < actuator.lower < actuator.upper < limits[name][1]
    for q, _, _ in states(plant):
        values, _ = with_right_arm(plant.robot, q, np.zeros(3))
        values[3] %= 2 * pi
        for name, value in zip(NAMES, values, strict=True):
            assert limits[name][0] <= value <= limits[name][1], name


def test_urdf_outlines_match_clearance_checks(plant: PlantParameters, root: ElementTree.Element) -> None:
    """The club is the line to the centre of the face with a sole below, the frame a disc round R1."""
    outlines = {
        link.get("name"): [(shape.tag, shape.attrib) for shape in link.iterfind("collision/geometry/*")]
        for link in root.iter("link")
        if link.find("collision") is not None
    }
    club = plant.robot.club
    line = {"radius": repr(club.shaft_radius), "length": repr(club.length_to_face)}
    assert outlines == {
        "swing_plane": [("cylinder", {"radius": repr(FRAME_RADIUS), "length": "0.1"})],
        "club": [("cylinder", line), ("sphere", {"radius": repr(plant.site.sole_depth)})],
    }


# Readers ---------------------------------------------------------------------------------------------


@pytest.mark.release
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the reader's own calls
def test_urdf_read_by_yourdfpy_matches_drawn_robot(plant: PlantParameters, folder: Path) -> None:
    yourdfpy = pytest.importorskip("yourdfpy", reason="needs yourdfpy (pip install '.[benchmark]')")
    file, meshes = str(folder / "golfbench.urdf"), str(folder)
    read = yourdfpy.URDF.load(file, mesh_dir=meshes, build_collision_scene_graph=True)
    assert read.validate()
    q = address(plant)
    values, _ = with_right_arm(plant.robot, q, np.zeros(3))
    read.update_cfg(dict(zip(NAMES, values, strict=True)))
    first, second = (read.get_transform(name, "ground") for name in CLOSURE)
    assert first[:3, 3] == pytest.approx(second[:3, 3], abs=1e-9)
    # The face meets the ball: in the golf frame above the origin, here with Z up.
    face = read.get_transform("club", "ground") @ [plant.robot.club.length_to_face, 0.0, 0.0, 1.0]
    height = (plant.site.ball_y - plant.site.ground) * sin(plant.robot.lie)
    assert face[:3] == pytest.approx((0.0, 0.0, height), abs=1e-9)
    axes, _ = plane_to_golf(plant.robot, plant.site)
    normal = read.get_transform("club", "ground")[:3, 2]
    assert normal == pytest.approx((axes[0, 2], -axes[2, 2], axes[1, 2]), abs=1e-9)
    assert sum(mesh.volume > 0 for mesh in read.scene.geometry.values()) == len(read.scene.geometry)


class PinocchioReader:
    """The file in Pinocchio, its loop closed by a rigid point constraint."""

    TOLERANCE = 1e-9

    def __init__(self, plant: PlantParameters, folder: Path) -> None:
        self._pin = pin = pytest.importorskip("pinocchio", reason="needs pin (pip install '.[benchmark]')")
        self._robot = plant.robot
        self._model = model = pin.buildModelFromUrdf(str(folder / "golfbench.urdf"))
        closure = json.loads((folder / "closure.json").read_text())
        model.gravity.linear = np.array(closure["gravity_m_per_s2"])
        one, other = (model.frames[model.getFrameId(name)] for name in closure["links"])
        ends = (one.parentJoint, one.placement, other.parentJoint, other.placement)
        loop = pin.RigidConstraintModel(pin.ContactType.CONTACT_3D, model, *ends, pin.ReferenceFrame.LOCAL)
        self._loops, self._memory = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
        self._loops.append(loop)
        self._memory.append(self._loops[0].createData())
        self._data = model.createData()
        pin.initConstraintDynamics(model, self._data, self._loops, self._memory)
        self._solver = pin.ProximalSettings(1e-12, 1e-12, 10)
        self._order = [model.joints[model.getJointId(name)].idx_v for name in NAMES]

    def accelerations(self, q: Array, u: Array, force: Array) -> Array:
        """Return the bench's three joints' (rad/s2) under `force` (5,) in the order of NAMES."""
        position, velocity, effort = np.zeros(5), np.zeros(5), np.zeros(5)
        position[self._order], velocity[self._order] = with_right_arm(self._robot, q, u)
        effort[self._order] = force
        arguments = (self._loops, self._memory, self._solver)
        found = self._pin.constraintDynamics(self._model, self._data, position, velocity, effort, *arguments)
        return np.array(found[self._order][:3])

    def along_the_arm(self, q: Array, pin: Array) -> Array:
        """Return the efforts (5,) of 1 N along the left arm on the club at `pin`, and back on the arm."""
        position = np.zeros(5)
        position[self._order], _ = with_right_arm(self._robot, q, np.zeros(3))
        library, model, data = self._pin, self._model, self._data
        library.computeJointJacobians(model, data, position)
        club, arm = (model.getJointId(name) for name in ("wrist", "arm"))
        location = data.oMi[club].act(pin)
        there = library.SE3(np.eye(3), location)
        world = [library.getJointJacobian(model, data, i, library.ReferenceFrame.WORLD) for i in (club, arm)]
        moved = there.toActionMatrixInverse() @ (world[0] - world[1])
        return np.array((data.oMi[arm].rotation[:, 0] @ moved[:3])[self._order])


class MujocoReader:
    """The file in MuJoCo, its constraints, soft by 1e-4, a millionth as soft by the weights it takes."""

    TOLERANCE = 1e-6

    def __init__(self, plant: PlantParameters, folder: Path) -> None:
        self._mujoco = mujoco = pytest.importorskip(
            "mujoco", reason="needs mujoco (pip install '.[benchmark]')"
        )
        self._robot = plant.robot
        spec = mujoco.MjSpec.from_file(str(folder / "golfbench.urdf"))
        for name in CLOSURE:
            spec.body(name).add_site(name=name)
        loop = spec.add_equality()
        loop.type, loop.objtype = mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtObj.mjOBJ_SITE
        loop.name1, loop.name2 = CLOSURE
        loop.solimp[:3] = 0.9999, 0.9999, 0.001
        self._model = model = spec.compile()
        assert model.opt.gravity == pytest.approx((0.0, 0.0, -plant.robot.gravity))
        off = mujoco.mjtDisableBit
        model.opt.disableflags = int(off.mjDSBL_CONTACT) | int(off.mjDSBL_LIMIT)
        model.opt.iterations, model.opt.tolerance = 200, 0.0
        model.eq_solref[0] = 2 * model.opt.timestep, 1.0
        model.body_invweight0[:] *= 1e-6
        self._data = mujoco.MjData(model)
        self._order = [model.joint(name).dofadr[0] for name in NAMES]

    def accelerations(self, q: Array, u: Array, force: Array) -> Array:
        """Return the bench's three joints' (rad/s2) under `force` (5,) in the order of NAMES."""
        data = self._data
        data.qpos[self._order], data.qvel[self._order] = with_right_arm(self._robot, q, u)
        data.qfrc_applied[self._order] = force
        self._mujoco.mj_forward(self._model, data)
        return np.array(data.qacc[self._order][:3])

    def along_the_arm(self, q: Array, pin: Array) -> Array:
        """Return the efforts (5,) of 1 N along the left arm on the club at `pin`, and back on the arm."""
        data = self._data
        data.qpos[self._order], _ = with_right_arm(self._robot, q, np.zeros(3))
        self._mujoco.mj_forward(self._model, data)
        club, arm = data.body("club"), data.body("left_arm")
        location = club.xpos + club.xmat.reshape(3, 3) @ pin
        moved = np.zeros((2, 3, self._model.nv))
        for jacobian, link in zip(moved, (club, arm), strict=True):
            self._mujoco.mj_jac(self._model, data, jacobian, None, location, link.id)
        return np.array((arm.xmat.reshape(3, 3)[:, 0] @ (moved[0] - moved[1]))[self._order])


READERS = (PinocchioReader, MujocoReader)


@pytest.mark.release
@pytest.mark.parametrize("reader", READERS)
def test_urdf_simulators_match_forward_dynamics(
    plant: PlantParameters, folder: Path, reader: type[PinocchioReader] | type[MujocoReader]
) -> None:
    read = reader(plant, folder)
    worst = max(
        relative(read.accelerations(q, u, generalised(effort)), forward_dynamics(plant.robot, q, u, effort))
        for q, u, effort in states(plant)
    )
    assert worst < reader.TOLERANCE


@pytest.mark.release
@pytest.mark.parametrize("reader", READERS)
def test_urdf_wrist_cylinder_force_matches_forward_dynamics(
    plant: PlantParameters, folder: Path, reader: type[PinocchioReader] | type[MujocoReader]
) -> None:
    """Its force pushes the drawn pin along the arm, and the arm back: the wrist's effort comes from there."""
    read = reader(plant, folder)
    (drawn,) = [part.solid for part in lever_parts(plant) if part.name == "lever pin"]
    assert isinstance(drawn, Tube)
    pin, worst = np.array([*drawn.start[:2], 0.0]), 0.0
    for q, u, effort in states(plant):
        force = 20.0 * effort[2]  # N: up to 2000
        pushed = generalised(np.array([effort[0], effort[1], 0.0])) + force * read.along_the_arm(q, pin)
        ours = np.array([effort[0], effort[1], force * plant.wrist_slope(q[2])])
        found = read.accelerations(q, u, pushed)
        worst = max(worst, relative(found, forward_dynamics(plant.robot, q, u, ours)))
    assert worst < reader.TOLERANCE
