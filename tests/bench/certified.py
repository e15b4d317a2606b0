"""A bench that is reached by TLS, and those who come: each with a certificate in one folder."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from bench.base.address import free_port
from bench.config import Configuration, NetworkSettings
from bench.network.certificates import AUTHORITY, Identity, make_authority, make_certificate, write_identity
from tests.bench.fake_bench_service import loopback_configuration

HERE = ("127.0.0.1", "localhost")


class Folder:
    """A folder of certificates, as `golfbench certificates` makes it."""

    def __init__(self, path: Path) -> None:
        path.mkdir()
        self.path = path
        self.authority: Identity = make_authority(datetime.now(UTC))
        write_identity(path, AUTHORITY, self.authority)

    def add(self, name: str, *, file: str = "", days: float = 1.0, ago: float = 0.0) -> str:
        """Make a certificate for `name` that was made `ago` d ago for `days`; return its `identity`."""
        now = datetime.now(UTC) - timedelta(days=ago)
        file = file or name
        write_identity(self.path, file, make_certificate(self.authority, name, HERE, now, days))
        return str(self.path / file)


def bench_of(
    folder: Folder, *, viewers: tuple[str, ...] = (), operators: tuple[str, ...] = ()
) -> Configuration:
    """Return the configuration of a bench on the loopback and, by TLS, beyond it."""
    configuration = loopback_configuration()
    network = replace(
        configuration.network,
        beyond=f"tls/127.0.0.1:{free_port()}",
        identity=folder.add("bench1"),
        viewers=viewers,
        operators=operators,
    )
    return replace(configuration, network=network)


def client_of(endpoint: str, identity: str) -> Configuration:
    """Return the configuration of a client on another machine."""
    return replace(loopback_configuration(), network=NetworkSettings(endpoint, identity=identity))
