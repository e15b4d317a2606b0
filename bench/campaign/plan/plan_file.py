"""The plan of a campaign in a TOML file, checked before anything moves.

A file gives only the differences from `defaults.toml`, which lists every key with its unit and meaning.
`[balls.x]` and `[clubs.x]` add to those of the configuration; `like` names the one they resemble.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import fields, replace
from datetime import date
from pathlib import Path
from typing import Any, get_args

from bench.base.errors import BenchError, did_you_mean
from bench.base.from_toml import (
    Builder,
    Mistake,
    TomlValue,
    Tree,
    as_tree,
    errors_of,
    format_value,
    laid_over,
    read_toml,
    without,
)
from bench.campaign.plan.conformity_rules import rule_names
from bench.campaign.plan.plan import STATED, CampaignPlan, Quantity, levels
from bench.campaign.plan.shot_sequence import hits_needed
from bench.config import Configuration, variants_with
from sim.ball import Ball
from sim.robot import Club

CAMPAIGN_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,40}")
"""Name of a campaign, part of its id and of file names."""
DEFAULTS = Path(__file__).with_name("defaults.toml")
EXAMPLES = Path(__file__).parents[2] / "campaigns"
"""Folder of the shipped campaigns, which are found by name."""


def campaign_names() -> list[str]:
    """Return the names of the shipped campaigns."""
    return sorted(path.stem for path in EXAMPLES.glob("*.toml"))


def find_plan(wanted: Path) -> Path:
    """Return the file of a campaign: a path, or the name of a shipped one.

    Raises:
        BenchError: there is no such file; the text names the shipped ones.
    """
    if wanted.is_file():
        return wanted
    if len(wanted.parts) == 1 and wanted.name in campaign_names():
        return EXAMPLES / f"{wanted.name}.toml"
    action = did_you_mean(wanted.stem, campaign_names(), "Correct the path.")
    known = f"a path, or one of {', '.join(campaign_names())}"
    raise BenchError(f"campaign {wanted}", "no such file", known, action)


def load_plan(path: Path, configuration: Configuration) -> CampaignPlan:
    """Return the checked plan at `path` (as `find_plan` takes it).

    Raises:
        BenchError: the file is missing, cannot be read, or is no TOML.
        ExceptionGroup: one BenchError per mistake in it.
    """
    file = find_plan(path)
    faults: list[BenchError] = []
    given = as_tree(read_toml(file, "a campaign's plan", "Correct the path."), file, faults)
    known: dict[str, Mapping[str, Any]] = {"balls": configuration.balls, "clubs": configuration.clubs}
    entries: Tree = {name: _completed(name, given.pop(name, {}), known[name], file, faults) for name in known}
    base = as_tree(read_toml(DEFAULTS, "defaults", "Reinstall golfbench."), DEFAULTS, faults)
    plan, wrong = _build({**laid_over(base, given), **entries}, file, faults)
    if plan is None:  # with their defaults in place of wrong values the others show what contradicts itself
        plan, _ = _build({**laid_over(base, without(given, wrong)), **without(entries, wrong)}, file, [])
    if plan is not None:
        balls, clubs = {**configuration.balls, **plan.balls}, {**configuration.clubs, **plan.clubs}
        found = (mistake for mistake in _mistakes(plan, balls, clubs) if mistake[0] not in wrong)
        faults += errors_of(found, given, file)
        plan = replace(
            plan,
            balls={name: balls[name] for name in plan.ball_names if name in balls},
            clubs={name: clubs[name] for name in plan.design.clubs if name in clubs},
        )
    if plan is None or faults:
        raise ExceptionGroup(f"{file} is invalid", faults)
    return plan


def plan_from_record(record: Mapping[str, Any], location: str) -> CampaignPlan:
    """Return the plan that `CampaignPlan.record` gave.

    Raises:
        ExceptionGroup: BenchErrors of a record that is damaged or of another version of golfbench.
    """
    faults: list[BenchError] = []
    tables = json.loads(json.dumps(record))
    for name in ("balls", "clubs"):
        for entry in tables.get(name, {}).values():
            entry.pop("name", None)
    plan, _ = _build(as_tree(tables, Path(location), faults), Path(location), faults)
    if plan is None:
        raise ExceptionGroup(f"{location} is invalid", faults)
    return plan


def _build(tree: Tree, file: Path, faults: list[BenchError]) -> tuple[CampaignPlan | None, set[str]]:
    """Return the plan of `tree`, None with `faults`, and the keys that have them."""
    action = f"Correct it; keys and units: {DEFAULTS.name}."
    builder = Builder(tree, file, action, "Add it.", frozenset(), faults)
    plan: CampaignPlan | None = builder.build(CampaignPlan)
    return plan, builder.wrong


def _completed(
    section: str, node: Tree | TomlValue, known: Mapping[str, Any], file: Path, faults: list[BenchError]
) -> Tree:
    """Return a section's entries, those that say `like` completed from the one it names."""
    if isinstance(node, TomlValue):
        action = "Write a table such as [balls.name]."
        faults.append(BenchError(f"{file}: {section}", format_value(node.value), "tables", action))
        return {}
    done: Tree = {}
    for name, entry in node.items():
        if isinstance(entry, dict) and isinstance(like := entry.get("like"), TomlValue):
            rest = {key: value for key, value in entry.items() if key != "like"}
            if not isinstance(like.value, str) or like.value not in known:
                location, expected = f"{file}: {section}.{name}.like", f"one of {', '.join(known)}"
                faults.append(BenchError(location, format_value(like.value), expected, "Name one of them."))
                continue
            other = known[like.value]
            values = {f.name: getattr(other, f.name) for f in fields(other) if f.init and f.name != "name"}
            done[name] = laid_over(as_tree(values, file, faults), rest)
        else:
            done[name] = entry
    return done


def _unknown_action(section: str, name: str, known: Mapping[str, Any]) -> str:
    """Return what to do about the `name` that `section` of plan and configuration lacks."""
    if variants := variants_with(section, name):
        use = " or ".join(f"golfbench --config {one}" for one in variants)
        return f"Use a shipped variant that has it: {use}; or add it to [{section}]."
    return did_you_mean(name, known, f"Add [{section}.{name}].")


def _mistakes(plan: CampaignPlan, balls: Mapping[str, Ball], clubs: Mapping[str, Club]) -> Iterator[Mistake]:
    d = plan.design
    if not CAMPAIGN_NAME.fullmatch(plan.campaign.name):
        found, wanted = format_value(plan.campaign.name), "small letters, digits and -"
        yield "campaign.name", found, wanted, "Rename it: the name is part of file names."
    for key, section, names, known in (
        ("design.balls", "balls", d.balls, balls),
        ("control.ball", "balls", filter(None, (plan.control.ball,)), balls),
        ("design.clubs", "clubs", d.clubs, clubs),
    ):
        for name in names:
            if name not in known:
                action = _unknown_action(section, name, known)
                yield key, f"{format_value(name)}, unknown", f"one of {', '.join(known)}", action
    for key, names in (("balls", d.balls), ("clubs", d.clubs), ("swings", d.swings)):
        for name in names:
            if not name or name != name.strip() or not name.isprintable():
                wanted = "a name of printable characters, without spaces at its ends"
                yield f"design.{key}", format_value(name), wanted, "Reports and prompts show it."
        if not names or len(set(names)) < len(names):
            found, action = format_value(list(names)), f"Correct the list design.{key}."
            yield f"design.{key}", found, "at least one name, each once", action
    yield from _unknown("swings", plan.swings, d.swings, "Add it to design.swings.")
    for swing, profiles in plan.swings.items():
        yield from _unknown(f"swings.{swing}", profiles, d.clubs, "Add it to design.clubs.")
    yield from _unknown("preparation", plan.preparation, d.clubs, "Add it to design.clubs.")
    yield from _stop(plan)
    yield from _split(plan)
    if 0 < plan.interruption.restart_after <= d.seconds_per_shot:
        found = f"{plan.interruption.restart_after:g}"
        expected = f"more than design.seconds_per_shot, {d.seconds_per_shot:g}; or 0"
        yield "interruption.restart_after", found, expected, "Every shot would restart its block."
    if plan.gate.reference == "warm-up" and not plan.warm_up.at_most:
        wanted = '"planned", as warm_up.at_most is 0'
        yield "gate.reference", '"warm-up"', wanted, 'Set gate.reference = "planned".'
    if plan.warm_up.at_most and plan.warm_up.at_most < plan.warm_up.window:
        found = str(plan.warm_up.at_most)
        yield "warm_up.at_most", found, f"at least window, {plan.warm_up.window}", "Raise it."
    if not plan.gate.sources:
        yield "gate.sources", "[]", "at least one source", "Name those whose delivery counts."
    if plan.analysis.reference and plan.analysis.reference not in levels(plan):
        found, wanted = format_value(plan.analysis.reference), f"one of {', '.join(levels(plan))}"
        action = did_you_mean(plan.analysis.reference, levels(plan), f"Use one of design.{d.compare}s.")
        yield "analysis.reference", found, wanted, action
    yield from _carry(plan)
    yield from _hits(plan)
    yield from _covariates(plan)
    yield from _rules(plan)
    yield from _particulars(plan)


def _unknown(table: str, given: Iterable[str], known: Collection[str], action: str) -> Iterator[Mistake]:
    """Yield an error for each key `given` in `table` that is not `known`."""
    for name in given:
        if name not in known:
            wanted = f"one of {', '.join(known)}"
            yield f"{table}.{name}", format_value(name), wanted, did_you_mean(name, known, action)


def _stop(plan: CampaignPlan) -> Iterator[Mistake]:
    stop, d = plan.stop, plan.design
    if stop.rule != "fixed" and stop.min_blocks > d.blocks:
        wanted = f"up to design.blocks, {d.blocks}"
        yield "stop.min_blocks", str(stop.min_blocks), wanted, "Lower it."
    if stop.rule != "fixed" and stop.interim_analyses < 2:
        found, wanted = str(stop.interim_analyses), "at least 2: the last one is after all blocks"
        yield "stop.interim_analyses", found, wanted, "Raise it."
    if stop.rule == "width" and not stop.width:
        yield "stop.width", "0", "a half width above 0 for the rule width", "Set it."
    if stop.rule == "equivalence" and not plan.analysis.equivalence_margin:
        yield "analysis.equivalence_margin", "0", "a margin above 0 for the rule equivalence", "Set it."
    if stop.rule != "fixed" and len(levels(plan)) < 2:
        wanted = '"fixed", as there is one level only'
        yield "stop.rule", format_value(stop.rule), wanted, 'Set stop.rule = "fixed".'


def _split(plan: CampaignPlan) -> Iterator[Mistake]:
    """Yield an error if a split-plot could not answer its question."""
    d = plan.design
    if not d.hits_per_mounting:
        return
    if d.compare != "club":
        found = f"{d.hits_per_mounting}, comparing {d.compare}s"
        action = "Leave it out: each club is a section, and is mounted once."
        yield "design.hits_per_mounting", found, "0 unless clubs are compared", action
        return
    if len(d.clubs) > 1 and d.blocks < 2:
        action = "Each club is mounted once in each block; one mounting does not show how mountings differ."
        yield "design.blocks", str(d.blocks), "at least 2 in a split-plot", action
    if plan.control.ball:
        found, action = format_value(plan.control.ball), "Leave it out: blocks take the drift out of clubs."
        yield "control.ball", found, "none in a split-plot", action


def _rules(plan: CampaignPlan) -> Iterator[Mistake]:
    for name in plan.rules.apply:
        if name not in rule_names():
            wanted = f"one of {', '.join(rule_names())}"
            yield "rules.apply", format_value(name), wanted, "Correct the name in rules.apply."
    s = plan.set_up
    if bool(s.control_restitution) != bool(s.control_contact_time):
        missing = "control_contact_time" if s.control_restitution else "control_restitution"
        yield f"set_up.{missing}", "0", "both figures of the control ball, or neither", "Add it."
    action = "Correct the key below [rules.uncertainty]."
    yield from _unknown("rules.uncertainty", plan.rules.uncertainty, get_args(Quantity), action)


def _particulars(plan: CampaignPlan) -> Iterator[Mistake]:
    known = (*plan.ball_names, *plan.design.clubs)
    yield from _unknown("items", plan.items, known, "Correct the name in the plan.")
    dates = {f"items.{name}.received": item.received for name, item in plan.items.items()}
    for name, stated in plan.calibrations.items():
        dates |= {f"calibrations.{name}.date": stated.date, f"calibrations.{name}.due": stated.due}
        table, action = f"calibrations.{name}.uncertainty", "Correct the quantity in the plan."
        yield from _unknown(table, stated.uncertainty, STATED, action)
    for key, text in dates.items():
        if text and not _is_date(text):
            yield key, format_value(text), "a date such as 2026-11-21", "Write the date as YYYY-MM-DD."


def _is_date(text: str) -> bool:
    try:
        return date.fromisoformat(text).isoformat() == text
    except ValueError:
        return False


def _carry(plan: CampaignPlan) -> Iterator[Mistake]:
    """Yield an error if the named carry cannot answer the question."""
    a = plan.analysis
    if a.carry == "reference" and "symmetry" in plan.rules.apply:
        found = (
            '"reference", while symmetry is judged: one ball\'s coefficients for pole and seam are the same'
        )
        action = "Take a monitor that sees the whole flight, or measure the aerodynamics of each orientation."
        yield "analysis.carry", found, '"monitor" or "measured"', action
    if a.carry == "monitor" and a.quantity in {"total_m", "landing_angle"}:
        found = f'"monitor", while {a.quantity} is compared, which a launch monitor does not report here'
        yield "analysis.carry", found, '"reference" or "measured"', "Name one of them, or compare carry_m."


def _covariates(plan: CampaignPlan) -> Iterator[Mistake]:
    """Yield an error if a covariate would take away the compared difference."""
    a = plan.analysis
    if a.covariates and plan.design.compare != "ball":
        found = f"{format_value(list(a.covariates))}, comparing {plan.design.compare}s"
        action = "Leave it out: clubs and swings differ by what they deliver."
        yield "analysis.covariates", found, "none unless balls are compared", action
    if a.quantity in a.covariates:
        yield "analysis.covariates", format_value(a.quantity), "not the quantity", "Leave it out."
    if a.expected_r_squared and not a.covariates:
        wanted = "0 without analysis.covariates"
        yield "analysis.expected_r_squared", f"{a.expected_r_squared:g}", wanted, "Name what explains it."


def _hits(plan: CampaignPlan) -> Iterator[Mistake]:
    """Yield an error if balls would exceed their hits, repeats left out."""
    handling = plan.ball_handling
    allowed = handling.samples * handling.hits
    if not all((plan.design.balls, plan.design.clubs, plan.design.swings)):
        return
    for name, needed in hits_needed(plan).items():
        if needed > allowed:
            samples = -(-needed // handling.hits)
            found = f"{handling.samples}; {needed} hits of {format_value(name)} are planned"
            wanted = f"at most {handling.samples} x {handling.hits} = {allowed} hits"
            action = f"Take {samples} samples of each ball, or fewer blocks."
            yield "ball_handling.samples", found, wanted, action
