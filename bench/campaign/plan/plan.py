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
    """Its levels take turns within a block; the other two factors make sections, one after the other."""
    balls: tuple[str, ...]
    clubs: tuple[str, ...]
    swings: tuple[str, ...]
    blocks: Annotated[int, Range(1, 100000, "")]
    """Complete blocks in each section."""
    hits_per_mounting: Annotated[int, Range(0, 1000, "")]
    """Hits of each ball before the next club is mounted (split-plot); 0: clubs in any order."""
    seed: Annotated[int, Range(0, 2**31 - 1, "")]
    """Seed of the shot order."""
    seconds_per_shot: Annotated[float, Range(1.0, 3600.0, "s")]
    repeats: Annotated[int, Range(0, 20, "")]
    """Max number of repeats of a shot that was not valid."""
    failures_in_a_row: Annotated[int, Range(1, 100, "")]
    """Number of consecutive shots not valid after which the campaign is suspended."""


@dataclass(frozen=True)
class Control:
    """The control ball, which separates drift from differences."""

    ball: str
    """Hit at start, middle and end of each block; empty: none."""


@dataclass(frozen=True)
class WarmUp:
    """Swings before each section, until the club speed is stable."""

    window: Annotated[int, Range(2, 50, "")]
    """Number of last shots that are checked."""
    tolerance: Annotated[float, Range(0.0, 50.0, "m/s")]
    """Max range of their club speeds, m/s."""
    at_most: Annotated[int, Range(0, 200, "")]
    """Shots after which the campaign is refused; 0: no warm-up."""
    practice: bool
    """A swing without a ball after each arming of a bench that stays armed between shots."""


@dataclass(frozen=True)
class BallHandling:
    """Physical balls of each model, and how they are kept."""

    samples: Annotated[int, Range(1, 1000, "")]
    """Number of balls of each model, numbered from `first_sample`, used in turn."""
    first_sample: Annotated[int, Range(1, 100000, "")]
    hits: Annotated[int, Range(1, 10000, "")]
    """Max hits of a ball in all campaigns of this bench together."""
    temperature: Annotated[float, Range(250.0, 330.0, "K")]
    temperature_tolerance: Annotated[float, Range(0.0, 20.0, "K")]
    conditioning_time: Annotated[float, Range(0.0, 1e6, "s")]
    identify: bool
    """The feeder's reading of a ball's number must be the expected one."""
    magazine: Annotated[int, Range(0, 1000, "")]
    """Balls per filling of the feeder by a person, in the listed order; 0: the feeder finds each."""


@dataclass(frozen=True)
class Learning:
    """Corrections of the swings, see `golfbench learn`."""

    refresh: bool
    """Relearn a swing between blocks if its delivery has drifted."""
    swings: Annotated[int, Range(1, 100, "")]
    """Max number of swings for relearning."""


@dataclass(frozen=True)
class SupplyRequirement:
    """The air that a running bench must have before each swing."""

    min_pressure_ratio: Annotated[float, Range(0.0, 1.5, "")]
    """Share of the pressure that the swing was designed for; 0: not checked."""
    timeout: Annotated[float, Range(0.0, 86400.0, "s")]
    """Held at its address until the pressure is back; then the robot is vented and a person is needed."""


@dataclass(frozen=True)
class AirSettings:
    """The air at a running bench; a simulated one has the configured air."""

    valid_for: Annotated[float, Range(0.0, 1e6, "s")]
    """Validity of a reading (`golfbench campaign air`), s; shots without one have no air."""


@dataclass(frozen=True)
class HandWork:
    """Time that work by hand takes, for the expected duration."""

    club_change: Annotated[float, Range(0.0, 36000.0, "s")]
    """Time from the prompt until the guard is locked again."""
    feeder_fill: Annotated[float, Range(0.0, 36000.0, "s")]


@dataclass(frozen=True)
class InterruptionSettings:
    """Reaction to a time without shots."""

    restart_after: Annotated[float, Range(0.0, 1e6, "s")]
    """Time without a shot, s, after which the robot is warmed up again and its block restarted; 0: never."""


@dataclass(frozen=True)
class Gate:
    """Tolerances (half widths) of the delivery; 0: not checked. Never the ball's result."""

    reference: Literal["warm-up", "planned"]
    """Centre: the median of the warm-up's last shots, or the designed delivery."""
    club_speed: Annotated[float, Range(0.0, 50.0, "m/s")]
    attack_angle: Annotated[float, Range(0.0, pi / 4, "rad")]
    shaft_lean: Annotated[float, Range(0.0, pi / 4, "rad")]
    """Tolerance of the dynamic loft, which follows the shaft lean."""
    strike_x: Annotated[float, Range(0.0, 0.05, "m")]
    strike_y: Annotated[float, Range(0.0, 0.05, "m")]
    sources: tuple[str, ...]
    """Sources whose delivery counts."""


@dataclass(frozen=True)
class Stop:
    """When a section has enough shots before all its blocks are done."""

    rule: Literal["fixed", "width", "equivalence"]
    """All blocks; or every interval of a difference narrow enough; or every pair shown to be the same."""
    width: Annotated[float, Range(0.0, 1e6, "")]
    """Max half width of a difference's interval, in the unit of the compared quantity."""
    min_blocks: Annotated[int, Range(2, 100000, "")]
    interim_analyses: Annotated[int, Range(1, 50, "")]
    """Number of looks at the data, evenly from min_blocks to blocks, the end included."""


@dataclass(frozen=True)
class Analysis:
    """Question of the campaign, fixed before its first shot."""

    quantity: Quantity
    carry: Literal["", "reference", "monitor", "measured"]
    """Which carry `carry_m` is, see `bench.campaign.plan.carry`; empty: the simulated ball's, none on
    hardware."""
    expected_sd: Annotated[float, Range(0.0, 1e6, "")]
    """Expected standard deviation of one shot, unit of the quantity; 0: unknown, no power is predicted."""
    ball_sd: Annotated[float, Range(0.0, 1e6, "")]
    """Expected standard deviation between balls of one model, in the same unit; 0: one ball is as another."""
    mounting_sd: Annotated[float, Range(0.0, 1e6, "")]
    """Expected standard deviation between mountings of one club, in the same unit."""
    covariates: tuple[Delivered, ...]
    """Figures of the delivery by which a ball's result is corrected, fixed before the first shot."""
    expected_r_squared: Annotated[float, Range(0.0, 0.9999, "")]
    """Expected share of `sd` squared that the covariates explain."""
    target_difference: Annotated[float, Range(1e-9, 1e6, "")]
    """Difference worth finding."""
    equivalence_margin: Annotated[float, Range(0.0, 1e6, "")]
    """Differences below it count as the same (TOST); 0: not asked."""
    confidence: Annotated[float, Range(0.5, 0.9999, "")]
    power: Annotated[float, Range(0.5, 0.9999, "")]
    drift: Literal["linear", "none"]
    """Whether the control ball removes drift within blocks; the report also has the other analysis."""
    reference: str
    """Level that the report compares the others with; empty: the first one."""


@dataclass(frozen=True)
class SetUp:
    """The machine is set by the control ball's speed; the club's is a reference only (2025 practice)."""

    control_ball_speed: Annotated[float, Range(0.0, 120.0, "m/s")]
    """0: not checked."""
    tolerance: Annotated[float, Range(0.0, 20.0, "m/s")]
    control_restitution: Annotated[float, Range(0.0, 1.0, "")]
    """Restitution of the control ball at 143.8 ft/s; 0: unknown. With the contact time it sets a rule's ball
    speed."""
    control_contact_time: Annotated[float, Range(0.0, 0.002, "s")]
    """Contact time of the control ball at 143.8 ft/s."""


@dataclass(frozen=True)
class Rules:
    """Dated rules for the figures."""

    apply: tuple[str, ...]
    """Names of rule sets, or of families of which the date chooses, see `bench/campaign/plan/rules.toml`."""
    uncertainty: dict[str, Annotated[float, Range(0.0, 1e3, "")]] = field(default_factory=dict)
    """Quantity -> standard uncertainty of its measurement besides the scatter, SI; rules need it."""


@dataclass(frozen=True)
class ReportParticulars:
    """Statements on laboratory, customer and method (ISO/IEC 17025:2017, 7.8); may be empty."""

    laboratory: str
    address: str
    location: str
    """Place of the tests if it is not the laboratory's address."""
    customer: str
    customer_contact: str
    operator: str
    """Who does the tests; empty: who starts the runs."""
    method: str
    """Identification of the method besides this plan."""
    sampling: str
    """How and by whom the items were taken from what they stand for."""
    deviations: tuple[str, ...]
    """Additions to, deviations and exclusions from the method that no event of the campaign shows."""


@dataclass(frozen=True)
class ItemParticulars:
    """A tested item, a ball model or a club, as received."""

    identity: str = field(default="", metadata={"optional": True})
    """Maker, model, lot, marking."""
    condition: str = field(default="", metadata={"optional": True})
    received: str = field(default="", metadata={"optional": True})
    """Date of receipt, YYYY-MM-DD."""


@dataclass(frozen=True)
class StatedCalibration:
    """A calibration of an instrument that the bench itself does not know."""

    instrument: str
    identity: str = field(default="", metadata={"optional": True})
    """Type and serial number."""
    source: str = field(default="", metadata={"optional": True})
    """Laboratory and certificate."""
    date: str = field(default="", metadata={"optional": True})
    """YYYY-MM-DD."""
    due: str = field(default="", metadata={"optional": True})
    """Date of the next one, YYYY-MM-DD."""
    uncertainty: dict[str, Annotated[float, Range(0.0, 1e6, "")]] = field(
        default_factory=dict, metadata={"optional": True}
    )
    """Quantity -> standard uncertainty, one of `STATED`; SI, angles in degrees."""
    dof: Annotated[float, Range(0.0, 1e6, "")] = field(default=0.0, metadata={"optional": True})
    """Its degrees of freedom; 0: infinite."""

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
    """Scatter of the launch monitor's carry about the flight of the true launch."""
    drift: Annotated[float, Range(-0.1, 0.1, "")]
    wear: Annotated[float, Range(0.0, 10.0, "")]
    launch_missing: Annotated[float, Range(0.0, 1.0, "")]
    launch_misread: Annotated[float, Range(0.0, 1.0, "")]
    launch_double: Annotated[float, Range(0.0, 1.0, "")]
    missing_launch: tuple[int, ...]
    missed_ball: tuple[int, ...]
    feeder_jam: tuple[int, ...]
    wrong_ball: tuple[int, ...]
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
    air: AirSettings
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
    """Balls and clubs as received."""
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
