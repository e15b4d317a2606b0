"""The plan of a campaign as values: swings, clubs and balls, their order, and the question.

`bench.campaign.plan.plan_file` reads and checks its TOML file. `defaults.toml` lists every key with its unit
and meaning.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from math import inf, pi
from typing import Annotated, Any, Literal, NamedTuple, get_args

from drivers.base.ranges import Range
from sim.ball import Ball
from sim.robot import Club

Quantity = Literal[
    "carry_m", "total_m", "ball_speed_mps", "launch_angle", "spin_rpm", "club_speed_mps", "landing_angle"
]
"""Quantities that can be compared; angles in degrees."""
Factor = Literal["ball", "club", "swing"]
FLOWN = frozenset({"carry_m", "total_m", "landing_angle"})
"""Quantities of the flight: which carry they belong to must be named on hardware."""
Delivered = Literal[
    "club_speed_mps",
    "attack_angle_deg",
    "club_path_deg",
    "face_angle_deg",
    "dynamic_loft_deg",
    "strike_x_mm",
    "strike_y_mm",
]
"""Figures of the delivery that can be covariates."""
NAMES: Mapping[str, str] = {
    "club_speed_mps": "club speed",
    "attack_angle_deg": "attack angle",
    "club_path_deg": "club path",
    "face_angle_deg": "face angle",
    "dynamic_loft_deg": "dynamic loft",
    "strike_x_mm": "strike heel to toe",
    "strike_y_mm": "strike low to high",
    "ball_speed_mps": "ball speed",
    "launch_angle_deg": "launch angle",
    "launch_angle": "launch angle",
    "spin_rpm": "spin",
    "carry_m": "carry",
    "carry_side_m": "offline",
    "total_m": "total distance",
    "apex_m": "apex",
    "landing_angle_deg": "landing angle",
    "landing_angle": "landing angle",
    "air_temperature_k": "air temperature",
    "air_pressure_pa": "air pressure",
    "relative_humidity": "air humidity",
}
"""Names of the columns of the shot table and of the quantities in sentences."""


@dataclass(frozen=True)
class Heading:
    """Name and title of the campaign."""

    name: str
    title: str


@dataclass(frozen=True)
class ExperimentDesign:
    """Levels, blocks and order of the shots."""

    compare: Factor
    balls: tuple[str, ...]
    clubs: tuple[str, ...]
    swings: tuple[str, ...]
    blocks: Annotated[int, Range(1, 100000, "")]
    hits_per_mounting: Annotated[int, Range(0, 1000, "")]
    seed: Annotated[int, Range(0, 2**31 - 1, "")]
    seconds_per_shot: Annotated[float, Range(1.0, 3600.0, "s")]
    repeats: Annotated[int, Range(0, 20, "")]
    failures_in_a_row: Annotated[int, Range(1, 100, "")]


@dataclass(frozen=True)
class Control:
    """The control ball, which separates drift from differences."""

    ball: str


@dataclass(frozen=True)
class WarmUp:
    """Swings before each section, until the club speed is stable."""

    window: Annotated[int, Range(2, 50, "")]
    tolerance: Annotated[float, Range(0.0, 50.0, "m/s")]
    at_most: Annotated[int, Range(0, 200, "")]
    practice: bool


@dataclass(frozen=True)
class BallHandling:
    """Physical balls of each model, and how they are kept."""

    samples: Annotated[int, Range(1, 1000, "")]
    first_sample: Annotated[int, Range(1, 100000, "")]
    hits: Annotated[int, Range(1, 10000, "")]
    temperature: Annotated[float, Range(250.0, 330.0, "K")]
    temperature_tolerance: Annotated[float, Range(0.0, 20.0, "K")]
    conditioning_time: Annotated[float, Range(0.0, 1e6, "s")]
    magazine: Annotated[int, Range(0, 1000, "")]


@dataclass(frozen=True)
class Learning:
    """Corrections of the swings, see `golfbench learn`."""

    refresh: bool
    swings: Annotated[int, Range(1, 100, "")]


@dataclass(frozen=True)
class SupplyRequirement:
    """The air that a running bench must have before each swing."""

    min_pressure_ratio: Annotated[float, Range(0.0, 1.5, "")]


@dataclass(frozen=True)
class HandWork:
    """Time that work by hand takes, for the expected duration."""

    club_change: Annotated[float, Range(0.0, 36000.0, "s")]
    feeder_fill: Annotated[float, Range(0.0, 36000.0, "s")]


@dataclass(frozen=True)
class InterruptionSettings:
    """Reaction to a time without shots."""

    restart_after: Annotated[float, Range(0.0, 1e6, "s")]


@dataclass(frozen=True)
class Gate:
    """Tolerances (half widths) of the delivery; 0: not checked. Never the ball's result."""

    reference: Literal["warm-up", "planned"]
    club_speed: Annotated[float, Range(0.0, 50.0, "m/s")]
    attack_angle: Annotated[float, Range(0.0, pi / 4, "rad")]
    shaft_lean: Annotated[float, Range(0.0, pi / 4, "rad")]
    strike_x: Annotated[float, Range(0.0, 0.05, "m")]
    strike_y: Annotated[float, Range(0.0, 0.05, "m")]
    sources: tuple[Literal["simulated", "encoders+model", "launch monitor"], ...]


@dataclass(frozen=True)
class Stop:
    """When a section has enough shots before all its blocks are done."""

    rule: Literal["fixed", "width", "equivalence"]
    width: Annotated[float, Range(0.0, 1e6, "")]
    min_blocks: Annotated[int, Range(2, 100000, "")]
    interim_analyses: Annotated[int, Range(1, 50, "")]


@dataclass(frozen=True)
class Analysis:
    """Question of the campaign, fixed before its first shot."""

    quantity: Quantity
    carry: Literal["", "reference", "monitor", "measured"]
    expected_sd: Annotated[float, Range(0.0, 1e6, "")]
    ball_sd: Annotated[float, Range(0.0, 1e6, "")]
    mounting_sd: Annotated[float, Range(0.0, 1e6, "")]
    covariates: tuple[Delivered, ...]
    expected_r_squared: Annotated[float, Range(0.0, 0.9999, "")]
    target_difference: Annotated[float, Range(1e-9, 1e6, "")]
    equivalence_margin: Annotated[float, Range(0.0, 1e6, "")]
    confidence: Annotated[float, Range(0.5, 0.9999, "")]
    power: Annotated[float, Range(0.5, 0.9999, "")]
    drift: Literal["linear", "none"]
    reference: str


@dataclass(frozen=True)
class SetUp:
    """The machine is set by the control ball's speed; the club's is a reference only (2025 practice)."""

    control_ball_speed: Annotated[float, Range(0.0, 120.0, "m/s")]
    tolerance: Annotated[float, Range(0.0, 20.0, "m/s")]
    control_restitution: Annotated[float, Range(0.0, 1.0, "")]
    control_contact_time: Annotated[float, Range(0.0, 0.002, "s")]


@dataclass(frozen=True)
class Rules:
    """Dated rules for the figures."""

    apply: tuple[str, ...]
    uncertainty: dict[str, Annotated[float, Range(0.0, 1e3, "")]] = field(default_factory=dict)


@dataclass(frozen=True)
class ReportParticulars:
    """Statements on laboratory, customer and method (ISO/IEC 17025:2017, 7.8); may be empty."""

    laboratory: str
    address: str
    location: str
    customer: str
    customer_contact: str
    operator: str
    method: str
    sampling: str
    deviations: tuple[str, ...]


@dataclass(frozen=True)
class ItemParticulars:
    """A tested item, a ball model or a club, as received."""

    identity: str = field(default="", metadata={"optional": True})
    condition: str = field(default="", metadata={"optional": True})
    received: str = field(default="", metadata={"optional": True})


@dataclass(frozen=True)
class StatedCalibration:
    """A calibration of an instrument that the bench itself does not know."""

    instrument: str
    identity: str = field(default="", metadata={"optional": True})
    source: str = field(default="", metadata={"optional": True})
    date: str = field(default="", metadata={"optional": True})
    due: str = field(default="", metadata={"optional": True})
    uncertainty: dict[str, Annotated[float, Range(0.0, 1e6, "")]] = field(
        default_factory=dict, metadata={"optional": True}
    )
    dof: Annotated[float, Range(0.0, 1e6, "")] = field(default=0.0, metadata={"optional": True})

    @property
    def text(self) -> str:
        """Instrument, source and date in a line."""
        return ", ".join(filter(None, (self.instrument, self.identity, self.source, self.date)))


STATED = (*get_args(Quantity), "air_temperature_k", "air_pressure_pa", "relative_humidity")
"""Quantities whose uncertainty a calibration may state."""


@dataclass(frozen=True)
class Simulation:
    """Scatter from shot to shot in `--sim` (standard deviations), and injected faults by shot."""

    supply: Annotated[float, Range(0.0, 0.2, "")]
    restitution: Annotated[float, Range(0.0, 0.2, "")]
    sample: Annotated[float, Range(0.0, 0.2, "")]
    encoders: Annotated[float, Range(0.0, 0.01, "rad")]
    ball_speed: Annotated[float, Range(0.0, 10.0, "m/s")]
    launch_angle: Annotated[float, Range(0.0, 0.2, "rad")]
    direction: Annotated[float, Range(0.0, 0.2, "rad")]
    spin_rpm: Annotated[float, Range(0.0, 5000.0, "1/min")]
    carry: Annotated[float, Range(0.0, 50.0, "m")]
    drift: Annotated[float, Range(-0.1, 0.1, "")]
    wear: Annotated[float, Range(0.0, 10.0, "")]
    missing_launch: tuple[int, ...]
    missed_ball: tuple[int, ...]
    feeder_jam: tuple[int, ...]
    guard_opened: tuple[int, ...]


@dataclass(frozen=True)
class CampaignPlan:
    """A campaign as its file plans it, with the balls and clubs it names."""

    campaign: Heading
    design: ExperimentDesign
    control: Control
    warm_up: WarmUp
    ball_handling: BallHandling
    learning: Learning
    supply: SupplyRequirement
    interruption: InterruptionSettings
    hand_work: HandWork
    gate: Gate
    stop: Stop
    analysis: Analysis
    set_up: SetUp
    rules: Rules
    report: ReportParticulars
    simulation: Simulation
    swings: dict[str, dict[str, str]] = field(default_factory=dict)
    """Swing -> club -> profile, where a swing's name is not its profile's."""
    preparation: dict[str, str] = field(default_factory=dict)
    """Work besides mounting it that a club needs, by club: its site, its tee."""
    items: dict[str, ItemParticulars] = field(default_factory=dict)
    calibrations: dict[str, StatedCalibration] = field(default_factory=dict)
    balls: dict[str, Ball] = field(default_factory=dict)
    clubs: dict[str, Club] = field(default_factory=dict)

    @property
    def ball_names(self) -> tuple[str, ...]:
        """All balls that are hit, the control ball last when it is not compared."""
        return tuple(dict.fromkeys((*self.design.balls, *filter(None, (self.control.ball,)))))

    @property
    def column(self) -> str:
        """Column of the shot table with the compared quantity."""
        quantity = self.analysis.quantity
        return f"{quantity}_deg" if quantity in {"launch_angle", "landing_angle"} else quantity

    def profile(self, swing: str, club: str) -> str:
        """Return the profile, a name or a path, that `club` swings as `swing`."""
        return self.swings.get(swing, {}).get(club, swing)

    @property
    def split(self) -> bool:
        """Whether it is a split-plot: a club stays mounted while the balls take turns."""
        return self.design.compare == "club" and self.design.hits_per_mounting > 0

    @property
    def shots_per_mounting(self) -> int:
        """Number of shots with a club in each block, repeats left out."""
        return self.design.hits_per_mounting * len(self.design.balls) if self.split else 1

    def record(self) -> dict[str, Any]:
        """Return the plan for JSON; `plan_from_record` reads it back."""
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return plain

    @property
    def digest(self) -> str:
        """16 hex digits that differ between different plans."""
        return sha256(json.dumps(self.record(), sort_keys=True).encode()).hexdigest()[:16]


def levels(plan: CampaignPlan) -> tuple[str, ...]:
    """Return the levels of the compared factor."""
    found: tuple[str, ...] = getattr(plan.design, f"{plan.design.compare}s")
    return found


def reference_level(plan: CampaignPlan) -> str:
    """Return the level that the report compares the others with."""
    return plan.analysis.reference or levels(plan)[0]


class StatedUncertainty(NamedTuple):
    """A standard uncertainty of a quantity besides its scatter, as a plan states it."""

    uncertainty: float
    dof: float
    source: str


def stated_uncertainties(plan: CampaignPlan, quantity: str) -> list[StatedUncertainty]:
    """Return the uncertainties of a quantity: from [rules.uncertainty] as a whole, else from calibrations."""
    if quantity in plan.rules.uncertainty:
        return [StatedUncertainty(plan.rules.uncertainty[quantity], inf, "the plan's [rules.uncertainty]")]
    return [
        StatedUncertainty(one.uncertainty[quantity], one.dof or inf, one.text)
        for one in plan.calibrations.values()
        if quantity in one.uncertainty
    ]
