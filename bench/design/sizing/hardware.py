"""One choice of parts, and the configuration that it makes of a robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import degrees, sqrt
from typing import Any, NamedTuple

from bench.base.errors import BenchError
from bench.base.to_toml import toml_value
from bench.design.sizing.catalogue import (
    PRICES,
    AbsorberPart,
    Catalogue,
    CylinderPart,
    FramePart,
    HosePart,
    ManifoldPart,
    PassagePart,
    PricedPart,
    ValvePart,
    VanePart,
    in_series,
)
from sim.plant import PlantParameters
from sim.pneumatics import Actuator

DESIGN_SPEED = 45.0
"""Head speed to which the limits of the joint speeds of the shipped envelope belong, m/s."""
RELIEF = 0.5e5, 11.5e5
"""Opening of the relief valves above the highest planned pressure, and at most, Pa; ratings are 12 bar."""
MANIFOLD_RELIEF = 4.0 / 3.0
"""Conductance of the manifold's relief valve over the feed's: the flow of a fully open regulator."""
_CYLINDER_WIDTH = 0.045
"""Width of the right arm's cylinder in its moment of inertia, m, as the thesis has it."""
_MIN_SUPPLY, _MAX_SUPPLY = 0.8125, 1.1
"""Shares of the regulated pressure between which a swing may begin, as in the shipped envelope."""


@dataclass(frozen=True)
class Hardware:
    """Names of parts in the catalogue, with a pressure and a lever that are set freely."""

    vane: str = "V400"
    arm: str = "C50"
    """Cylinder of the right arm."""
    wrist: str = "C50"
    """Cylinder of the wrist."""
    shoulder_valve: str = "F2000"
    arm_valve: str = "F2000"
    wrist_valve: str = "F2000"
    arm_absorber: str = "A40"
    wrist_absorber: str = "A90"
    feed: str = "L34"
    manifold: str = "M2"
    pressure: float = 8.0e5
    """Regulated pressure, Pa absolute."""
    lever: float = 0.06
    """Wrist's lever, m."""
    lever_angle: float = 0.0
    """Mounting angle of that lever on the club, rad."""
    frame: str = "R80"
    """Joints' ranges; the structure has no price class."""
    hose: str = ""
    """Hose from each valve to each chamber; empty: valves at the actuators, as shipped."""
    vent: str = ""
    """Vents; empty: throttles turned until the chambers empty as fast as the shipped ones."""

    @property
    def valves(self) -> tuple[str, str, str]:
        """Valves of shoulder, right arm and wrist."""
        return self.shoulder_valve, self.arm_valve, self.wrist_valve

    @property
    def name(self) -> str:
        """Name with all choices: parts, bar, mm of the lever; its angle, frame, hose, vents if changed."""
        parts = [str(getattr(self, field.name)) for field in fields(self)[:10]]
        parts += [f"{self.pressure / 1e5:g}bar", f"{1e3 * self.lever:g}mm"]
        if self.lever_angle:
            parts.append(f"{degrees(self.lever_angle):g}deg")
        if self.frame != Hardware.frame:
            parts.append(self.frame)
        parts += [part for part in (self.hose, self.vent) if part]
        return "-".join(parts)


KINDS = {
    "vane": "vanes",
    "arm": "cylinders",
    "wrist": "cylinders",
    "shoulder_valve": "valves",
    "arm_valve": "valves",
    "wrist_valve": "valves",
    "arm_absorber": "absorbers",
    "wrist_absorber": "absorbers",
    "feed": "feeds",
    "manifold": "manifolds",
    "frame": "frames",
    "hose": "hoses",
    "vent": "vents",
}
"""Kind of part of each field."""
_OPTIONAL = ("hose", "vent")
"""Fields that may name no part."""
_PIECES = {"hose": 6}
"""Number of pieces where a part is needed several times: a hose for each chamber."""


class Parts(NamedTuple):
    """The parts that a hardware names, looked up."""

    vane: VanePart
    arm: CylinderPart
    wrist: CylinderPart
    shoulder_valve: ValvePart
    arm_valve: ValvePart
    wrist_valve: ValvePart
    arm_absorber: AbsorberPart
    wrist_absorber: AbsorberPart
    feed: PassagePart
    manifold: ManifoldPart
    frame: FramePart
    hose: HosePart | None = None
    vent: PassagePart | None = None

    @property
    def valves(self) -> tuple[ValvePart, ValvePart, ValvePart]:
        """Valves of shoulder, right arm and wrist."""
        return self.shoulder_valve, self.arm_valve, self.wrist_valve

    @property
    def price(self) -> int:
        """Upper ends of the parts' price classes, EUR in all."""
        return sum(
            _PIECES.get(field, 1) * PRICES[part.price]
            for field, part in self._asdict().items()
            if isinstance(part, PricedPart)
        )


def parts_of(catalogue: Catalogue, hardware: Hardware) -> Parts:
    """Return the parts of `hardware`.

    Raises:
        BenchError: the catalogue has no part of a name.
    """
    found: dict[str, Any] = {}
    for field, kind in KINDS.items():
        name, known = getattr(hardware, field), getattr(catalogue, kind)
        if name in known:
            found[field] = known[name]
        elif name or field not in _OPTIONAL:
            raise BenchError(
                f"hardware: {field}", name, f"of {kind}: {', '.join(known)}", "Correct it, or add the part."
            )
    return Parts(**found)


def overrides(
    catalogue: Catalogue, hardware: Hardware, shipped: PlantParameters, speed: float
) -> dict[str, Any]:
    """Return the configuration's tables that make `hardware` of the `shipped` plant, for `speed` (m/s).

    Values that no part states are scaled from the shipped plant. Dry friction, dead volume and, without vents
    of the catalogue, their throttles scale with area or displacement, viscous friction with its root. Limits
    of joint speeds scale with the head speed, speeds that a cushion takes with the root of its energy. Masses
    of the bodies stay.
    """
    parts = parts_of(catalogue, hardware)
    absorbers = parts.arm_absorber, parts.wrist_absorber
    plant: dict[str, Any] = {
        "wrist_lever": hardware.lever,
        "shoulder": _actuator(shipped.shoulder, (parts.vane.displacement,) * 2, parts, 0),
        "right_arm": _actuator(shipped.right_arm, parts.arm.areas, parts, 1)
        | _arm_stop(absorbers[0], shipped.right_arm),
        "wrist": _actuator(shipped.wrist, parts.wrist.areas, parts, 2) | _wrist_stop(absorbers[1]),
        "supply": _supply(parts, hardware, shipped),
    }
    if hardware.lever_angle:
        plant["wrist_lever_angle_deg"] = degrees(hardware.lever_angle)
    if hardware.frame != Hardware.frame:
        _set_ranges(plant, parts.frame, shipped)
    held = (shipped.right_arm.stop.energy, shipped.wrist.stop.energy)
    ratings = [part.energy / energy for part, energy in zip(absorbers, held, strict=True)]
    return {"plant": plant, "envelope": _envelope(hardware, [1.0, *ratings], speed)}


def _actuator(shipped: Actuator, areas: tuple[float, float], parts: Parts, index: int) -> dict[str, Any]:
    """Return the keys of an actuator with these areas (A, B; m2, vane m3/rad) and the valve `index`.

    A hose adds its volume to the dead volume, and acts in series with both metering edges; the valve's
    critical pressure ratio is kept.
    """
    scale, friction, hose = areas[0] / shipped.area_a, shipped.friction, parts.hose
    conductance = parts.valves[index].conductance
    return {
        "area_a": areas[0],
        "area_b": areas[1],
        "dead_volume": scale * shipped.dead_volume + (hose.volume if hose else 0.0),
        "friction": {
            "viscous": sqrt(scale) * friction.viscous,
            "coulomb": scale * friction.coulomb,
            "static": scale * friction.static,
        },
        "valve": {"conductance": in_series(conductance, hose.conductance) if hose else conductance},
    }


def _set_ranges(plant: dict[str, Any], frame: FramePart, shipped: PlantParameters) -> None:
    """Set the ranges of `frame` in the tables of `plant`.

    The right arm's cylinder weighs more as it is longer, a bar of even mass about its new middle.
    """
    robot = shipped.robot
    length = frame.arm_behind + frame.arm_body
    mass = robot.cylinder.mass * length / robot.l56
    plant["robot"] = {
        "l56": frame.arm_body,
        "stroke": frame.arm_stroke,
        "cylinder": {
            "mass": mass,
            "centre_of_mass": (frame.arm_body - frame.arm_behind) / 2,
            "inertia": mass * (length**2 + _CYLINDER_WIDTH**2) / 12,
        },
    }
    plant["shoulder"] |= {"lower": frame.shoulder_lower, "upper": frame.shoulder_upper}
    plant["right_arm"]["upper"] = frame.arm_stroke
    plant["wrist"]["lower_deg"] = degrees(shipped.wrist.upper - frame.wrist_cock)


def _arm_stop(absorber: AbsorberPart, shipped: Actuator) -> dict[str, Any]:
    """Return the right arm's stop: its clearance grows with the absorber's stroke beyond the shipped one."""
    longer = max(absorber.stroke - shipped.stop.travel, 0.0)
    return {
        "clearance": shipped.clearance + longer,
        "stop": {"energy": absorber.energy, "travel": absorber.stroke, "rated": absorber.rated},
    }


def _wrist_stop(absorber: AbsorberPart) -> dict[str, Any]:
    """Return the wrist's stop, whose absorber stands at its `radius`."""
    travel = absorber.stroke / absorber.radius
    return {
        "clearance": max(0.12, travel - 0.054),
        "stop": {"energy": absorber.energy, "travel": travel, "rated": absorber.rated},
    }


def _supply(parts: Parts, hardware: Hardware, shipped: PlantParameters) -> dict[str, Any]:
    supply = shipped.supply
    swept = max(
        parts.arm.areas[0] / shipped.right_arm.area_a, parts.vane.displacement / shipped.shoulder.area_a
    )
    return {
        "pressure": hardware.pressure,
        "feed_conductance": parts.feed.conductance,
        "volume": parts.manifold.volume,
        "dump_conductance": supply.dump_conductance * parts.manifold.volume / supply.volume,
        "vent_conductance": parts.vent.conductance if parts.vent else swept * supply.vent_conductance,
        "relief_pressure": relief_pressure(hardware.pressure),
        "relief_conductance": swept * supply.relief_conductance,
        "manifold_relief_ratio": _MAX_SUPPLY,
        "manifold_relief_conductance": MANIFOLD_RELIEF * parts.feed.conductance,
    }


def highest_pressure(regulated: float) -> float:
    """Return the chamber pressure (Pa absolute) that a plan may reach with this regulated pressure."""
    return max(10.0e5, regulated + 1.0e5)


def relief_pressure(regulated: float) -> float:
    """Return the opening pressure of the relief valves (Pa absolute)."""
    return min(highest_pressure(regulated) + RELIEF[0], RELIEF[1])


def _envelope(hardware: Hardware, ratings: list[float], speed: float) -> dict[str, Any]:
    faster = max(speed / DESIGN_SPEED, 1.0)
    stops = zip((9.0, 5.2, 34.0), ratings, strict=True)
    return {
        "max_speed": [faster * limit for limit in (26.0, 6.0, 48.0)],
        "end_stop_max_speed": [limit * sqrt(rating) for limit, rating in stops],
        "min_supply_pressure": _MIN_SUPPLY * hardware.pressure,
        "max_supply_pressure": _MAX_SUPPLY * hardware.pressure,
    }


def configuration_text(tables: Mapping[str, Any], heading: str) -> str:
    """Return a configuration file over the shipped one that gives `tables`; `heading` becomes a comment."""
    lines = [*(f"# {line}" for line in heading.splitlines()), 'base = "shipped"', *_toml(tables, "")]
    return "\n".join(lines) + "\n"


def _toml(tables: Mapping[str, Any], path: str) -> list[str]:
    values = [f"{key} = {_value(value)}" for key, value in tables.items() if not isinstance(value, Mapping)]
    lines = ["", f"[{path}]", *values] if values and path else values
    for key, value in tables.items():
        if isinstance(value, Mapping):
            lines += _toml(value, f"{path}.{key}" if path else key)
    return lines


def _value(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(_value(entry) for entry in value) + "]"
    return f"{value:.6g}" if isinstance(value, float) else toml_value(value)
