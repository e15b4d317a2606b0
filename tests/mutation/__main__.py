"""`python -m tests.mutation`, or `make mutation`: do the tests notice small mistakes in the safety code?

Each mutant of `bench/control/envelope.py` and `bench/lifecycle.py` is put in place of the module in a process
of its own, forked from one that has everything else imported, and the tests run until the first fails.
Compilation is off. Exit code 1 when fewer than 95 % are killed, or a survivor is not in `EXPLAINED`.
(mutmut leaves out decorated functions, which is all of the envelope, and cosmic-ray starts an interpreter a
mutant, two seconds of imports each.)
"""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
import time
from pathlib import Path

os.environ["NUMBA_DISABLE_JIT"] = "1"

import pytest

from tests.mutation.mutants import Mutant, mutants

ROOT = Path(__file__).parents[2]
TARGETS = {
    "bench.control.envelope": ("tests/bench/control/test_envelope.py",),
    "bench.lifecycle": (
        "tests/bench/test_lifecycle.py",
        "tests/bench/control/test_edges.py",
        "tests/bench/control/test_requests.py",
    ),
}
"""Modules and the tests that must notice, the quickest first."""
AT_LEAST = 0.95
LONGEST = 90.0
"""s that the tests of one mutant may take; longer is noticed, too."""

EXPLAINED: dict[str, str] = {}
"""Survivors that no test can or need notice: `module: change` and why."""


def is_killed(module: str, mutant: Mutant, tests: tuple[str, ...]) -> bool:
    """Return whether a test fails on `mutant`."""
    child = os.fork()
    if child == 0:
        os._exit(_failing(module, mutant, tests))
    deadline = time.monotonic() + LONGEST
    while time.monotonic() < deadline:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status) != 0
        time.sleep(0.01)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return True


def _failing(module: str, mutant: Mutant, tests: tuple[str, ...]) -> int:
    """Return 0 when all `tests` pass with `mutant` as `module`; run in a fork only."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    try:
        target = importlib.import_module(module)
        exec(compile(mutant.source, str(target.__file__), "exec"), target.__dict__)  # noqa: S102
        # What took values of it when it was imported is made anew from them.
        for name in [name for name in sys.modules if name.startswith("bench.") and name != module]:
            if name in _AFTER.get(module, ()):
                importlib.reload(sys.modules[name])
        options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:randomly", "--no-header", "--tb=no"]
        return int(pytest.main([*options, *tests]))
    except BaseException:
        return 1


_AFTER = {
    "bench.lifecycle": (
        "bench.control.envelope", "bench.control.requests", "bench.control.model", "bench.control.step",
        "bench.control.settings",
    ),
}  # fmt: skip


def main() -> int:
    """Try every mutant of the named modules, by default all."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutation")
    parser.add_argument("modules", nargs="*", default=list(TARGETS), metavar="MODULE")
    parser.add_argument("--every", type=int, default=1, help="Try one in so many.")
    options = parser.parse_args()
    os.chdir(ROOT)
    for name in ("bench.control.settings",):
        importlib.import_module(name)  # forks need not import them again
    failed = False
    for module in options.modules:
        failed |= not _verdict(module, options.every)
    return int(failed)


def _verdict(module: str, every: int) -> bool:
    path = ROOT / Path(*module.split(".")).with_suffix(".py")
    source = path.read_text()
    tests = TARGETS[module]
    if is_killed(module, Mutant(0, "nothing", source), tests):
        print(f"{module}: its tests fail without a mutant")
        return False
    tried = list(mutants(source))[::every]
    begun, killed, survivors = time.monotonic(), 0, []
    for number, mutant in enumerate(tried, 1):
        if is_killed(module, mutant, tests):
            killed += 1
        else:
            survivors.append(mutant)
            print(f"survives {path.name}:{mutant.line}: {mutant.what}", flush=True)
        if number % 20 == 0:
            print(
                f"... {number} of {len(tried)}, {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True
            )
    unexplained = [m for m in survivors if f"{module}: {m.what}" not in EXPLAINED]
    share = killed / len(tried)
    print(f"{module}: {killed} of {len(tried)} killed, {share:.1%}; {len(unexplained)} unexplained survivors")
    return share >= AT_LEAST and not unexplained


if __name__ == "__main__":
    sys.exit(main())
