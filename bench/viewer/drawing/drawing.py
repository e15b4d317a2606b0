"""All drawn bodies of a configured robot, with vane drive, stand, tee and guard, and their positions.

The golf frame is that of `sim/impact.py`: X along the target line, Y up, Z to the right; the origin is on the
ground below the point of impact. The right arm, rod with eye and piston, and cylinder, lies along x of its
frames.

Bodies lie along the normal of the swing plane so that they pass each other. The club swings in the plane
itself, z = 0; the left arm lies before it, the right arm and the vane drive behind. All are assumptions: the
dynamics are those of a plane.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import cos, pi, sin, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bench.base.errors import BenchError
from bench.viewer.drawing.bodies import (
    ACETAL,
    ALUMINIUM,
    BALL,
    CHROME,
    COMPOSITE,
    CYLINDER,
    FRAME,
    GUARD,
    HEAD,
    MOUNT,
    SHAFT_STEEL,
    STEEL,
    TEE,
    Bar,
    Bore,
    DrawnBody,
    Ellipsoid,
    Material,
    Part,
    PlacedBody,
    Solid,
    Tube,
)
from sim.kinematics import UnreachablePose, inverse_kinematics, joint_positions
from sim.plant import PlantParameters, Site
from sim.pneumatics import Actuator
from sim.robot import Body, Club, RobotParameters
from sim.vectors import Vector

Array = NDArray[np.float64]


def plane_to_golf(robot: RobotParameters, site: Site) -> tuple[Array, Array]:
    """Return (axes, origin): golf = axes @ (x, y, z of the swing plane) + origin; (3, 3) and (3,) m."""
    c, s = cos(robot.lie), sin(robot.lie)
    axes = np.array([[1.0, 0.0, 0.0], [0.0, s, c], [0.0, -c, s]])
    contact = np.array([0.0, (site.ball_y - site.ground) * s, 0.0])
    return axes, contact - axes @ np.array([site.ball_x, site.ball_y, 0.0])


def ball_at_rest(robot: RobotParameters, site: Site, radius: float) -> Array:
    """Return the centre of the ball on its tee in the golf frame (m): ahead of the face that meets it."""
    height = (site.ball_y - site.ground) * sin(robot.lie)
    return np.array([radius * cos(robot.club.loft), height + radius * sin(robot.club.loft), 0.0])


def body_poses(plant: PlantParameters, q: Array) -> dict[str, tuple[Array, Array]]:
    """Return each moving body's (translations (n, 3) m, quaternions xyzw (n, 4)) in the swing plane."""
    r1, r2, r3, r6, _ = np.moveaxis(joint_positions(plant.robot, q), -2, 0)
    theta1, theta12, theta_t = np.cumsum(q, axis=1).T
    right_arm = np.arctan2(*(r6 - r3).T[::-1])
    along = np.column_stack([np.cos(theta12), np.sin(theta12)])
    way = plant.wrist_stroke(q[:, 2])
    placed = {
        "shoulder_link": (r1, theta1),
        "left_arm": (r2, theta12),
        "wrist_rod": (r2 + way[:, None] * along, theta12),
        "club": (r3, theta_t),
        "right_arm_rod": (r3, right_arm),
        "right_arm_cylinder": (r6, right_arm + pi),
    }
    flat = np.zeros(len(q))
    return {
        name: (
            np.column_stack([point, flat]),
            np.column_stack([flat, flat, np.sin(angle / 2), np.cos(angle / 2)]),
        )
        for name, (point, angle) in placed.items()
    }


def address(plant: PlantParameters) -> Array:
    """Return joint angles (rad) with the face at the ball and the shaft straight down the swing plane.

    Raises:
        BenchError: the arm cannot bring the face there.
    """
    site = plant.site
    try:
        q = inverse_kinematics(plant.robot, [site.ball_x, site.ball_y, -pi / 2])
    except UnreachablePose as error:
        wanted, action = "a ball within the arm's reach", "Correct ball_x or ball_y."
        raise BenchError("plant.site", str(error), wanted, action) from None
    middle = (plant.wrist.lower + plant.wrist.upper) / 2
    q[2] += 2 * pi * round((middle - q[2]) / (2 * pi))
    return q


# The robot's bodies, as heavy as assumed --------------------------------------------------------------

PIN = 0.005
"""Radius of the joints' pins."""
GAP = 0.004
MOUNT_HEIGHT = 0.024
PLATE_HEIGHT = 0.006
LEVER_HEIGHT = 0.010
YOKE_HEIGHT = 0.010
WALL = 0.0025
"""Wall of a cylinder, assumed."""


def bore_radius(actuator: Actuator) -> float:
    """Return the radius of a cylinder's bore (m), from its full area."""
    return sqrt(max(actuator.area_a, actuator.area_b) / pi)


def rod_radius(actuator: Actuator) -> float:
    """Return the radius of a rod (m), from the areas' difference; at least a third of the bore's radius."""
    least = bore_radius(actuator) / 3
    return max(sqrt(abs(actuator.area_a - actuator.area_b) / pi), least)


class Layers(NamedTuple):
    """Heights over the swing plane (m): middles of the bodies, front of the drive."""

    arm: float
    arm_front: float
    lever: float
    yoke: float
    right_arm: float
    drive: float


def wrist_ways(plant: PlantParameters) -> tuple[float, float]:
    """Return the ends of that way over the wrist's range with its clearance (m)."""
    low, high = plant.wrist.chamber_ends
    turns = np.linspace(low, high, 721)
    ways = plant.wrist_stroke(turns)
    return float(ways.min()), float(ways.max())


_INCH = 0.0254
LINK_WIDTH = 2 * _INCH
"""Width of the shoulder link, as in the thesis (m)."""
ARM_WIDTH = 1.5 * _INCH
"""Width of the left arm, as in the thesis (m)."""
PLATE = (0.21, 0.075, PLATE_HEIGHT)
"""Plate of the wrist's actuator, as in the thesis (m)."""
_PLATE_SHARE = ALUMINIUM.density * 0.006 * 0.075 * 0.21
_ACTUATOR_SHARE = 0.524
_ARM_SHARE = ALUMINIUM.density * 0.625 * 1.5 * 24.5 * _INCH**3
_SHARES = _PLATE_SHARE + _ACTUATOR_SHARE + _ARM_SHARE
"""The thesis' left arm (kg); another one's mass is shared in the same ratio."""
_EDGE = 0.015


def _bar_length(body: Body, width: float, reach: float) -> float:
    """Return the length (m) of a bar with the body's inertia, at least `reach` with its edges."""
    squared = 12 * body.inertia / body.mass - width**2
    return max(sqrt(max(squared, 0.0)), reach + 2 * _EDGE)


def _link_size(plant: PlantParameters) -> tuple[float, float, float]:
    """Return the shoulder link's bar: length from its inertia, thickness from its mass."""
    body, robot = plant.robot.shoulder_link, plant.robot
    reach = 2 * max(robot.l12 - body.centre_of_mass, robot.l16 + body.centre_of_mass)
    length = _bar_length(body, LINK_WIDTH, reach)
    return length, LINK_WIDTH, body.mass / (STEEL.density * length * LINK_WIDTH)


def _arm_size(plant: PlantParameters) -> tuple[float, float, float]:
    """Return the left arm's bar in the same way, of its share of the mass."""
    body = plant.robot.left_arm
    reach = 2 * max(plant.robot.l23 - body.centre_of_mass, body.centre_of_mass)
    length = _bar_length(body, ARM_WIDTH, reach)
    mass = body.mass * _ARM_SHARE / _SHARES
    return length, ARM_WIDTH, mass / (ALUMINIUM.density * length * ARM_WIDTH)


def layers_of(plant: PlantParameters) -> Layers:
    """Return the heights of all bodies over the swing plane."""
    link, arm = _link_size(plant)[2], _arm_size(plant)[2]
    clear = max(link, MOUNT_HEIGHT) / 2 + GAP
    front = clear + arm
    lever = front + PLATE_HEIGHT + GAP + LEVER_HEIGHT / 2
    yoke = lever + LEVER_HEIGHT / 2 + GAP + YOKE_HEIGHT / 2
    cylinder = bore_radius(plant.right_arm) + WALL
    right = -clear - cylinder
    yoke = max(yoke, front + bore_radius(plant.wrist) + WALL)
    return Layers(clear + arm / 2, front, lever, yoke, right, right - cylinder - 2 * GAP)


def shoulder_link(plant: PlantParameters) -> DrawnBody:
    """Return the shoulder link with the pins of R2 and R6; the axle of R1 belongs to the drive."""
    robot, at, size = plant.robot, layers_of(plant), _link_size(plant)
    middle = robot.shoulder_link.centre_of_mass
    bores = tuple(Bore(x - middle, 0.0, r) for x, r in ((0.0, 0.015), (robot.l12, PIN), (-robot.l16, PIN)))
    back, past = at.right_arm - bore_radius(plant.right_arm) - WALL, size[2] / 2 + GAP
    ends = {"pin R2": (robot.l12, -past, at.arm_front + GAP), "pin R6": (-robot.l16, back, past)}
    pins = {name: Tube((x, 0.0, low), (x, 0.0, high), PIN) for name, (x, low, high) in ends.items()}
    link = Part("link", Bar(size, (middle, 0.0, 0.0), bores=bores), STEEL)
    parts = (link, *(Part(name, pin, STEEL, joint=True) for name, pin in pins.items()))
    return DrawnBody("shoulder_link", parts, robot.shoulder_link)


def actuator_places(plant: PlantParameters) -> tuple[float, float]:
    """Return the middles of plate and cylinder along the left arm (m).

    No configuration gives them. They are where the whole has the centre of mass and the inertia of the
    dynamics, as far as both stay between R2 and R3: the plate towards the wrist, the cylinder towards R2.
    """
    body, arm = plant.robot.left_arm, _arm_size(plant)
    share = body.mass / _SHARES
    plate, cylinder = share * _PLATE_SHARE, share * _ACTUATOR_SHARE
    length, outer = _cylinder_length(plant), bore_radius(plant.wrist) + WALL
    own = share * _ARM_SHARE * (arm[0] ** 2 + arm[1] ** 2) / 12 + plate * (PLATE[0] ** 2 + PLATE[1] ** 2) / 12
    own += cylinder * (length**2 / 12 + (outer**2 + rod_radius(plant.wrist) ** 2) / 4)
    way = sqrt(max(body.inertia - own, 0.0) / (plate * (1 + plate / cylinder)))
    wrist_side = plant.robot.l23 - body.centre_of_mass
    way = min(way, wrist_side, (body.centre_of_mass - length / 2) * cylinder / plate)
    return body.centre_of_mass + way, body.centre_of_mass - way * plate / cylinder


def _cylinder_length(plant: PlantParameters) -> float:
    low, high = wrist_ways(plant)
    return high - low + 0.07


def left_arm(plant: PlantParameters) -> DrawnBody:
    """Return the left arm with plate and cylinder of the wrist, a part of it in the dynamics."""
    body, at, size = plant.robot.left_arm, layers_of(plant), _arm_size(plant)
    middle, share = body.centre_of_mass, body.mass / _SHARES
    bores = (Bore(-middle, 0.0, PIN), Bore(plant.robot.l23 - middle, 0.0, PIN))
    plate_at, cylinder_at = actuator_places(plant)
    half = _cylinder_length(plant) / 2
    start, end = ((cylinder_at + side * half, 0.0, at.yoke) for side in (-1.0, 1.0))
    cylinder = Tube(start, end, bore_radius(plant.wrist) + WALL, rod_radius(plant.wrist))
    plate = Bar(PLATE, (plate_at, 0.0, at.arm_front + PLATE_HEIGHT / 2))
    parts = (
        Part("arm", Bar(size, (middle, 0.0, at.arm), bores=bores), ALUMINIUM),
        _of_mass("plate", plate, ALUMINIUM, share * _PLATE_SHARE),
        _of_mass("wrist cylinder", cylinder, CYLINDER, share * _ACTUATOR_SHARE),
    )
    return DrawnBody("left_arm", parts, body)


def wrist_rod(plant: PlantParameters) -> DrawnBody:
    """Return the wrist's piston rod and yoke in the left arm's frame, as if the yoke stood at R3.

    Its mass is the cylinder's: in the dynamics it does not slide.
    """
    at, wrist, lever = layers_of(plant), plant.robot.l23, plant.wrist_lever
    _, cylinder_at = actuator_places(plant)
    rear = cylinder_at - _cylinder_length(plant) / 2 + 0.025 - wrist_ways(plant)[0]
    weightless = CHROME._replace(density=0.0)
    inner, outer = PIN + 0.001, PIN + 0.009
    rod = Tube((rear, 0.0, at.yoke), (wrist - outer, 0.0, at.yoke), rod_radius(plant.wrist))
    middle, side = (inner + outer) / 2, (outer - inner, 2 * (lever + outer), YOKE_HEIGHT)
    end = (2 * inner, outer - inner, YOKE_HEIGHT)
    yoke = {
        "yoke rear": Bar(side, (wrist - middle, 0.0, at.yoke)),
        "yoke front": Bar(side, (wrist + middle, 0.0, at.yoke)),
        "yoke lower end": Bar(end, (wrist, -lever - middle, at.yoke)),
        "yoke upper end": Bar(end, (wrist, lever + middle, at.yoke)),
    }
    parts: dict[str, Solid] = {"wrist rod": rod, **yoke}
    return DrawnBody("wrist_rod", tuple(Part(name, solid, weightless) for name, solid in parts.items()))


def lever_parts(plant: PlantParameters) -> tuple[Part, ...]:
    """Return the wrist's lever with its pin, fixed to the club: along -y3, rotated by its mounting angle."""
    at, lever = layers_of(plant), plant.wrist_lever
    c, s = cos(plant.wrist_lever_angle), sin(plant.wrist_lever_angle)
    size = (0.024, lever + 0.024, LEVER_HEIGHT)
    bar = Bar(
        size,
        (lever / 2 * s, -lever / 2 * c, at.lever),
        turn=((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)),
        bores=(Bore(0.0, lever / 2, PIN), Bore(0.0, -lever / 2, PIN)),
    )
    x, y = lever * s, -lever * c
    pin = Tube((x, y, at.lever - LEVER_HEIGHT / 2), (x, y, at.yoke + YOKE_HEIGHT), PIN)
    return Part("lever", bar, ALUMINIUM), Part("lever pin", pin, STEEL)


_REAR = 0.012
"""Least that the cylinder has behind the axis R6 (m)."""
_REAR_CAP = 0.030
_PISTON = 0.015
_EYE = 0.020
"""Outer radius of the rod's eye at R3 (m)."""
_MIN_WALL = 0.0005


def _behind(plant: PlantParameters) -> float:
    """Return the cylinder's length behind the axis R6 (m): the middle of an even bar is its centre."""
    return max(plant.robot.l56 - 2.0 * plant.robot.cylinder.centre_of_mass, _REAR)


def _front_cap(plant: PlantParameters) -> float:
    """Return the front cap's thickness (m) that puts the centre of mass where it is assumed."""
    body, end, behind = plant.robot.cylinder, plant.robot.l56, _behind(plant)
    bore, rod = bore_radius(plant.right_arm), rod_radius(plant.right_arm)
    rear = ALUMINIUM.density * pi * bore**2 * _REAR_CAP
    per_metre = ALUMINIUM.density * pi * (bore**2 - rod**2)
    com = body.centre_of_mass
    tube = (end - behind) / 2 - com
    linear = end - com - tube
    rest = ((body.mass - rear) * tube + rear * (_REAR_CAP / 2 - behind - com)) / per_metre
    root = linear**2 + 2 * rest
    cap = linear - sqrt(root) if root > 0 else linear
    return min(max(cap, 0.015), 0.060)


def right_arm_cylinder(plant: PlantParameters) -> DrawnBody:
    """Return the cylinder from its rear end to the rod's exit: its wall follows from its mass."""
    body, at, end = plant.robot.cylinder, layers_of(plant).right_arm, plant.robot.l56
    bore, rod, cap = bore_radius(plant.right_arm), rod_radius(plant.right_arm), _front_cap(plant)
    behind = _behind(plant)
    rear = Tube((-behind, 0.0, at), (_REAR_CAP - behind, 0.0, at), bore)
    front = Tube((end - cap, 0.0, at), (end, 0.0, at), bore, rod)
    caps = ALUMINIUM.density * (rear.volume.volume + front.volume.volume)
    area = max(body.mass - caps, 0.0) / (ALUMINIUM.density * (end + behind))
    outer = max(sqrt(bore**2 + area / pi), bore + _MIN_WALL)
    parts = (
        Part("right-arm tube", Tube((-behind, 0.0, at), (end, 0.0, at), outer, bore), CYLINDER),
        Part("right-arm rear cap", rear, ALUMINIUM),
        Part("right-arm front cap", front, ALUMINIUM),
    )
    return DrawnBody("right_arm_cylinder", parts, body)


def right_arm_rod(plant: PlantParameters) -> DrawnBody:
    """Return rod, piston and eye: as long as the stroke needs, bore and eye from mass and centre of mass."""
    body, at = plant.robot.rod, layers_of(plant).right_arm
    outer, bore = rod_radius(plant.right_arm), bore_radius(plant.right_arm)
    length = plant.right_arm.chamber_ends[1] + _front_cap(plant) + _PISTON
    piston = Tube((length - _PISTON, 0.0, at), (length, 0.0, at), bore - 0.0002, outer)
    weight = ACETAL.density * piston.volume.volume
    needed = body.mass * body.centre_of_mass - weight * (length - _PISTON / 2)
    mass = min(max(2 * needed / length, 0.2 * body.mass), body.mass - weight - 0.02)
    inner = sqrt(max(outer**2 - mass / (CHROME.density * pi * length), 0.0))
    rod = Tube((0.0, 0.0, at), (length, 0.0, at), outer, min(inner, outer - _MIN_WALL))
    left = max(body.mass - weight - CHROME.density * rod.volume.volume, 0.01)
    height = left / (STEEL.density * pi * (_EYE**2 - PIN**2))
    eye = Tube((0.0, 0.0, at - height / 2), (0.0, 0.0, at + height / 2), _EYE, PIN)
    pieces = ("rod", rod, CHROME), ("piston", piston, ACETAL), ("eye", eye, STEEL)
    parts = tuple(Part(f"right-arm {name}", solid, material) for name, solid, material in pieces)
    return DrawnBody("right_arm_rod", parts, body)


_MOUNT_WIDTH = 0.050
_MIN_MOUNT = 0.030
_STEEL_SHAFT = 0.1
"""Mass of a shaft per metre (kg/m) from which on it is drawn as steel."""
_WOOD_DEPTH = 0.015
"""Depth of the centre of mass (m) from which on a head is drawn as a wood."""
_HEIGHT_RATIO = 0.44
"""Half height of a wood over its radius of gyration about the heel-toe axis; 29 mm of a driver."""


def club_body(plant: PlantParameters) -> DrawnBody:
    """Return mount, shaft and head in the club's frame: x along the shaft, y to the target at address."""
    club = plant.robot.club
    return DrawnBody("club", (*_mount(plant), _shaft(club), *_head(plant.robot, plant.site)), club)


def _mount(plant: PlantParameters) -> tuple[Part, ...]:
    """Return clamp, pin of R3 and wrist lever; the clamp's length makes up the mount's mass."""
    at, lever = layers_of(plant), lever_parts(plant)
    low, high = at.right_arm - bore_radius(plant.right_arm), at.lever + LEVER_HEIGHT / 2 + GAP
    pin = Part("pin R3", Tube((0.0, 0.0, low), (0.0, 0.0, high), PIN), STEEL)
    rest = plant.robot.club.mount_mass - pin.mass - sum(part.mass for part in lever)
    length = max(rest / (MOUNT.density * _MOUNT_WIDTH * MOUNT_HEIGHT), _MIN_MOUNT)
    clamp = Part("mount", Bar((length, _MOUNT_WIDTH, MOUNT_HEIGHT), (0.0, 0.0, 0.0)), MOUNT)
    return clamp, pin, *lever


def _shaft(club: Club) -> Part:
    """Return the shaft as a tube whose wall makes up its mass; solid if even that is too light."""
    material = SHAFT_STEEL if club.shaft_mass / club.shaft_length > _STEEL_SHAFT else COMPOSITE
    inner_squared = club.shaft_radius**2 - club.shaft_mass / (material.density * pi * club.shaft_length)
    start, end = (0.0, 0.0, 0.0), (club.shaft_length, 0.0, 0.0)
    tube = Tube(start, end, club.shaft_radius, sqrt(max(inner_squared, 0.0)))
    return _of_mass("shaft", tube, material, club.shaft_mass)


def head_half_sizes(club: Club) -> Vector:
    """Return half depth, half height and half width (m) of a head with about the club's head inertias.

    A thin shell as well as a blade has about m/3 times the sum of two squared half sizes.
    """
    about_vertical = 3 * club.head_inertia_horizontal / club.head_mass
    about_heel_toe = 3 * club.head_inertia_vertical / club.head_mass
    if club.head_depth >= _WOOD_DEPTH:
        height = _HEIGHT_RATIO * sqrt(about_heel_toe)
        depth = sqrt(about_heel_toe - height**2)
    else:
        depth = max(club.head_depth, 0.004)
        height = sqrt(max(about_heel_toe - depth**2, 0.012**2))
    width = sqrt(max(about_vertical - depth**2, 0.02**2))
    return depth, height, width


def _head(robot: RobotParameters, site: Site) -> tuple[Part, ...]:
    """Return the head behind the centre of the face, soled as deep as the site says.

    At address the vertical and the horizontal are those of the club's frame turned by the lie about y.
    """
    club = robot.club
    up = np.array([-sin(club.lie), 0.0, cos(club.lie)])
    toe = np.array([cos(club.lie), 0.0, sin(club.lie)])
    ahead = np.array([0.0, 1.0, 0.0])
    normal = cos(club.loft) * ahead + sin(club.loft) * up
    tilted = np.column_stack([normal, np.cross(toe, normal), toe])
    face = np.array([club.length_to_face, 0.0, 0.0])
    half = depth, height, width = head_half_sizes(club)
    rise = height - site.sole_depth * sin(robot.lie)
    if club.head_depth < _WOOD_DEPTH:
        blade = Bar((2 * depth, 2 * height, 2 * width), face - depth * normal + rise * up, turn=tilted)
        return (_of_mass("head", blade, CHROME, club.head_mass),)
    centre = face - club.head_depth * ahead + rise * up
    head = Ellipsoid(half, centre, np.column_stack([ahead, up, toe]), cut=club.head_depth)
    plate = Ellipsoid((0.003, 0.8 * height, 0.8 * width), face - 0.003 * normal, tilted)
    return _of_mass("head", head, HEAD, club.head_mass), Part("face", plate, CHROME._replace(density=0.0))


def _of_mass(name: str, solid: Solid, material: Material, mass: float) -> Part:
    """Return a bought part: `material` gets the mean density of `mass` (kg) drawn as `solid`."""
    return Part(name, solid, material._replace(density=mass / solid.volume.volume))


# Drive, stand, tee, ball and guard --------------------------------------------------------------------

AXLE = 0.015
"""Radius of the shoulder's axle (m)."""
_VANE_WIDTH, _VANE_HUB, _HOUSING = 0.14, 0.030, 0.010
_STRUT, _STRUT_WALL = 0.028, 0.003
_POST = 0.040
_ROOM = 0.30
"""Between the club's reach and the guard (m)."""
_FRONT = 0.60
"""Guard's front side beyond the target line (m)."""


def drive(plant: PlantParameters) -> DrawnBody:
    """Return the vane drive in the swing plane's frame; its radius gives the configured volume per angle."""
    front = layers_of(plant).drive
    area = max(plant.shoulder.area_a, plant.shoulder.area_b)
    radius = sqrt(2 * area / _VANE_WIDTH + _VANE_HUB**2) + _HOUSING
    back = front - _VANE_WIDTH - 2 * _HOUSING
    housing = Part("vane drive", Tube((0.0, 0.0, back), (0.0, 0.0, front), radius), CYLINDER)
    axle = Tube((0.0, 0.0, front), (0.0, 0.0, 2 * GAP), AXLE)
    return DrawnBody("drive", (housing, Part("axle R1", axle, STEEL, joint=True)))


def stand(plant: PlantParameters) -> DrawnBody:
    """Return the stand in the golf frame: three legs under the drive, behind the swing plane."""
    axes, origin = plane_to_golf(plant.robot, plant.site)
    front = layers_of(plant).drive
    top = axes @ np.array([0.0, 0.0, front - _VANE_WIDTH - 2 * _HOUSING]) + origin
    saddle = axes @ np.array([0.0, 0.0, front - _VANE_WIDTH - 2 * _HOUSING - 0.08]) + origin
    feet = [(origin[0] + x, 0.0, saddle[2] + z) for x, z in ((-0.45, 0.25), (0.45, 0.25), (0.0, -0.70))]
    legs = [Tube(saddle, foot, _STRUT, _STRUT - _STRUT_WALL) for foot in feet]
    plates = [Bar((0.12, 0.01, 0.12), (float(x), 0.005, float(z))) for x, _, z in feet]
    parts = *_numbered("leg", legs, FRAME), *_numbered("foot", plates, FRAME)
    return DrawnBody("stand", (Part("saddle", Tube(top, saddle, 0.05), FRAME), *parts))


def _numbered(name: str, solids: Sequence[Solid], material: Material) -> Iterator[Part]:
    return (Part(f"{name} {number}", solid, material) for number, solid in enumerate(solids, 1))


def tee(plant: PlantParameters) -> DrawnBody:
    """Return the tee in the golf frame, from the ground to the ball."""
    rest, radius = ball_at_rest(plant.robot, plant.site, plant.ball.radius), plant.ball.radius
    x, top = float(rest[0]), max(float(rest[1]) - radius, 0.005)
    return DrawnBody("tee", (Part("tee", Tube((x, 0.0, 0.0), (x, top, 0.0), 0.004), TEE),))


def ball(plant: PlantParameters) -> DrawnBody:
    """Return the ball at rest in the golf frame."""
    radius = plant.ball.radius
    solid = Ellipsoid((radius,) * 3, ball_at_rest(plant.robot, plant.site, radius))
    return DrawnBody("ball", (Part("ball", solid, BALL),))


def guard(plant: PlantParameters) -> DrawnBody:
    """Return posts and rails of the guard in the golf frame, round the club's reach; open to the target."""
    robot, site = plant.robot, plant.site
    _, origin = plane_to_golf(robot, site)
    reach = robot.l12 + robot.l23 + robot.club.length_to_face + _ROOM
    left, right = float(origin[0]) - reach, float(origin[0]) + reach
    back, front = float(origin[2]) - reach * cos(robot.lie), _FRONT
    top = float(origin[1]) + reach * sin(robot.lie)
    posts = [Bar((_POST, top, _POST), (x, top / 2, z)) for x in (left, right) for z in (back, front)]
    low, middle, high = _POST / 2, top / 2, top - _POST / 2
    wide, deep = (right - left, _POST, _POST), (_POST, _POST, front - back)
    # The front is the door: no rail across.
    rails = [Bar(wide, ((left + right) / 2, height, back)) for height in (low, middle, high)]
    rails += [Bar(wide, ((left + right) / 2, height, front)) for height in (low, high)]
    rails += [Bar(deep, (left, height, (back + front) / 2)) for height in (low, middle, high)]
    return DrawnBody("guard", (*_numbered("post", posts, GUARD), *_numbered("rail", rails, GUARD)))


class Drawing(NamedTuple):
    """Bodies by the frame they are drawn in."""

    moving: tuple[DrawnBody, ...]
    """Each in its own frame, placed by `body_poses`."""
    fixed_in_plane: tuple[DrawnBody, ...]
    """Fixed bodies in the swing plane's frame."""
    fixed: tuple[DrawnBody, ...]
    """Fixed bodies in the golf frame."""


def draw(plant: PlantParameters) -> Drawing:
    """Return the drawn bodies of the robot, its drive, stand, tee, ball and guard."""
    return Drawing(
        moving=(
            shoulder_link(plant),
            left_arm(plant),
            wrist_rod(plant),
            club_body(plant),
            right_arm_rod(plant),
            right_arm_cylinder(plant),
        ),
        fixed_in_plane=(drive(plant),),
        fixed=(stand(plant), tee(plant), ball(plant), guard(plant)),
    )


def placed(plant: PlantParameters) -> list[PlacedBody]:
    """Return all bodies in the golf frame, at address."""
    drawing = draw(plant)
    axes, origin = plane_to_golf(plant.robot, plant.site)
    poses = body_poses(plant, np.atleast_2d(address(plant)))
    bodies = []
    for body in drawing.moving:
        (point,), (quaternion,) = poses[body.name]
        turn = Rotation.from_quat(quaternion).as_matrix()
        bodies.append(PlacedBody(body, axes @ turn, axes @ point + origin))
    bodies += [PlacedBody(body, axes, origin) for body in drawing.fixed_in_plane]
    return bodies + [PlacedBody(body, np.eye(3), np.zeros(3)) for body in drawing.fixed]
