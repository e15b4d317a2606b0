"""The parts that a robot may be built of, a choice of them, and the configuration that it makes of a robot.

Parts, with source and price class, are read from `catalogue.toml`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from math import degrees, log, pi, sqrt
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from scipy.optimize import brentq

from bench.base.errors import BenchError
from bench.base.from_toml import Builder, as_tree, read_toml
from bench.base.to_toml import toml_value
from drivers.base.ranges import AtLeast, AtMost, Range
from sim.plant import PlantParameters
from sim.pneumatics import GAS_CONSTANT, REFERENCE_DENSITY, REFERENCE_TEMPERATURE, Actuator

FILE = Path(__file__).with_name("catalogue.toml")

PriceClass = Annotated[int, AtLeast(1), AtMost(4)]
PRICES = {1: 100, 2: 300, 3: 1000, 4: 3000}
"""Upper limits of the price classes (EUR each); the last class has none and is costed at its value here."""

_UPSTREAM, _DOWNSTREAM = 7.013e5, 6.013e5
"""Pressures at which a nominal flow is stated: 6 to 5 bar gauge, Pa absolute."""
_CRITICAL_RATIO = 0.3
_HEAT_RATIO = 1.4
_WALL_FRICTION = 0.02
"""Darcy friction factor of a smooth hose; assumption: at the Reynolds numbers here, about 1e5."""


@dataclass(frozen=True, kw_only=True)
class SourcedPart:
    """A part with the source of its figures."""

    name: str
    source: str


@dataclass(frozen=True, kw_only=True)
class PricedPart(SourcedPart):
    """A part with a price class."""

    price: PriceClass


@dataclass(frozen=True, kw_only=True)
class VanePart(PricedPart):
    """A rotary vane."""

    displacement: Annotated[float, Range(1e-6, 0.05, "m3/rad")]
    """Volume of a chamber a radian, m3/rad."""


@dataclass(frozen=True, kw_only=True)
class CylinderPart(PricedPart):
    """A double-acting cylinder with one rod."""

    bore: Annotated[float, Range(0.005, 0.3, "m")]
    rod: Annotated[float, Range(0.002, 0.2, "m")]
    """Diameter of the rod, m."""

    def __post_init__(self) -> None:
        """Raise ValueError unless the rod fits into the bore."""
        if self.rod >= self.bore:
            raise ValueError(f"a rod thinner than the bore of {self.bore:g} m")

    @property
    def areas(self) -> tuple[float, float]:
        """Areas of the bore's side and of the rod's side, m2."""
        return pi / 4 * self.bore**2, pi / 4 * (self.bore**2 - self.rod**2)


@dataclass(frozen=True, kw_only=True)
class ValvePart(PricedPart):
    """A proportional valve."""

    nominal_flow: Annotated[float, Range(1.0, 20000.0, "l/min")]
    """l/min of free air from 6 to 5 bar gauge."""

    @property
    def conductance(self) -> float:
        """Sonic conductance, m3/(s Pa), for a critical ratio of 0.3."""
        return conductance_of(self.nominal_flow)


@dataclass(frozen=True, kw_only=True)
class AbsorberPart(PricedPart):
    """A shock absorber."""

    energy: Annotated[float, Range(0.1, 1000.0, "J")]
    """Energy of a stroke as it is set, J."""
    stroke: Annotated[float, Range(0.001, 0.2, "m")]
    rated: Annotated[float, Range(0.0, 1000.0, "J")] = field(default=0.0, metadata={"optional": True})
    """Energy that its body is rated for, J; `energy` unless it is larger."""
    radius: Annotated[float, Range(0.02, 0.5, "m")] = field(default=0.08, metadata={"optional": True})
    """Radius at which it stands if it is the wrist's, m; assumption: the shipped 0.174 rad are 13.9 mm."""


@dataclass(frozen=True, kw_only=True)
class PassagePart(PricedPart):
    """The line from the reservoir with regulator and soft-start valve, or vents with their throttles."""

    conductance: Annotated[float, Range(1e-12, 1e-5, "m3/(s Pa)")]
    """Sonic conductance, of vents that of the throttle of each chamber, m3/(s Pa)."""


@dataclass(frozen=True, kw_only=True)
class ManifoldPart(PricedPart):
    """The manifold between soft-start valve and spools."""

    volume: Annotated[float, Range(1e-5, 1.0, "m3")]


@dataclass(frozen=True, kw_only=True)
class ShutOffPart(SourcedPart):
    """A shut-off valve that reports its position."""

    switching_time: Annotated[float, Range(0.0, 5.0, "s")]
    """Max time from loss of power to exhausting (s)."""


@dataclass(frozen=True, kw_only=True)
class HosePart(PricedPart):
    """A hose from a valve to a chamber, cut to length."""

    inner_diameter: Annotated[float, Range(0.001, 0.05, "m")]
    length: Annotated[float, Range(0.01, 10.0, "m")]

    @property
    def volume(self) -> float:
        """Volume that it adds to the chamber's dead volume, m3."""
        return pi / 4 * self.inner_diameter**2 * self.length

    @property
    def conductance(self) -> float:
        """Sonic conductance, m3/(s Pa)."""
        return hose_conductance(self.inner_diameter, self.length)


@dataclass(frozen=True, kw_only=True)
class FramePart(SourcedPart):
    """The joints' ranges, with the right arm's cylinder that gives them."""

    shoulder_lower: Annotated[float, Range(-6.0, 0.0, "rad")]
    shoulder_upper: Annotated[float, Range(0.0, 6.0, "rad")]
    """Ends of the shoulder's travel (rad)."""
    wrist_cock: Annotated[float, Range(0.5, 2.8, "rad")]
    """Range of the wrist from the line of the arm, rad."""
    arm_body: Annotated[float, Range(0.1, 1.0, "m")]
    """Right shoulder to the exit of the right arm's rod, m."""
    arm_behind: Annotated[float, Range(0.0, 1.0, "m")]
    """Length of its cylinder behind the right shoulder, about which it swings, m."""
    arm_stroke: Annotated[float, Range(0.05, 1.0, "m")]


@dataclass(frozen=True)
class Catalogue:
    """All parts, by kind and name."""

    vanes: dict[str, VanePart]
    cylinders: dict[str, CylinderPart]
    valves: dict[str, ValvePart]
    absorbers: dict[str, AbsorberPart]
    feeds: dict[str, PassagePart]
    manifolds: dict[str, ManifoldPart]
    frames: dict[str, FramePart]
    shut_offs: dict[str, ShutOffPart]
    hoses: dict[str, HosePart]
    vents: dict[str, PassagePart]


def conductance_of(nominal_flow: float) -> float:
    """Return the sonic conductance, m3/(s Pa), of a valve with `nominal_flow` (l/min, 6 to 5 bar gauge).

    ISO 6358 below the critical ratio's flow (golf.md 8.2): Q = C p1 sqrt(1 - ((p2/p1 - b) / (1 - b))^2), in
    the reference atmosphere.
    """
    ratio = _DOWNSTREAM / _UPSTREAM
    driving = sqrt(1.0 - ((ratio - _CRITICAL_RATIO) / (1.0 - _CRITICAL_RATIO)) ** 2)
    return nominal_flow / 60e3 / (_UPSTREAM * driving)


def fanno_length(mach: float) -> float:
    """Return friction factor times length over diameter after which flow that enters at `mach` chokes.

    Adiabatic flow of air with wall friction in a pipe of one diameter (Fanno flow, Darcy friction factor).
    """
    k = _HEAT_RATIO
    ratio = (k + 1) * mach**2 / (2 + (k - 1) * mach**2)
    return (1 - mach**2) / (k * mach**2) + (k + 1) / (2 * k) * log(ratio)


def hose_conductance(inner_diameter: float, length: float) -> float:
    """Return the sonic conductance, m3/(s Pa), of a hose (m, m) that chokes at its end.

    Isentropic from rest to the inlet, then Fanno flow. Fittings and bends are not counted.
    """
    k, needed = _HEAT_RATIO, _WALL_FRICTION * length / inner_diameter
    mach = float(brentq(lambda m: fanno_length(m) - needed, 1e-4, 1.0 - 1e-12))
    speed = mach * sqrt(k * GAS_CONSTANT * REFERENCE_TEMPERATURE)  # at rest's temperature
    density_ratio: float = (1 + (k - 1) / 2 * mach**2) ** (-(k + 1) / (2 * (k - 1)))
    area = pi / 4 * inner_diameter**2
    return area * speed * density_ratio / (GAS_CONSTANT * REFERENCE_TEMPERATURE * REFERENCE_DENSITY)


def in_series(first: float, second: float) -> float:
    """Return the conductance of two in series, by the squares of their reciprocals.

    As effective areas are combined (JIS; techon.nikkeibp.co.jp/article/WORD/20060515/117083).
    """
    return 1.0 / sqrt(first**-2 + second**-2)


def load_catalogue(path: Path = FILE) -> Catalogue:
    """Return the catalogue in the file `path`.

    Raises:
        BenchError: the file is missing, unreadable or not TOML.
        ExceptionGroup: one BenchError per mistake in it.
    """
    faults: list[BenchError] = []
    tree = as_tree(read_toml(path, "a catalogue of parts", "Correct the path."), path, faults)
    builder = Builder(tree, path, "Correct the part.", "Add it to the part.", faults=faults)
    catalogue = builder.build(Catalogue)
    if faults:
        raise ExceptionGroup(f"{path} is not a valid catalogue", faults)
    return catalogue  # type: ignore[no-any-return]


@cache
def shipped_catalogue() -> Catalogue:
    """Return the catalogue that comes with golfbench."""
    return load_catalogue()


DESIGN_SPEED = 45.0
"""Head speed to which the limits of the joint speeds of the shipped envelope belong, m/s."""
RELIEF = 0.5e5, 11.5e5
"""Opening of the relief valves above the highest planned pressure, and at most, Pa; ratings are 12 bar."""
MANIFOLD_RELIEF = 4.0 / 3.0
"""Conductance of the manifold's relief valve over the feed's: the flow of a fully open regulator."""
_CYLINDER_WIDTH = 0.045
"""Width of the right arm's cylinder in its moment of inertia, m, as the thesis has it."""
_MIN_SUPPLY, _MAX_SUPPLY = 0.8125, 1.1
"""Min and max supply pressure of a swing, as ratios to the regulated pressure, as in the default envelope."""


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
    """Return the parts of `hardware`; raises BenchError: the catalogue has no part of a name."""
    found: dict[str, Any] = {}
    for part, kind in KINDS.items():
        name, known = getattr(hardware, part), getattr(catalogue, kind)
        if name in known:
            found[part] = known[name]
        elif name or part not in _OPTIONAL:
            action = "Name a known part, or add it to the catalogue."
            raise BenchError(f"hardware: {part}", name, f"of {kind}: {', '.join(known)}", action)
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
    # The right arm's clearance grows with the absorber's stroke; the wrist's absorber stands at its radius.
    stroke, travel = absorbers[0].stroke, absorbers[1].stroke / absorbers[1].radius
    longer = max(stroke - shipped.right_arm.stop.travel, 0.0)
    stops = (
        _stop(absorbers[0], stroke, shipped.right_arm.clearance + longer),
        _stop(absorbers[1], travel, max(0.12, travel - 0.054)),
    )
    plant: dict[str, Any] = {
        "wrist_lever": hardware.lever,
        "shoulder": _actuator(shipped.shoulder, (parts.vane.displacement,) * 2, parts, 0),
        "right_arm": _actuator(shipped.right_arm, parts.arm.areas, parts, 1) | stops[0],
        "wrist": _actuator(shipped.wrist, parts.wrist.areas, parts, 2) | stops[1],
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


def _stop(absorber: AbsorberPart, travel: float, clearance: float) -> dict[str, Any]:
    stop = {"energy": absorber.energy, "travel": travel, "rated": absorber.rated}
    return {"clearance": clearance, "stop": stop}


def _supply(parts: Parts, hardware: Hardware, shipped: PlantParameters) -> dict[str, Any]:
    supply, area, displacement = shipped.supply, parts.arm.areas[0], parts.vane.displacement
    swept = max(area / shipped.right_arm.area_a, displacement / shipped.shoulder.area_a)
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
