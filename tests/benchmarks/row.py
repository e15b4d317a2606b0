"""One measured figure and the bound it has to hold; options of a benchmark that are numbers."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import NamedTuple


class Row(NamedTuple):
    """A result; `at_least` and `at_most` are the project's promised limits, where there are any."""

    benchmark: str
    name: str
    value: float
    unit: str
    note: str = ""
    at_least: float | None = None
    at_most: float | None = None

    @property
    def holds(self) -> bool:
        """Whether the promise, if there is one, is kept. NaN keeps none."""
        return (self.at_least is None or self.value >= self.at_least) and (
            self.at_most is None or self.value <= self.at_most
        )

    @property
    def promise(self) -> str:
        """The bounds in words; empty without one."""
        return " ".join(
            f"at {which} {bound:g}"
            for which, bound in (("least", self.at_least), ("most", self.at_most))
            if bound is not None
        )


def numbers(name: str, arguments: Sequence[str], **defaults: int) -> argparse.Namespace:
    """Return the options of benchmark `name`, whole numbers with these defaults."""
    about = sys.modules[f"tests.benchmarks.{name}"].__doc__
    parser = argparse.ArgumentParser(prog=f"python -m tests.benchmarks {name}", description=about)
    for option, default in defaults.items():
        parser.add_argument(f"--{option}", type=int, default=default, metavar="N")
    return parser.parse_args(arguments)
