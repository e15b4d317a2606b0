"""`python -m tests.mutation`, or `make mutation`: do the tests notice small mistakes in the safety code?

Every mutant of envelope, answers to requests, state changes and lifecycle meets the tests named here,
compilation off, until one fails. Exit code 1 when fewer than 95 % are noticed, or a survivor is not in
`survivors.toml` with the reason why no test can or need notice it, or a mutant that stands there is noticed
after all.

(mutmut leaves out decorated functions, which is all of the envelope; cosmic-ray starts an interpreter a
mutant, two seconds of imports each.)
"""

from __future__ import annotations

import argparse
import ast
import os
import sys
import time
import tomllib
from pathlib import Path

os.environ["NUMBA_DISABLE_JIT"] = "1"  # before anything imports numba

from tests.mutation.mutants import Members, Mutant, mutants
from tests.mutation.trial import ROOT, Trials

_CONTROL = "tests/bench/control"
TARGETS = {
    "bench.control.envelope": (f"{_CONTROL}/test_envelope.py",),
    "bench.control.requests": (f"{_CONTROL}/test_answers.py",),
    "bench.control.states": (f"{_CONTROL}/test_answers.py", f"{_CONTROL}/test_states.py"),
    "bench.base.lifecycle": ("tests/bench/base/test_lifecycle.py", f"{_CONTROL}/test_answers.py"),
}
"""Modules and the tests that must notice: those on records alone, as a survivor costs the time of all."""
AT_LEAST = 0.95
SURVIVORS = Path(__file__).with_name("survivors.toml")
"""By module: mutants that may survive, by name, and why."""


def main() -> int:
    """Try every mutant of the named modules, by default all."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutation")
    parser.add_argument("modules", nargs="*", default=list(TARGETS), metavar="MODULE")
    parser.add_argument("--only", default="", metavar="TEXT", help="Try mutants with this in their name.")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="Try one in so many.")
    options = parser.parse_args()
    os.chdir(ROOT)
    explained = tomllib.loads(SURVIVORS.read_text())
    verdicts = [
        verdict(module, explained.get(module, {}), options.only, options.every) for module in options.modules
    ]
    return int(not all(verdicts))


def verdict(module: str, explained: dict[str, str], only: str, every: int) -> bool:
    """Try the mutants of `module`, print the survivors; return whether all is as expected."""
    path = ROOT / Path(*module.split(".")).with_suffix(".py")
    source = path.read_text()
    trials = Trials(module, TARGETS[module])
    begun = time.monotonic()
    trials.begin(source)
    all_mutants = list(mutants(source, enumerations()))
    tried = [mutant for mutant in all_mutants if only in mutant.name][::every]
    survivors: list[Mutant] = []
    excused_but_noticed = set(explained) - {mutant.name for mutant in all_mutants}
    for number, mutant in enumerate(tried, 1):
        killer = trials.killer(mutant.source)
        if killer and mutant.name in explained:
            excused_but_noticed.add(mutant.name)
        elif not killer:
            survivors.append(mutant)
            known = "explained" if mutant.name in explained else "SURVIVES"
            print(f"{known} {path.name}:{mutant.line}: {mutant.name}", flush=True)
        if number % 25 == 0:
            took = time.monotonic() - begun
            print(f"... {number} of {len(tried)}, {took:.0f} s", file=sys.stderr, flush=True)
    for name in sorted(excused_but_noticed):
        print(f"explained, but noticed or gone: {name}")
    unexplained = sum(mutant.name not in explained for mutant in survivors)
    share = 1.0 - len(survivors) / max(len(tried), 1)
    print(
        f"{module}: {len(tried) - len(survivors)} of {len(tried)} noticed ({share:.1%}), {unexplained} "
        f"survivors unexplained; {time.monotonic() - begun:.0f} s",
        flush=True,
    )
    return share >= AT_LEAST and not unexplained and not excused_but_noticed


def enumerations() -> Members:
    """Return the members of the lifecycle's enumerations, read from its source: it is not imported here."""
    tree = ast.parse((ROOT / "bench/base/lifecycle.py").read_text())
    found = {
        node.name: tuple(
            assigned.targets[0].id
            for assigned in node.body
            if isinstance(assigned, ast.Assign) and isinstance(assigned.targets[0], ast.Name)
        )
        for node in tree.body
        if isinstance(node, ast.ClassDef) and any(ast.unparse(base) == "IntEnum" for base in node.bases)
    }
    return found | {"_S": found["State"]}


if __name__ == "__main__":
    sys.exit(main())
