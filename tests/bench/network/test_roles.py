"""Remote access: no rights without a certificate, otherwise the rights of the role."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
import zenoh

from bench.base.address import free_port
from bench.base.errors import BenchError, ExitCode
from bench.config import Configuration, NetworkSettings
from bench.network.certificates import make_certificate, write_identity
from bench.network.client import BenchClient
from bench.network.zenoh_session import NoAnswer, open_client, open_daemon
from tests.bench.certified import Folder, bench_of, client_of
from tests.bench.fake_bench_service import FakeDesk, RunningPlane, running_plane
from tests.conftest import Run

PUBLISHED = ("telemetry", "state", "event", "shot", "loop")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    made = Folder(tmp_path_factory.mktemp("network") / "certificates")
    for name in ("anna", "bob", "carl"):
        made.add(name)
    return made


@pytest.fixture(scope="module")
def configuration(folder: Folder) -> Configuration:
    return bench_of(folder, viewers=("anna",), operators=("bob",))


@pytest.fixture
def bench(configuration: Configuration) -> Iterator[RunningPlane]:
    with running_plane(FakeDesk(), configuration) as running:
        yield running


Connect = Callable[..., BenchClient]
SHORT = 0.4
"""s that the answer to a denied request is waited for; what a bench did shows its service."""


@pytest.fixture
def come_as(bench: RunningPlane, folder: Folder) -> Iterator[Connect]:
    """Connect by TLS with the certificate in a file of `folder`."""
    clients: list[BenchClient] = []

    def connect(file: str, timeout: float = 1.0) -> BenchClient:
        client = client_of(bench.configuration.network.beyond, str(folder.path / file))
        clients.append(BenchClient.connect(client, timeout))
        return clients[-1]

    yield connect
    for client in clients:
        client.close()


@contextmanager
def denied() -> Iterator[None]:
    with pytest.raises(NoAnswer, match="denied or not running") as caught:
        yield
    assert int(caught.value.exit_code) == 75


def heard_by(network: NetworkSettings, publisher: zenoh.Session, *, longest: float) -> set[str]:
    """Return the published messages that a client with `network` receives within `longest` s."""
    heard: set[str] = set()
    with open_client(network, "bench1") as session:
        session.declare_subscriber("golfbench/bench1/**", lambda sample: heard.add(str(sample.key_expr)))
        deadline = time.monotonic() + longest
        while len(heard) < len(PUBLISHED) and time.monotonic() < deadline:
            for name in PUBLISHED:
                publisher.put(f"golfbench/bench1/{name}", b"news")
            time.sleep(0.02)
    return {key.rpartition("/")[2] for key in heard}


# Who may not connect ---------------------------------------------------------------------------------


@pytest.mark.parametrize("trusts_bench", [False, True])
def test_tls_connect_certificate_of_other_authority_is_refused(
    bench: RunningPlane, folder: Folder, tmp_path: Path, trusts_bench: bool
) -> None:
    """A stranger who trusts the bench is refused by the bench."""
    other = Folder(tmp_path / "other")
    stranger = other.add("bob")
    if trusts_bench:
        (other.path / "authority.pem").write_bytes((folder.path / "authority.pem").read_bytes())
    with denied():
        BenchClient.connect(client_of(bench.configuration.network.beyond, stranger))


def test_tls_connect_expired_certificate_is_refused(
    bench: RunningPlane, folder: Folder, come_as: Connect
) -> None:
    folder.add("bob", file="expired", days=1.0, ago=1.001)
    with denied():
        come_as("expired")
    assert come_as("bob").status()["state"]


def test_tls_connect_without_certificate_is_refused(bench: RunningPlane, folder: Folder) -> None:
    tls = {"root_ca_certificate": str(folder.path / "authority.pem")}
    for endpoint in (
        bench.configuration.network.beyond,
        bench.configuration.network.beyond.replace("tls", "tcp"),
    ):
        configuration = zenoh.Config.from_json5('{mode: "client", scouting: {multicast: {enabled: false}}}')
        configuration.insert_json5("connect/endpoints", f'["{endpoint}"]')
        configuration.insert_json5("transport/link/tls", str(tls).replace("'", '"'))
        with pytest.raises(zenoh.ZError):
            zenoh.open(configuration)


def test_bench_client_refuses_bench_with_wrong_certificate(folder: Folder, tmp_path: Path) -> None:
    """A bench with a certificate for another address, or of another authority, receives no commands."""
    false = bench_of(Folder(tmp_path / "other"))
    with running_plane(FakeDesk(), false), denied():
        BenchClient.connect(client_of(false.network.beyond, str(folder.path / "bob")))
    made = make_certificate(
        folder.authority, "dora", (), datetime.now(UTC), 1.0
    )  # a person's, for no address
    write_identity(folder.path, "dora", made)
    network = NetworkSettings(
        f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}", identity=str(folder.path / "dora")
    )
    with open_daemon(network), denied():
        BenchClient.connect(client_of(network.beyond, str(folder.path / "bob")))


def test_tls_connection_ends_when_certificate_expires(
    bench: RunningPlane, folder: Folder, come_as: Connect
) -> None:
    folder.add("bob", file="brief", days=4.0 / 86400)
    client = come_as("brief")
    assert client.status()["state"]
    deadline = time.monotonic() + 20.0
    with denied():
        while time.monotonic() < deadline:
            client.status()
            time.sleep(0.1)


# Roles -----------------------------------------------------------------------------------------------


def test_viewer_role_reads_status_schema_and_publications(
    bench: RunningPlane, come_as: Connect, folder: Folder
) -> None:
    viewer = come_as("anna")
    assert viewer.status()["version"]
    with open_client(viewer._network, "bench1") as session:
        (reply,) = session.get("golfbench/bench1/schema", timeout=5.0)
        assert reply.ok is not None
    network = bench.configuration.network
    with open_client(network, "bench1") as publisher:  # on the loopback, as the publisher is
        beyond = client_of(network.beyond, str(folder.path / "anna")).network
        assert heard_by(beyond, publisher, longest=10.0) == set(PUBLISHED)


@pytest.mark.parametrize("name", ["anna", "carl"])
def test_client_without_operator_role_is_denied_motion_and_lease_commands(
    bench: RunningPlane, come_as: Connect, name: str
) -> None:
    client = come_as(name, SHORT)
    for command in (client.disarm, lambda: client.take_lease(name)):
        with denied():
            command()
    assert bench.plane.lease() is None
    with come_as("bob").lease("bob") as held:
        client.held = replace(held, sequence=100)  # even with a lease that is somebody's
        for command in (client.reset, client.home, client.arm, client.swing, client.tee, client.access):
            with denied():
                command()
    assert come_as("bob").status()["state"]  # time for what was sent before to arrive
    assert bench.service.requests == []


def test_client_without_role_is_denied_status_and_publications(
    bench: RunningPlane, come_as: Connect, folder: Folder
) -> None:
    with denied():
        come_as("carl").status()
    network = bench.configuration.network
    with open_client(network, "bench1") as publisher:
        beyond = client_of(network.beyond, str(folder.path / "carl")).network
        assert heard_by(beyond, publisher, longest=0.5) == set()


def test_remote_client_publications_and_queryables_are_blocked(bench: RunningPlane, folder: Folder) -> None:
    network = bench.configuration.network
    for name in ("anna", "bob", "carl"):
        with open_client(client_of(network.beyond, str(folder.path / name)).network, "bench1") as impostor:
            assert heard_by(network, impostor, longest=0.5) == set()
            false = impostor.declare_queryable("golfbench/bench1/**", zenoh.handlers.FifoChannel(10))
            time.sleep(0.2)
            with BenchClient.connect(bench.configuration) as here:
                assert here.status()["state"]
            assert false.try_recv() is None


def test_operator_role_reads_and_commands(bench: RunningPlane, come_as: Connect, folder: Folder) -> None:
    operator = come_as("bob")
    with operator.lease("bob"):
        operator.reset()
        operator.home()
        operator.arm()
        operator.swing()
    assert len(bench.service.requests) == 4
    network = bench.configuration.network
    with open_client(network, "bench1") as publisher:
        beyond = client_of(network.beyond, str(folder.path / "bob")).network
        assert heard_by(beyond, publisher, longest=10.0) == set(PUBLISHED)


@pytest.mark.parametrize("name", ["anna", "bob", "carl"])
def test_connected_client_stop_and_estop_are_accepted(
    name: str, bench: RunningPlane, come_as: Connect
) -> None:
    client = come_as(name)
    assert client.stop().state == "FAULT"
    assert client.emergency_stop().state == "ESTOP"


def test_loopback_client_commands_without_role(bench: RunningPlane) -> None:
    with BenchClient.connect(bench.configuration) as here, here.lease("Ann"):
        here.reset()
    assert len(bench.service.requests) == 1


def test_command_line_denied_command_exits_with_75(
    bench: RunningPlane, folder: Folder, tmp_path: Path, run: Run
) -> None:
    file = tmp_path / "elsewhere.toml"
    outcomes = []
    for name in ("anna", "carl"):
        file.write_text(
            f'base = "shipped"\n[network]\nendpoint = "{bench.configuration.network.beyond}"\n'
            f'identity = "{folder.path / name}"\n'
        )
        for verb in ("status", "disarm", "stop"):
            code, _, err = run("--config", file, verb)
            outcomes.append((name, verb, code, "denied or not running" in err))
    assert outcomes == [
        ("anna", "status", 0, False),
        ("anna", "disarm", 75, True),
        ("anna", "stop", 0, False),
        ("carl", "status", 75, True),
        ("carl", "disarm", 75, True),
        ("carl", "stop", 0, False),
    ]


# Certificates that do not hold are told before anything is opened ------------------------------------


@pytest.mark.parametrize("lacking", ["authority.pem", "x.pem", "x.key"])
def test_network_identity_missing_or_invalid_file_raises_error(lacking: str, tmp_path: Path) -> None:
    folder = Folder(tmp_path / "c")
    identity = folder.add("x")
    client = client_of(f"tls/127.0.0.1:{free_port()}", identity).network
    daemon = replace(client, endpoint=f"tcp/127.0.0.1:{free_port()}", beyond=client.endpoint)
    folder.add("y")
    other = (folder.path / "y.key").read_bytes()
    for content in (None, b"nonsense", other):
        path = folder.path / lacking
        path.unlink() if content is None else path.write_bytes(content)
        for is_client in (True, False):
            with pytest.raises(BenchError, match="golfbench certificates") as caught:
                open_client(client, "b") if is_client else open_daemon(daemon)
            assert caught.value.exit_code == ExitCode.BAD_INPUT
            assert caught.value.location == f"network.identity {identity}"
            if lacking == "authority.pem":
                assert lacking in caught.value.found


def test_open_daemon_tls_endpoint_without_loopback_raises_error(folder: Folder) -> None:
    network = NetworkSettings(f"tls/127.0.0.1:{free_port()}", identity=str(folder.path / "bob"))
    with pytest.raises(BenchError, match=r"network\.beyond"):
        open_daemon(network)
