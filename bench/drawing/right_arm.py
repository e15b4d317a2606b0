"""The right arm: rod with eye and piston, and cylinder, both along x of their own frames."""

from __future__ import annotations

from math import pi, sqrt

from bench.drawing.bodies import ACETAL, ALUMINIUM, CHROME, CYLINDER, STEEL, DrawnBody, Part
from bench.drawing.layers import PIN, bore_radius, rod_radius
from bench.drawing.links import layers_of
from bench.drawing.solids import Tube
from sim.plant import PlantParameters

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
