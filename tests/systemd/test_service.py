"""The service for real: golfbench@bench1 as it ships, run by a separate systemd (container.py).

The first start compiles everything, which makes the first test the longest by far.
"""

from __future__ import annotations

import json
import re
import resource
import subprocess
from collections.abc import Iterator
from typing import Any

import pytest

from bench.supervisor.ownership import bench_folder
from tests.systemd.container import Container, wait_until
from tests.systemd.root import PROJECT, build_root

pytestmark = [pytest.mark.requires("systemd-nspawn"), pytest.mark.timeout(1200)]

MEMORY = str(bench_folder("bench1"))
UNIT = "golfbench@bench1"
COMMAND = "/opt/golfbench/bin/golfbench"
START = 700.0
"""s that a start may take on a busy machine; usual are 30 s with compilation, 5 s without."""

AMBIENT = """[Service]
PrivateUsers=no
CapabilityBoundingSet=CAP_SYS_NICE CAP_IPC_LOCK
AmbientCapabilities=CAP_SYS_NICE CAP_IPC_LOCK
"""
"""In place of LimitRTPRIO= and LimitMEMLOCK= where not even root may raise limits."""


def may_raise_limits() -> bool:
    """Return whether root may raise resource limits here, as everywhere but in some containers."""
    attempt = "import resource; resource.setrlimit(resource.RLIMIT_RTPRIO, (98, 98))"
    if resource.getrlimit(resource.RLIMIT_RTPRIO)[1] >= 98:
        return True
    return subprocess.run(["python3", "-c", attempt], check=False, capture_output=True).returncode == 0


def may_be_real_time() -> bool:
    """Return whether root may use SCHED_FIFO here."""
    attempt = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
    return subprocess.run(["python3", "-c", attempt], check=False, capture_output=True).returncode == 0


class Service:
    """The service under test, as systemd and golfbench report it."""

    def __init__(self, container: Container) -> None:
        self.container = container

    def show(self, name: str, unit: str = UNIT) -> str:
        return self.container.run("systemctl", "show", "--property", name, "--value", unit)

    def status(self) -> dict[str, Any]:
        config = f"--config=/etc/golfbench/{UNIT.partition('@')[2]}.toml"
        status: dict[str, Any] = json.loads(self.container.run(COMMAND, config, "status", "--json"))
        return status

    def start(self) -> None:
        """Start it if it does not run; do not count earlier starts against its limit."""
        self.container.run("systemctl", "reset-failed", check=False)
        self.container.run("systemctl", "start", UNIT, timeout=START)

    def processes(self) -> dict[str, int]:
        """Return the pids in the container of the supervisor, the loop and the others."""
        status = self.status()["processes"]
        return {"supervisor": int(self.show("MainPID"))} | {name: p["pid"] for name, p in status.items()}

    def kill(self, signal: str, process: str) -> int:
        """Send `signal` to a process, wait until the service is up again; return how often it restarted."""
        pid, before = self.processes()[process], int(self.show("NRestarts"))
        self.container.run("kill", f"-{signal}", str(pid))
        wait_until(lambda: int(self.show("NRestarts")) > before, 60.0, f"a restart after SIG{signal}")
        wait_until(lambda: self.show("ActiveState") == "active", START, "the service up again")
        return int(self.show("NRestarts")) - before

    def journal(self) -> str:
        return self.container.run("journalctl", "--no-pager", "--output=cat", f"--unit={UNIT}")

    def machine_code(self) -> set[str]:
        return set(self.container.run("find", "/var/cache/golfbench", "-name", "*.nbc").split())


@pytest.fixture(scope="module")
def container(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Container]:
    if not may_be_real_time():
        pytest.skip("root may not use SCHED_FIFO on this machine")
    folder = tmp_path_factory.mktemp("systemd")
    root = build_root(folder / "root")
    if not may_raise_limits():
        drop_ins = root.folder / "etc/systemd/system/golfbench@.service.d"
        drop_ins.mkdir()
        (drop_ins / "limits.conf").write_text(AMBIENT)
    container = Container(root, folder / "console.txt")
    yield container
    container.stop()


@pytest.fixture
def service(container: Container) -> Service:
    service = Service(container)
    service.start()
    return service


def test_service_started_runs_hardened_in_real_time(service: Service) -> None:
    status = service.status()
    assert (status["state"], status["cause"]["name"]) == ("ESTOP", "POWER_UP")
    granted = {name: setting["granted"] for name, setting in status["real_time"]["settings"].items()}
    assert status["real_time"]["mode"] == "require"
    assert status["real_time"]["held"], granted
    assert granted["scheduling"] == "FIFO 80, reset on fork"
    loop = status["processes"]["loop"]["pid"]
    assert "SCHED_FIFO" in service.container.run("chrt", "--pid", str(loop))
    told = dict(re.findall(r"(\w+):\s+(.*)", service.container.run("cat", f"/proc/{loop}/status")))
    user = service.container.run("id", "--user", "golfbench")
    assert (told["NoNewPrivs"], told["Seccomp"], told["Uid"].split()[1]) == ("1", "2", user)
    assert int(told["VmLck"].split()[0]) > 100_000
    assert service.show("StatusText").startswith("bench bench1")


def test_service_limits_alone_grant_real_time(service: Service) -> None:
    if not may_raise_limits():
        pytest.skip("not even root may raise RLIMIT_RTPRIO on this machine: capabilities stand in for it")
    loop = service.status()["processes"]["loop"]["pid"]
    assert "CapEff:\t0000000000000000" in service.container.run("cat", f"/proc/{loop}/status")


def test_service_folders_are_closed_to_other_users(service: Service) -> None:
    for folder in ("/var/lib/golfbench", "/var/cache/golfbench"):
        assert service.container.run("stat", "--format=%a %U", folder) == "750 golfbench"
    assert service.container.run("stat", "--format=%a", MEMORY) == "700"


def test_service_restart_reuses_machine_code(service: Service) -> None:
    kept = service.machine_code()
    assert len(kept) > 50
    service.container.run("systemctl", "stop", UNIT)
    assert service.show("Result") == "success"
    assert service.container.run("pgrep", "--uid", "golfbench", check=False) == ""
    assert "No such file" in service.container.run("ls", MEMORY, check=False)
    service.start()
    status = service.status()
    assert (status["state"], status["cause"]["name"]) == ("ESTOP", "POWER_UP")
    assert service.machine_code() == kept


@pytest.mark.parametrize(
    ("signal", "process", "logged"),
    [
        ("KILL", "supervisor", ()),
        ("KILL", "loop", ("killed by SIGKILL",)),
        # The traceback shows where the supervisor stood when the watchdog ended it.
        ("STOP", "supervisor", ("Watchdog timeout", "bench/supervisor/daemon.py")),
        ("STOP", "loop", ("froze",)),
    ],
)
def test_service_killed_or_frozen_process_restarts_in_estop(
    service: Service, signal: str, process: str, logged: tuple[str, ...]
) -> None:
    loop = service.processes()["loop"]
    assert service.kill(signal, process) == 1
    journal = service.journal()
    assert all(text in journal for text in logged)
    if process == "supervisor":  # the loop ends automatically
        assert f"Killing process {loop} (python) with signal SIGKILL" not in journal
    status = service.status()
    assert (status["state"], status["cause"]["name"]) == ("ESTOP", "RESTART")


def test_service_invalid_configuration_fails_without_restart(container: Container) -> None:
    config = container.root / "etc/golfbench/bench2.toml"
    config.write_text('base = "shipped"\n[loop]\nrate_hz = 7\n')
    told = container.run("systemctl", "start", "golfbench@bench2", check=False, timeout=START)
    assert "failed" in told
    service = Service(container)
    assert service.show("ExecMainStatus", "golfbench@bench2") == "2"
    assert service.show("NRestarts", "golfbench@bench2") == "0"
    assert "loop.rate" in container.run("journalctl", "--no-pager", "--unit=golfbench@bench2")


def test_service_exposure_when_running_matches_manual(service: Service) -> None:
    if not may_raise_limits():
        pytest.skip("the unit runs with capabilities in place of limits")
    told = service.container.run("systemd-analyze", "security", "--no-pager", f"{UNIT}.service")
    stated = re.search(
        r"`golfbench@\.service` \| ([0-9.]+)", (PROJECT / "bench/manual/integrator/service.md").read_text()
    )
    assert stated is not None
    assert f": {stated[1]} " in told.splitlines()[-1]
