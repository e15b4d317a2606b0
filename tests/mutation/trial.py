"""A mutant put before the tests: in a fork of a process that has the libraries imported, but nothing of ours.

The child imports `bench` and the tests anew, the mutated module from the changed source: every importer
gets the mutant's values and functions, and none keeps the original's.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import json
import os
import resource
import signal
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, NamedTuple

import pytest

OURS = ("bench", "tests")
"""Packages that are imported anew with every mutant; `sim` and `drivers` import nothing of `bench`."""
ROOT = Path(__file__).parents[2]
_PASSED = 0
_NOTICED = (pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.INTERRUPTED, pytest.ExitCode.USAGE_ERROR)
"""A test failed, a test module could not be imported, a conftest could not be imported."""


class Outcome(NamedTuple):
    """Test results of a source."""

    killer: str
    """The test that failed, `import` or `time`; empty when all passed."""
    seconds: dict[str, float]
    """CPU time of each test that ran, s."""
    loaded: tuple[str, ...]
    """All modules that were loaded at the end."""


class NoVerdictError(Exception):
    """The tests could not be run, which says nothing of the mutant."""


@dataclass
class Trials:
    """Mutants of `module` before `tests` (paths), one at a time; those that noticed one go first."""

    module: str
    tests: Sequence[str]
    order: list[str] = field(default_factory=list)
    """Names of tests in the order they are to run in; the others follow."""
    longest: float = 60.0
    """CPU time limit of one test, s; exceeding it kills the mutant."""

    def begin(self, source: str) -> Outcome:
        """Try the unchanged `source`, which all tests must pass; import its dependencies, order by time.

        Raises:
            NoVerdictError: a test fails on it.
        """
        warm(self._forked(source, "--collect-only").loaded)
        outcome = self._forked(source)
        if outcome.killer:
            raise NoVerdictError(f"{self.module}: {outcome.killer} fails without a mutant")
        self.order = sorted(outcome.seconds, key=outcome.seconds.__getitem__)
        self.longest = 5.0 + 5.0 * max(outcome.seconds.values())
        return outcome

    def killer(self, source: str) -> str:
        """Return which test notices `source`, or an empty string."""
        killer = self._forked(source).killer
        if killer in self.order:
            self.order.remove(killer)
            self.order.insert(0, killer)
        return killer

    def _forked(self, source: str, *options: str) -> Outcome:
        ours = [name for name in sys.modules if is_ours(name) and not name.startswith("tests.mutation")]
        if ours and ours != ["tests"]:
            raise NoVerdictError(f"imported before the mutant: {', '.join(ours)}")
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(reading)
            with open(writing, "w") as report:
                code = self._run(source, options, report)
            os._exit(code)
        os.close(writing)
        with open(reading) as report:
            lines = [json.loads(line) for line in report]
        _, status = os.waitpid(child, 0)
        return _outcome(os.waitstatus_to_exitcode(status), lines)

    def _run(self, source: str, further: Sequence[str], report: Any) -> int:
        """Run the tests on `source`; return pytest's exit code; in a fork only."""
        null = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(null, stream)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        sys.meta_path.insert(0, Swap(self.module, source))
        options = ["-x", "-q", "-p", "no:cacheprovider", "--no-header", "--tb=no", "--assert=plain"]
        options += ["--timeout=300", "--rootdir", str(ROOT), *further]
        code = int(pytest.main([*options, *self.tests], plugins=[Watch(self.order, self.longest, report)]))
        swapped = isinstance(getattr(sys.modules.get(self.module), "__loader__", None), _Source)
        _tell(report, swapped=swapped, loaded=sorted(sys.modules))
        return code


def is_ours(name: str) -> bool:
    """Return whether the module `name` must not outlive a mutant."""
    return name.split(".", maxsplit=1)[0] in OURS


def warm(names: Iterable[str]) -> None:
    """Import the modules `names` once for all mutants, but for ours."""
    for name in names:
        if not is_ours(name) and name not in sys.modules:
            with suppress(Exception):
                importlib.import_module(name)


def _outcome(code: int, lines: list[dict[str, Any]]) -> Outcome:
    """Return the outcome of a child that ended with `code`.

    Raises:
        NoVerdictError: it ended in another way than a mutant can make it, or never loaded the mutant.
    """
    told: dict[str, Any] = {}
    seconds: dict[str, float] = {}
    for line in lines:
        told |= line
        seconds |= line.get("seconds", {})
    if code == -signal.SIGPROF:
        return Outcome(told.get("begun", "time"), seconds, ())
    if code not in (_PASSED, *_NOTICED):
        raise NoVerdictError(f"the tests ended with {code}: {told}")
    if not told.get("swapped", False) and code == _PASSED:
        raise NoVerdictError("the tests never imported what they are to test")
    killer = "" if code == _PASSED else told.get("failed", "import")
    return Outcome(killer, seconds, tuple(told.get("loaded", ())))


def _tell(report: Any, **values: Any) -> None:
    report.write(json.dumps(values) + "\n")
    report.flush()


class Swap(importlib.abc.MetaPathFinder):
    """Finds one module's file, but loads `source` in its place."""

    def __init__(self, module: str, source: str) -> None:
        self.module, self.source = module, source

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return the spec of the mutated module; None leaves all others to the usual finders."""
        if fullname != self.module:
            return None
        usual = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if usual is None or usual.origin is None:
            return None
        loader = _Source(fullname, usual.origin, self.source)
        return importlib.util.spec_from_file_location(fullname, usual.origin, loader=loader)


class _Source(importlib.machinery.SourceFileLoader):
    """Loads a text as if it stood in the file."""

    def __init__(self, fullname: str, path: str, source: str) -> None:
        super().__init__(fullname, path)
        self.source = source

    def get_code(self, fullname: str) -> CodeType:
        """Return the compiled text; no cache file is read or written."""
        return compile(self.source, self.path, "exec", dont_inherit=True)


class Watch:
    """Orders the tests, ends one that takes too long, and reports each."""

    def __init__(self, order: Sequence[str], longest: float, report: Any) -> None:
        self.rank = {name: rank for rank, name in enumerate(order)}
        self.longest, self.report = longest, report

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Put those first that noticed others."""
        items.sort(key=lambda item: self.rank.get(item.nodeid, len(self.rank)))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Any:
        """Bound the CPU time of a test: an endless loop ends the process by SIGPROF."""
        _tell(self.report, begun=item.nodeid)
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_PROF, self.longest)
        begun = time.process_time()
        try:
            return (yield)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            _tell(self.report, seconds={item.nodeid: time.process_time() - begun})

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Report the first failure."""
        if report.failed:
            _tell(self.report, failed=report.nodeid)
