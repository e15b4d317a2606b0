"""Materials of drawn parts: density and colour."""

from __future__ import annotations

from typing import NamedTuple

Colour = tuple[int, int, int]

_POUND_PER_CUBIC_INCH = 0.45359237 / 0.00001639  # as in the thesis, kg/m3


class Material(NamedTuple):
    """Name, density (kg/m3) and colour (red, green, blue, 0 to 255) of a part."""

    name: str
    density: float
    colour: Colour


STEEL = Material("steel", 0.283 * _POUND_PER_CUBIC_INCH, (112, 122, 136))
ALUMINIUM = Material("aluminium", 0.098 * _POUND_PER_CUBIC_INCH, (196, 203, 211))
CYLINDER = ALUMINIUM._replace(name="cylinder", colour=(38, 112, 178))
CHROME = STEEL._replace(name="chrome", colour=(228, 231, 235))
MOUNT = ALUMINIUM._replace(name="mount", colour=(235, 153, 40))
COMPOSITE = Material("composite", 1600.0, (40, 42, 46))
SHAFT_STEEL = STEEL._replace(name="shaft steel", colour=(150, 154, 160))
ACETAL = Material("acetal", 1410.0, (238, 238, 232))
HEAD = Material("head", 0.0, (172, 32, 40))
FRAME = STEEL._replace(name="frame", colour=(72, 80, 92))
GUARD = Material("hollow profile", 1060.0, (170, 178, 160))
TEE = Material("tee", 700.0, (240, 196, 110))
BALL = Material("ball", 0.0, (255, 255, 255))


def envelope(material: Material, mass: float, volume: float) -> Material:
    """Return `material` with the mean density of a bought part of `mass` (kg) drawn as `volume` (m3)."""
    return material._replace(density=mass / volume)
