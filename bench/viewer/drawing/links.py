"""Shoulder link, left arm with the wrist's actuator, and the club in its mount, as heavy as assumed.

The right arm, rod with eye and piston, and cylinder, lies along x of its frames.

Bodies lie along the normal of the swing plane so that they pass each other. The club swings in the plane
itself, z = 0; the left arm lies before it, the right arm and the vane drive behind. All are assumptions: the
dynamics are those of a plane.
"""

from __future__ import annotations

from math import cos, pi, sin, sqrt
from typing import NamedTuple

import numpy as np

from bench.viewer.drawing.bodies import (
    ACETAL,
    ALUMINIUM,
    CHROME,
    COMPOSITE,
    CYLINDER,
    HEAD,
    MOUNT,
    SHAFT_STEEL,
    STEEL,
    Bar,
    Bore,
    DrawnBody,
    Ellipsoid,
    Material,
    Part,
    Solid,
    Tube,
    Turn,
    vector,
)
from sim.plant import PlantParameters, Site
from sim.pneumatics import Actuator
from sim.robot import Body, Club, RobotParameters
from sim.vectors import Vector

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
    back = at.right_arm - bore_radius(plant.right_arm) - WALL
    return DrawnBody(
        "shoulder_link",
        (
            Part("link", Bar(size, (middle, 0.0, 0.0), bores=bores), STEEL),
            Part("pin R2", _pin(robot.l12, -size[2] / 2 - GAP, at.arm_front + GAP), STEEL, joint=True),
            Part("pin R6", _pin(-robot.l16, back, size[2] / 2 + GAP), STEEL, joint=True),
        ),
        robot.shoulder_link,
    )


def _pin(x: float, low: float, high: float) -> Tube:
    return Tube((x, 0.0, low), (x, 0.0, high), PIN)


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
    cylinder = Tube(
        (cylinder_at - half, 0.0, at.yoke),
        (cylinder_at + half, 0.0, at.yoke),
        bore_radius(plant.wrist) + WALL,
        rod_radius(plant.wrist),
    )
    plate = Bar(PLATE, (plate_at, 0.0, at.arm_front + PLATE_HEIGHT / 2))
    return DrawnBody(
        "left_arm",
        (
            Part("arm", Bar(size, (middle, 0.0, at.arm), bores=bores), ALUMINIUM),
            Part("plate", plate, envelope(ALUMINIUM, share * _PLATE_SHARE, plate.volume.volume)),
            Part(
                "wrist cylinder",
                cylinder,
                envelope(CYLINDER, share * _ACTUATOR_SHARE, cylinder.volume.volume),
            ),
        ),
        body,
    )


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
    sides = tuple(
        Part(
            f"yoke {name}",
            Bar(
                (outer - inner, 2 * (lever + outer), YOKE_HEIGHT),
                (wrist + side * (inner + outer) / 2, 0.0, at.yoke),
            ),
            weightless,
        )
        for name, side in (("rear", -1.0), ("front", 1.0))
    )
    ends = tuple(
        Part(
            f"yoke {name}",
            Bar(
                (2 * inner, outer - inner, YOKE_HEIGHT),
                (wrist, side * (lever + (inner + outer) / 2), at.yoke),
            ),
            weightless,
        )
        for name, side in (("lower end", -1.0), ("upper end", 1.0))
    )
    return DrawnBody("wrist_rod", (Part("wrist rod", rod, weightless), *sides, *ends))


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
    return DrawnBody(
        "right_arm_cylinder",
        (
            Part("right-arm tube", Tube((-behind, 0.0, at), (end, 0.0, at), outer, bore), CYLINDER),
            Part("right-arm rear cap", rear, ALUMINIUM),
            Part("right-arm front cap", front, ALUMINIUM),
        ),
        body,
    )


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
    return DrawnBody(
        "right_arm_rod",
        (
            Part("right-arm rod", rod, CHROME),
            Part("right-arm piston", piston, ACETAL),
            Part("right-arm eye", eye, STEEL),
        ),
        body,
    )


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
    return DrawnBody(
        "club", (*_mount(plant), Part("shaft", *_shaft(club)), *_head(plant.robot, plant.site)), club
    )


def _mount(plant: PlantParameters) -> tuple[Part, ...]:
    """Return clamp, pin of R3 and wrist lever; the clamp's length makes up the mount's mass."""
    at, lever = layers_of(plant), lever_parts(plant)
    low, high = at.right_arm - bore_radius(plant.right_arm), at.lever + LEVER_HEIGHT / 2 + GAP
    pin = Part("pin R3", Tube((0.0, 0.0, low), (0.0, 0.0, high), PIN), STEEL)
    rest = plant.robot.club.mount_mass - pin.mass - sum(part.mass for part in lever)
    length = max(rest / (MOUNT.density * _MOUNT_WIDTH * MOUNT_HEIGHT), _MIN_MOUNT)
    clamp = Part("mount", Bar((length, _MOUNT_WIDTH, MOUNT_HEIGHT), (0.0, 0.0, 0.0)), MOUNT)
    return clamp, pin, *lever


def _shaft(club: Club) -> tuple[Tube, Material]:
    """Return the shaft as a tube whose wall makes up its mass; solid if even that is too light."""
    material = SHAFT_STEEL if club.shaft_mass / club.shaft_length > _STEEL_SHAFT else COMPOSITE
    inner_squared = club.shaft_radius**2 - club.shaft_mass / (material.density * pi * club.shaft_length)
    start, end = (0.0, 0.0, 0.0), (club.shaft_length, 0.0, 0.0)
    tube = Tube(start, end, club.shaft_radius, sqrt(max(inner_squared, 0.0)))
    return tube, envelope(material, club.shaft_mass, tube.volume.volume)


def _columns(*axes: np.ndarray) -> Turn:
    rows = np.column_stack(axes)
    first, second, third = (tuple(map(float, row)) for row in rows)
    return first, second, third  # type: ignore[return-value]


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
    tilted = _columns(normal, np.cross(toe, normal), toe)
    face = np.array([club.length_to_face, 0.0, 0.0])
    half = depth, height, width = head_half_sizes(club)
    rise = height - site.sole_depth * sin(robot.lie)
    if club.head_depth < _WOOD_DEPTH:
        blade = Bar(
            (2 * depth, 2 * height, 2 * width), vector(face - depth * normal + rise * up), turn=tilted
        )
        return (_of_mass("head", blade, CHROME, club.head_mass),)
    centre = vector(face - club.head_depth * ahead + rise * up)
    head = Ellipsoid(half, centre, _columns(ahead, up, toe), cut=club.head_depth)
    plate = Ellipsoid((0.003, 0.8 * height, 0.8 * width), vector(face - 0.003 * normal), tilted)
    return _of_mass("head", head, HEAD, club.head_mass), Part("face", plate, CHROME._replace(density=0.0))


def envelope(material: Material, mass: float, volume: float) -> Material:
    """Return `material` with the mean density of a bought part of `mass` (kg) drawn as `volume` (m3)."""
    return material._replace(density=mass / volume)


def _of_mass(name: str, solid: Solid, material: Material, mass: float) -> Part:
    return Part(name, solid, envelope(material, mass, solid.volume.volume))
