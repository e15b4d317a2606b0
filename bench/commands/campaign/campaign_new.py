"""`golfbench campaign new`: a commented plan from options, or from answers at a terminal."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_args

import typer

from bench.base.errors import BenchError
from bench.commands.common.options import argument, option
from bench.commands.common.session import Session, at_terminal

if TYPE_CHECKING:
    from bench.campaign.plan.plan import CampaignPlan
    from bench.config import Configuration

T = TypeVar("T")
Compared = Literal["ball", "club", "swing"]
Carry = Literal["monitor", "reference", "measured"]
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
    carry: Annotated[
        Carry, option("Carry as the launch monitor, a reference ball or measured balls yield it.")
    ] = "monitor",
    title: Annotated[str, option("Title of the report.", "TEXT", shown="the name")] = "",
) -> None:
    """Write a commented plan from options; missing ones are questions at the terminal.

    Prints duration and resolution. Mistakes are listed all at once; the file is kept and can be corrected.
    """
    name = _plan_name(file)
    answers: dict[str, Any] = {"compare": compare, "ball": ball, "club": club, "swing": swing}
    answers |= {"difference": difference, "sd": sd}
    configuration = context.ensure_object(Session).configuration()
    design, analysis = _answered(answers, configuration)
    sections = {
        "campaign": {"name": name, "title": title or name.replace("-", " ").capitalize()},
        "design": design,
        "control": {"ball": control},
        "analysis": {"carry": carry, **analysis},
    }
    for line in _outlook(_write(file, sections, blocks, configuration)):
        typer.echo(line)
    typer.echo(f"Written: {file}. Shot order: golfbench campaign check {file}")


def _answered(
    given: Mapping[str, Any], configuration: Configuration
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the keys of [design] and [analysis] by the options `given`, and by answers at a terminal."""
    _require_answers({name: value for name, value in given.items() if name != "swing"})
    balls, clubs = ", ".join(configuration.balls), ", ".join(configuration.clubs)
    compared = _given(given["compare"], "Compare ball, club or swing", _one_of(get_args(Compared)))
    design = {
        "compare": compared,
        "balls": _given(given["ball"], f"Balls, separated by commas ({balls})", _names),
        "clubs": _given(given["club"], f"Clubs, separated by commas ({clubs})", _names),
    }
    if given["swing"] or compared == "swing":
        design["swings"] = _given(given["swing"], "Swings, separated by commas", _names)
    return design, {
        "expected_sd": _given(given["sd"], "Expected standard deviation of one shot, m", _length),
        "target_difference": _given(
            given["difference"], "Smallest difference of carry worth finding, m", _length
        ),
    }


def _plan_name(file: Path) -> str:
    """Return the campaign's name by its `file`.

    Raises:
        BenchError: the file exists, or its name makes no campaign's name.
    """
    from bench.campaign.plan.plan_file import CAMPAIGN_NAME

    if file.suffix != ".toml" or not CAMPAIGN_NAME.fullmatch(file.stem):
        expected = "at most 41 small letters, digits and -, with .toml"
        raise BenchError("campaign new", str(file), expected, "Name the file such as two-balls.toml.")
    if file.exists():
        raise BenchError(str(file), "an existing file", "a new name", "Name another file, or edit this one.")
    return file.stem


def _require_answers(options: Mapping[str, object]) -> None:
    """Refuse `options` that are not given where no terminal can be asked.

    Raises:
        BenchError: it lists them.
    """
    missing = [f"--{name}" for name, value in options.items() if value in (None, [])]
    if missing and not at_terminal():
        action = f"Add {', '.join(missing)}."
        raise BenchError("campaign new", f"no {', '.join(missing)}", "these options, or a terminal", action)


def _given(value: T | None, question: str, read: Callable[[str], T]) -> T:
    """Return `value`, or the answer to `question` without one."""
    if value is not None and value != []:
        return value

    def answer(text: str) -> T:
        try:
            return read(text.strip())
        except ValueError as error:
            raise typer.BadParameter(str(error)) from None

    answered: T = typer.prompt(question, value_proc=answer, err=True)
    return answered


def _one_of(known: Sequence[Any]) -> Callable[[str], Any]:
    def read(text: str) -> str:
        if text not in known:
            raise ValueError(f"found {text!r}, expected one of {', '.join(known)}")
        return text

    return read


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]


def _length(text: str) -> float:
    value = float(text.replace(",", "."))
    if not 0.0 < value < _MANY:
        raise ValueError(f"found {text!r}, expected a number above 0")
    return value


def _write(
    file: Path, sections: dict[str, dict[str, Any]], blocks: int | None, configuration: Configuration
) -> CampaignPlan:
    """Write the plan of `sections`; without `blocks` as many as find its difference with its chance.

    A club that the swing was not designed for gets its own from golfbench's profiles, where there is one.

    Raises:
        ExceptionGroup: BenchErrors, one for each mistake in it.
    """
    from bench.campaign.plan.plan_file import load_plan
    from bench.campaign.report.preview import outlook
    from bench.campaign.run.plan_requirements import swings_of_other_clubs
    from bench.swing.library import profiles_for

    def written() -> CampaignPlan:
        file.write_text(_plan_text(sections), encoding="utf-8")
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


def _outlook(plan: CampaignPlan) -> list[str]:
    """Return shots, duration and resolution in words."""
    from bench.campaign.plan.shot_sequence import all_trials
    from bench.campaign.report.preview import outlook_words
    from bench.campaign.run.plan_requirements import needs

    shots = len(all_trials(plan))
    minutes = (shots * plan.design.seconds_per_shot + needs(plan).hand_work) / 60.0
    return [f"{shots} shots, about {minutes:.0f} min with the work by hand.", *outlook_words(plan)]
