"""The page's ASGI application: its paths, each with role and work, behind the guard."""

from __future__ import annotations

import logging
from collections.abc import Collection
from typing import TYPE_CHECKING

from bench.page.answers import InvalidBody, UnknownName, json_answer
from bench.page.campaign_service import CampaignService
from bench.page.commissioning_service import CommissioningService
from bench.page.page_access import PageRole
from bench.page.page_service import Call, PageService, Pool
from bench.page.request_filter import Application, Guard
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

    viewer, operator = PageRole.VIEWER, PageRole.OPERATOR
    looks = {
        "/api/archive": campaigns.archive,
        "/api/campaign/{campaign}": campaigns.detail,
        "/api/plans": starts.plans,
        "/api/values": starts.values,
    }
    changes = {
        "/api/stop/{name}": Call(PageRole.STOPPER, Pool.STOPS, service.stop, reads_body=False),
        "/api/command/{name}": Call(operator, Pool.COMMANDS, service.command),
        "/api/lease": Call(operator, Pool.COMMANDS, service.lease),
        "/api/campaign/{campaign}/report": Call(operator, Pool.PROGRAMS, campaigns.write_report),
        "/api/campaign/{campaign}/{name}": Call(operator, Pool.LOOKUPS, campaigns.change),
        "/api/plan/{plan}/check": Call(operator, Pool.PROGRAMS, starts.check),
        "/api/plan/{plan}/start": Call(operator, Pool.LOOKUPS, starts.start),
        "/api/values/{form}": Call(operator, Pool.PROGRAMS, starts.enter),
        "/api/viewer/close": Call(operator, Pool.PROGRAMS, starts.close_viewer),
        "/api/commissioning/check": Call(operator, Pool.PROGRAMS, commissionings.check),
        "/api/commissioning/start": Call(operator, Pool.LOOKUPS, commissionings.start),
        "/api/commissioning/stop": Call(operator, Pool.LOOKUPS, commissionings.stop),
    }
    downloads = {
        "/commissioning/{commissioning}/{kind}": commissionings.file,
        "/report/{campaign}": campaigns.report,
        "/record/{name}": campaigns.record,
    }
    routes = [
        Route("/", service.file),
        Route("/static/{name}", service.file),
        Route("/api/stream", service.stream),
        Route("/api/you", service.you),
        Route("/api/sign-in", service.sign_in, methods=["POST"]),
        Route("/viewer", starts.viewer),
        *(Route(path, service.calling(Call(viewer, Pool.LOOKUPS, look))) for path, look in looks.items()),
        *(Route(path, service.calling(call), methods=["POST"]) for path, call in changes.items()),
        *(Route(path, service.sending(find)) for path, find in downloads.items()),
    ]
    handlers = {InvalidBody: _invalid, UnknownName: _unknown, Exception: _failed}
    return Guard(Starlette(routes=routes, exception_handlers=handlers), scheme, hosts)


async def _invalid(_: Request, error: Exception) -> Response:
    return json_answer({"what": f"Invalid request: {error}.", "cure": "Load the page again."}, 400)


async def _unknown(_: Request, error: Exception) -> Response:
    return json_answer({"what": f"There is no such {error}."}, 404)


async def _failed(_: Request, error: Exception) -> Response:
    _log.error("page: %s: %s", type(error).__name__, error)
    cure = "Look at the robot, load the page again, and report it."
    return json_answer({"what": f"Internal error of the page: {type(error).__name__}.", "cure": cure}, 500)
