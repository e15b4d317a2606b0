"""Sessions stay on the loopback, and report an absent daemon or a port in use."""

from __future__ import annotations

import ipaddress
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path

import psutil
import pytest

from bench.base.errors import BenchError, ExitCode
from bench.config import NetworkSettings, load_configuration
from bench.network.zenoh_session import MAX_TRANSPORT_BYTES, NoAnswer, open_client, open_daemon
from tests.bench.fake_bench_service import loopback_configuration
from tests.sampling import release_except


def test_open_daemon_port_in_use_reports_location_and_action() -> None:
    network = loopback_configuration().network
    with open_daemon(network), pytest.raises(BenchError) as caught:
        open_daemon(network)
    assert caught.value.location == f"network.endpoint {network.endpoint}"
    assert caught.value.found == "already in use"
    assert "golfbench status" in caught.value.action


def test_open_client_without_daemon_raises_no_answer_promptly() -> None:
    began = time.monotonic()
    with pytest.raises(NoAnswer, match="denied or not running") as caught:
        open_client(loopback_configuration().network, "bench1")
    assert caught.value.exit_code == ExitCode.NO_ANSWER
    assert time.monotonic() - began < 2.0


def test_zenoh_session_binds_loopback_only() -> None:
    network = loopback_configuration().network
    with open_daemon(network), open_client(network, "bench1"):
        bound = [c.laddr.ip for c in psutil.Process().net_connections("inet") if c.laddr]
    assert bound
    assert all(ipaddress.ip_address(address).is_loopback for address in bound)


def test_zenoh_session_message_beyond_size_limit_is_dropped() -> None:
    network = loopback_configuration().network
    arrived: list[int] = []
    with open_daemon(network) as daemon, open_client(network, "bench1") as client:
        queryable = daemon.declare_queryable("a", lambda query: arrived.append(len(query.payload or b"")))
        for size in (MAX_TRANSPORT_BYTES // 2, MAX_TRANSPORT_BYTES + 1):
            list(client.get("a", payload=b"x" * size, timeout=0.5))
        queryable.undeclare()
    assert arrived == [MAX_TRANSPORT_BYTES // 2]


def configured(folder: Path, **network: str) -> NetworkSettings:
    """Return [network] with these keys, read from a file."""
    path = folder / "bench.toml"
    keys = "".join(f'{key} = "{value}"\n' for key, value in network.items())
    path.write_text(f'base = "shipped"\n[network]\n{keys}')
    return load_configuration(path).network


@pytest.mark.parametrize(
    "endpoint",
    ["tcp/127.0.0.1:7451", "tcp/127.1.2.3:1", "tcp/[::1]:65535", "tls/bench.example:7452", "tls/[::]:7452"],
)
def test_network_endpoint_loopback_tcp_or_tls_is_accepted(endpoint: str, tmp_path: Path) -> None:
    assert configured(tmp_path, endpoint=endpoint, identity="bob").endpoint == endpoint


BEYOND_IN_THE_CLEAR = [
    "tcp/0.0.0.0:7451",
    "tcp/[::]:7451",
    "tcp/192.168.1.5:7451",
    "tcp/bench.example:7451",
    "tcp/127.0.0.1.1:7451",
    "udp/127.0.0.1:7451",
    "quic/192.168.1.5:7451",
]
NO_ENDPOINT = [
    "7451",
    "tcp/127.0.0.1",
    "tcp/127.0.0.1:0",
    "tcp/127.0.0.1:65536",
    "tcp/127.0.0.1:123456",
    "tcp/127.0.0.1:7451#iface=eth0",
    "tcp/127.0.0.1:7451\\n",
    "tls/:7452",
    "tls/192.168.1.5",
    "tls/192.168.1.5:7452?rel=0",
    "tls/192.168.1.5:7452#verify_name_on_connect=false",
    "tls/192.168.1.5:7452,tcp/0.0.0.0:7451",
]


SAMPLE = [BEYOND_IN_THE_CLEAR[0], NO_ENDPOINT[0], *NO_ENDPOINT[-2:]]
"""Endpoints that every key is given daily; "endpoint" is given all."""


@pytest.mark.parametrize(
    ("endpoint", "key"),
    [
        *product((*BEYOND_IN_THE_CLEAR, *NO_ENDPOINT), ("endpoint",)),
        ("", "endpoint"),
        ("tcp/127.0.0.1:7451", "beyond"),
        *release_except(SAMPLE, product((*BEYOND_IN_THE_CLEAR, *NO_ENDPOINT), ("beyond", "router"))),
    ],
)
def test_network_endpoint_insecure_or_malformed_is_rejected(endpoint: str, key: str, tmp_path: Path) -> None:
    with pytest.raises(ExceptionGroup) as caught:
        configured(tmp_path, identity="bench1", **{key: endpoint})
    (fault,) = caught.value.exceptions
    assert isinstance(fault, BenchError)
    assert fault.location.endswith(f"network.{key}")
    assert "tls/HOST:PORT" in fault.expected
    if key == "endpoint":
        assert "an address of this machine only" in fault.expected


@pytest.mark.parametrize("key", ["endpoint", "beyond", "router"])
def test_network_tls_endpoint_without_identity_is_rejected(key: str, tmp_path: Path) -> None:
    with pytest.raises(ExceptionGroup) as caught:
        configured(tmp_path, **{key: "tls/192.0.2.5:7452"})
    (fault,) = caught.value.exceptions
    assert isinstance(fault, BenchError)
    assert fault.location.endswith("network.identity")
    assert "golfbench certificates" in fault.action


@pytest.mark.parametrize("name", ["", "anna*", "anna bob", "**"])
def test_network_operators_invalid_name_is_rejected(name: str, tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(f'base = "shipped"\n[network]\noperators = ["bob", "{name}"]\n')
    with pytest.raises(ExceptionGroup) as caught:
        load_configuration(path)
    (fault,) = caught.value.exceptions
    assert isinstance(fault, BenchError)
    assert fault.location.endswith("network.operators")
    assert fault.found == f'"{name}"'


_DAEMON = """
import sys, time
from bench.config import NetworkSettings
from bench.network.zenoh_session import open_daemon
session = open_daemon(NetworkSettings(sys.argv[1]))
subscriber = session.declare_subscriber("golfbench/**", id)
print("listens", flush=True)
time.sleep(600.0)
"""
_CLIENT = """
import sys, time
from bench.config import NetworkSettings
from bench.base.interrupt import leave
from bench.network.client import BenchClient
from bench.network.zenoh_session import open_client
from bench.viewer.feed import Feed
network = NetworkSettings(sys.argv[1])
session = open_client(network, "bench1")
client = sys.argv[2] == "client"
made = BenchClient(session, "bench1", network, 1.0) if client else Feed(session, "bench1")
print("open", flush=True)
sys.stdin.readline()  # now the bench stands still
end = time.monotonic() + 0.5
while time.monotonic() < end:
    session.put("golfbench/bench1/telemetry", bytes(60_000))
began = time.monotonic()
made.close()
print(time.monotonic() - began)
leave(3) if sys.argv[3] == "golfbench" else sys.exit(3)
"""


@pytest.mark.live
@pytest.mark.parametrize("kind", ["client", "feed"])
@pytest.mark.parametrize("program", ["golfbench", "python"])
def test_bench_client_close_stopped_daemon_ends_in_time_with_exit_code(kind: str, program: str) -> None:
    endpoint = loopback_configuration().network.endpoint
    with _started(_DAEMON, endpoint) as daemon, _started(_CLIENT, endpoint, kind, program) as client:
        daemon.send_signal(signal.SIGSTOP)
        began = time.monotonic()
        said, _ = client.communicate("go\n", timeout=60.0)
        took = time.monotonic() - began
    assert client.returncode == 3  # not aborted out of zenoh
    assert float(said) < 2.0
    assert took < 5.0 or program == "python"


@contextmanager
def _started(text: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run `text` with Python for the block, from its first line on."""
    command = [sys.executable, "-c", text, *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            yield process
        finally:
            process.kill()
