"""The page's web server: its parts, its paths, its socket, how it begins and ends."""

from __future__ import annotations

import asyncio
import logging
import signal
import socket
import ssl
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.base.address import identity_files
from bench.base.errors import BenchError, ExitCode, load_extra
from bench.calibration.archive import calibration_of
from bench.calibration.calibration import apply
from bench.records.shot.recorded_shot import FlightConditions
from bench.supervisor.child_process import RING_FILE
from bench.supervisor.ownership import bench_folder
from bench.web._answers import Downloads, InvalidBody, UnknownName, json_answer
from bench.web._bench_link import BenchLink, PageBroadcaster, TopicPoller
from bench.web._campaign_service import CampaignService
from bench.web._command_line import BackgroundCommand, CommandLine, ViewerProcess
from bench.web._last_swing import SwingReader
from bench.web._page_service import Call, PageService, Pool
from bench.web._start_service import CommissioningService, PlanCatalogue, StartService
from bench.web.page_access import (
    Application,
    PageAddress,
    PageRole,
    RequestFilter,
    checked_address,
    http_protocol,
    page_access,
)

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

    from bench.config import Configuration

DEAD_PEER = 20_000
"""Time after which the kernel ends a connection whose peer takes nothing, ms."""
_BEAT = 0.5
"""Period of the message that the page's own server is alive, s."""


def serve_page(
    configuration: Configuration,
    address: PageAddress,
    golfbench: Sequence[str],
    ready: Callable[[str, Callable[[], None]], None],
) -> None:
    """Serve the page until asked to stop by signal.

    `golfbench` is the program with its global options, for commands that the page runs.
    `ready` gets the URL and a function that ends the server, once it listens; both from the server's thread.

    Raises:
        BenchError: as `checked_address` and `read_tokens`; the extra `page` is not installed; the port is in
            use.
    """
    hosts, access = checked_address(address), page_access(address, configuration)
    for package in ("starlette", "uvicorn"):
        load_extra(package, "page", "golfbench page")
    with _listening(address) as listener, ExitStack() as stack:
        settings, broadcaster = configuration.bench, PageBroadcaster()
        downloads = Downloads(settings.data_dir, settings.id)
        reader = _started_reader(configuration, broadcaster, downloads.newest())
        stack.callback(reader.close)
        ring = bench_folder(settings.id) / RING_FILE
        link = BenchLink(
            configuration.network,
            settings.id,
            broadcaster.publish,
            lambda running: reader.offer_ring(ring, running=running),
            reader.offer_shot,
        )
        stack.callback(link.close)
        service = PageService(link, broadcaster, access, secure=bool(address.identity))
        stack.callback(service.close)
        program = CommandLine(golfbench)
        stack.callback(program.close)
        log = settings.data_dir / "campaigns" / f".runner-of-{settings.id}.log"
        runner = BackgroundCommand(program, log, broadcaster.publish, "runner", outcome=run_outcome)
        viewer = ViewerProcess(program, broadcaster.publish)
        stack.callback(viewer.close)
        campaigns = CampaignService(configuration, downloads, program, runner)
        plans = PlanCatalogue(settings.data_dir, {"balls": configuration.balls, "clubs": configuration.clubs})
        starts = StartService(service, program, plans, runner, viewer, configuration)
        log = settings.data_dir / "commissioning" / f".process-of-{settings.id}.log"
        command = BackgroundCommand(
            program, log, broadcaster.publish, "commissioner", expected=(ExitCode.REFUSED, -signal.SIGTERM)
        )
        commissionings = CommissioningService(settings, program, command)
        looks = {
            "commissioning": commissionings.view,
            "campaigns": lambda: campaigns.running(link.client().campaigns()),
        }
        stack.callback(TopicPoller(broadcaster, looks).close)
        application = page_application(service, campaigns, starts, commissionings, address.scheme, hosts)
        asyncio.run(_serve(application, link, broadcaster, address, listener, ready))


def _started_reader(
    configuration: Configuration, broadcaster: PageBroadcaster, newest: Path | None
) -> SwingReader:
    """Return a reader of swings with the calibrated plant; the `newest` record is its first."""
    c = apply(calibration_of(configuration, datetime.now(UTC)), configuration)
    reader = SwingReader(broadcaster.publish, c.plant, FlightConditions(c.air, c.wind, c.turf))
    reader.start()
    if newest is not None:
        reader.offer(newest)
    return reader


def run_outcome(record: dict[str, Any]) -> str:
    """Return in words how a campaign's run ended, by the JSON that it printed."""
    reason = f": {record['reason']}" if record["reason"] else ""
    return f"{record['state'].capitalize()}{reason}; {record['shots']} shots, {record['valid']} valid."


@contextmanager
def _listening(address: PageAddress) -> Iterator[socket.socket]:
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    # asyncio sends small parts at once only on sockets that name their protocol: else each file takes 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # Connections inherit it: the kernel also cuts off a peer that takes nothing.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, DEAD_PEER)
        try:
            listener.bind((address.host, address.port))
        except OSError as error:
            location = f"--host {address.host} --port {address.port}"
            action = "Choose another --port, or end the process that listens there."
            raise BenchError(location, error.strerror or str(error), "a free address", action) from None
        yield listener
    finally:
        listener.close()


async def _serve(
    application: Application,
    link: BenchLink,
    broadcaster: PageBroadcaster,
    address: PageAddress,
    listener: socket.socket,
    ready: Callable[[str, Callable[[], None]], None],
) -> None:
    import uvicorn

    files = identity_files(address.identity) if address.identity else None
    config = uvicorn.Config(
        application,
        http=http_protocol(),
        ws="none",
        lifespan="off",
        loop="asyncio",
        log_config=None,
        access_log=False,
        proxy_headers=False,
        server_header=False,
        timeout_graceful_shutdown=2,
        h11_max_incomplete_event_size=16384,
        ssl_certfile=files and files.certificate,
        ssl_keyfile=files and files.key,
        ssl_ca_certs=files and str(files.authority),
        # With tokens a browser without a certificate may sign in.
        ssl_cert_reqs=ssl.CERT_OPTIONAL if address.tokens else ssl.CERT_REQUIRED,
    )
    server, loop = uvicorn.Server(config), asyncio.get_running_loop()
    # Signals are the page's own.
    server.capture_signals = nullcontext  # type: ignore[method-assign, assignment]

    def end() -> None:
        server.should_exit = True
        broadcaster.attach(None)

    for number in (signal.SIGINT, signal.SIGTERM):
        with suppress(RuntimeError, ValueError):  # not in the main thread: a test ends it
            loop.add_signal_handler(number, end)
    broadcaster.attach(loop)
    beat = asyncio.create_task(_beat(link, broadcaster))
    host = f"[{address.host}]" if ":" in address.host else address.host
    url = f"{address.scheme}://{host}:{address.port}/"
    serving = asyncio.create_task(server.serve([listener]))
    while not server.started and not serving.done():
        await asyncio.sleep(0.01)

    def ask_to_end() -> None:
        loop.call_soon_threadsafe(end)

    ready(url, ask_to_end)
    try:
        await serving
    finally:
        beat.cancel()


async def _beat(link: BenchLink, broadcaster: PageBroadcaster) -> None:
    """Publish how long the bench has been silent, so that a page notices the loss of bench or server."""
    while True:
        silence = link.silence()
        broadcaster.publish("link", {"silent_s": None if silence == float("inf") else round(silence, 2)})
        await asyncio.sleep(_BEAT)


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
        "/api/archive/{search}": campaigns.archive,
        "/api/swing/{name}": campaigns.swing,
        "/api/campaign/{campaign}": campaigns.detail,
        "/api/plans": starts.plans,
        "/api/values": starts.values,
        "/api/names": starts.names,
    }
    changes = {
        "/api/stop/{name}": Call(PageRole.STOPPER, Pool.STOPS, service.stop, reads_body=False),
        "/api/command/{name}": Call(operator, Pool.COMMANDS, service.command),
        "/api/lease": Call(operator, Pool.COMMANDS, service.lease),
        "/api/wear": Call(operator, Pool.PROGRAMS, campaigns.wear),
        "/api/campaign/{campaign}/report": Call(operator, Pool.PROGRAMS, campaigns.write_report),
        "/api/campaign/{campaign}/{name}": Call(operator, Pool.LOOKUPS, campaigns.change),
        "/api/new-plan": Call(operator, Pool.PROGRAMS, starts.write_plan),
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
    return RequestFilter(Starlette(routes=routes, exception_handlers=handlers), scheme, hosts)


async def _invalid(_: Request, error: Exception) -> Response:
    return json_answer({"what": f"Invalid request: {error}.", "action": "Load the page again."}, 400)


async def _unknown(_: Request, error: Exception) -> Response:
    return json_answer({"what": f"There is no such {error}."}, 404)


async def _failed(_: Request, error: Exception) -> Response:
    _log.error("page: %s: %s", type(error).__name__, error)
    action = "Look at the robot, load the page again, and report it."
    return json_answer(
        {"what": f"Internal error of the page: {type(error).__name__}.", "action": action}, 500
    )
