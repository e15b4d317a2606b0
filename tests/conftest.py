"""Rules for every test: no leaks, no silent skips, repeatable random cases, one marker for its run.

Leaks. A test that leaves a Python thread, a process (also one that detached itself) or a file in
shared memory behind fails. Module- and session-wide fixtures may hold theirs. In a parallel run each
worker checks its own threads, processes and files; a file that no worker can own (its name has no
process id and nothing has it open) is checked when the run ends.

Tools. `@pytest.mark.requires("chromium")`, or the fixture `tool` for its path, skips a test whose tool
is absent, by name; with GOLFBENCH_REQUIRE=chromium,postgres the skip is a failure. The run ends with a
list of the skips by tool.

Markers. `live` tests run alone, `slow` tests run in parallel, both in `make test-all`; `release` tests run in
`make test-release` only; a test without a marker runs in `make test`. A test that asks for a tool is `live`.
A live test that fails because, as its bench says, the machine stood still is repeated and listed as rerun.

Random cases. With CI set hypothesis derives its cases from the test itself; elsewhere they are random,
and a failure prints the blob that repeats it.
"""

from __future__ import annotations

import ctypes
import gc
import os
import pickle
import re
import shutil
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import hypothesis
import psutil
import pytest

if TYPE_CHECKING:
    from bench.config import Configuration
    from bench.swing.profile import Profile

SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - watched, never written
STALLED = "a stall of this (machine|computer)"
"""Report of a bench that stopped, as required, because no processor ran it."""
GRACE = 2.0
"""Seconds a thread, process or file may take to go away after its test."""

PR_SET_CHILD_SUBREAPER = 36

# Tools -----------------------------------------------------------------------------------------------


def _program(*names: str) -> Callable[[], str | None]:
    """Return a search for the first of `names` on the PATH."""
    return lambda: next(filter(None, map(shutil.which, names)), None)


def _postgres() -> str | None:
    """Return the path of PostgreSQL's initdb, which Debian keeps off the PATH."""
    off_path = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), reverse=True)
    return shutil.which("initdb") or next(map(str, off_path), None)


def _systemd() -> str | None:
    """Return systemctl's path when systemd runs this machine."""
    return shutil.which("systemctl") if Path("/run/systemd/system").is_dir() else None


def _nspawn() -> str | None:
    """Return the path of systemd-nspawn, which boots this machine's own systemd and needs root for it."""
    usable = os.geteuid() == 0 and Path("/usr/lib/systemd/systemd").exists() and shutil.which("nsenter")
    return shutil.which("systemd-nspawn") if usable else None


def _zenoh_pico() -> str | None:
    """Return the folder of the C library's description, if a compiler is there as well."""
    if not (shutil.which("cc") and shutil.which("pkg-config")):
        return None
    command = ["pkg-config", "--variable=pcfiledir", "zenohpico"]
    found = subprocess.run(command, check=False, capture_output=True, text=True, timeout=10)
    return found.stdout.strip() or None


TOOLS: dict[str, Callable[[], str | None]] = {
    "cc": _program("cc"),
    "chromium": _program("chromium", "chromium-browser", "google-chrome"),
    "cyclictest": _program("cyclictest"),
    "octave": _program("octave-cli", "octave"),
    "postgres": _postgres,
    "qemu": _program("qemu-system-x86_64"),
    "systemd": _systemd,
    "systemd-analyze": _program("systemd-analyze"),
    "systemd-nspawn": _nspawn,
    "tmux": _program("tmux"),
    "zenoh-pico": _zenoh_pico,
}
"""Optional tools by name; each search returns the tool's path or None."""

MISSING = pytest.StashKey[dict[str, list[str]]]()
"""Tests skipped by missing tool."""

FILES = pytest.StashKey[frozenset[str]]()
"""Files in shared memory before the run."""

LEFT = pytest.StashKey[list[str]]()
"""Files in shared memory that the run left behind."""


def demanded_tools() -> frozenset[str]:
    """Return the tools GOLFBENCH_REQUIRE demands; an unknown name, which would demand none, stops the run."""
    names = frozenset(os.environ.get("GOLFBENCH_REQUIRE", "").replace(",", " ").split())
    if unknown := sorted(names - TOOLS.keys()):
        raise pytest.UsageError(
            f"GOLFBENCH_REQUIRE names {', '.join(unknown)}; known tools: {', '.join(sorted(TOOLS))}"
        )
    return names


def _require(item: pytest.Item, name: str) -> str:
    """Return the path of tool `name`, else skip `item`, or fail it when the tool is demanded."""
    if name not in TOOLS:
        pytest.fail(f"unknown tool {name!r}; known: {', '.join(sorted(TOOLS))} (tests/conftest.py)", False)
    if path := TOOLS[name]():
        return path
    if name in demanded_tools():
        pytest.fail(f"{name} is absent, and GOLFBENCH_REQUIRE demands it", False)
    item.config.stash[MISSING][name].append(item.nodeid)
    pytest.skip(f"needs {name}")


@pytest.fixture
def tool(request: pytest.FixtureRequest) -> Callable[[str], str]:
    """Return `tool(name) -> path`, which skips or fails the test when the tool is absent."""
    return lambda name: _require(request.node, name)


@pytest.fixture(scope="session")
def configuration() -> Configuration:
    """Return the shipped configuration."""
    from bench.config import load_configuration, shipped_configuration

    return load_configuration(shipped_configuration())


@pytest.fixture(scope="session")
def default_profile() -> Profile:
    """Return the default profile."""
    from bench.swing.library import find_profile
    from bench.swing.profile import load_profile

    return load_profile(find_profile("default"))


@pytest.fixture(scope="session", autouse=True)
def _shared_gains(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Place the gains of a machine once for all workers of a run: it takes two seconds of a processor."""
    module: Any = sys.modules.get("bench.control.law.gain_scheduling")
    if module is None:  # no test of this run needs them
        yield
        return
    base, place = tmp_path_factory.getbasetemp(), module._designed.__wrapped__
    folder = (base.parent if hasattr(request.config, "workerinput") else base) / "machine-gains"
    folder.mkdir(exist_ok=True)

    @cache
    def designed(*machine: object) -> object:
        file = folder / sha256(repr(machine).encode()).hexdigest()
        with suppress(FileNotFoundError):
            return pickle.loads(file.read_bytes())  # noqa: S301 - our own bytes
        found: object = place(*machine)
        part = file.with_suffix(f".{os.getpid()}")
        part.write_bytes(pickle.dumps(found))
        part.rename(file)
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_designed", designed)
        yield


# The command line in this process --------------------------------------------------------------------


class Outcome(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def words(self) -> str:
        """All of the screen, with single blanks."""
        assert "Traceback" not in self.err
        return " ".join((self.out + self.err).split())


Run = Callable[..., Outcome]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command line; return its exit code and both outputs."""
    from bench.commands.cli import main

    def run(*arguments: object) -> Outcome:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments])
        assert isinstance(ended.value.code, int)
        return Outcome(int(ended.value.code), *capsys.readouterr())

    return run


# Leaks -----------------------------------------------------------------------------------------------


class Held(NamedTuple):
    """What this process holds that outlives a test."""

    threads: frozenset[threading.Thread]
    processes: frozenset[psutil.Process]
    files: frozenset[str]


def _is_helper_of_python(process: psutil.Process) -> bool:
    """Return whether `process` is multiprocessing's own, kept for the life of its parent."""
    try:
        line = " ".join(process.cmdline())
    except psutil.Error:
        return False
    return "multiprocessing.resource_tracker" in line or "multiprocessing.forkserver" in line


def _is_alive(process: psutil.Process) -> bool:
    """Return whether `process` runs; a finished orphan that came to us is reaped on the way."""
    try:
        if process.status() != psutil.STATUS_ZOMBIE:
            return True
        os.waitpid(process.pid, os.WNOHANG)
    except (psutil.NoSuchProcess, ChildProcessError):
        pass
    return False


def _is_foreign(name: str) -> bool:
    """Return whether a process outside this test run uses the shared-memory file `name`."""
    own = {os.getpid()} | {child.pid for child in psutil.Process().children(recursive=True)}
    return _is_used(name, {int(folder.name) for folder in Path("/proc").glob("[0-9]*")} - own)


def _is_used(name: str, processes: set[int]) -> bool:
    """Return whether one of `processes` (ids) has the shared-memory file `name` open or mapped."""
    path = str(SHARED_MEMORY / name)
    for folder in (Path(f"/proc/{number}") for number in processes):
        try:
            if path in (folder / "maps").read_text():
                return True
            if any(os.readlink(handle).startswith(path) for handle in (folder / "fd").iterdir()):
                return True
        except OSError:
            continue
    return False


def _is_contained(process: psutil.Process) -> bool:
    """Return whether `process` lives in a container, whose fixture answers for all that is in it."""
    try:
        return os.readlink(f"/proc/{process.pid}/ns/pid") != os.readlink("/proc/self/ns/pid")
    except OSError:
        return False


def _has_children() -> bool:
    """Return whether this process has a child; 400 times as fast as a list of them, as 7,000 tests need."""
    try:
        for thread in os.listdir("/proc/self/task"):
            with open(f"/proc/self/task/{thread}/children", "rb", buffering=0) as children:
                if children.read(1):
                    return True
    except OSError:
        return True
    return False


def _processes() -> frozenset[psutil.Process]:
    """Return the children of this process and theirs."""
    return frozenset(psutil.Process().children(recursive=True)) if _has_children() else frozenset()


def _files() -> frozenset[str]:
    """Return the names of all files in shared memory."""
    return frozenset(os.listdir(SHARED_MEMORY)) if SHARED_MEMORY.is_dir() else frozenset()


def _held() -> Held:
    return Held(frozenset(threading.enumerate()), _processes(), _files())


def _is_ours(name: str) -> bool:
    """Return whether this worker of a parallel run made the shared-memory file `name`.

    Its name carries the process id of this worker or of a child, or one of them has it open.
    """
    own = {os.getpid()} | {child.pid for child in _processes()}
    return any(str(number) in re.findall(r"[0-9]+", name) for number in own) or _is_used(name, own)


def _leaked(before: Held, parallel: bool) -> Held:
    now = _held()
    files = now.files - before.files
    return Held(
        frozenset(thread for thread in now.threads - before.threads if thread.is_alive()),
        frozenset(
            process
            for process in now.processes - before.processes
            if _is_alive(process) and not _is_helper_of_python(process) and not _is_contained(process)
        ),
        frozenset(filter(_is_ours, files)) if parallel else files,
    )


def _describe(process: psutil.Process) -> str:
    try:
        return f"process {process.pid}: {' '.join(process.cmdline())}"
    except psutil.Error:
        return f"process {process.pid} (just gone)"


@pytest.fixture(autouse=True)
def _no_leaks(request: pytest.FixtureRequest) -> Iterator[None]:
    """Fail a test that leaves a thread, a process or a shared-memory file behind."""
    parallel = hasattr(request.config, "workerinput")  # set by pytest-xdist in its workers
    before = _held()
    yield
    deadline = time.monotonic() + GRACE
    while any(leaked := _leaked(before, parallel)) and time.monotonic() < deadline:
        time.sleep(0.01)
    found = [f"thread {thread.name}" for thread in leaked.threads]
    found += [_describe(process) for process in leaked.processes]
    found += [f"file {SHARED_MEMORY / name}" for name in leaked.files if not _is_foreign(name)]
    for process in leaked.processes:
        process.kill()  # only what the test itself left
    if found:
        pytest.fail("the test left behind:\n  " + "\n  ".join(sorted(found)), False)


# The run ---------------------------------------------------------------------------------------------


def pytest_configure(config: pytest.Config) -> None:
    """Check GOLFBENCH_REQUIRE, choose hypothesis' profile, adopt processes that detach themselves."""
    demanded_tools()
    missing: dict[str, list[str]] = defaultdict(list)
    config.stash[MISSING] = missing
    hypothesis.settings.register_profile("ci", derandomize=True, deadline=None, print_blob=True)
    hypothesis.settings.register_profile("dev", deadline=None, print_blob=True)
    hypothesis.settings.register_profile("thorough", deadline=None, print_blob=True, max_examples=2000)
    hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "dev")
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Leave packages and tests, which live to the end of the run, out of every search for garbage."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests that ask for a tool as `live`, before -m selects; repeat live ones after a stall."""
    for item in items:
        if item.get_closest_marker("requires") or "tool" in getattr(item, "fixturenames", ()):
            item.add_marker("live")
        if item.get_closest_marker("live"):
            item.add_marker(pytest.mark.flaky(reruns=2, only_rerun=STALLED))


def pytest_sessionstart(session: pytest.Session) -> None:
    """Note the files in shared memory before the run."""
    session.config.stash[FILES] = _files()


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail a parallel run that left a file in shared memory which no worker could own."""
    gc.unfreeze()
    config = session.config
    if hasattr(config, "workerinput") or not config.getoption("numprocesses", None):
        return
    before = config.stash[FILES]
    left = sorted(name for name in _files() - before if not _is_foreign(name))
    if left:
        config.stash[LEFT] = left
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip or fail a test marked `requires` whose tool is absent."""
    for marker in item.iter_markers("requires"):
        for name in marker.args:
            _require(item, name)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """List files the run left behind, then the skipped tests: by missing tool, the others with reason."""
    for name in config.stash.get(LEFT, []):
        terminalreporter.line(f"the run left behind: file {SHARED_MEMORY / name}", red=True)
    skipped = terminalreporter.stats.get("skipped", [])
    if not skipped:
        return
    missing = config.stash[MISSING]
    by_tool = {nodeid for nodeids in missing.values() for nodeid in nodeids}
    terminalreporter.section("skipped tests")
    for name, nodeids in sorted(missing.items()):
        terminalreporter.line(f"missing tool {name}: {len(nodeids)} skipped")
        for nodeid in nodeids:
            terminalreporter.line(f"  {nodeid}")
    for report in skipped:
        if report.nodeid not in by_tool:
            reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
            terminalreporter.line(f"{report.nodeid}: {reason}")
