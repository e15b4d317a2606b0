"""Requests of the page that run a command of `golfbench`: plans, forms, and the viewer."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any

from bench.page.answers import Asked, InvalidBody, UnknownName, json_answer
from bench.page.background_command import BackgroundCommand
from bench.page.campaign_service import STARTED
from bench.page.command_line import CommandLine
from bench.page.entry_forms import FORMS, form_arguments
from bench.page.page_access import PageRole
from bench.page.page_service import PageService, Pool
from bench.page.plan_catalogue import PlanCatalogue
from bench.page.viewer_process import ViewerProcess

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

MAX_BLOCKS = 200
"""Max number of blocks in a preview."""


class StartService:
    """Checks and starts of campaigns, entries of measured values, and the viewer."""

    def __init__(
        self,
        page: PageService,
        golfbench: CommandLine,
        plans: PlanCatalogue,
        runner: BackgroundCommand,
        viewer: ViewerProcess,
        values: Callable[[], dict[str, Any]],
    ) -> None:
        """`values` returns the calibrations in force and the forms, as `bench_values`."""
        self._page, self._golfbench, self._plans = page, golfbench, plans
        self._runner, self._viewer, self._values = runner, viewer, values

    def plans(self, _: Asked) -> list[dict[str, Any]]:
        """Return the plans that a campaign can be started from."""
        return self._plans.listed()

    def check(self, asked: Asked) -> dict[str, Any]:
        """Return the preview of a plan, or its mistakes."""
        name = asked.path["plan"]
        file = self._plans.file(name)
        found = json.loads(self._golfbench.output("campaign", "check", "--json", "--", str(file)))
        kept = {key: value for key, value in found.items() if key not in _LEFT_OUT}
        return kept | {"plan": name, "order": _order(found["sequence"])}

    def start(self, asked: Asked) -> dict[str, Any]:
        """Start a campaign from a plan, as it was checked."""
        name, by, units, digest = asked.path["plan"], asked.text("by"), asked.units(), asked.text("digest")
        if not _DIGEST.fullmatch(digest):
            raise InvalidBody("digest: that of the checked plan")
        asked.once(fresh=True)
        # A plan that was changed since it was checked is refused by the runner.
        given = [f"--by={by}", f"--units={units}", f"--expect={digest}"]
        given += ["--ask"] if asked.body.get("ask") is True else []
        self._runner.start(name, "campaign", "run", "--json", *given, "--", str(self._plans.file(name)))
        return {"note": f"{STARTED.format(name)}."}

    def values(self, _: Asked) -> dict[str, Any]:
        """Return calibrations, air and forms."""
        return self._values()

    def enter(self, asked: Asked) -> dict[str, Any]:
        """Store what a person measured."""
        if (form := FORMS.get(asked.path["form"])) is None:
            raise UnknownName("form")
        arguments = form_arguments(form, asked.body, asked.text("by"))
        asked.once()
        return {"note": self._golfbench.output(*arguments).strip()}

    async def viewer(self, request: Request) -> Response:
        """Open Rerun's viewer, which is started unless it runs."""
        from starlette.responses import RedirectResponse

        if (refusal := self._page.needing(PageRole.OPERATOR, request)) is not None:
            return refusal
        if request.headers.get("sec-fetch-site", "") != "same-origin":  # it starts a program
            return json_answer({"what": "Open it by its link on the page."}, 403)
        if request.client is None or not ip_address(request.client.host).is_loopback:
            what = "Rerun's viewer can be reached from the page's own computer only."
            return json_answer({"what": what, "cure": "There: golfbench view, or open this page."}, 403)
        found: list[str] = []
        answer = await self._page.answered(Pool.PROGRAMS, lambda: found.append(self._viewer.url()))
        return RedirectResponse(found[0], 303) if found else answer

    def close_viewer(self, _: Asked) -> None:
        """End Rerun's viewer."""
        self._viewer.close()


_DIGEST = re.compile(r"[0-9a-f]{8,64}")
_LEFT_OUT = frozenset({"sequence", "loads", "outlook"})


def _order(sequence: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the shot order by block: its section, number, and the shots as role, swing, club, ball."""
    found: list[dict[str, Any]] = []
    for trial in sequence:
        if not found or (found[-1]["section"], found[-1]["block"]) != (trial["section"], trial["block"]):
            if len(found) == MAX_BLOCKS:
                break
            found.append({"section": trial["section"], "block": trial["block"], "shots": []})
        found[-1]["shots"].append([trial[key] for key in ("role", "swing", "club", "ball")])
    return found
