"""Compressed air: proportional valve, chambers, supply (golf.md 8; ISO 6358; Richer & Hurmuzlu 2000).

Everything here works on pressures (Pa absolute). Mass flow m' enters the chamber equation only as
q = m' R T, because p' = (n / V) (q - p V') for a polytropic exponent n.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import pi, sqrt
from typing import Annotated

import numpy as np

from drivers.base.compiled import compiled
from drivers.base.ranges import Range

REFERENCE_TEMPERATURE = 293.15
GAS_CONSTANT = 287.05
REFERENCE_DENSITY = 1.185
FLOW_TO_PRESSURE = GAS_CONSTANT * REFERENCE_TEMPERATURE * REFERENCE_DENSITY
"""R T0 rho0 (Pa): turns ISO 6358 conductance times pressure into m' R T (W)."""

LAMINAR_RATIO = 0.98
"""Pressure ratio above which the flow is taken as linear; removes the infinite slope at equal pressures."""

Conductance = Annotated[float, Range(1e-12, 1e-5, "m3/(s Pa)")]
Area = Annotated[float, Range(1e-6, 0.05, "m2, vane m3/rad")]


@compiled
def flow(conductance: float, upstream: float, downstream: float, critical_ratio: float) -> float:
    """Return m' R T (W) through an orifice, positive from `upstream` to `downstream`; ISO 6358.

    `conductance` m3/(s Pa); pressures Pa absolute; choked below `critical_ratio`, elliptic above it,
    linear above `LAMINAR_RATIO`. The sign follows the pressures.
    """
    if upstream >= downstream:
        high, low, sign = upstream, downstream, 1.0
    else:
        high, low, sign = downstream, upstream, -1.0
    spread = 1.0 - 2.0 * critical_ratio
    if low <= critical_ratio * high:
        driving = high
    elif low < LAMINAR_RATIO * high:
        # high sqrt(1 - ((low / high - b) / (1 - b))^2) with one division less
        driving = sqrt((high - low) * (low + spread * high)) / (1.0 - critical_ratio)
    else:
        slope = sqrt((LAMINAR_RATIO + spread) / (1.0 - LAMINAR_RATIO)) / (1.0 - critical_ratio)
        driving = slope * (high - low)
    return sign * conductance * FLOW_TO_PRESSURE * driving


@dataclass(frozen=True)
class Valve:
    """A 5/3 proportional valve, centre closed (MPYE type; golf.md 8.2)."""

    conductance: Conductance = 7.9e-8
    """Sonic conductance of one metering edge fully open, m3/(s Pa)."""
    critical_ratio: Annotated[float, Range(0.05, 0.9, "")] = 0.3
    """Pressure ratio of choking."""
    natural_frequency: Annotated[float, Range(10.0, 1e4, "rad/s")] = 2 * pi * 100.0
    """Natural frequency of the spool, rad/s (assumption: critical frequency about 100 Hz)."""
    damping_ratio: Annotated[float, Range(0.05, 2.0, "")] = 0.8
    """Damping ratio of the spool."""
    dead_band: Annotated[float, Range(0.0, 0.5, "")] = 0.02
    """Overlap on each side of the centre, as a share of the stroke."""
    leakage: Annotated[float, Range(0.0, 0.1, "")] = 0.001
    """Leakage opening of a closed edge, as a share of the full opening."""
    centre: Annotated[float, Range(-0.2, 0.2, "")] = 0.0
    """Command at which the spool is centred, found by calibration."""

    def half_step_matrix(self, half_step: float) -> np.ndarray:
        """Return the exact 2x2 propagation of (opening - command, rate) over `half_step` s."""
        omega, zeta = self.natural_frequency, self.damping_ratio
        root = omega * np.emath.sqrt(zeta**2 - 1.0)
        decay = np.exp(-zeta * omega * half_step)
        even = decay * np.cosh(root * half_step).real
        odd = decay * half_step * np.sinc(1j * root * half_step / pi).real  # sinh(root t) / root, also at 0
        return np.array([[even + zeta * omega * odd, odd], [-(omega**2) * odd, even - zeta * omega * odd]])


@dataclass(frozen=True)
class Friction:
    """Joint friction in the actuator's coordinate: viscous, and Coulomb with Stribeck's static rise."""

    viscous: Annotated[float, Range(0.0, 1e4, "N s/m, vane N m s/rad")]
    """Viscous coefficient, N s/m or N m s/rad."""
    coulomb: Annotated[float, Range(0.0, 2000.0, "N, vane N m")]
    """Coulomb friction, N or N m."""
    static: Annotated[float, Range(0.0, 2000.0, "N, vane N m")]
    """Static friction, N or N m; at least `coulomb`."""
    stribeck_speed: Annotated[float, Range(1e-4, 2.0, "m/s, vane rad/s")] = 0.05
    """Stribeck speed, m/s or rad/s."""


@dataclass(frozen=True)
class EndStop:
    """End stop with shock absorber: `travel` beyond the working range absorbs up to `rating`."""

    energy: Annotated[float, Range(0.1, 1000.0, "J")]
    """Energy at which the spring fills the travel, J; the rated one unless `rated` is larger."""
    travel: Annotated[float, Range(1e-4, 1.0, "rad, rod m")]
    """Absorber travel beyond the range (m, or rad at shoulder and wrist)."""
    damping_speed: Annotated[float, Range(0.01, 1000.0, "rod m/s, else rad/s")] = 2.0
    """Speed at which damping doubles the spring force, and rebound force vanishes (m/s or rad/s)."""
    rated: Annotated[float, Range(0.0, 1000.0, "J")] = field(default=0.0, metadata={"optional": True})
    """Rated energy of a stroke where it is larger than `energy`, J: what damping takes is heat for the body,
    not travel. It does not change the force."""

    @property
    def rating(self) -> float:
        """Rated energy of a stroke, J."""
        return max(self.energy, self.rated)

    @property
    def stiffness(self) -> float:
        """Spring rate at which `energy` just fills the travel (N/m or N m/rad)."""
        return 2 * self.energy / self.travel**2


@dataclass(frozen=True)
class Actuator:
    """A double-acting pneumatic actuator with its valve, hoses, friction and stops.

    Areas are m2, for a rotary vane m3/rad; `lower` and `upper` bound the working range of its joint
    coordinate: theta1 (rad), rod extension (m), theta3 (rad).
    """

    area_a: Area
    """Area of chamber A, which drives the coordinate up: m2 of a cylinder, m3/rad of a vane."""
    area_b: Area
    """Area of chamber B: m2 of a cylinder, m3/rad of a vane."""
    dead_volume: Annotated[float, Range(1e-7, 0.01, "m3")]
    """Volume of each chamber with its hose at `clearance` beyond the range, m3."""
    lower: Annotated[float, Range(-10.0, 10.0, "rad, rod m")]
    """Lower end of the range: joint angle (rad), or rod extension of the right arm (m)."""
    upper: Annotated[float, Range(-10.0, 10.0, "rad, rod m")]
    """Upper end of the range: joint angle (rad), or rod extension of the right arm (m)."""
    clearance: Annotated[float, Range(0.0, 1.0, "rad, rod m")]
    """Way beyond the range at which a chamber has its dead volume only (m, or rad at shoulder and wrist)."""
    friction: Friction
    stop: EndStop
    valve: Valve = field(default_factory=Valve)
    cross_leakage: Annotated[float, Range(0.0, 1e-8, "m3/(s Pa)")] = 2e-11
    """Conductance between the chambers past the seals, m3/(s Pa)."""
    pressure_rating: Annotated[float, Range(2e5, 5e6, "Pa absolute")] = 1.2e6
    """Pressure rating, Pa absolute."""

    @property
    def chamber_ends(self) -> tuple[float, float]:
        """Coordinates at which chamber A and chamber B have their dead volume only (rad, m, rad)."""
        return self.lower - self.clearance, self.upper + self.clearance


@dataclass(frozen=True)
class Supply:
    """Regulator, supply and shut-off valve in series, manifold, throttles behind two vents, relief valves.

    Supply valve and shut-off valve are 3/2 valves: either one shut cuts the supply and exhausts the manifold.
    The supply valve follows its command. The shut-off valve is held open by the same output, over a contact
    of the guard's lock that its release opens, and shuts late, by a pneumatic timer: a supply valve that
    stays open shows in the manifold's pressure before. Vents are normally open. A safety relay, which an
    emergency stop or an open guard releases, has a contact in the coils of vents and shut-off valve; their
    timers leave the bench time to brake by air.
    """

    pressure: Annotated[float, Range(2e5, 1.2e6, "Pa absolute")] = 8.0e5
    """Regulated pressure, Pa absolute."""
    feed_conductance: Conductance = 3.0e-7
    """Conductance from the reservoir through the soft-start valve, m3/(s Pa)."""
    volume: Annotated[float, Range(1e-5, 1.0, "m3")] = 0.002
    """Manifold volume between soft-start valve and spools, m3; small, so that a supply cut acts at once."""
    dump_conductance: Conductance = 4.0e-7
    """Conductance of the manifold's dump valve, m3/(s Pa)."""
    soft_start_time: Annotated[float, Range(0.001, 30.0, "s")] = 0.3
    """Time from closed to fully open, s."""
    vent_conductance: Conductance = 5.0e-9
    """Conductance of one chamber's throttle behind the two vents, either of which opens it, m3/(s Pa)."""
    vent_delay: Annotated[float, Range(0.0, 30.0, "s")] = 0.5
    """Delay from loss of power to open vents (pneumatic timer), s."""
    shut_off_delay: Annotated[float, Range(0.0, 30.0, "s")] = field(default=0.8, metadata={"optional": True})
    """Delay from loss of power to a shut shut-off valve (pneumatic timer), s."""
    relief_pressure: Annotated[float, Range(2e5, 3e6, "Pa absolute")] = 1.05e6
    """Opening pressure of the relief valve of each chamber, Pa absolute."""
    relief_conductance: Conductance = 1.0e-7
    """Conductance of a relief valve fully open, 0.5 bar above its pressure, m3/(s Pa)."""
    manifold_relief_ratio: Annotated[float, Range(1.0, 5.0, "")] = field(
        default=1.1, metadata={"optional": True}
    )
    """Opening pressure of the manifold's relief valve over the regulated one; no healthy swing reaches it."""
    manifold_relief_conductance: Conductance = field(default=4.0e-7, metadata={"optional": True})
    """Conductance of that relief valve fully open, 0.5 bar above its pressure, m3/(s Pa)."""
    atmosphere: Annotated[float, Range(5e4, 1.1e5, "Pa absolute")] = 1.013e5
    """Atmospheric pressure, Pa."""
    polytropic_exponent: Annotated[float, Range(1.0, 1.4, "")] = 1.2
    """Exponent of the chambers: 1.0 isothermal ... 1.4 adiabatic."""

    @property
    def manifold_relief_pressure(self) -> float:
        """Opening pressure of the manifold's relief valve, Pa absolute."""
        return self.manifold_relief_ratio * self.pressure


@compiled
def stop_force(stiffness: float, travel: float, damping_speed: float, depth: float, speed: float) -> float:
    """Return the force of an absorber compressed by `depth` (> 0) at `speed` (positive inwards).

    Spring with position-dependent damping (Hunt & Crossley 1975), so that force and energy are continuous
    and it never pulls. Beyond the absorber's travel the structure is twenty times as stiff.
    """
    factor = max(1.0 + speed / damping_speed, 0.0)
    force = stiffness * depth
    if depth > travel:
        force += 20.0 * stiffness * (depth - travel)
    return force * factor
