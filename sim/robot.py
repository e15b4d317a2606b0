"""The robot: lengths, bodies and clubs (thesis section 2.1 and Appendix A).

Frames: frame 0 is fixed at the shoulder axis R1, x0 towards the target, y0 up the swing plane. Body
frames 1, 2, 3 turn with the shoulder link, the left arm and the club; q = (theta1, theta2, theta3).

Errata of the thesis noted where they are corrected: 8 (club's centre of mass divides by the club's own
mass, here in `Club.centre_of_mass`) and 9 (rod length and inertia of body D: Appendix A's are taken).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from math import pi, radians, sin
from typing import Annotated

import numpy as np

from drivers.base.compiled import copy_fields, fields, new_record
from drivers.base.ranges import Gap, Range

_INCH = 0.0254
_POUND_PER_CUBIC_INCH = 0.45359237 / 0.00001639  # as in the thesis, kg/m3
_STEEL = 0.283 * _POUND_PER_CUBIC_INCH
_ALUMINIUM = 0.098 * _POUND_PER_CUBIC_INCH

Length = Annotated[float, Range(0.01, 2.0, "m")]
HeadInertia = Annotated[float, Range(1e-5, 2e-3, "kg m2")]
FaceRadius = Annotated[float, Range(0.05, 1e6, "m"), Gap(2.0, 1e4)]
"""Inches and millimetres lie in the gap."""


@dataclass(frozen=True, slots=False)
class Club:
    """A golf club in the robot's mount; the head is a point mass to the robot, a rigid body to the ball.

    Lengths run from the wrist axis R3 along the shaft. Defaults after the first block are assumptions
    for a modern driver; head inertias and depth from golf.md 3.3 (4,000-5,900 g cm2; depth 35 mm).
    """

    head_mass: Annotated[float, Range(0.02, 0.6, "kg")] = 0.2
    """kg; a real driver's by default."""
    shaft_mass: Annotated[float, Range(0.02, 0.5, "kg")] = 0.065
    """kg"""
    mount_mass: Annotated[float, Range(0.0, 3.0, "kg")] = 0.4
    """Mass of the robot's clamp (kg), as in the thesis."""
    shaft_length: Annotated[float, Range(0.3, 1.5, "m")] = 1.0668
    """R3 to the head's mass point (m); 42 in as in the thesis."""
    shaft_radius: Annotated[float, Range(0.001, 0.03, "m")] = 0.0075
    """Radius of the shaft, as in the thesis (m)."""
    length_to_face: Annotated[float, Range(0.3, 1.5, "m")] = 1.09
    """R3 to the centre of the face (m), l3T of the thesis."""
    name: str = "driver"
    loft: Annotated[float, Range(0.0, radians(70.0), "rad"), Gap(0.0, radians(1.5))] = radians(15.0)
    """Loft (rad) in the robot's mount: what a driver of 12 degrees has at the ball with a shaft that bends.
    The dynamic loft of the LPGA Tour, whose 96 mph and rise are the shipped swing's, is 15.5 degrees."""
    lie: Annotated[float, Range(radians(35.0), radians(80.0), "rad")] = radians(53.0)
    """Shaft to the ground when the sole is flat (rad): equal to the plane, the toe is level."""
    face_angle: Annotated[float, Range(radians(-10.0), radians(10.0), "rad")] = 0.0
    """Face angle in the mount at zero shaft lean (rad, positive open)."""
    head_inertia_horizontal: HeadInertia = 4.8e-4
    """About the vertical axis through the head's centre of mass (kg m2)."""
    head_inertia_vertical: HeadInertia = 2.9e-4
    """About the heel-toe axis (kg m2)."""
    head_depth: Annotated[float, Range(0.0, 0.12, "m")] = 0.035
    """Depth of the centre of mass behind the face (m)."""
    restitution: Annotated[float, Range(0.1, 1.0, "")] = 0.882
    """Coefficient at the centre, at an approach of 40 m/s; a thin titanium face by default. Like the three
    values of the contact below it is fitted to tour averages (`python -m tests.benchmarks impact`): an
    effective value, above the Rules' 0.83, which is of another ball and method."""
    tangential_factor: Annotated[float, Range(0.0, 1.0, "")] = 0.75
    """Share of the rolling-contact spin that a modern face gives (golf.md 3.1, a start value)."""
    restitution_slope: Annotated[float, Range(-0.02, 0.02, "s/m")] = -0.0007
    """Change of the restitution with the speed of approach (s/m)."""
    tangential_stiffness: Annotated[float, Range(0.0, 4.0, "")] = 1.147
    """Stiffness of the contact across the face over that along its normal; 0: `tangential_factor` instead."""
    tangential_loss: Annotated[float, Range(0.0, 2.0, "")] = 0.34
    """Loss factor of the contact across the face; only with `tangential_stiffness`."""
    friction_factor: Annotated[float, Range(0.0, 3.0, "")] = 1.0
    """Factor on the ball's friction: below 1 for a wet or worn face."""
    bulge_radius: FaceRadius = 0.305
    """Curvature heel to toe (m); 1e6 is flat."""
    roll_radius: FaceRadius = 0.305
    """Curvature sole to crown (m); 1e6 is flat."""
    tee_shift: Annotated[float, Range(-0.05, 0.05, "m")] = field(default=0.0, metadata={"optional": True})
    """Level distance of the tee from the swing plane, away from the robot (m): the ball meets the face so far
    towards the toe. It is the tee's, moved by hand, and stands with the club that is swung at it."""

    @classmethod
    def thesis(cls) -> Club:
        """Return the thesis' club: 0.1 kg head, 0.1 kg shaft, 0.4 kg mount."""
        return cls(head_mass=0.1, shaft_mass=0.1, mount_mass=0.4, name="thesis")

    @classmethod
    def driver(cls) -> Club:
        """Return a real driver: 0.2 kg head, 65 g graphite shaft."""
        return cls()

    @property
    def mass(self) -> float:
        """Mass of body C (kg)."""
        return self.mount_mass + self.shaft_mass + self.head_mass

    @property
    def centre_of_mass(self) -> float:
        """Distance of body C's centre of mass from R3 (m); erratum 8."""
        return self.shaft_length * (self.shaft_mass / 2 + self.head_mass) / self.mass

    @property
    def inertia(self) -> float:
        """Moment of inertia about body C's centre of mass (kg m2), thesis Eq. 32 with erratum 8."""
        about_wrist = (
            self.shaft_mass * (3 * self.shaft_radius**2 + self.shaft_length**2) / 12
            + self.shaft_mass * self.shaft_length**2 / 4
            + self.head_mass * self.shaft_length**2
        )
        return about_wrist - self.mass * self.centre_of_mass**2


@dataclass(frozen=True)
class Body:
    """A rigid body: mass (kg), distance of its centre of mass on its axis (m), central inertia (kg m2)."""

    mass: Annotated[float, Range(0.01, 100.0, "kg")]
    """Mass (kg)."""
    centre_of_mass: Annotated[float, Range(-1.0, 1.0, "m")]
    """Centre of mass from the body's axis (m)."""
    inertia: Annotated[float, Range(1e-6, 10.0, "kg m2")]
    """Moment of inertia about the centre of mass (kg m2)."""


def _bar(mass: float, length: float, width: float) -> float:
    """Central inertia of a rectangular bar (thesis Eqs. 30, 31, 34)."""
    return mass * (length**2 + width**2) / 12


def _shoulder_link() -> Body:
    mass = _STEEL * (0.375 * 2 * 17) * _INCH**3
    # Centre of mass: 0.34 m / 2 - 0.09 m.
    return Body(mass, 0.08, _bar(mass, 17 * _INCH, 2 * _INCH))


def _left_arm() -> Body:
    mass = _ALUMINIUM * (0.625 * 1.5 * 24.5 * _INCH**3 + 0.006 * 0.075 * 0.21) + 0.524
    return Body(mass, 0.28, _bar(mass, 24.5 * _INCH, 1.5 * _INCH))


def _rod() -> Body:
    # Inertia: m l^2/12 with Appendix A's length 0.20 m (erratum 9).
    return Body(0.6, 0.10, 0.002)


def _right_arm_cylinder() -> Body:
    return Body(0.517, 0.17, _bar(0.517, 0.34, 0.045))


ROBOT = np.dtype(
    [
        *fields("f8", "l12 l16 l62 l23 l3t l56"),
        *fields("f8", "mass_a com_a inertia_a mass_b com_b inertia_b mass_c com_c inertia_c"),
        *fields("f8", "mass_d com_d inertia_d mass_e com_e inertia_e gravity"),
    ],
    align=True,
)
"""`RobotParameters` as a record for compiled code; `gravity` is its in-plane part."""


@dataclass(frozen=True)
class RobotParameters:
    """Lengths (m), bodies and gravity of the parallel-arm robot.

    `shoulder_link` is measured from R1 along x1, `left_arm` from R2 along x2, `rod` from R3 towards R6,
    `cylinder` from R6 towards R3. The swing plane is tilted by `lie` (rad) from the horizontal.
    """

    l12: Length = 0.25
    """R1 shoulder axis to R2 left shoulder (m)."""
    l16: Length = 0.09
    """R1 to R6 right shoulder (m)."""
    l23: Length = 0.56
    """R2 to R3 wrist (m)."""
    l56: Length = 0.34
    """Body of the right-arm cylinder, R6 to the rod's exit (m)."""
    stroke: Length = 0.22
    """Stroke of the right arm's rod (m)."""
    shoulder_link: Body = field(default_factory=_shoulder_link)
    left_arm: Body = field(default_factory=_left_arm)
    rod: Body = field(default_factory=_rod)
    cylinder: Body = field(default_factory=_right_arm_cylinder)
    club: Club = field(default_factory=Club.driver)
    gravity: Annotated[float, Range(0.0, 20.0, "m/s2")] = 9.82
    """Gravity (m/s2); its part in the swing plane does work."""
    lie: Annotated[float, Range(radians(20.0), pi / 2, "rad")] = radians(53.0)
    """Swing plane to the ground (rad)."""

    @property
    def l62(self) -> float:
        """R6 to R2 (m)."""
        return self.l12 + self.l16

    @property
    def in_plane_gravity(self) -> float:
        """Part of gravity along -y0 (m/s2); erratum 4: it does work."""
        return self.gravity * sin(self.lie)

    @cached_property
    def record(self) -> np.ndarray:
        """The parameters as a one-element `ROBOT` array for compiled code."""
        record = new_record(ROBOT)
        copy_fields(record, self, "l12 l16 l62 l23 l56")
        values: dict[str, float] = {
            "l3t": self.club.length_to_face,
            "mass_c": self.club.mass,
            "com_c": self.club.centre_of_mass,
            "inertia_c": self.club.inertia,
            "gravity": self.in_plane_gravity,
        }
        for letter, body in zip(
            "abde", (self.shoulder_link, self.left_arm, self.rod, self.cylinder), strict=True
        ):
            values |= {
                f"mass_{letter}": body.mass,
                f"com_{letter}": body.centre_of_mass,
                f"inertia_{letter}": body.inertia,
            }
        for name, value in values.items():
            record[name] = value
        return record


def thesis_robot(club: Club | None = None) -> RobotParameters:
    """Return the robot of the thesis with `club` (the thesis' own light club by default)."""
    return RobotParameters(club=club or Club.thesis())
