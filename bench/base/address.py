"""Where a bench is reached: its name, its addresses, its database, and the certificate for other machines.

A client of a running bench needs nothing else of the configuration, reads nothing else and is stopped by no
mistake in the rest.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from bench.base.configuration_files import PRINT, find_configuration, read_layers
from bench.base.errors import BenchError
from bench.base.from_toml import Builder, Mistake, errors_of, format_value

if TYPE_CHECKING:
    from sqlalchemy import URL

DATABASE_FILE = "golfbench.sqlite"
"""SQLite's file in the folder of records."""
PAGE_PORT = 8600
"""Port of the page unless another one is given."""
BENCH_ID = r"[A-Za-z0-9][A-Za-z0-9_-]{0,62}"
"""Pattern of a bench id, which is part of network keys and file names."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,62}")
"""Name of a person or machine in a certificate."""


def root_key(bench: str) -> str:
    """Return the key that all zenoh keys of `bench` begin with; rules of access name it too."""
    return f"golfbench/{bench}"


@dataclass(frozen=True)
class BenchSettings:
    """Name of the bench and its storage."""

    id: str
    """Name of this bench, part of every address on the network: letters, digits, - and _."""
    data_dir: Path
    """Folder of records, relative to the working directory."""
    database: str = ""
    """URL of the database; empty: SQLite in `data_dir`."""
    commissioned: str = ""
    """Time (ISO, UTC) at which golfbench commission measured the robot; empty: never. Calibrations of
    encoders and valves before it that replace values of the configuration block arming."""


@dataclass(frozen=True)
class NetworkSettings:
    """Addresses of the daemon, and the rights of clients on other machines."""

    endpoint: str
    """zenoh endpoint of the daemon on this machine; for a client elsewhere, the daemon's `beyond`."""
    beyond: str = ""
    """TLS endpoint for other machines; empty: none."""
    router: str = ""
    """zenoh router that the daemon connects to; empty: none."""
    identity: str = ""
    """Path, without ending, of this side's certificate (.pem) and key (.key); authority.pem in the same
    folder."""
    viewers: tuple[str, ...] = ()
    """Names in certificates of those who may read."""
    operators: tuple[str, ...] = ()
    """Names in certificates of those who may also command, a router included; stop and estop are open to
    every certificate."""


class Addressed(Protocol):
    """A configuration as far as its bench is reached by it."""

    @property
    def bench(self) -> BenchSettings:
        """Name of the bench."""

    @property
    def network(self) -> NetworkSettings:
        """Addresses of the bench."""


@dataclass(frozen=True)
class BenchAddress:
    """Name and addresses of a bench."""

    bench: BenchSettings
    network: NetworkSettings


def load_address(path: Path | None = None) -> BenchAddress:
    """Return the network address in the configuration at `path` (as for `find_configuration`).

    Raises:
        BenchError: a file is missing, cannot be read, or is not TOML.
        ExceptionGroup: one BenchError per mistake in the address.
    """
    faults: list[BenchError] = []
    file = find_configuration(path)
    whole, _ = read_layers(file, _defaults, faults)
    sections = [field.name for field in fields(BenchAddress)]
    tree = {name: whole[name] for name in sections if name in whole}
    action = f"Correct the value; {PRINT} prints its meaning, unit and default."
    address: BenchAddress | None = Builder(
        tree, file, action, f"Add it; {PRINT} prints every key.", faults=faults
    ).build(BenchAddress)
    if address is not None:
        faults += errors_of(address_mistakes(address), tree, file)
    if address is None or faults:
        raise ExceptionGroup(f"{file} has no valid address of a bench", faults)
    return address


def free_port() -> int:
    """Return a port of the loopback that is free now."""
    import socket  # not for a stop

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def database_url(database: str, data_dir: Path) -> URL:
    """Return where the database is: the URL in `database`, or if that is empty SQLite's file in `data_dir`.

    Raises:
        BenchError: `database` is not the URL of a database that several processes can open.
    """
    from sqlalchemy import URL, make_url  # slow to import, and needed only here
    from sqlalchemy.exc import ArgumentError, NoSuchModuleError

    if not database:
        return URL.create("sqlite", database=str(data_dir / DATABASE_FILE))
    action = 'Correct it, or leave it empty ("") for SQLite in data_dir.'
    wanted = "a URL such as sqlite:////var/lib/golfbench/bench.sqlite or postgresql+psycopg://host/golfbench"
    try:
        url = make_url(database)
        url.get_dialect()
    except (ArgumentError, NoSuchModuleError, ValueError):
        raise BenchError("bench.database", "not a URL that SQLAlchemy knows", wanted, action) from None
    if url.get_backend_name() == "sqlite" and url.database in {None, "", ":memory:"}:
        raise BenchError("bench.database", "SQLite without a file", wanted, action)
    return url


def _defaults() -> dict[str, Any]:
    sections = {"bench": BenchSettings, "network": NetworkSettings}
    return {
        name: {
            field.name: list(field.default) if isinstance(field.default, tuple) else field.default
            for field in fields(kind)
            if field.default is not MISSING
        }
        for name, kind in sections.items()
    }


def address_mistakes(of: Addressed) -> Iterator[Mistake]:
    """Yield the mistakes in name and addresses: key, found, expected, action."""
    if not re.fullmatch(BENCH_ID, of.bench.id):
        expected = "letters, digits, - and _, at most 63"
        yield "bench.id", format_value(of.bench.id), expected, "It is part of addresses."
    network, inside = of.network, "tcp/127.0.0.1:PORT or tcp/[::1]:PORT, an address of this machine only"
    beyond = "tls/HOST:PORT: beyond this machine commands must be encrypted"
    places = (
        ("endpoint", network.endpoint, f"{inside}, or {beyond}", _is_loopback, _is_secure),
        ("beyond", network.beyond, f'"", or {beyond}', _is_empty, _is_secure),
        ("router", network.router, f'"", {inside}, or {beyond}', _is_empty, _is_loopback, _is_secure),
    )
    for name, endpoint, wanted, *allowed in places:
        if not any(allow(endpoint) for allow in allowed):
            expected = f"{wanted}; PORT 1 to 65535"
            yield f"network.{name}", format_value(endpoint), expected, f"Correct network.{name}."
        elif _is_secure(endpoint) and not network.identity:
            found = f"none, with {name} = {format_value(endpoint)}"
            action = "Create them with `golfbench certificates`."
            yield "network.identity", found, "path of certificate and key, without ending", action
    for role in ("viewers", "operators"):
        for name in getattr(network, role):
            if not NAME.fullmatch(name):
                wanted = "names as in certificates: letters, digits, ., - and _, at most 63"
                yield f"network.{role}", format_value(name), wanted, f"Correct the name in network.{role}."


def _is_empty(endpoint: str) -> bool:
    return endpoint == ""


def _is_loopback(endpoint: str) -> bool:
    form = re.fullmatch(r"tcp/(?:\[(?P<six>[0-9a-f:]+)\]|(?P<four>[0-9.]+)):(?P<port>[0-9]{1,5})", endpoint)
    try:
        return form is not None and ip_address(form["six"] or form["four"]).is_loopback and _is_port(form)
    except ValueError:
        return False


def _is_secure(endpoint: str) -> bool:
    form = re.fullmatch(r"tls/(?:\[[0-9a-f:]+\]|[A-Za-z0-9.-]+):(?P<port>[0-9]{1,5})", endpoint)
    return form is not None and _is_port(form)


def _is_port(form: re.Match[str]) -> bool:
    return 1 <= int(form["port"]) <= 65535


class IdentityFiles(NamedTuple):
    """Certificate and key of one side, and the authority that signs all, PEM."""

    authority: Path
    certificate: Path
    key: Path


def identity_files(identity: str) -> IdentityFiles:
    """Return the files of `identity`, a path without ending.

    Raises:
        BenchError: a file is missing, is no PEM, or belongs to another certificate.
    """
    import ssl

    files = IdentityFiles(
        Path(identity).with_name("authority.pem"), Path(f"{identity}.pem"), Path(f"{identity}.key")
    )
    # zenoh would say no more than that it cannot connect.
    context, file = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT), files.authority
    try:
        context.load_verify_locations(files.authority)
        file = files.certificate
        context.load_cert_chain(files.certificate, files.key, password=lambda: b"")
    except (OSError, ValueError) as error:
        raise BenchError(
            f"network.identity {identity}",
            f"{file}: {error.strerror if isinstance(error, OSError) else error}",
            f"{files.certificate.name}, {files.key.name} that fits it, and {files.authority.name}, PEM, "
            "in one folder",
            "Correct the path, or make them: golfbench certificates.",
        ) from None
    return files
