"""Sockets of a running bench and its viewer, as the kernel reports them: this machine only."""

from __future__ import annotations

import ipaddress
import select
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple
from urllib.request import urlopen

import psutil
import pytest

from bench.base.address import free_port
from tests.bench.certified import Folder
from tests.running_bench import running_bench, write_configuration

pytestmark = [
    pytest.mark.live,
    pytest.mark.timeout(400),  # the first start compiles
]

HURRY = 60.0


class Sockets(NamedTuple):
    """IP addresses and ports of a bench or viewer and all processes below it."""

    listening: frozenset[tuple[str, int]]
    others: frozenset[str]
    """Addresses of connections, both ends, and whatever else is bound, such as datagrams."""


def sockets_of(pid: int) -> Sockets:
    process = psutil.Process(pid)
    listening, others = set(), set()
    for one in (process, *process.children(recursive=True)):
        for c in one.net_connections("inet"):
            if c.type == socket.SOCK_STREAM and c.status == psutil.CONN_LISTEN:
                listening.add((c.laddr.ip, c.laddr.port))
            else:
                others |= {end.ip for end in (c.laddr, c.raddr) if end}
    return Sockets(frozenset(listening), frozenset(others))


def beyond(addresses: set[str]) -> set[str]:
    return {address for address in addresses if not ipaddress.ip_address(address).is_loopback}


@contextmanager
def web_viewer(file: Path) -> Iterator[tuple[int, str]]:
    """Yield its process id and its page."""
    viewer = subprocess.Popen(
        [sys.executable, "-m", "bench", "--config", str(file), "view", "--web"], stdout=subprocess.PIPE
    )
    try:
        assert viewer.stdout is not None
        assert select.select([viewer.stdout], [], [], HURRY)[0]
        yield viewer.pid, viewer.stdout.readline().decode().strip()
    finally:
        viewer.terminate()
        try:
            viewer.communicate(timeout=HURRY)
        except subprocess.TimeoutExpired:
            viewer.kill()
            viewer.communicate()


def test_bench_and_web_viewer_bind_loopback_only(tmp_path: Path) -> None:
    file = write_configuration(tmp_path, "listening")
    with running_bench(file) as bench, web_viewer(file) as (viewer, page):
        with urlopen(page, timeout=HURRY) as answer:  # noqa: S310 - the viewer's own page
            assert answer.status == 200
        time.sleep(2.0)  # what reports, scouts or looks for newer versions has begun by now
        of_bench, of_viewer = sockets_of(bench.process.pid), sockets_of(viewer)
        port = int(bench.configuration.network.endpoint.rpartition(":")[2])
    assert of_bench.listening == {("127.0.0.1", port)}
    assert len(of_viewer.listening) >= 2  # page and data
    for found in (of_bench, of_viewer):
        assert found.others
        assert not beyond({address for address, _ in found.listening} | found.others)


@pytest.mark.release
def test_networked_bench_adds_single_tls_listener(tmp_path: Path) -> None:
    folder, port = Folder(tmp_path / "certificates"), free_port()
    identity = folder.add("bench1")
    file = write_configuration(
        tmp_path, "networked", f'beyond = "tls/127.0.0.1:{port}"\nidentity = "{identity}"\n'
    )
    with running_bench(file) as bench:
        found = sockets_of(bench.process.pid)
        inside = int(bench.configuration.network.endpoint.rpartition(":")[2])
        bench.client.status()
    assert found.listening == {("127.0.0.1", inside), ("127.0.0.1", port)}
    assert not beyond(set(found.others))
