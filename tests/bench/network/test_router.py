"""A zenoh router between a bench and those who look and command, configured as the shipped example is."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import zenoh

from bench.base.address import free_port
from bench.base.errors import BenchError
from bench.base.lifecycle import Request
from bench.config import VARIANTS, Configuration
from bench.network.client import BenchClient
from bench.network.zenoh_session import NoAnswer, access_control, open_client
from tests.bench.certified import Folder, client_of
from tests.bench.fake_bench_service import FakeDesk, RunningPlane, loopback_configuration, running_plane
from tests.waiting import HURRY, wait_until

EXAMPLE = VARIANTS / "router.json5"
ROUTER = """
import sys, time, zenoh
with zenoh.open(zenoh.Config.from_file(sys.argv[1])):
    print("here", flush=True)
    time.sleep(300)
"""


class Router:
    """A router in a separate process."""

    def __init__(self, configuration: Path) -> None:
        self._command = [sys.executable, "-c", ROUTER, str(configuration)]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        self._process = subprocess.Popen(self._command, stdout=subprocess.PIPE)
        assert self._process.stdout is not None
        assert self._process.stdout.readline().strip() == b"here"

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    made = Folder(tmp_path_factory.mktemp("network") / "certificates")
    for name in ("bench1", "router", "anna", "bob", "carl"):
        made.add(name)
    return made


@pytest.fixture
def endpoint() -> str:
    return f"tls/127.0.0.1:{free_port()}"


@pytest.fixture
def router(folder: Folder, endpoint: str, tmp_path: Path) -> Iterator[Router]:
    example = EXAMPLE.read_text().replace("/etc/golfbench/certificates", str(folder.path))
    here = tmp_path / "router.json5"
    here.write_text(example.replace("tls/192.0.2.9:7447", endpoint))
    made = Router(here)
    yield made
    made.kill()


@pytest.fixture
def configuration(folder: Folder, endpoint: str) -> Configuration:
    """Return that of a bench that others reach by the router only."""
    made = loopback_configuration()
    network = replace(
        made.network, router=endpoint, identity=str(folder.path / "bench1"), operators=("router",)
    )
    return replace(made, network=network)


@pytest.fixture
def bench(configuration: Configuration) -> Iterator[RunningPlane]:
    with running_plane(FakeDesk(), configuration) as running:
        yield running


def answers(client: Configuration) -> bool:
    try:
        with BenchClient.connect(client, timeout=1.0) as connected:
            return bool(connected.status())
    except NoAnswer:
        return False


def denied(command: Callable[[], object]) -> bool:
    try:
        command()
    except NoAnswer:
        return True
    except BenchError:
        return False
    return False


def rule(name: str, flow: str, messages: list[str], key: str) -> dict[str, object]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": [key]}


def router_access() -> dict[str, list[dict[str, object]]]:
    """Return the access at a router: bench1 speaks for itself only, and everyone comes by TLS."""
    bench = access_control(viewers=("anna",), operators=("bob",))
    *rules, _ = bench["rules"]  # the last ones are of the bench's own machine
    own, may = "golfbench/bench1/**", ["bench1 publishes", "bench1 is asked", "wanted"]
    rules += [
        rule("wanted", "egress", ["declare_subscriber"], "golfbench/**"),  # from all benches is from each
        rule("bench1 publishes", "ingress", ["put", "declare_queryable", "reply"], own),
        rule("bench1 is asked", "egress", ["query"], own),
    ]
    subjects = [one for one in bench["subjects"] if one["id"] != "this machine"]
    policies = [one for one in bench["policies"] if one["subjects"] != ["this machine"]]
    return {
        "rules": rules,
        "subjects": [*subjects, {"id": "bench1", "cert_common_names": ["bench1"]}],
        "policies": [*policies, {"rules": may, "subjects": ["bench1"]}],
    }


def test_router_example_matches_bench_access_control() -> None:
    shipped = json.loads(zenoh.Config.from_file(str(EXAMPLE)).get_json("access_control"))
    wanted = router_access()
    for part in ("rules", "subjects", "policies"):
        found = [{key: value for key, value in entry.items() if value is not None} for entry in shipped[part]]
        assert found == wanted[part]
    assert (shipped["enabled"], shipped["default_permission"]) == (True, "deny")


@pytest.mark.live
def test_router_enforces_viewer_and_operator_roles(
    router: Router, bench: RunningPlane, folder: Folder, endpoint: str
) -> None:
    router.start()
    anna, bob, carl = (client_of(endpoint, str(folder.path / name)) for name in ("anna", "bob", "carl"))
    wait_until(lambda: answers(bob))
    assert answers(anna)
    assert not answers(carl)
    with BenchClient.connect(bob) as operator, operator.lease("bob") as held:
        operator.reset()
        assert bench.service.requests == [Request.RESET]
        for somebody in (anna, carl):
            with BenchClient.connect(somebody) as client:
                assert denied(lambda client=client: client.take_lease("x"))  # type: ignore[misc]
                assert denied(client.disarm)
                client.held = replace(held, sequence=100)
                assert denied(client.home)
                assert client.stop().state == "FAULT"
                assert client.emergency_stop().state == "ESTOP"
    assert bench.service.requests == [Request.RESET]


@pytest.mark.live
def test_router_forwards_bench_publications_only(
    router: Router, bench: RunningPlane, folder: Folder, endpoint: str
) -> None:
    """Also publications of a client of the daemon, as the publisher is one; and nothing else."""
    router.start()
    heard: dict[str, set[str]] = {"anna": set(), "bob": set(), "carl": set()}
    told = {"golfbench/bench1/telemetry", "golfbench/bench1/event"}

    def open_as(name: str) -> zenoh.Session:
        return stack.enter_context(
            open_client(client_of(endpoint, str(folder.path / name)).network, "bench1")
        )

    def tell() -> bool:
        publisher.put("golfbench/bench1/telemetry", b"cycles")
        publisher.put("golfbench/another/telemetry", b"of a bench that this one is not")
        bench.session.put("golfbench/bench1/event", b"event")
        for liar in liars:
            liar.put("golfbench/bench1/state", b"a lie")
        return heard["anna"] >= told and heard["bob"] >= told

    with ExitStack() as stack:
        publisher = stack.enter_context(open_client(bench.configuration.network, "bench1"))
        liars = [open_as(name) for name in heard]
        for name, keys in heard.items():
            session = open_as(name)
            session.declare_subscriber("golfbench/**", partial(note_key, keys))
        wait_until(tell)
        time.sleep(0.2)
        tell()
        time.sleep(0.2)
    assert heard == {"anna": told, "bob": told, "carl": set()}


def note_key(keys: set[str], sample: zenoh.Sample) -> None:
    keys.add(str(sample.key_expr))


@pytest.mark.live
def test_bench_runs_without_router_and_reconnects(
    router: Router, bench: RunningPlane, folder: Folder, endpoint: str
) -> None:
    assert answers(bench.configuration)
    bob = client_of(endpoint, str(folder.path / "bob"))
    assert not answers(bob)
    for _ in range(2):
        router.start()
        wait_until(lambda: answers(bob))
        router.kill()
        assert not answers(bob)
        assert answers(bench.configuration)


@pytest.mark.live
def test_router_without_bench_gives_no_answer(router: Router, folder: Folder, endpoint: str) -> None:
    router.start()
    with BenchClient.connect(client_of(endpoint, str(folder.path / "bob"))) as client:
        began = time.monotonic()
        assert denied(client.stop)
        assert time.monotonic() - began < HURRY


def test_router_on_loopback_needs_no_certificates(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    file = tmp_path / "router.json5"
    file.write_text(
        f'{{mode: "router", listen: {{endpoints: ["{endpoint}"]}},'
        " scouting: {multicast: {enabled: false}}, transport: {shared_memory: {enabled: false}}}"
    )
    made = loopback_configuration()
    configuration = replace(made, network=replace(made.network, router=endpoint))
    router = Router(file)
    router.start()
    try:
        with running_plane(FakeDesk(), configuration):
            wait_until(lambda: answers(client_of(endpoint, "")))
    finally:
        router.kill()
