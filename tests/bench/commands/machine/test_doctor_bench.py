"""`golfbench doctor` on a machine with hardware: each gap is seen in the kernel's files, with its action."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bench.commands.machine.doctor import CheckStatus, Finding, examine
from bench.commands.machine.doctor_bench import bench_probes
from bench.config import Configuration, load_configuration

GOOD_FILES = {
    "sys/devices/system/cpu/isolated": "1,3-4",
    "sys/devices/system/cpu/nohz_full": "3",
    "sys/class/net/can0/tx_queue_len": "256",
    "sys/class/net/can0/statistics/rx_over_errors": "0",
    "proc/412/comm": "irq/35-can0",
    "proc/412/stat": f"412 (irq/35-can0) S {' '.join(map(str, range(4, 40)))} 90 1 0",
    "proc/413/comm": "irq/36-eth0",
    "proc/413/stat": f"413 (irq/36-eth0) S {' '.join(map(str, range(4, 40)))} 50 1 0",
    "proc/irq/35/smp_affinity_list": "0-3",
}
GOOD_LINK: dict[str, Any] = {
    "state": "ERROR-ACTIVE",
    "berr_counter": {"tx": 0, "rx": 0},
    "restart_ms": 100,
    "bittiming": {"bitrate": 1_000_000, "sample_point": "0.750"},
}
Look = Callable[..., dict[str, Finding]]


@pytest.fixture
def look(tmp_path: Path) -> Look:
    """Return the findings of a good bench with some files, facts of the link or settings changed."""

    def find(
        files: dict[str, str] | None = None,
        link: dict[str, Any] | None = None,
        seen: dict[str, int] | None = None,
        *,
        bus: str = "pci",
        cpu: int = 3,
    ) -> dict[str, Finding]:
        for name, text in (GOOD_FILES | (files or {})).items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text + "\n")
        if bus:
            for name, target in (("subsystem", f"sys/bus/{bus}"), ("driver", f"sys/bus/{bus}/drivers/x_can")):
                (tmp_path / target).mkdir(parents=True, exist_ok=True)
                (tmp_path / "sys/class/net/can0/device").mkdir(parents=True, exist_ok=True)
                (tmp_path / "sys/class/net/can0/device" / name).symlink_to(tmp_path / target)
        facts = {"linkinfo": {"info_data": GOOD_LINK | (link or {}), "info_xstats": seen or {}}}
        probes = bench_probes(_configuration(cpu), tmp_path, lambda channel: json.dumps([facts]))
        return {finding.item.removeprefix("can0: "): finding for finding in examine(probes)}

    return find


def _configuration(cpu: int = 3, driver: str = "canopen") -> Configuration:
    c = load_configuration(Path("shipped"))
    return replace(c, driver=replace(c.driver, name=driver), loop=replace(c.loop, cpu=cpu, priority=80))


def test_bench_probes_good_bench_are_all_ok(look: Look) -> None:
    findings = look()
    assert list(findings) == [
        "core of the loop",
        "bit timing",
        "errors",
        "send queue",
        "card",
        "interrupt thread",
    ]
    assert [f for f in findings.values() if f.status is not CheckStatus.OK or f.advice] == []
    assert findings["bit timing"].value.startswith("1000000 bit/s, sample point 0.750")
    assert findings["card"].value == "x_can, on pci"
    assert findings["interrupt thread"].value == "irq 35 with priority 90, the loop has 80"


SLOW_THREAD = GOOD_FILES["proc/412/stat"].replace(" 90 1 0", " 50 1 0")


@pytest.mark.parametrize(
    ("item", "changes", "value", "advice"),
    [
        ("core of the loop", {"cpu": -1}, "any", "set loop.cpu = 1"),
        ("core of the loop", {"cpu": 2}, "2, shared", "isolcpus=2 nohz_full=2"),
        ("core of the loop", {"cpu": 4}, "4, shared", "boot with nohz_full=4"),
        (
            "core of the loop",
            {"cpu": -1, "files": {"sys/devices/system/cpu/isolated": ""}},
            "any",
            "isolcpus=1 nohz_full=1 rcu_nocbs=1",
        ),
        ("bit timing", {"link": {"bittiming": None}}, "no bit rate", "bitrate 1000000"),
        (
            "bit timing",
            {"link": {"bittiming": {"bitrate": 500000, "sample_point": "0.875"}}},
            "500000 bit/s, sample point 0.875, not 1000000",
            "or correct canopen.bitrate",
        ),
        (
            "bit timing",
            {"link": {"bittiming": {"bitrate": 1000000, "sample_point": "0.5"}}},
            "0.500",
            "sample-point 0.875",
        ),
        ("bit timing", {"link": {"restart_ms": 0}}, "stays off", "restart-ms 100"),
        ("errors", {"link": {"state": "STOPPED"}}, "STOPPED", "ip link set can0 up"),
        ("errors", {"link": {"state": "BUS-OFF"}}, "BUS-OFF", "measure 60 ohms"),
        ("errors", {"link": {"berr_counter": {"tx": 128, "rx": 0}}}, "counters 128 sending", "terminator"),
        ("errors", {"link": {"berr_counter": {"tx": 0, "rx": 12}}}, "12 receiving", "terminators"),
        ("errors", {"seen": {"bus_off": 3}}, "3 times bus-off", "disturbed"),
        (
            "errors",
            {"files": {"sys/class/net/can0/statistics/rx_over_errors": "7"}},
            "7 frames lost in the card",
            "interrupt thread",
        ),
        ("send queue", {"files": {"sys/class/net/can0/tx_queue_len": "10"}}, "10 frames", "txqueuelen 256"),
        ("card", {"bus": "usb"}, "x_can, on usb", "PCIe"),
        ("card", {"bus": ""}, "virtual link", "attach a card"),
        ("interrupt thread", {"files": {"proc/412/comm": "irq/35-eth1"}}, "none", "threadirqs"),
        (
            "interrupt thread",
            {"files": {"proc/412/stat": SLOW_THREAD}},
            "priority 50, the loop has 80",
            "chrt -f -p 85 412, or keep it off core 3: /proc/irq/35/smp_affinity_list",
        ),
    ],
)
def test_bench_probes_gap_reports_value_and_advice(
    look: Look, item: str, changes: dict[str, Any], value: str, advice: str
) -> None:
    finding = look(**changes)[item]
    assert finding.status is not CheckStatus.OK
    assert value in finding.value
    assert advice in finding.advice


def test_bench_probes_interrupt_thread_on_other_core_is_ok(look: Look) -> None:
    files = {"proc/412/stat": SLOW_THREAD, "proc/irq/35/smp_affinity_list": "0-2"}
    assert look(files)["interrupt thread"].status is CheckStatus.OK


def test_bench_probes_missing_link_is_reported_once(tmp_path: Path) -> None:
    *_, last = examine(bench_probes(_configuration(), tmp_path))
    assert (last.item, last.status, last.value) == ("can0", CheckStatus.MISSING, "no such link")
    assert "ip link set can0 up type can bitrate 1000000" in last.advice


def test_bench_probes_without_can_skip_link_items() -> None:
    assert bench_probes(_configuration(driver="sim")) == ()
    daq = [probe.item for probe in bench_probes(_configuration(driver="daq"))]
    assert daq == ["core of the loop"]
