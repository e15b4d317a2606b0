"""The page's web server: where it listens, with which certificate, and how it ends."""

from __future__ import annotations

import asyncio
import signal
import socket
import ssl
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from bench.config.identity_files import identity_files
from bench.errors import BenchError, Refused
from bench.page.application import page_application
from bench.page.bench_link import BenchLink
from bench.page.broadcaster import PageBroadcaster
from bench.page.http_protocol import http_protocol
from bench.page.page_access import PageAccess, PageRole, read_tokens
from bench.page.page_service import PageService

if TYPE_CHECKING:
    import uvicorn

    from bench.config import Configuration

PORT = 8600
"""Port of the page unless another one is given."""
DEAD_PEER = 20_000
"""Time after which the kernel ends a connection whose peer takes nothing, ms."""
_BEAT = 0.5
"""Period of the message that the page's own server is alive, s."""


class PageAddress(NamedTuple):
    """Where the page is reached, and by whom."""

    host: str = "127.0.0.1"
    """IP address to listen at."""
    port: int = PORT
    identity: str = ""
    """Path, without ending, of certificate and key; empty: no TLS, on the loopback only."""
    tokens: Path | None = None
    """File of tokens; None: none."""

    @property
    def scheme(self) -> str:
        """Scheme of the page's URL."""
        return "https" if self.identity else "http"


def checked_address(address: PageAddress) -> tuple[str, ...]:
    """Return HOST:PORT of all names under which the page is reached.

    Raises:
        BenchError: the host is no IP address; the certificate or its key is invalid.
        Refused: beyond the loopback without TLS.
    """
    try:
        ip = ip_address(address.host)
    except ValueError:
        expected = "an IP address of this machine, or 0.0.0.0 for all"
        raise BenchError("--host", repr(address.host), expected, "Correct it.") from None
    if not ip.is_loopback and not address.identity:
        raise Refused(
            f"--host {address.host}",
            "an address for other machines without TLS",
            "a certificate for this machine: commands and tokens must not be readable on the network",
            "Make one: golfbench certificates DIR NAME --address HOST, then add --identity DIR/NAME.",
        )
    names = {"127.0.0.1", "localhost", "[::1]"} if ip.is_loopback else set[str]()
    if not ip.is_unspecified:
        names.add(f"[{ip}]" if ip.version == 6 else str(ip))
    if address.identity:
        names |= _certified_names(identity_files(address.identity).certificate)
    default = 443 if address.identity else 80
    return tuple(
        sorted({f"{n}:{address.port}" for n in names} | (names if address.port == default else set()))
    )


def _certified_names(file: Path) -> set[str]:
    """Return host names and addresses in the certificate `file`, as a URL has them."""
    from cryptography import x509

    certificate = x509.load_pem_x509_certificate(file.read_bytes())
    try:
        found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        cure = "Make one with golfbench certificates DIR NAME --address HOST."
        raise BenchError(str(file), "a client's certificate", "one with addresses", cure) from None
    addresses = found.get_values_for_type(x509.IPAddress)
    return set(found.get_values_for_type(x509.DNSName)) | {
        f"[{ip}]" if ip.version == 6 else str(ip) for ip in addresses
    }


def page_access(address: PageAddress, configuration: Configuration) -> PageAccess:
    """Return who may do what at `address`; raises as `read_tokens`."""
    tokens: dict[str, PageRole] = read_tokens(address.tokens) if address.tokens else {}
    network = configuration.network
    return PageAccess(network.viewers, network.operators, tokens, closed=bool(address.identity))


def serve_page(
    configuration: Configuration, address: PageAddress, ready: Callable[[str, Callable[[], None]], None]
) -> None:
    """Serve the page until asked to stop by signal.

    `ready` gets the URL and a function that ends the server, once it listens; both from the server's thread.

    Raises:
        BenchError: as `checked_address` and `read_tokens`; the extra `page` is not installed; the port is in
            use.
    """
    hosts, access = checked_address(address), page_access(address, configuration)
    _require_packages()
    broadcaster = PageBroadcaster()
    link = BenchLink(configuration.network, configuration.bench.id, broadcaster.publish)
    with _listening(address) as listener:
        service = PageService(link, broadcaster, access, secure=bool(address.identity))
        link.start()
        try:
            asyncio.run(_serve(service, link, broadcaster, address, hosts, listener, ready))
        finally:
            service.close()
            link.close()


def _require_packages() -> None:
    try:
        import starlette  # noqa: F401
        import uvicorn  # noqa: F401
    except ImportError as error:
        cure = 'pip install "golfbench[page]"'
        raise BenchError("golfbench page", f"no package ({error})", "starlette and uvicorn", cure) from error


@contextmanager
def _listening(address: PageAddress) -> Iterator[socket.socket]:
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # Connections inherit it: a peer that takes nothing is cut off by the kernel, too.
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, DEAD_PEER)
        try:
            listener.bind((address.host, address.port))
        except OSError as error:
            place = f"--host {address.host} --port {address.port}"
            cure = "Choose another --port, or end the process that listens there."
            raise BenchError(place, error.strerror or str(error), "a free address", cure) from None
        yield listener
    finally:
        listener.close()


async def _serve(
    service: PageService,
    link: BenchLink,
    broadcaster: PageBroadcaster,
    address: PageAddress,
    hosts: tuple[str, ...],
    listener: socket.socket,
    ready: Callable[[str, Callable[[], None]], None],
) -> None:
    import uvicorn

    files = identity_files(address.identity) if address.identity else None
    config = uvicorn.Config(
        page_application(service, address.scheme, hosts),
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
    server, loop = _server_without_signals(config), asyncio.get_running_loop()

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
    """Publish how long the bench has been silent, so that a page notices either loss by itself."""
    while True:
        silence = link.silence()
        broadcaster.publish("link", {"silent_s": None if silence == float("inf") else round(silence, 2)})
        await asyncio.sleep(_BEAT)


def _server_without_signals(config: uvicorn.Config) -> uvicorn.Server:
    import uvicorn

    class QuietServer(uvicorn.Server):
        """Leaves the signals to the page."""

        @contextmanager
        def capture_signals(self) -> Iterator[None]:
            yield

    return QuietServer(config)
