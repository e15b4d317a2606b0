"""The plan of a campaign: one TOML file, checked before anything moves.

A file gives only what differs from `defaults.toml` beside this module, where every key, its unit and its
meaning stand. `[balls.x]` and `[clubs.x]` add to those of the configuration; `like` names the one they
resemble.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from difflib import get_close_matches
from hashlib import sha256
from math import pi
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from bench.config import Configuration
from bench.errors import BenchError
from bench.from_toml import Builder, Leaf, Tree, as_tree, laid_over, place_of, read_toml, shown
from sim.ball import Ball
from sim.ranges import Range
from sim.robot import Club

DEFAULTS = Path(__file__).with_name("defaults.toml")
EXAMPLES = Path(__file__).parent.parent / "campaigns"
"""Folder of the campaigns that come with golfbench; their names stand for their paths."""

Quantity = Literal[
    "carry_m", "total_m", "ball_speed_mps", "launch_angle", "spin_rpm", "club_speed_mps", "landing_angle"
]
"""What can be compared; angles are the columns in degrees."""
Factor = Literal["ball", "club", "swing"]

_Count = Annotated[int, Range(0, 100000, "")]
_Length = Annotated[float, Range(0.0, 1000.0, "m")]


@dataclass(frozen=True)
class Heading:
    """What the campaign is called."""

    name: str
    title: str


@dataclass(frozen=True)
class Design:
    """What is swung at what, in which order."""

    compare: Factor
    """Its levels take turns within a block; the other two factors make sections, one after the other."""
    balls: tuple[str, ...]
    clubs: tuple[str, ...]
    swings: tuple[str, ...]
    blocks: Annotated[int, Range(1, 100000, "")]
    """Complete blocks in each section."""
    seed: Annotated[int, Range(0, 2**31 - 1, "")]
    """Of the order."""
    seconds_per_shot: Annotated[float, Range(1.0, 3600.0, "s")]
    repeats: Annotated[int, Range(0, 20, "")]
    """Further attempts at a shot that was not valid."""
    failures_in_a_row: Annotated[int, Range(1, 100, "")]
    """Shots that are not valid, one after the other, after which the campaign is suspended."""


@dataclass(frozen=True)
class Control:
    """The control ball, which tells drift from difference."""

    ball: str
    """Hit at start, middle and end of each block; empty: none."""


@dataclass(frozen=True)
class WarmUp:
    """Swings before each section, until the club speed is stable."""

    window: Annotated[int, Range(2, 50, "")]
    """Last shots that are looked at."""
    tolerance: Annotated[float, Range(0.0, 50.0, "m/s")]
    """Greatest range of their club speeds."""
    at_most: Annotated[int, Range(0, 200, "")]
    """Shots after which the campaign is refused; 0: no warm-up."""


@dataclass(frozen=True)
class BallHandling:
    """Physical balls of each model, and how they are kept."""

    samples: Annotated[int, Range(1, 1000, "")]
    """Of each model, numbered from `first_sample`; they take turns."""
    first_sample: Annotated[int, Range(1, 100000, "")]
    hits: Annotated[int, Range(1, 10000, "")]
    """A ball may take, in all campaigns of this bench together."""
    temperature: Annotated[float, Range(250.0, 330.0, "K")]
    temperature_tolerance: Annotated[float, Range(0.0, 20.0, "K")]
    conditioning_time: Annotated[float, Range(0.0, 1e6, "s")]
    identify: bool
    """The feeder's reading of a ball's number must be the expected one."""


@dataclass(frozen=True)
class Gate:
    """Half widths of what counts as the same delivery; 0: not looked at. Never the ball's result."""

    centre: Literal["warm-up", "planned"]
    """The median of the warm-up's last shots, or what the swing was designed for."""
    club_speed: Annotated[float, Range(0.0, 50.0, "m/s")]
    attack_angle: Annotated[float, Range(0.0, pi / 4, "rad")]
    shaft_lean: Annotated[float, Range(0.0, pi / 4, "rad")]
    """Of the dynamic loft, which follows it."""
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
    """Greatest half width of a difference's interval, in the unit of the compared quantity."""
    blocks_at_least: Annotated[int, Range(2, 100000, "")]
    looks: Annotated[int, Range(1, 50, "")]
    """Times the data are looked at, evenly from blocks_at_least to blocks, the end included."""


@dataclass(frozen=True)
class Analysis:
    """What the campaign is to answer, said before its first shot."""

    quantity: Quantity
    deviation: Annotated[float, Range(0.0, 1e6, "")]
    """Expected standard deviation of one shot, unit of the quantity; 0: not known, no power is foretold."""
    difference: Annotated[float, Range(1e-9, 1e6, "")]
    """Worth finding."""
    margin: Annotated[float, Range(0.0, 1e6, "")]
    """Differences below it count as the same (TOST); 0: not asked."""
    confidence: Annotated[float, Range(0.5, 0.9999, "")]
    power: Annotated[float, Range(0.5, 0.9999, "")]
    drift: Literal["linear", "none"]
    """Taken out by the control ball within blocks; the other analysis stands beside it."""


@dataclass(frozen=True)
class SetUp:
    """The machine is set by the control ball's speed; the club's is a reference only (2025 practice)."""

    control_ball_speed: Annotated[float, Range(0.0, 120.0, "m/s")]
    """0: not looked at."""
    tolerance: Annotated[float, Range(0.0, 20.0, "m/s")]


@dataclass(frozen=True)
class Rules:
    """Which dated rules the figures are judged by."""

    apply: tuple[str, ...]
    """Names of rule sets, see `bench/campaign/rules.toml`."""


@dataclass(frozen=True)
class Simulation:
    """What differs from shot to shot in `--sim` (standard deviations), and what goes wrong in which shots."""

    supply: Annotated[float, Range(0.0, 0.2, "")]
    restitution: Annotated[float, Range(0.0, 0.2, "")]
    sample: Annotated[float, Range(0.0, 0.2, "")]
    encoders: Annotated[float, Range(0.0, 0.01, "rad")]
    ball_speed: Annotated[float, Range(0.0, 10.0, "m/s")]
    launch_angle: Annotated[float, Range(0.0, 0.2, "rad")]
    direction: Annotated[float, Range(0.0, 0.2, "rad")]
    spin_rpm: Annotated[float, Range(0.0, 5000.0, "1/min")]
    drift: Annotated[float, Range(-0.1, 0.1, "")]
    missing_launch: tuple[int, ...]
    missed_ball: tuple[int, ...]
    feeder_jam: tuple[int, ...]
    door_opened: tuple[int, ...]
    low_supply: tuple[int, ...]


@dataclass(frozen=True)
class Plan:
    """A campaign as its file plans it, with the balls and clubs it names."""

    campaign: Heading
    design: Design
    control: Control
    warm_up: WarmUp
    ball_handling: BallHandling
    gate: Gate
    stop: Stop
    analysis: Analysis
    set_up: SetUp
    rules: Rules
    simulation: Simulation
    balls: dict[str, Ball] = field(default_factory=dict)
    clubs: dict[str, Club] = field(default_factory=dict)

    @property
    def ball_names(self) -> tuple[str, ...]:
        """All balls that are hit, the control ball last when it is not compared."""
        return tuple(dict.fromkeys((*self.design.balls, *filter(None, (self.control.ball,)))))

    def record(self) -> dict[str, Any]:
        """Return the plan for JSON; `plan_from_record` reads it back."""
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return plain

    @property
    def digest(self) -> str:
        """16 hex digits that differ between different plans."""
        return sha256(json.dumps(self.record(), sort_keys=True).encode()).hexdigest()[:16]


def campaign_names() -> list[str]:
    """Return the names of the campaigns that come with golfbench."""
    return sorted(path.stem for path in EXAMPLES.glob("*.toml"))


def find_plan(wanted: Path) -> Path:
    """Return the file of a campaign: a path, or the name of one that comes with golfbench.

    Raises:
        BenchError: there is none; the text names the known ones.
    """
    if wanted.is_file():
        return wanted
    if len(wanted.parts) == 1 and wanted.name in campaign_names():
        return EXAMPLES / f"{wanted.name}.toml"
    near = get_close_matches(wanted.stem, campaign_names(), n=1)
    cure = f"Did you mean {near[0]}?" if near else "Correct the path."
    known = f"a path, or one of {', '.join(campaign_names())}"
    raise BenchError(f"campaign {wanted}", "no such file", known, cure)


def load_plan(path: Path, configuration: Configuration) -> Plan:
    """Return the checked plan at `path` (as `find_plan` takes it).

    Raises:
        BenchError: the file is missing, cannot be read, or is no TOML.
        ExceptionGroup: of BenchErrors, one for each mistake in it.
    """
    file = find_plan(path)
    faults: list[BenchError] = []
    given = as_tree(read_toml(file, "a campaign's plan", "Correct the path."), file, faults)
    known: dict[str, Mapping[str, Any]] = {"balls": configuration.balls, "clubs": configuration.clubs}
    entries = {name: _completed(name, given.pop(name, {}), known[name], file, faults) for name in known}
    base = as_tree(read_toml(DEFAULTS, "defaults", "Install golfbench anew."), DEFAULTS, faults)
    plan = _build({**laid_over(base, given), **entries}, file, faults)
    if plan is not None:
        balls, clubs = {**configuration.balls, **plan.balls}, {**configuration.clubs, **plan.clubs}
        for key, found, wanted, cure in _mistakes(plan, balls, clubs):
            faults.append(BenchError(place_of(given, file, key), found, wanted, cure))
        plan = replace(
            plan,
            balls={name: balls[name] for name in plan.ball_names if name in balls},
            clubs={name: clubs[name] for name in plan.design.clubs if name in clubs},
        )
    if plan is None or faults:
        raise ExceptionGroup(f"{file} does not hold", faults)
    return plan


def plan_from_record(record: Mapping[str, Any], place: str) -> Plan:
    """Return the plan that `Plan.record` gave.

    Raises:
        ExceptionGroup: of BenchErrors; it is one of another version of golfbench, or damaged.
    """
    faults: list[BenchError] = []
    tables = json.loads(json.dumps(record))
    for name in ("balls", "clubs"):
        for entry in tables.get(name, {}).values():
            entry.pop("name", None)
    plan = _build(as_tree(tables, Path(place), faults), Path(place), faults)
    if plan is None:
        raise ExceptionGroup(f"{place} does not hold", faults)
    return plan


def _build(tree: Tree, file: Path, faults: list[BenchError]) -> Plan | None:
    builder = Builder(
        tree, file, f"Correct it; keys and units: {DEFAULTS.name}.", "Add it.", frozenset(), faults
    )
    plan: Plan | None = builder.build(Plan)
    return plan


def _completed(
    section: str, node: Tree | Leaf, known: Mapping[str, Any], file: Path, faults: list[BenchError]
) -> Tree:
    """Return a section's entries, those that say `like` completed from the one it names."""
    if isinstance(node, Leaf):
        faults.append(BenchError(f"{file}: {section}", shown(node.value), "tables", "Write [balls.name]."))
        return {}
    done: Tree = {}
    for name, entry in node.items():
        if isinstance(entry, dict) and isinstance(like := entry.get("like"), Leaf):
            rest = {key: value for key, value in entry.items() if key != "like"}
            if like.value not in known:
                place = f"{file}: {section}.{name}.like"
                faults.append(
                    BenchError(place, shown(like.value), f"one of {', '.join(known)}", "Name one of them.")
                )
                continue
            other = known[like.value]
            values = {f.name: getattr(other, f.name) for f in fields(other) if f.init and f.name != "name"}
            done[name] = laid_over(as_tree(values, file, faults), rest)
        else:
            done[name] = entry
    return done


class Mistake(NamedTuple):
    """What several keys together do not hold."""

    key: str
    found: str
    expected: str
    cure: str


def _mistakes(plan: Plan, balls: Mapping[str, Ball], clubs: Mapping[str, Club]) -> Iterator[Mistake]:
    d, stop, analysis = plan.design, plan.stop, plan.analysis
    if not re.fullmatch(r"[a-z0-9][a-z0-9-]{0,40}", plan.campaign.name):
        yield Mistake(
            "campaign.name", shown(plan.campaign.name), "small letters, digits and -", "It names files."
        )
    for key, names, known in (
        ("design.balls", d.balls, balls),
        ("control.ball", filter(None, (plan.control.ball,)), balls),
        ("design.clubs", d.clubs, clubs),
    ):
        for name in names:
            if name not in known:
                near = get_close_matches(name, list(known), n=1)
                cure = f"Did you mean {near[0]}?" if near else f"Add [{key.split('.')[1]}.{name}]."
                yield Mistake(key, f"{shown(name)}, unknown", f"one of {', '.join(known)}", cure)
    for key, names in (("balls", d.balls), ("clubs", d.clubs), ("swings", d.swings)):
        if not names or len(set(names)) < len(names):
            yield Mistake(f"design.{key}", shown(list(names)), "at least one, each once", "Correct it.")
    if stop.rule != "fixed" and stop.blocks_at_least > d.blocks:
        yield Mistake(
            "stop.blocks_at_least", str(stop.blocks_at_least), f"up to design.blocks, {d.blocks}", "Lower it."
        )
    if stop.rule != "fixed" and stop.looks < 2:
        yield Mistake(
            "stop.looks", str(stop.looks), "at least 2: the last one is after all blocks", "Raise it."
        )
    if stop.rule == "width" and not stop.width:
        yield Mistake("stop.width", "0", "a half width above 0 for the rule width", "Set it.")
    if stop.rule == "equivalence" and not analysis.margin:
        yield Mistake("analysis.margin", "0", "a margin above 0 for the rule equivalence", "Set it.")
    if stop.rule != "fixed" and len(levels(plan)) < 2:
        yield Mistake("stop.rule", shown(stop.rule), '"fixed": there is one level only', "Correct it.")
    if plan.gate.centre == "warm-up" and not plan.warm_up.at_most:
        yield Mistake("gate.centre", '"warm-up"', '"planned", for there is no warm-up', "Correct it.")
    if plan.warm_up.at_most and plan.warm_up.at_most < plan.warm_up.window:
        found = str(plan.warm_up.at_most)
        yield Mistake("warm_up.at_most", found, f"at least window, {plan.warm_up.window}", "Raise it.")
    yield from _hits(plan)
    from bench.campaign.rules import rule_names

    for name in plan.rules.apply:
        if name not in rule_names():
            yield Mistake("rules.apply", shown(name), f"of {', '.join(rule_names())}", "Correct it.")


def _hits(plan: Plan) -> Iterator[Mistake]:
    """Tell of balls that would be hit more often than they may, repeats left out."""
    from bench.campaign.sequence import hits_needed

    handling = plan.ball_handling
    allowed = handling.samples * handling.hits
    for name, needed in hits_needed(plan).items():
        if needed > allowed:
            samples = -(-needed // handling.hits)
            yield Mistake(
                "ball_handling.samples",
                f"{handling.samples}; {needed} hits of {shown(name)} are planned",
                f"at most {handling.samples} x {handling.hits} = {allowed} hits",
                f"Take {samples} samples of each ball, or fewer blocks.",
            )


def levels(plan: Plan) -> tuple[str, ...]:
    """Return the levels of the compared factor."""
    found: tuple[str, ...] = getattr(plan.design, f"{plan.design.compare}s")
    return found


def controls_per_block(plan: Plan) -> int:
    """Return how often a block hits the control ball: at start and end, and between where there is one."""
    return 0 if not plan.control.ball else 2 + (len(levels(plan)) > 1)
