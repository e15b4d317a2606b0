"""`golfbench campaign new`: a commented plan from options, or from answers at a terminal."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import typer

from bench.base.errors import BenchError
from bench.commands.common import Session, argument, at_terminal, option, write_text
from bench.swing.library import profiles_for
from drivers.base.ranges import read_number

if TYPE_CHECKING:
    from bench.campaign.plan.plan import CampaignPlan
    from bench.config import Configuration

Compared = Literal["ball", "club", "swing"]
_COMMENT_AT = 34
"""Column of the comments."""
_MANY = 1e6
"""Max difference and deviation, m."""


def new(
    context: typer.Context,
    file: Annotated[Path, argument("FILE", "Plan to write, NAME.toml; NAME becomes the campaign's name.")],
    compare: Annotated[Compared | None, option("Factor to compare.", shown="asked")] = None,
    ball: Annotated[
        list[str] | None, option("Ball; several with one option each.", "NAME", shown="asked")
    ] = None,
    club: Annotated[
        list[str] | None, option("Club, the same; also to compare balls.", "NAME", shown="asked")
    ] = None,
    swing: Annotated[list[str] | None, option("Swing profile, the same.", "NAME")] = None,
    control: Annotated[
        str, option("Control ball: hit in each block, shows drift.", "NAME", shown="none")
    ] = "",
    difference: Annotated[
        float | None, option("Smallest difference of carry worth finding, m.", "M", shown="asked")
    ] = None,
    sd: Annotated[
        float | None, option("Expected standard deviation of one shot, m.", "M", shown="asked")
    ] = None,
    blocks: Annotated[
        int | None,
        option("Blocks.", "COUNT", low=2, high=1000, shown="as many as find the difference"),
    ] = None,
) -> None:
    """Write a commented plan from options; missing ones are questions at the terminal.

    Prints duration and resolution. Mistakes are listed all at once; the file is kept and can be corrected.
    """
    from bench.campaign.plan.shot_sequence import all_trials
    from bench.campaign.report.preview import outlook_words
    from bench.campaign.run.plan_requirements import needs

    name = _plan_name(file)
    given: dict[str, Any] = {"compare": compare, "ball": ball, "club": club, "swing": swing}
    configuration = context.ensure_object(Session).configuration()
    answers = _answered(given | {"difference": difference, "sd": sd}, configuration)
    design: dict[str, Any] = {
        "compare": answers["compare"],
        "balls": answers["ball"],
        "clubs": answers["club"],
    }
    if answers["swing"]:
        design["swings"] = answers["swing"]
    analysis = {"expected_sd": answers["sd"], "target_difference": answers["difference"]}
    sections = {
        "campaign": {"name": name, "title": name.replace("-", " ").capitalize()},
        "design": design,
        "control": {"ball": control},
        "analysis": {"carry": "monitor", **analysis},
    }
    plan = _write(file, sections, blocks, configuration)
    shots = len(all_trials(plan))
    minutes = (shots * plan.design.seconds_per_shot + needs(plan).hand_work) / 60.0
    typer.echo(f"{shots} shots, about {minutes:.0f} min with the work by hand.")
    for line in outlook_words(plan):
        typer.echo(line)
    typer.echo(f"Written: {file}. Shot order: golfbench campaign check {file}")
    _report_refusals(plan, configuration)


def _report_refusals(plan: CampaignPlan, configuration: Configuration) -> None:
    """Print the reasons why the machine would refuse `plan`."""
    from bench.campaign.run.plan_requirements import machine_refusals

    if configuration.driver.name != "sim":
        for refusal in machine_refusals(plan, {}, monitored=configuration.launch_monitor.enabled):
            typer.echo(f"Before it runs on this machine: {refusal}", err=True)


def _answered(options: Mapping[str, Any], configuration: Configuration) -> dict[str, Any]:
    """Return `options`, the missing ones by answers at a terminal."""
    given = dict(options)
    idle = "" if given["compare"] == "swing" else "swing"
    missing = [name for name, value in given.items() if value in (None, []) and name != idle]
    if missing and not at_terminal():
        named = ", ".join(f"--{name}" for name in missing)
        raise BenchError("campaign new", f"no {named}", "these options, or a terminal", f"Add {named}.")
    balls, clubs = ", ".join(configuration.balls), ", ".join(configuration.clubs)
    questions: dict[str, tuple[str, Callable[[str], Any]]] = {
        "compare": ("Compare ball, club or swing", _factor),
        "ball": (f"Balls, separated by commas ({balls})", _names),
        "club": (f"Clubs, separated by commas ({clubs})", _names),
        "swing": ("Swings, separated by commas", _names),
        "sd": ("Expected standard deviation of one shot, m", _length),
        "difference": ("Smallest difference of carry worth finding, m", _length),
    }
    for name, (question, read) in questions.items():
        if name in missing or (name == "swing" and not given[name] and given["compare"] == "swing"):
            given[name] = typer.prompt(question, value_proc=read, err=True)
    return given


def _plan_name(file: Path) -> str:
    from bench.campaign.plan.plan_file import CAMPAIGN_NAME

    if file.suffix != ".toml" or not CAMPAIGN_NAME.fullmatch(file.stem):
        expected = "at most 41 small letters, digits and -, with .toml"
        raise BenchError("campaign new", str(file), expected, "Name the file such as two-balls.toml.")
    if file.exists():
        raise BenchError(str(file), "an existing file", "a new name", "Name another file, or edit this one.")
    return file.stem


def _factor(text: str) -> str:
    if text.strip() not in get_args(Compared):
        known = ", ".join(get_args(Compared))
        raise typer.BadParameter(f"found {text!r}, expected one of {known}")
    return text.strip()


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]


def _length(text: str) -> float:
    try:
        value = read_number(text.replace(",", "."))
    except ValueError:
        value = 0.0
    if not 0.0 < value < _MANY:
        raise typer.BadParameter(f"found {text!r}, expected a number above 0")
    return value


def _write(
    file: Path, sections: dict[str, dict[str, Any]], blocks: int | None, configuration: Configuration
) -> CampaignPlan:
    """Write the plan of `sections`; without `blocks` as many as find its difference with its chance.

    A club that the swing was not designed for gets its own from golfbench's profiles, where there is one.
    """
    from bench.campaign.plan.plan_file import load_plan
    from bench.campaign.report.preview import outlook
    from bench.campaign.run.plan_requirements import swings_of_other_clubs

    def written() -> CampaignPlan:
        write_text(_plan_text(sections), file)
        return load_plan(file, configuration)

    if blocks is not None:
        sections["design"]["blocks"] = blocks
    plan = written()
    if misfits := swings_of_other_clubs(plan, configuration):
        for swing, club in list(misfits):
            if len(fitting := profiles_for(club)) == 1:
                sections.setdefault(f"swings.{swing}", {})[club] = fitting[0]
                del misfits[swing, club]
        plan = written()
    if misfits:
        raise ExceptionGroup("the plan's swings do not fit", list(misfits.values()))
    if blocks is None and (needed := outlook(plan).needed):
        sections["design"]["blocks"] = max(needed, plan.stop.min_blocks)
        plan = written()
    return plan


def _plan_text(sections: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a plan; each key has the comment of the plan's defaults."""
    from bench.campaign.plan.plan_file import DEFAULTS

    comments, section = {}, ""
    for line in DEFAULTS.read_text(encoding="utf-8").splitlines():
        if head := re.match(r"\[([a-z_]+)\]", line):
            section = head[1]
        elif entry := re.match(r"([a-z_]+) = .*?\s# (.+)", line):
            comments[section, entry[1]] = entry[2]
    lines = ["# Keys left out have their defaults: see the manual, test engineer, plan keys."]
    for section, values in sections.items():
        lines += ["", f"[{section}]"]
        for key, value in values.items():
            line = f"{key} = {json.dumps(value, ensure_ascii=False)}"
            comment = comments.get((section, key), "")
            lines.append(f"{line:<{_COMMENT_AT}}# {comment}" if comment else line)
    return "\n".join(lines) + "\n"
