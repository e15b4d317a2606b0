"""`golfbench doctor`: every item is looked at, nothing raises, each gap comes with its action."""

from __future__ import annotations

import io
import json
import resource
import socket
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from packaging.requirements import Requirement
from rich.console import Console

from bench.commands.machine import doctor
from bench.commands.machine.doctor import CheckStatus, Finding, ItemResult, Probe
from drivers.base.machine_code import cache_folder, module_digests


@pytest.fixture(scope="module")
def findings() -> list[Finding]:
    """This machine, looked at once, without the import of each package: the command does that below."""
    run = doctor._run
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(doctor, "_run", lambda *words: "" if words[0] == "-c" else run(*words))
        return list(doctor.examine(doctor.probes(Path("data"))))


def test_doctor_test_machine_is_usable(findings: list[Finding]) -> None:
    assert doctor.usable(findings)
    assert [f"{f.item}: {f.value}" for f in findings if f.value.startswith("not examined")] == []


def test_doctor_findings_not_ok_have_advice(findings: list[Finding]) -> None:
    assert [f.item for f in findings if f.status is not CheckStatus.OK and not f.advice] == []


def test_doctor_packages_list_installed_versions(findings: list[Finding]) -> None:
    versions = {f.item: f.value for f in findings if f.group == "packages"}
    assert {"numpy", "numba", "eclipse-zenoh", "rerun-sdk", "python-can", "filterpy"} <= versions.keys()
    assert versions["numpy"] == np.__version__


def test_doctor_report_is_versioned_json(findings: list[Finding]) -> None:
    document = json.loads(json.dumps(doctor.report(findings), allow_nan=False))
    assert (document["schema"], document["schema_version"]) == ("golfbench.doctor", 1)
    assert sum(document["count"].values()) == len(document["findings"]) == len(findings)
    assert document["usable"] is True
    assert set(document["findings"][0]) == set(Finding._fields)


def test_doctor_table_shows_all_items_and_ok_count(findings: list[Finding]) -> None:
    screen = io.StringIO()
    Console(width=160, file=screen).print(doctor.table(findings))
    text = screen.getvalue()
    assert all(finding.item in text for finding in findings)
    assert f"the simulation runs here: {sum(f.status is CheckStatus.OK for f in findings)} ok" in text


def test_doctor_examine_raising_probe_returns_limited_finding() -> None:
    def look() -> ItemResult:
        raise ZeroDivisionError("no such thing")

    (finding,) = doctor.examine([Probe("group", "item", look, required=True)])
    assert finding.status is CheckStatus.LIMITED
    assert "ZeroDivisionError: no such thing" in finding.value


def test_doctor_usable_required_item_missing_is_false() -> None:
    gap = ItemResult(CheckStatus.MISSING, "gone")
    assert doctor.usable(list(doctor.examine([Probe("group", "optional", lambda: gap)])))
    assert not doctor.usable(list(doctor.examine([Probe("group", "needed", lambda: gap, required=True)])))


# Packages --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "status", "value"),
    [
        ("numpy>=1", CheckStatus.OK, ""),
        ("numpy>=1,<2", CheckStatus.LIMITED, "outside the tested versions"),
        ("no-such-distribution", CheckStatus.MISSING, "not installed"),
    ],
)
def test_doctor_package_version_sets_status(line: str, status: CheckStatus, value: str) -> None:
    outcome = doctor.package(Requirement(line))
    assert outcome.status is status
    assert outcome.value.endswith(value)


def test_doctor_extras_equal_those_of_project() -> None:
    project = tomllib.loads((Path(__file__).parents[4] / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"].keys() - {"benchmark", "daq", "dev", "manual"}
    assert doctor.EXTRAS.keys() == extras


def test_doctor_extra_unknown_to_old_installation_is_missing() -> None:
    status, value, advice = doctor.extra_packages("mcap", [Requirement('mcap>=1; extra == "dev"')])
    assert (status, value) == (CheckStatus.MISSING, "not known to this installation")
    assert "golfbench[mcap]" in advice


def test_doctor_extra_older_version_is_missing() -> None:
    status, value, _ = doctor.extra_packages("cad", [Requirement('numpy>=99; extra == "cad"')])
    assert (status, value) == (CheckStatus.MISSING, f"numpy {np.__version__}")


def test_doctor_extra_states_absent_packages_and_commands() -> None:
    lines = ["numpy>=2", 'numpy>=2; extra == "cad"', 'no-such-distribution>=1; extra == "page"']
    requirements = [Requirement(line) for line in lines]
    assert doctor.extra_packages("cad", requirements) == ItemResult(CheckStatus.OK, f"numpy {np.__version__}")
    status, value, advice = doctor.extra_packages("page", requirements)
    assert (status, value) == (CheckStatus.MISSING, "no no-such-distribution")
    assert "golfbench page" in advice
    assert '"golfbench[page]"' in advice


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGILL)", "child process ended with -4: no message"),
        ("raise ImportError('lib.so')", "ImportError: lib.so"),
        ("import time; time.sleep(60)", "timed out after 1"),
    ],
    ids=["ends the interpreter", "raises", "hangs"],
)
def test_doctor_package_import_failure_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, found: str
) -> None:
    (tmp_path / "numpy.py").write_text(code)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(doctor, "CHILD_TIME_LIMIT", 1.0)
    outcome = doctor.package(Requirement("numpy"))
    assert outcome.status is CheckStatus.MISSING
    assert f"{np.__version__}, import fails: " in outcome.value
    assert found in outcome.value


def test_doctor_package_probes_without_metadata_report_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def requires(name: str) -> Iterator[str]:
        raise PackageNotFoundError(name)

    monkeypatch.setattr("importlib.metadata.requires", requires)
    (finding,) = doctor.examine(list(doctor.package_probes()))
    assert (finding.status, finding.required) == (CheckStatus.MISSING, True)
    assert "golfbench" in finding.value


@pytest.mark.slow
def test_doctor_compiled_code_reports_cold_warm_and_read_only_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    cold = doctor.compiled_code()
    assert cold.status is CheckStatus.LIMITED
    assert cold.value.startswith("cold")
    digests = module_digests()
    for module, *versions in (("sim.kane", "0123456789abcdef"), ("bench.control.step",)):
        assert doctor.compiled_code().value.startswith("cold")  # as after the check of the Kalman filter
        for version in (digests[module], *versions):
            (cache_folder() / module / version).mkdir(parents=True)
            (cache_folder() / module / version / "f.nbc").touch()
    warm = doctor.compiled_code()
    assert warm.status is CheckStatus.OK
    assert warm.value.startswith("warm, 2 functions")
    monkeypatch.setattr("os.access", lambda *_: False)
    assert "not writable" in doctor.compiled_code().value


@pytest.mark.parametrize("difference", [2e-9, float("nan")])
def test_doctor_kalman_filter_other_than_filterpy_is_not_usable(
    monkeypatch: pytest.MonkeyPatch, difference: float
) -> None:
    monkeypatch.setattr(doctor, "_child", lambda _: difference)
    (probe,) = (one for one in doctor.probes(Path()) if one.item == "Kalman filter")
    findings = [*doctor.examine([probe])]
    assert findings[0].status is CheckStatus.MISSING
    assert not doctor.usable(findings)


# The machine -----------------------------------------------------------------------------------------


@pytest.fixture
def files(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Contents of the kernel's files by path, in place of this machine's."""
    contents: dict[str, str] = {}
    monkeypatch.setattr(doctor, "small_text", lambda path: contents.get(str(path), ""))
    return contents


_RUNTIME, _PERIOD = (f"/proc/sys/kernel/sched_rt_{name}_us" for name in ("runtime", "period"))
_HUGE = "/sys/kernel/mm/transparent_hugepage/enabled"
_CLOCK = "/sys/devices/system/clocksource/clocksource0"
_MEMORY = "MemTotal: 9 kB\nMemAvailable:   {} kB"


@pytest.mark.parametrize(
    ("look", "contents", "status", "words"),
    [
        (doctor.kernel, {"/sys/kernel/realtime": "1"}, "ok", "PREEMPT_RT"),
        (doctor.virtual_machine, {"/proc/cpuinfo": "flags : fpu sse"}, "ok", "no"),
        (doctor.virtual_machine, {"/proc/cpuinfo": "flags : fpu hypervisor sse"}, "limited", "yes"),
        (doctor.memory, {"/proc/meminfo": _MEMORY.format(8_000_000)}, "ok", "7.6 GiB available"),
        (doctor.memory, {"/proc/meminfo": _MEMORY.format(1_000_000)}, "limited", "1.0 GiB available"),
        (doctor.throttling, {_RUNTIME: "-1", _PERIOD: "1000000"}, "ok", "off"),
        (doctor.throttling, {_RUNTIME: "950000", _PERIOD: "1000000"}, "ok", "95% of each 1 s"),
        (doctor.throttling, {_RUNTIME: "500000", _PERIOD: "1000000"}, "limited", "50% of each 1 s"),
        (doctor.huge_pages, {_HUGE: "[always] madvise never\n"}, "limited", "always"),
        (doctor.huge_pages, {_HUGE: "always [madvise] never\n"}, "ok", "madvise"),
        (doctor.huge_pages, {_HUGE: "always madvise [never]\n"}, "ok", "never"),
        (doctor.huge_pages, {}, "ok", "this kernel has none"),
        (doctor.clock, {f"{_CLOCK}/current_clocksource": "tsc"}, "ok", "source tsc"),
        (doctor.clock, {f"{_CLOCK}/current_clocksource": "acpi_pm"}, "limited", "dmesg"),
        (
            doctor.clock,
            {f"{_CLOCK}/current_clocksource": "hpet", f"{_CLOCK}/available_clocksource": "tsc hpet"},
            "limited",
            "clocksource=tsc",
        ),
    ],
)
def test_doctor_item_reads_kernel_files(
    look: Callable[[], ItemResult], contents: dict[str, str], status: str, words: str, files: dict[str, str]
) -> None:
    files |= contents
    outcome = look()
    assert (outcome.status, words in outcome.value + outcome.advice) == (status, True)


def test_doctor_processors_report_isolation_governor_and_single_core(
    files: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1, 2, 3})
    files["/sys/devices/system/cpu/isolated"] = "3"
    assert doctor.processors()[:2] == (CheckStatus.OK, "4, isolated: 3")
    files["/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"] = "powersave"
    assert doctor.processors().status is CheckStatus.LIMITED
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0})
    assert "share one" in doctor.processors().advice


def test_doctor_data_folder_reports_missing_and_low_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert doctor.data_folder(tmp_path / "not" / "yet").status is CheckStatus.OK
    file = tmp_path / "file"
    file.touch()
    loop, dangling = tmp_path / "loop", tmp_path / "dangling"
    loop.symlink_to(loop)
    dangling.symlink_to(tmp_path / "nowhere")
    for path, blocking in ((file, file), (loop, loop), (loop / "data", loop), (dangling, dangling)):
        outcome = doctor.data_folder(path)
        assert outcome.status is CheckStatus.MISSING
        assert str(blocking) in outcome.advice
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 1000}))
    assert doctor.data_folder(tmp_path).status is CheckStatus.LIMITED


# Real time -------------------------------------------------------------------------------------------


def _answer(held: bool, p99_us: float) -> dict[str, Any]:
    """Return the child's report when the kernel grants everything or nothing."""
    told = {True: ("FIFO 80", "", ""), False: ("OTHER 0", "Operation not permitted", "the action")}[held]
    names = ("scheduling", "memory lock", "timer slack", "idle states")
    setting = dict(zip(("granted", "reason", "action"), told, strict=True)) | {"held": held}
    return {
        "settings": dict.fromkeys(names, setting),
        "latency": {"p50_us": 8.0, "p99_us": p99_us, "max_us": 4000.0},
    }


SETTINGS = ("SCHED_FIFO", "memory lock", "timer slack", "idle states")


def _realtime(monkeypatch: pytest.MonkeyPatch, answer: dict[str, Any]) -> dict[str, Finding]:
    monkeypatch.setattr(doctor, "_child", lambda _: answer)
    return {finding.item: finding for finding in doctor.examine(list(doctor.realtime_probes()))}


def test_doctor_realtime_granted_is_ok(monkeypatch: pytest.MonkeyPatch) -> None:
    found = _realtime(monkeypatch, _answer(True, 40.0))
    assert {found[item].status for item in (*SETTINGS, "wake-up latency")} == {CheckStatus.OK}
    assert "FIFO 80" in found["SCHED_FIFO"].value
    assert "median 8 µs, 99 % 40 µs, longest 4000 µs" in found["wake-up latency"].value


def test_doctor_realtime_refused_is_limited_with_action(monkeypatch: pytest.MonkeyPatch) -> None:
    found = _realtime(monkeypatch, _answer(False, 900.0))
    assert {found[item].status for item in (*SETTINGS, "wake-up latency")} == {CheckStatus.LIMITED}
    assert "Operation not permitted" in found["SCHED_FIFO"].value
    assert {found[item].advice for item in SETTINGS} == {"the action"}
    assert "scheduling OTHER 0" in found["wake-up latency"].value


def test_doctor_realtime_child_failure_is_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: str) -> str:
        raise RuntimeError("child ended")

    monkeypatch.setattr(doctor, "_child", fail)
    found = {finding.item: finding for finding in doctor.examine(list(doctor.realtime_probes()))}
    assert found["SCHED_FIFO"].value == "not examined: RuntimeError: child ended"


def test_doctor_child_unknown_question_raises() -> None:
    with pytest.raises(RuntimeError, match="child process ended with 1"):
        doctor._child("no such question")


CAPABILITIES = {"none": 0, "nice": 1 << 23, "lock": 1 << 14, "both": 1 << 23 | 1 << 14}


@pytest.mark.parametrize(
    ("priority", "locked", "held", "lacking"),
    [
        (0, 8 * 2**20, "both", ""),
        (0, 8 * 2**20, "none", "rtprio 80 and memlock unlimited"),
        (0, 8 * 2**20, "nice", "memlock unlimited"),
        (0, 8 * 2**20, "lock", "rtprio 80"),
        (80, resource.RLIM_INFINITY, "none", ""),
        (resource.RLIM_INFINITY, 8 * 2**20, "none", "memlock unlimited"),
    ],
)
def test_doctor_limits_name_missing_rtprio_and_memlock(
    priority: int,
    locked: int,
    held: str,
    lacking: str,
    files: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    limits = {resource.RLIMIT_RTPRIO: priority, resource.RLIMIT_MEMLOCK: locked}
    monkeypatch.setattr("resource.getrlimit", lambda kind: (limits[kind], limits[kind]))
    files["/proc/self/status"] = f"Name:\tpython\nCapEff:\t{CAPABILITIES[held]:016x}"
    outcome = doctor.limits()
    assert outcome.status is (CheckStatus.LIMITED if lacking else CheckStatus.OK)
    assert outcome.advice == (f"raise to {lacking} in /etc/security/limits.conf" if lacking else "")


def test_doctor_clock_coarse_resolution_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.clock_getres", lambda _: 4e-3)
    assert doctor.clock().status is CheckStatus.LIMITED


def test_wake_up_latencies_are_sorted_and_not_negative() -> None:
    late = doctor.wake_up_latencies(ticks=20, period_ns=1_000_000)
    assert len(late) == 20
    assert late == sorted(late)
    assert late[0] >= 0.0


# CAN ---------------------------------------------------------------------------------------


def test_doctor_socketcan_unsupported_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> socket.socket:
        raise OSError(97, "Address family not supported by protocol")

    monkeypatch.setattr("socket.socket", refuse)
    outcome = doctor.socketcan()
    assert outcome.status is CheckStatus.MISSING
    assert "Address family not supported" in outcome.value


@pytest.mark.parametrize(("kind", "status"), [("280", CheckStatus.OK), ("1", CheckStatus.LIMITED)])
def test_doctor_socketcan_without_can_interface_is_limited(
    kind: str, status: CheckStatus, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Socket:
        def close(self) -> None: ...

    monkeypatch.setattr("socket.socket", lambda *_: Socket())
    monkeypatch.setattr(doctor, "small_text", lambda path: kind if path.name == "type" else "up")
    outcome = doctor.socketcan()
    assert outcome.status is status
    assert ("lo up" in outcome.value) is (status is CheckStatus.OK)


@pytest.mark.parametrize(
    ("channels", "status"), [(["pcan:PCAN_USBBUS1"], CheckStatus.OK), ([], CheckStatus.MISSING)]
)
def test_doctor_can_channels_none_is_missing(
    channels: list[str], status: CheckStatus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "_child", lambda _: channels)
    assert doctor.can_channels().status is status


NI_MISSING = "Could not find an installation of NI-DAQmx."


@pytest.mark.parametrize(
    ("found", "status", "value", "advice"),
    [
        (["", "", [], "found no package"], CheckStatus.MISSING, "no package nidaqmx", "golfbench[daq]"),
        (["1.7.0", "", [], NI_MISSING], CheckStatus.MISSING, NI_MISSING, "NI-DAQmx for Linux"),
        (["1.7.0", "24.3.0", [], ""], CheckStatus.LIMITED, "no card", "nilsdev"),
        (["1.7.0", "24.3.0", [], "(-50)"], CheckStatus.LIMITED, "24.3.0, (-50)", "nilsdev"),
        (["1.7.0", "24.3.0", ["Dev1 (PCIe-6363)"], ""], CheckStatus.OK, "NI-DAQmx 24.3.0: Dev1 (PCIe", ""),
    ],
)
def test_doctor_daq_cards_report_missing_part_with_advice(
    found: list[object], status: CheckStatus, value: str, advice: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("package", "runtime", "cards", "fault")
    monkeypatch.setattr(doctor, "_child", lambda _: dict(zip(names, found, strict=True)))
    outcome = doctor.daq_cards()
    assert outcome.status is status
    assert value in outcome.value
    assert advice in outcome.advice


def test_attached_daq_cards_without_nidaqmx_reports_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    nidaqmx = pytest.importorskip("nidaqmx")
    found = doctor.attached_daq_cards()
    assert found["package"] == nidaqmx.__version__
    assert found["runtime"] or "NI-DAQmx" in found["fault"]
    monkeypatch.setitem(sys.modules, "nidaqmx", None)  # not installed
    assert doctor.attached_daq_cards() == {
        "package": "",
        "runtime": "",
        "cards": [],
        "fault": doctor.attached_daq_cards()["fault"],
    }
    assert "golfbench[daq]" in doctor.attached_daq_cards()["fault"]


# The command -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_doctor_command_prints_json_only() -> None:
    answer = subprocess.run(
        [sys.executable, "-m", "bench", "doctor", "--json"], capture_output=True, text=True, check=True
    )
    told = json.loads(answer.stdout)
    assert told["usable"] is True
    assert [one for one in told["findings"] if one["value"].startswith("not examined")] == []
    assert answer.stderr == ""
