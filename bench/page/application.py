"""The page's ASGI application: its paths, behind the guard."""

from __future__ import annotations

import logging
from collections.abc import Collection
from typing import TYPE_CHECKING

from bench.page.answers import InvalidBody, json_answer
from bench.page.campaign_service import CampaignService
from bench.page.commissioning_service import CommissioningService
from bench.page.guard import Application, Guard
from bench.page.page_service import PageService
from bench.page.start_service import StartService

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

_log = logging.getLogger("golfbench")


def page_application(
    service: PageService,
    campaigns: CampaignService,
    starts: StartService,
    commissionings: CommissioningService,
    scheme: str,
    hosts: Collection[str],
) -> Application:
    """Return the application of the four services, reached by `scheme` under `hosts` (HOST:PORT)."""
    from starlette.applications import Starlette
    from starlette.routing import Route

    routes = [
        Route("/", service.file),
        Route("/static/{name}", service.file),
        Route("/api/stream", service.stream),
        Route("/api/you", service.you),
        Route("/api/sign-in", service.sign_in, methods=["POST"]),
        Route("/api/lease", service.lease, methods=["POST"]),
        Route("/api/stop/{name}", service.stop, methods=["POST"]),
        Route("/api/command/{name}", service.command, methods=["POST"]),
        Route("/api/archive", campaigns.archive),
        Route("/api/campaign/{campaign}", campaigns.detail),
        Route("/api/campaign/{campaign}/report", campaigns.write_report, methods=["POST"]),
        Route("/api/campaign/{campaign}/{name}", campaigns.change, methods=["POST"]),
        Route("/api/plans", starts.plans),
        Route("/api/plan/{plan}/check", starts.check, methods=["POST"]),
        Route("/api/plan/{plan}/start", starts.start, methods=["POST"]),
        Route("/api/values", starts.values),
        Route("/api/values/{form}", starts.enter, methods=["POST"]),
        Route("/api/viewer/close", starts.close_viewer, methods=["POST"]),
        Route("/api/commissioning/check", commissionings.check, methods=["POST"]),
        Route("/api/commissioning/start", commissionings.start, methods=["POST"]),
        Route("/api/commissioning/stop", commissionings.stop, methods=["POST"]),
        Route("/commissioning/{commissioning}/{kind}", commissionings.file),
        Route("/viewer", starts.viewer),
        Route("/report/{campaign}", campaigns.report),
        Route("/record/{name}", campaigns.record),
    ]
    application = Starlette(routes=routes, exception_handlers={InvalidBody: _invalid, Exception: _failed})
    return Guard(application, scheme, hosts)


async def _invalid(_: Request, error: Exception) -> Response:
    return json_answer({"what": f"Invalid request: {error}.", "cure": "Load the page again."}, 400)


async def _failed(_: Request, error: Exception) -> Response:
    _log.error("page: %s: %s", type(error).__name__, error)
    cure = "Look at the robot, load the page again, and report it."
    return json_answer({"what": f"Internal error of the page: {type(error).__name__}.", "cure": cure}, 500)
