"""The parts that a robot may be built of, with source and price class, read from `catalogue.toml`."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from math import log, pi, sqrt
from pathlib import Path
from typing import Annotated

from scipy.optimize import brentq

from bench.base.errors import BenchError
from bench.base.from_toml import Builder, as_tree, read_toml
from drivers.base.ranges import AtLeast, AtMost, Range
from sim.pneumatics import GAS_CONSTANT, REFERENCE_DENSITY, REFERENCE_TEMPERATURE

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
    """Longest time from loss of power to exhausting, s."""


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
