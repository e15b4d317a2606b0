"""The plans that a campaign can be started from on the page: the shipped ones, and those of the bench.

Plans of the bench are files in the folder `plans` beside its records. A request names one of the listed ones
and nothing else.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from itertools import takewhile
from pathlib import Path
from typing import Any

from bench.campaign.plan_file import EXAMPLES, campaign_names
from bench.errors import BenchError, Refused
from bench.from_toml import parse_toml, read_text

MAX_PLANS = 100
"""Max number of listed plans of the bench."""
LONGEST_PLAN = 1 << 20
"""Max size of a plan's file, bytes."""

_LONGEST_ABOUT = 400
_LONGEST_NAME = 80
_MAX_LACKS = 20
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,80}")


class PlanCatalogue:
    """The plans of one bench."""

    def __init__(self, data_dir: Path, known: Mapping[str, Collection[str]]) -> None:
        """`known` are the names that the configuration has in its sections `balls` and `clubs`."""
        self._folder, self._known = data_dir / "plans", known

    def listed(self) -> list[dict[str, Any]]:
        """Return name, title and leading comment of each plan, whether it is shipped, and what it lacks.

        Plans that need a club or a ball of another configuration come last: they would be refused.
        """
        plans = [_described(name, file, self._known) for name, file in self._files().items()]
        return sorted(plans, key=lambda plan: bool(plan["lacks"]))

    def file(self, name: str) -> Path:
        """Return the file of the plan called `name`; one of the bench hides a shipped one.

        Raises:
            Refused: no such plan is listed.
        """
        found = self._files().get(name)
        if found is None:
            raise Refused(
                "plan", "an unknown name", "one of the listed plans", f"Put it into {self._folder}."
            )
        return found

    def _files(self) -> dict[str, Path]:
        shipped = {name: EXAMPLES / f"{name}.toml" for name in campaign_names()}
        try:
            own = sorted(self._folder.glob("*.toml"))[:MAX_PLANS]
        except OSError:
            own = []
        return shipped | {path.stem: path for path in own if is_toml_to_name(path)}


def is_toml_to_name(path: Path) -> bool:
    """Return whether `path` is a file itself, no link, of a plan's size, with a name that is safe to show."""
    try:
        plain = path.is_file() and not path.is_symlink() and path.stat().st_size <= LONGEST_PLAN
    except OSError:
        return False
    return plain and bool(_NAME.fullmatch(path.stem))


def _described(name: str, file: Path, known: Mapping[str, Collection[str]]) -> dict[str, Any]:
    """Return a plan for the list; one that cannot be read is checked in words when it is chosen."""
    title, about, lacks = name, "", []
    try:
        text = read_text(file, "a plan", "Correct the path.")
        lines = takewhile(lambda line: line.startswith("#"), text.splitlines())
        about = " ".join(line.removeprefix("#").strip() for line in lines)[:_LONGEST_ABOUT]
        plan = parse_toml(text, str(file))
        campaign = plan.get("campaign")
        if isinstance(campaign, dict) and isinstance(campaign.get("title"), str) and campaign["title"]:
            title = campaign["title"][:200]
        lacks = [one for section, names in known.items() for one in _lacking(plan, section, names)]
    except BenchError:
        pass
    return {"name": name, "title": title, "about": about, "shipped": file.parent == EXAMPLES, "lacks": lacks}


def _lacking(plan: Mapping[str, Any], section: str, known: Collection[str]) -> list[str]:
    """Return the names in the design's `section` that neither `known` nor the plan itself has."""
    design, own = plan.get("design", {}), plan.get(section, {})
    wanted = design.get(section) if isinstance(design, dict) else None
    if not isinstance(wanted, list) or not isinstance(own, dict):
        return []
    names = [one[:_LONGEST_NAME] for one in wanted if isinstance(one, str) and one not in own]
    return [one for one in names if one not in known][:_MAX_LACKS]
