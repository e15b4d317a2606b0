"""Checks of this machine for `golfbench doctor`, with status, finding and advice for each item.

Nothing here raises or changes the machine. Checks that may end or change a process (imports of binary
packages, real-time scheduling, memory locks, makers' drivers) run in a child process: this module with the
name of a question, whose answer it prints as JSON.
"""

from __future__ import annotations

import functools
import importlib.metadata
import itertools
import json
import os
import resource
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from enum import StrEnum
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from packaging.requirements import Requirement
from rich.console import Group
from rich.text import Text

from bench.base.atomic_file import nearest_entry
from bench.base.clock import GridClock
from bench.commands.common import plain_table
from bench.supervisor.real_time import IDLE, MEMORY, PRIORITY, SCHEDULING, SLACK, real_time
from drivers.base import DriverError
from drivers.daq.watchdog import error_text, load_nidaqmx

SCHEMA_VERSION = 1
"""Version of the JSON report; it changes when a field is renamed or changes its meaning."""

MEBIBYTE = 2**20
GIBIBYTE = 2**30

LATE = 200e-6
"""Seconds of wake-up latency (99 %) above which a 1 kHz loop loses a fifth of its period."""

CHILD_TIME_LIMIT = 60.0
"""Seconds a child process may take before its question counts as unanswered."""

MAX_FILTER_DIFFERENCE = 1e-9
"""Max difference between the compiled estimator's velocities and filterpy's (rad/s)."""

_ARPHRD_CAN = "280"
_CLOCKS = "/sys/devices/system/clocksource/clocksource0"
_STEADY = frozenset({"tsc", "arch_sys_counter", "kvm-clock"})
"""Clock sources that a read costs no trip to a chip."""
_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23

_MODULES = {"eclipse-zenoh": "zenoh", "python-can": "can", "rerun-sdk": "rerun"}
"""Import name of a distribution where it is not the same word with underscores."""

EXTRAS = {
    "cad": "golfbench draw --format step",
    "cluster": "golfbench cluster, --cluster",
    "design": "golfbench profile design, size, commission",
    "mcap": "golfbench export --format mcap",
    "mocap": "golfbench golfer with C3D",
    "notify": "notifications of campaigns",
    "page": "golfbench page",
    "postgresql": "a database on a PostgreSQL server",
}
"""Commands that need each extra of the installation; `daq` is an item of its group."""


class CheckStatus(StrEnum):
    """Status of a check."""

    OK = "ok"
    LIMITED = "limited"
    MISSING = "missing"


class ItemResult(NamedTuple):
    """Result of a check."""

    status: CheckStatus
    value: str
    advice: str = ""


ok = functools.partial(ItemResult, CheckStatus.OK)
limited = functools.partial(ItemResult, CheckStatus.LIMITED)
missing = functools.partial(ItemResult, CheckStatus.MISSING)


class Probe(NamedTuple):
    """A check to make."""

    group: str
    item: str
    look: Callable[[], ItemResult]
    required: bool = False
    """Whether the item is required for everything, including simulation."""


class Finding(NamedTuple):
    """A check with its result."""

    group: str
    item: str
    required: bool
    status: CheckStatus
    value: str
    advice: str


def examine(probes: Sequence[Probe]) -> Iterator[Finding]:
    """Look at each item in turn; one that cannot be looked at is `limited` and says why."""
    for probe in probes:
        try:
            outcome = probe.look()
        except Exception as error:
            outcome = limited(f"not examined: {type(error).__name__}: {error}")
        yield Finding(probe.group, probe.item, probe.required, *outcome)


def usable(findings: Sequence[Finding]) -> bool:
    """Return whether all requirements of the simulation are met."""
    return not any(finding.required and finding.status is CheckStatus.MISSING for finding in findings)


def count(findings: Sequence[Finding]) -> dict[CheckStatus, int]:
    """Return the number of findings of each status."""
    return {status: sum(f.status is status for f in findings) for status in CheckStatus}


def report(findings: Sequence[Finding]) -> dict[str, Any]:
    """Return the findings as a JSON document."""
    return {
        "schema": "golfbench.doctor",
        "schema_version": SCHEMA_VERSION,
        "time_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "usable": usable(findings),
        "count": count(findings),
        "findings": [finding._asdict() for finding in findings],
    }


def table(findings: Sequence[Finding]) -> Group:
    """Return the findings as a table for a terminal, closed by one line that sums them up."""
    rows = plain_table("", "status", "found", "what to do")
    for group, members in itertools.groupby(findings, key=lambda finding: finding.group):
        rows.add_row(Text(group, "bold"))
        for finding in members:
            gap = "red" if finding.required else "yellow"
            status = Text(finding.status, "green" if finding.status is CheckStatus.OK else gap)
            rows.add_row(Text(f"  {finding.item}"), status, Text(finding.value), Text(finding.advice))
        rows.add_section()
    counts = ", ".join(f"{number} {status}" for status, number in count(findings).items())
    verdict = "the simulation runs here" if usable(findings) else "golfbench cannot run here"
    return Group(rows, Text(f"{verdict}: {counts}", "bold"))


def probes(data_dir: Path) -> tuple[Probe, ...]:
    """Return every item to look at, cheap ones first; `data_dir` is where records will be stored."""
    return (
        Probe("machine", "Python", python),
        Probe("machine", "kernel", kernel),
        Probe("machine", "processors", processors),
        Probe("machine", "virtual machine", virtual_machine),
        Probe("machine", "memory", memory),
        Probe("machine", "data folder", functools.partial(data_folder, data_dir), required=True),
        Probe("packages", "compiled code", compiled_code),
        Probe("packages", "Kalman filter", kalman_filter, required=True),
        *package_probes(),
        *realtime_probes(),
        Probe("CAN", "SocketCAN", socketcan),
        Probe("CAN", "attached interfaces", can_channels),
        Probe("DAQ", "NI-DAQmx", daq_cards),
    )


# The machine -----------------------------------------------------------------------------------------


def python() -> ItemResult:
    """Look at the running interpreter; an installation has already refused one that is too old."""
    return ok(f"{sys.implementation.name} {sys.version.split()[0]} in {sys.prefix}")


def kernel() -> ItemResult:
    """Look for a kernel with full preemption."""
    release = f"{os.uname().sysname} {os.uname().release}"
    if small_text("/sys/kernel/realtime") == "1" or "PREEMPT_RT" in os.uname().version:
        return ok(f"{release}, PREEMPT_RT")
    return limited(
        f"{release}, no PREEMPT_RT",
        "enough for simulation; boot a PREEMPT_RT kernel to run hardware (Debian: linux-image-rt-amd64)",
    )


def processors() -> ItemResult:
    """Count the processors this process may use."""
    available = len(os.sched_getaffinity(0))
    isolated = small_text("/sys/devices/system/cpu/isolated")
    governor = small_text("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
    value = f"{available}" + (f", isolated: {isolated}" if isolated else "")
    if available < 2:
        return limited(value, "the loop and the rest share one: give it two or more")
    if governor == "powersave":
        advice = "clock rises late under load: cpupower frequency-set -g performance"
        return limited(f"{value}, governor {governor}", advice)
    return ok(value + (f", governor {governor}" if governor else ""))


def virtual_machine() -> ItemResult:
    """Look whether a hypervisor may take the processor away."""
    if "hypervisor" in small_text("/proc/cpuinfo").split():
        return limited("yes", "the host adds stalls: run hardware and timing proofs on a dedicated machine")
    return ok("no")


def memory() -> ItemResult:
    """Look at the memory that is free or can be freed."""
    lines = dict(line.split(":", 1) for line in small_text("/proc/meminfo").splitlines())
    available = int(lines["MemAvailable"].split()[0]) * 1024
    value = f"{available / GIBIBYTE:.1f} GiB available"
    if available < 2 * GIBIBYTE:
        return limited(value, "2 GiB are wanted: close other programs")
    return ok(value)


def data_folder(data_dir: Path) -> ItemResult:
    """Look whether records can be stored in `data_dir`, which need not exist yet."""
    existing = nearest_entry(data_dir)
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        advice = f"make {existing.absolute()} a folder you may write to, or set data_dir elsewhere"
        return missing(f"{data_dir.absolute()}: not writable", advice)
    free = shutil.disk_usage(existing).free
    value = f"{data_dir.absolute()}: {free / GIBIBYTE:.1f} GiB free"
    if free < GIBIBYTE:
        return limited(value, "a campaign of 100 swings may fill it: free 1 GiB")
    return ok(value)


# Packages --------------------------------------------------------------------------------------------


def package_probes() -> Iterator[Probe]:
    """Return one item for each package golfbench requires by its metadata, and for each of its EXTRAS."""
    try:
        requirements = [Requirement(line) for line in importlib.metadata.requires("golfbench") or ()]
    except importlib.metadata.PackageNotFoundError as error:
        found = f"{type(error).__name__}: {error}"
        outcome = missing(found, "install golfbench: `make demo`, or `pip install -e .`")
        yield Probe("packages", "golfbench", lambda: outcome, required=True)
        return
    for one in requirements:
        if one.marker is None or one.marker.evaluate({"extra": ""}):
            yield Probe("packages", one.name, functools.partial(package, one), required=True)
    for extra in EXTRAS:
        yield Probe("extras", extra, functools.partial(extra_packages, extra, requirements))


def package(requirement: Requirement) -> ItemResult:
    """Look whether a required distribution is installed in a version that is allowed, and can be imported."""
    name, action = requirement.name, "install what constraints.txt pins: `make clean demo`"
    if (version := installed_version(name)) is None:
        return missing("not installed", action)
    try:  # a wheel for another processor ends the process with SIGILL
        _run("-c", f"import {_MODULES.get(name, name.replace('-', '_'))}")
    except (RuntimeError, subprocess.TimeoutExpired) as error:
        return missing(f"{version}, import fails: {error}", action)
    if version not in requirement.specifier:
        return limited(f"{version}, outside the tested versions", action)
    return ok(version)


def installed_version(name: str) -> str | None:
    """Return the version of distribution `name`; None if it is not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def extra_packages(extra: str, requirements: Sequence[Requirement]) -> ItemResult:
    """Look whether those of `requirements` that `extra` alone has are installed."""
    versions, absent = list[str](), list[str]()
    for one in requirements:
        if one.marker and one.marker.evaluate({"extra": extra}) and not one.marker.evaluate({"extra": ""}):
            version = installed_version(one.name)
            fits = version is not None and one.specifier.contains(version, prereleases=True)
            (versions if fits else absent).append(f"{one.name} {version}" if version else f"no {one.name}")
    action = f'for {EXTRAS[extra]}: pip install "golfbench[{extra}]"'
    if absent or not versions:
        return missing(", ".join(absent) or "not known to this installation", action)
    return ok(", ".join(versions))


def compiled_code() -> ItemResult:
    """Look whether compiled code can be kept, and whether it already is."""
    found = _child("cache")
    folder, functions = Path(found["folder"]), found["functions"]
    if not os.access(nearest_entry(folder), os.W_OK | os.X_OK):
        return limited(
            f"{folder} is not writable", "every start recompiles: set NUMBA_CACHE_DIR to a writable folder"
        )
    if not functions:
        return limited(f"cold, will be kept in {folder}", "the first run compiles, later ones do not")
    return ok(f"warm, {functions} functions in {folder}")


def kalman_filter() -> ItemResult:
    """Compare the estimator as compiled for this processor with filterpy's filter."""
    difference = _child("filter")
    if not difference < MAX_FILTER_DIFFERENCE:  # also NaN
        found = f"velocities differ by {difference:.1e} rad/s from those of filterpy"
        return missing(found, "delete the folder of compiled code; if that is no help, use another machine")
    return ok(f"equal to filterpy within {MAX_FILTER_DIFFERENCE:g} rad/s")


# Real time -------------------------------------------------------------------------------------------


def realtime_probes() -> Iterator[Probe]:
    """Yield the checks of real time; the first one tries all settings of the loop in a child process."""
    granted = functools.cache(lambda: _child("realtime"))

    def setting(name: str) -> ItemResult:
        found = granted()["settings"][name]
        if found["held"]:
            return ok(f"{found['granted']}: granted and read back")
        return limited(f"{found['granted']}: {found['reason']}", found["action"])

    def wake_up() -> ItemResult:
        latency: dict[str, float] = granted()["latency"]
        value = "median {p50_us:.0f} µs, 99 % {p99_us:.0f} µs, longest {max_us:.0f} µs".format(**latency)
        value += f" of 500 at 1 kHz, scheduling {granted()['settings'][SCHEDULING]['granted']}"
        if latency["p99_us"] <= LATE * 1e6:
            return ok(value)
        return limited(value, "a quiet machine, SCHED_FIFO and PREEMPT_RT shorten it")

    for item, name in (("SCHED_FIFO", SCHEDULING), (MEMORY, MEMORY), (SLACK, SLACK), (IDLE, IDLE)):
        yield Probe("real time", item, functools.partial(setting, name))
    yield Probe("real time", "limits", limits)
    yield Probe("real time", "throttling", throttling)
    yield Probe("real time", "huge pages", huge_pages)
    yield Probe("real time", "clock", clock)
    yield Probe("real time", "wake-up latency", wake_up)


def limits() -> ItemResult:
    """Look at the resource limits, and at the capabilities that lift them."""
    priority = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    locked = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    value = f"rtprio {_limit(priority)}, memlock {_limit(locked, MEBIBYTE, ' MiB')}"
    status = dict(line.split(":", 1) for line in small_text("/proc/self/status").splitlines())
    held = int(status.get("CapEff", "0"), 16)
    nice, lock = held >> _CAP_SYS_NICE & 1, held >> _CAP_IPC_LOCK & 1
    if nice and lock:
        return ok(f"{value}, lifted by capabilities")
    priority_enough = nice or priority == resource.RLIM_INFINITY or priority >= PRIORITY
    locked_enough = lock or locked == resource.RLIM_INFINITY
    if priority_enough and locked_enough:
        return ok(value)
    wanted = [] if priority_enough else [f"rtprio {PRIORITY}"]
    wanted += [] if locked_enough else ["memlock unlimited"]
    return limited(value, f"raise to {' and '.join(wanted)} in /etc/security/limits.conf")


def throttling() -> ItemResult:
    """Look how much of each period real-time tasks may run before the kernel stops them."""
    runtime = int(small_text("/proc/sys/kernel/sched_rt_runtime_us"))
    period = int(small_text("/proc/sys/kernel/sched_rt_period_us"))
    if runtime < 0:
        return ok("off")
    value = f"{runtime / period:.0%} of each {period / 1e6:g} s"
    if runtime < 0.9 * period:
        return limited(value, "sysctl kernel.sched_rt_runtime_us=950000")
    return ok(f"{value}; the loop needs far less")


def huge_pages() -> ItemResult:
    """Look whether the kernel gathers everybody's small pages into huge ones, which stalls every task."""
    found = small_text("/sys/kernel/mm/transparent_hugepage/enabled")
    if "[always]" in found:
        return limited(
            "always",
            "the kernel copies whole huge pages every ten seconds: boot with transparent_hugepage=madvise",
        )
    return ok(next((w[1:-1] for w in found.split() if w[0] == "["), "this kernel has none"))


def clock() -> ItemResult:
    """Look at the monotonic clock: its stated and its observed step, and the kernel's source."""
    stated = time.clock_getres(time.CLOCK_MONOTONIC)
    stamps = [time.monotonic_ns() for _ in range(10_000)]
    step = min((b - a for a, b in itertools.pairwise(stamps) if b > a), default=0)
    source = small_text(f"{_CLOCKS}/current_clocksource") or "unknown"
    value = f"resolution {stated * 1e9:.0f} ns, observed step {step} ns, source {source}"
    has_tsc = "tsc" in small_text(f"{_CLOCKS}/available_clocksource").split()
    action = "boot with clocksource=tsc" if has_tsc else "see dmesg for why the kernel gave up tsc"
    if stated > 1e-6 or step > 5_000:
        return limited(f"{value}: too coarse for 1 kHz", action)
    if source not in _STEADY:
        return limited(f"{value}: each read of the clock takes microseconds", action)
    return ok(value)


def _limit(value: int, unit: int = 1, name: str = "") -> str:
    return "unlimited" if value == resource.RLIM_INFINITY else f"{value / unit:g}{name}"


# CAN -------------------------------------------------------------------------------------------------


def socketcan() -> ItemResult:
    """Look whether the kernel speaks CAN and which interfaces it has."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError) as error:
        return missing(
            f"no CAN sockets: {error}", "simulation needs none; hardware: load can, can_raw, can_dev"
        )
    names = [
        f"{folder.name} {small_text(folder / 'operstate')}"
        for folder in sorted(Path("/sys/class/net").iterdir())
        if small_text(folder / "type") == _ARPHRD_CAN
    ]
    if names:
        return ok(", ".join(names))
    return limited(
        "CAN sockets, no interface",
        "attach one and `ip link set can0 up type can bitrate 1000000`, or add a vcan to try",
    )


def can_channels() -> ItemResult:
    """Look for adapters with separate drivers, through python-can."""
    if channels := _child("can"):
        return ok(", ".join(channels))
    return missing("none", "not needed for simulation; for hardware attach an adapter and install its driver")


# DAQ -------------------------------------------------------------------------------------------------


def daq_cards() -> ItemResult:
    """Look for the package nidaqmx, for NI's own driver that it needs, and for cards."""
    found = _child("daq")
    if not found["package"]:
        return missing(
            "no package nidaqmx",
            'simulation needs none; for a card: pip install "golfbench[daq]", and NI\'s driver',
        )
    package = f"nidaqmx {found['package']}"
    if not found["runtime"]:
        return missing(
            f"{package}, but NI's driver does not answer: {found['fault']}",
            "simulation needs none; for a card: install NI-DAQmx for Linux from ni.com, then restart",
        )
    driver = f"{package}, NI-DAQmx {found['runtime']}"
    if found["fault"] or not found["cards"]:
        advice = "attach one, and see that NI's tool nilsdev lists it"
        return limited(f"{driver}, {found['fault'] or 'no card'}", advice)
    return ok(f"{driver}: {', '.join(found['cards'])}")


def _child(question: str) -> Any:
    return json.loads(_run("-m", "bench.commands.machine.doctor", question))


def _run(*arguments: str) -> str:
    """Return what another Python prints; raises when it fails or takes too long."""
    answer = subprocess.run(
        [sys.executable, *arguments], check=False, capture_output=True, text=True, timeout=CHILD_TIME_LIMIT
    )
    if answer.returncode:
        reason = (answer.stderr.strip().splitlines() or ["no message"])[-1]
        raise RuntimeError(f"child process ended with {answer.returncode}: {reason}")
    return answer.stdout


def small_text(path: str | Path) -> str:
    """Return a small text file without its last newline, '' when it cannot be read."""
    try:
        return Path(path).read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


# Questions to a child process ------------------------------------------------------------------------


def wake_up_latencies(ticks: int = 500, period_ns: int = 1_000_000) -> list[float]:
    """Return how late (s, ascending) the loop's clock wakes on its grid."""
    clock = GridClock(period_ns)
    latencies = []
    for _ in range(ticks):
        clock.wait()
        latencies.append((clock.woke - clock.due) * 1e-9)
    return sorted(latencies)


def _realtime() -> dict[str, Any]:
    """Return the real-time settings the kernel grants, and the wake-up latency (us) under them."""
    with real_time("prefer") as granted:
        late = wake_up_latencies()
    places = {"p50_us": len(late) // 2, "p99_us": int(0.99 * len(late)), "max_us": -1}
    latency = {name: round(late[place] * 1e6, 1) for name, place in places.items()}
    return {**granted, "latency": latency}


def _can_channels() -> list[str]:
    """Return the attached CAN channels as `interface:channel`; no network is searched."""
    import can

    attached = can.VALID_INTERFACES - {"virtual", "udp_multicast", "socketcand"}
    found = can.detect_available_configs(sorted(attached))
    return [f"{config['interface']}:{config['channel']}" for config in found]


def attached_daq_cards() -> dict[str, Any]:
    """Return `package` and `runtime`, versions of what drives NI's cards ("" when missing), and `cards`.

    `fault` says what NI's own driver says where it does not answer.
    """
    found: dict[str, Any] = {"package": "", "runtime": "", "cards": [], "fault": ""}
    try:
        nidaqmx = load_nidaqmx()
        found["package"] = version("nidaqmx")
        system = nidaqmx.system.System.local()
        found["runtime"] = ".".join(map(str, system.driver_version))
        found["cards"] = [f"{card.name} ({card.product_type})" for card in system.devices]
    except DriverError as error:
        found["fault"] = str(error)
    except Exception as error:  # NI's own, of which nothing can be imported where it is missing
        found["fault"] = error_text(error)
    return found


def _compiled_code() -> dict[str, Any]:
    """Return the folder of this installation's machine code, and the functions there once a bench has run."""
    from drivers.base.machine_code import cache_folder, module_digests

    folder = cache_folder()
    kept = {
        name: len([*(folder / name / digest).rglob("*.nbc")]) for name, digest in module_digests().items()
    }
    return {"folder": str(folder), "functions": sum(kept.values()) if kept["bench.control.step"] else 0}


def _filter_difference() -> float:
    from bench.control.estimate.reference_filter import velocity_difference

    return velocity_difference()


_QUESTIONS: dict[str, Callable[[], Any]] = {
    "realtime": _realtime,
    "can": _can_channels,
    "daq": attached_daq_cards,
    "cache": _compiled_code,
    "filter": _filter_difference,
}

if __name__ == "__main__":
    print(json.dumps(_QUESTIONS[sys.argv[1]]()))
