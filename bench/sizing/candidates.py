"""Which hardware is tried: a coarse grid, then single parts replaced by cheaper ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

from bench.sizing.catalogue import Catalogue
from bench.sizing.hardware import KINDS, Hardware, parts_of

_SMALL_FEED = 2.6e-7
"""Conductance of the three valves up to which the shipped feed and manifold serve, m3/(s Pa)."""


@dataclass(frozen=True)
class SizingGrid:
    """The coarse grid; both cylinders and all valves are alike in it, cheaper parts come one by one."""

    vanes: tuple[str, ...] = ("V400", "V600")
    cylinders: tuple[str, ...] = ("C50", "C63")
    valves: tuple[str, ...] = ("F2000", "F3500")
    absorbers: tuple[tuple[str, str], ...] = (("A40", "A90"), ("A120", "A170"))
    """Pairs of the right arm's and the wrist's."""
    pressures: tuple[float, ...] = (8.0e5, 10.0e5)
    """Pa absolute."""
    levers: tuple[float, ...] = (0.06,)
    """m"""
    lever_angles: tuple[float, ...] = (0.0,)
    """Mounting angles of the lever, rad."""
    frames: tuple[str, ...] = ("R80",)
    hoses: tuple[str, ...] = ("",)
    vents: tuple[str, ...] = ("",)

    def candidates(self, catalogue: Catalogue) -> list[Hardware]:
        """Return all combinations; feed and manifold follow the valves.

        Raises:
            BenchError: the catalogue has no part of a name.
        """
        found = []
        parts = product(self.vanes, self.cylinders, self.valves, self.absorbers)
        free = list(
            product(self.pressures, self.levers, self.lever_angles, self.frames, self.hoses, self.vents)
        )
        for (vane, bore, valve, (arm, wrist)), freely in product(parts, free):
            made = Hardware(vane, bore, bore, valve, valve, valve, arm, wrist, "L34", "M2", *freely)
            flow = sum(part.conductance for part in parts_of(catalogue, made).valves)
            found.append(made if flow <= _SMALL_FEED else replace(made, feed="L100", manifold="M5"))
        return found


def cheaper(catalogue: Catalogue, hardware: Hardware) -> list[Hardware]:
    """Return `hardware` with one part each replaced by the largest smaller one of a lower price class."""
    found = []
    for field, kind in KINDS.items():
        parts, own = getattr(catalogue, kind), getattr(hardware, field)
        if field == "frame" or not own:  # a frame has no price
            continue
        below = list(parts)[: list(parts).index(own)]
        less = [name for name in below if parts[name].price < parts[own].price]
        if less:
            found.append(replace(hardware, **{field: less[-1]}))
    return found


def without_repeats(found: Sequence[Hardware], known: Sequence[Hardware]) -> list[Hardware]:
    """Return those of `found` that are not in `known`, each once."""
    return [hardware for hardware in dict.fromkeys(found) if hardware not in known]
