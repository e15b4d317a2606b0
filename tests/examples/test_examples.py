"""The examples run as a reader runs them, and the README shows the commands' output."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import EntryPoint
from pathlib import Path

import numba
import pytest
import zenoh
from jsonschema import Draft202012Validator

from bench.config import Configuration
from bench.network.messages import wire_contract
from bench.network.zenoh_session import open_client
from bench.records.telemetry.cycle_record import arrow_schema
from drivers.base import PASSIVE, Command, Driver
from drivers.registry import GROUP, BrokenDriver, choose_driver, find_drivers
from tests.running_bench import running_bench, write_configuration

EXAMPLES = Path(__file__).parent
README = EXAMPLES.parents[1] / "README.md"

pytestmark = pytest.mark.skipif(
    bool(numba.config.DISABLE_JIT), reason="a whole swing takes minutes without compilation"
)


def _python(*arguments: str) -> str:
    """Run Python with `arguments` in a separate process and return its output."""
    done = subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, check=False, timeout=500
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of the README's campaign, and the command's output."""
    folder = tmp_path_factory.mktemp("campaign")
    configuration = folder / "bench.toml"
    configuration.write_text(f'base = "shipped"\n[bench]\ndata_dir = "{folder}"\n')
    printed = _python("-m", "bench", "--config", str(configuration), "campaign", "run", "two-balls", "--sim")
    (campaign,) = (folder / "campaigns").iterdir()
    return campaign, printed


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_readme_matches_campaign_run_output(campaign: tuple[Path, str]) -> None:
    shown = README.read_text().partition("two-balls --sim\n")[2].partition("```")[0]
    assert " ".join(shown.split()) in " ".join(campaign[1].split())


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_campaign_tracking_prints_row_per_record(campaign: tuple[Path, str]) -> None:
    rows = _python(str(EXAMPLES / "campaign_tracking.py"), str(campaign[0])).splitlines()
    assert rows[1].split() == ["record", "shoulder", "arm", "wrist"]
    assert len(rows) == 2 + len(list(campaign[0].glob("swings/*.parquet"))) + 2
    assert all(0.0 < float(value) < 500.0 for row in rows[2:] for value in row.split()[1:])


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_lock_step_swing_writes_plot(tmp_path: Path) -> None:
    _python(str(EXAMPLES / "lock_step_swing.py"), str(tmp_path / "swing.png"))
    assert (tmp_path / "swing.png").stat().st_size > 10_000


@pytest.mark.live
@pytest.mark.paced
@pytest.mark.timeout(600)
def test_one_swing_client_runs_and_messages_follow_contract(tmp_path: Path) -> None:
    """Also a program that does not import the bench; the bench's messages follow its contract."""
    file = write_configuration(tmp_path, "example")
    output = tmp_path / "subscriber.txt"
    with running_bench(file) as bench, _subscriber(bench.configuration, output):
        id_, network = bench.configuration.bench.id, bench.configuration.network
        with open_client(network, id_) as session:
            said: zenoh.handlers.FifoChannel[zenoh.Sample] = zenoh.handlers.FifoChannel(10_000)
            listening = session.declare_subscriber(f"golfbench/{id_}/*", said)
            printed = _python(str(EXAMPLES / "one_swing.py"), str(file))
            samples = list(iter(listening.try_recv, None))
        (record,) = bench.records
    _check_contract(id_, samples)
    rows = output.read_text().splitlines()
    assert rows[0] == f"{id_}: {len(arrow_schema())} columns, wrist in rad"
    assert {"DOWNSWING", "FOLLOW_THROUGH"} <= {row.split()[3] for row in rows[1:-1]}, rows[-5:]
    figures = dict(row.split(maxsplit=2)[::2] for row in printed.splitlines()[1:3])
    assert printed.splitlines()[0].split() == ["record", str(record)]
    assert 40.0 < float(figures["club"].split()[0]) < 46.0
    assert 55.0 < float(figures["ball"].split()[0]) < 67.0


@pytest.mark.live
@pytest.mark.paced
@pytest.mark.timeout(600)
@pytest.mark.requires("zenoh-pico")
def test_c_subscriber_receives_contract_and_valid_messages(tmp_path: Path) -> None:
    flags = subprocess.check_output(["pkg-config", "--cflags", "--libs", "zenohpico"], text=True).split()
    program = str(tmp_path / "subscriber")
    compiler = ["cc", "-Wall", "-Wextra", "-Werror", str(EXAMPLES / "subscriber.c"), "-o", program]
    subprocess.run([*compiler, "-DZENOH_LINUX", *flags, "-lpthread"], check=True, timeout=100)
    with running_bench(write_configuration(tmp_path, "inc")) as bench:
        id_, network = bench.configuration.bench.id, bench.configuration.network
        arguments = [program, id_, network.endpoint]
        with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            first, *states = (process.stdout.readline() for _ in range(4))
            process.kill()
    assert first == f"contract of {len(json.dumps(wire_contract(id_)).encode())} bytes\n"
    rows = {row["key"]: row for row in wire_contract(id_)["published"]}
    for state in states:
        Draft202012Validator(rows[f"golfbench/{id_}/state"]["schema"]).validate(json.loads(state))


@contextmanager
def _subscriber(configuration: Configuration, output: Path) -> Iterator[None]:
    """Run the example that does not import the bench, with its `output` in a file, for the block."""
    arguments = (configuration.bench.id, configuration.network.endpoint)
    with (
        output.open("w") as stream,
        subprocess.Popen(
            [sys.executable, str(EXAMPLES / "subscriber.py"), *arguments], stdout=stream
        ) as process,
    ):
        try:
            deadline = time.monotonic() + 60.0
            while "wrist in rad\n" not in output.read_text() and time.monotonic() < deadline:
                time.sleep(0.05)
            yield
        finally:
            process.kill()


def _check_contract(bench: str, samples: list[zenoh.Sample]) -> None:
    """Assert that all messages on JSON keys are as the contract of `bench` describes them."""
    rows = {row["key"]: row for row in wire_contract(bench)["published"] if "schema" in row}
    seen = set()
    for sample in samples:
        key = str(sample.key_expr)
        if key in rows:
            message = json.loads(sample.payload.to_bytes())
            Draft202012Validator(rows[key]["schema"]).validate(message)
            assert message.keys() <= rows[key]["schema"].get("properties", message).keys()
            seen.add(key.rpartition("/")[2])
    assert seen == {"state", "event", "shot", "loop"}


def test_half_stroke_driver_plug_in_limits_valves(monkeypatch: pytest.MonkeyPatch) -> None:
    folder = EXAMPLES / "driver_plugin"
    monkeypatch.syspath_prepend(folder)
    project = (folder / "pyproject.toml").read_text()
    assert 'half_stroke = "half_stroke_driver:HalfStrokeDriver"' in project
    drivers = find_drivers([EntryPoint("half_stroke", "half_stroke_driver:HalfStrokeDriver", GROUP)])
    assert not isinstance(drivers["half_stroke"], BrokenDriver)
    driver = choose_driver("half_stroke", drivers)()
    assert isinstance(driver, Driver)
    driver.open()
    asked = Command(valve=(1.0, -1.0, 0.2), supply_enable=True, exhaust_closed=True)
    assert driver.write(asked) == asked._replace(valve=(0.5, -0.5, 0.2))
    assert driver.write(asked._replace(valve=(float("nan"), 0.0, 0.0))) == PASSIVE
    first, second = driver.read(0.0), driver.read(0.1)
    assert first.encoder_valid == second.encoder_valid == (True, True, True)
    driver.make_passive()
    driver.close()
    driver.make_passive()
