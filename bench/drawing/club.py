"""The club in its mount: shaft and head of the configured club, the mount as heavy as assumed."""

from __future__ import annotations

from math import cos, pi, sin, sqrt

import numpy as np

from bench.drawing.bodies import (
    CHROME,
    COMPOSITE,
    HEAD,
    MOUNT,
    SHAFT_STEEL,
    STEEL,
    DrawnBody,
    Material,
    Part,
    envelope,
)
from bench.drawing.layers import GAP, LEVER_HEIGHT, MOUNT_HEIGHT, PIN, bore_radius
from bench.drawing.links import layers_of, lever_parts
from bench.drawing.solids import Bar, Ellipsoid, Solid, Tube, Turn
from sim.plant import PlantParameters, Site
from sim.robot import Club, RobotParameters
from sim.vectors import Vector

_MOUNT_WIDTH = 0.050
_LEAST_MOUNT = 0.030
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
    length = max(rest / (MOUNT.density * _MOUNT_WIDTH * MOUNT_HEIGHT), _LEAST_MOUNT)
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


def _vector(values: np.ndarray) -> Vector:
    x, y, z = map(float, values)
    return x, y, z


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
            (2 * depth, 2 * height, 2 * width), _vector(face - depth * normal + rise * up), turn=tilted
        )
        return (_of_mass("head", blade, CHROME, club.head_mass),)
    centre = _vector(face - club.head_depth * ahead + rise * up)
    head = Ellipsoid(half, centre, _columns(ahead, up, toe), cut=club.head_depth)
    plate = Ellipsoid((0.003, 0.8 * height, 0.8 * width), _vector(face - 0.003 * normal), tilted)
    return _of_mass("head", head, HEAD, club.head_mass), Part("face", plate, CHROME._replace(density=0.0))


def _of_mass(name: str, solid: Solid, material: Material, mass: float) -> Part:
    return Part(name, solid, envelope(material, mass, solid.volume.volume))
