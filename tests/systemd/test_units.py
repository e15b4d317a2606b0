"""The units as systemd's own checker sees them; what they do when they run: test_service.py."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

UNITS = Path(__file__).parents[2] / "systemd"
MANUAL = UNITS.parent / "bench/manual"
INSTANCES = {
    "golfbench": "bench1",
    "golfbench-can": "can0",
    "golfbench-page": "bench1",
    "golfbench-view": "bench1",
}

pytestmark = pytest.mark.requires("systemd-analyze")


def analyze(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = ["systemd-analyze", *arguments]
    return subprocess.run(command, check=False, capture_output=True, text=True, stdin=subprocess.DEVNULL)


def verify(folder: Path, name: str, more: str = "") -> subprocess.CompletedProcess[str]:
    """Check a copy of the units in which every program is one that this machine has."""
    for path in UNITS.glob("*.service"):
        program = re.compile(r"^(Exec\w+=)(/opt/golfbench/bin/golfbench|ip)\b", re.MULTILINE)
        (folder / path.name).write_text(program.sub(r"\1/bin/true", path.read_text()) + more)
    unit = folder / f"{name}@{INSTANCES[name]}.service"
    return analyze("verify", "--man=no", "--recursive-errors=yes", unit)


def exposure(unit: Path) -> float:
    """Return systemd's figure: 0 is a service that may do nothing, 10 one that may do everything."""
    told = analyze("security", "--offline=true", unit).stdout
    figure = re.search(r"exposure level for \S+: ([0-9.]+)", told)
    assert figure is not None, told
    return float(figure[1])


@pytest.mark.parametrize("name", INSTANCES)
def test_unit_passes_systemd_verify(name: str, tmp_path: Path) -> None:
    done = verify(tmp_path, name)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


def test_systemd_verify_misspelt_setting_fails(tmp_path: Path) -> None:
    done = verify(tmp_path, "golfbench", "\n[Service]\nWatchdogSecs=2\n")
    assert done.returncode != 0
    assert "WatchdogSecs" in done.stderr


@pytest.mark.parametrize("name", INSTANCES)
def test_unit_exposure_matches_manual(name: str) -> None:
    stated = re.search(
        rf"\| `{name}@\.service` \| ([0-9.]+) \|", (MANUAL / "integrator/service.md").read_text()
    )
    assert stated is not None
    assert exposure(UNITS / f"{name}@.service") == float(stated[1])


def test_bench_unit_is_restricted_except_needed_settings() -> None:
    told = analyze("security", "--offline=true", "--json=short", UNITS / "golfbench@.service").stdout
    open_to = {item["json_field"] for item in json.loads(told) if not item["set"]}
    needed = {"MemoryDenyWriteExecute", "RestrictRealtime", "SystemCallFilter_resources"}
    assert needed <= open_to
    assert not {name for name in open_to if name.startswith("CapabilityBoundingSet")}


@pytest.mark.skipif(shutil.which("systemd-sysusers") is None, reason="needs systemd-sysusers")
def test_sysusers_and_tmpfiles_match_unit(tmp_path: Path) -> None:
    (tmp_path / "etc/sysusers.d").mkdir(parents=True)
    shutil.copy(UNITS / "golfbench.sysusers", tmp_path / "etc/sysusers.d/golfbench.conf")
    subprocess.run(["systemd-sysusers", f"--root={tmp_path}"], check=True, capture_output=True)
    name, _, _, _, _, home, shell = (tmp_path / "etc/passwd").read_text().strip().split(":")
    assert (name, home, Path(shell).name) == ("golfbench", "/var/lib/golfbench", "nologin")
    folders = (UNITS / "golfbench.tmpfiles").read_text()
    unit = (UNITS / "golfbench@.service").read_text()
    for setting, folder in {"State": "/var/lib", "Cache": "/var/cache", "Logs": "/var/log"}.items():
        assert f"{setting}Directory=golfbench\n{setting}DirectoryMode=0750" in unit
        assert re.search(rf"^d {folder}/golfbench +0750 golfbench golfbench", folders, re.MULTILINE)
