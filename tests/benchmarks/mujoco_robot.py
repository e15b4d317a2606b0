"""The same five bodies in MuJoCo, the loop closed by a `connect` constraint at R6.

MuJoCo's constraints are soft by design: impedance is at most 0.9999, so that its accelerations differ
from the rigid model's by about 1e-4 of the largest, whatever the step. Time constant and damping of the
constraint are the stiffest MuJoCo itself allows (two steps, critical).
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.robot import Body, Club, RobotParameters
from tests.benchmarks.right_arm import with_right_arm

Array = NDArray[np.float64]

SETTINGS = ("default", "lean")
"""`default`: as delivered. `lean`: every stage this model does not need is switched off, dense matrices,
and conjugate gradients, measured as the fastest of MuJoCo's solvers here (fewer iterations than it takes
to converge would be faster by a tenth, but then the loop is open and it is another model)."""

_NEEDED = {"mjDSBL_CONSTRAINT", "mjDSBL_EQUALITY", "mjDSBL_GRAVITY"}
_SAFEGUARDS = {"mjDSBL_REFSAFE", "mjDSBL_AUTORESET"}


def _model(robot: RobotParameters) -> str:
    def inertial(body: Body | Club, direction: int = 1) -> str:
        return (
            f'<inertial mass="{body.mass!r}" pos="{direction * body.centre_of_mass!r} 0 0" '
            f'diaginertia="{body.inertia!r} {body.inertia!r} {body.inertia!r}"/>'
        )

    hinge = '<joint type="hinge" axis="0 0 1"/>'
    return f"""
    <mujoco>
      <compiler angle="radian"/>
      <option gravity="0 {-robot.in_plane_gravity!r} 0"/>
      <worldbody>
        <body name="shoulder link">{hinge}{inertial(robot.shoulder_link)}
          <site name="R6" pos="{-robot.l16!r} 0 0"/>
          <body name="left arm" pos="{robot.l12!r} 0 0">{hinge}{inertial(robot.left_arm)}
            <body name="club" pos="{robot.l23!r} 0 0">{hinge}{inertial(robot.club)}</body>
            <body name="rod" pos="{robot.l23!r} 0 0">{hinge}{inertial(robot.rod)}
              <body name="cylinder"><joint type="slide" axis="1 0 0"/>{inertial(robot.cylinder, -1)}
                <site name="cylinder end"/>
              </body>
            </body>
          </body>
        </body>
      </worldbody>
      <equality><connect site1="cylinder end" site2="R6" solimp="0.9999 0.9999 0.001"/></equality>
    </mujoco>"""


def _not_needed() -> int:
    """Return the bits of all stages that can be off without changing this robot's motion."""
    bits: dict[str, Any] = mujoco.mjtDisableBit.__members__
    return sum(int(bits[name]) for name in bits.keys() - _NEEDED - _SAFEGUARDS if name.startswith("mjDSBL_"))


class MujocoRobot:
    """The robot in MuJoCo, with one of its `SETTINGS`."""

    def __init__(self, robot: RobotParameters, settings: str = "lean") -> None:
        self._robot = robot
        self._model = mujoco.MjModel.from_xml_string(_model(robot))
        self._data = mujoco.MjData(self._model)
        option = self._model.opt
        option.integrator = mujoco.mjtIntegrator.mjINT_EULER
        if settings != "default":
            option.disableflags = _not_needed()
            option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
            option.solver = mujoco.mjtSolver.mjSOL_CG

    def start(self, q: Array, u: Array) -> None:
        """Set joint angles and speeds, the right arm's with them."""
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:], self._data.qvel[:] = with_right_arm(self._robot, q, u)

    def push(self, effort: Array) -> None:
        """Hold `effort` [M_A N m, F_E N, M_C N m] from now on; the rod slides with l46."""
        self._data.qfrc_applied[:] = effort[0], 0.0, effort[2], 0.0, effort[1]

    def _set_step(self, dt: float) -> None:
        self._model.opt.timestep = dt
        self._model.eq_solref[0] = 2 * dt, 1.0

    def follow(self, efforts: Array, dt: float, steps: int) -> None:
        """Take `steps` steps of `dt` seconds under each of `efforts` in turn, in one call each."""
        self._set_step(dt)
        for effort in efforts:
            self.push(effort)
            mujoco.mj_step(self._model, self._data, nstep=steps)

    def acceleration(self) -> Array:
        """Accelerations (rad/s2) of the joints in the present state."""
        mujoco.mj_forward(self._model, self._data)
        return np.array(self._data.qacc[:3])

    @property
    def q(self) -> Array:
        """Joint angles (rad)."""
        return np.array(self._data.qpos[:3])
