"""The same five bodies in Pinocchio, the loop closed by a rigid point constraint at R6.

Pinocchio's Python binding has no internal loop, so every evaluation pays for a call from Python. That
share is measured with the same call on a model without bodies (`bare_call`) and can be taken off.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from sim.robot import Body, Club, RobotParameters
from tests.benchmarks.right_arm import with_right_arm

Array = NDArray[np.float64]


def _at(x: float) -> pin.SE3:
    return pin.SE3(np.eye(3), np.array([x, 0.0, 0.0]))


def _inertia(body: Body | Club, direction: int = 1) -> pin.Inertia:
    return pin.Inertia(
        body.mass, np.array([direction * body.centre_of_mass, 0.0, 0.0]), np.eye(3) * body.inertia
    )


class _Problem:
    """A model with its constraints and the memory of the solver."""

    def __init__(self, model: pin.Model, constraints: list[pin.RigidConstraintModel]) -> None:
        self.model = model
        self.data = model.createData()
        self.constraints = pin.StdVec_RigidConstraintModel()
        self.constraint_data = pin.StdVec_RigidConstraintData()
        for constraint in constraints:
            self.constraints.append(constraint)
            self.constraint_data.append(self.constraints[len(self.constraints) - 1].createData())
        pin.initConstraintDynamics(self.model, self.data, self.constraints, self.constraint_data)
        # The out-of-plane row is redundant: this much damping makes the system regular, and one
        # iteration is then exact to 1e-12.
        self.solver = pin.ProximalSettings(1e-12, 1e-12, 1)


def _robot_problem(robot: RobotParameters) -> _Problem:
    model = pin.Model()
    model.gravity.linear = np.array([0.0, -robot.in_plane_gravity, 0.0])

    def add(parent: int, joint: pin.JointModel, x: float, name: str, inertia: pin.Inertia) -> int:
        identity: int = model.addJoint(parent, joint, _at(x), name)
        model.appendBodyToJoint(identity, inertia, _at(0.0))
        return identity

    link = add(0, pin.JointModelRZ(), 0.0, "shoulder link", _inertia(robot.shoulder_link))
    arm = add(link, pin.JointModelRZ(), robot.l12, "left arm", _inertia(robot.left_arm))
    add(arm, pin.JointModelRZ(), robot.l23, "club", _inertia(robot.club))
    rod = add(arm, pin.JointModelRZ(), robot.l23, "rod", _inertia(robot.rod))
    cylinder = add(rod, pin.JointModelPX(), 0.0, "cylinder", _inertia(robot.cylinder, -1))
    kind = pin.ContactType.CONTACT_3D
    closure = pin.RigidConstraintModel(kind, model, link, _at(-robot.l16), cylinder, _at(0.0))
    return _Problem(model, [closure])


class PinocchioRobot:
    """The robot in Pinocchio, integrated by a loop in Python."""

    def __init__(self, robot: RobotParameters) -> None:
        self._robot = robot
        self._problem = _robot_problem(robot)
        self._q, self._u, self._effort = np.zeros(5), np.zeros(5), np.zeros(5)

    def start(self, q: Array, u: Array) -> None:
        """Set joint angles and speeds, the right arm's with them."""
        self._q, self._u = with_right_arm(self._robot, q, u)

    def push(self, effort: Array) -> None:
        """Hold `effort` [M_A N m, F_E N, M_C N m] from now on; the rod slides with l46."""
        self._effort = np.array([effort[0], 0.0, effort[2], 0.0, effort[1]])

    def follow(self, efforts: Array, dt: float, steps: int) -> None:
        """Take `steps` steps of `dt` seconds under each of `efforts` in turn."""
        for effort in efforts:
            self.push(effort)
            self._advance(dt, steps)

    def acceleration(self) -> Array:
        """Accelerations (rad/s2) of the joints in the present state."""
        return np.array(self._accelerations()[:3])

    def _accelerations(self) -> Array:
        p = self._problem
        found: Array = pin.constraintDynamics(
            p.model, p.data, self._q, self._u, self._effort, p.constraints, p.constraint_data, p.solver
        )
        return found

    def _advance(self, dt: float, steps: int) -> None:
        p, q, u, effort = self._problem, self._q, self._u, self._effort
        arguments = (p.constraints, p.constraint_data, p.solver)
        for _ in range(steps):
            u += dt * pin.constraintDynamics(p.model, p.data, q, u, effort, *arguments)
            q += dt * u

    def evaluate(self, n: int) -> None:
        """Call `constraintDynamics` n times from Python."""
        p = self._problem
        for _ in range(n):
            pin.constraintDynamics(
                p.model, p.data, self._q, self._u, self._effort, p.constraints, p.constraint_data, p.solver
            )

    @property
    def q(self) -> Array:
        """Joint angles (rad)."""
        return self._q[:3].copy()


def bare_call(n: int) -> None:
    """Call `constraintDynamics` n times on a model without bodies: the price of the binding alone."""
    p, nothing = _Problem(pin.Model(), []), np.zeros(0)
    for _ in range(n):
        pin.constraintDynamics(
            p.model, p.data, nothing, nothing, nothing, p.constraints, p.constraint_data, p.solver
        )
