"""Wrong machines, and the words by which commissioning has to name them."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from sim.faults import Fault
from sim.plant import PlantParameters


class WrongCase(NamedTuple):
    """A robot with something wrong."""

    robot: PlantParameters
    faults: tuple[Fault, ...]
    place: str
    """Part of the place that is named."""
    words: str
    """Part of the text."""
    step: int
    """Number of the step that finds it, from 1."""


def wrong_machines(robot: PlantParameters) -> dict[str, WrongCase]:
    """Return wrong machines that are otherwise like `robot`, by name."""

    def broken(signal: str, kind: str, value: float, place: str, words: str, step: int = 1) -> WrongCase:
        return WrongCase(robot, (Fault("wrong", signal, kind, value),), place, words, step)  # type: ignore[arg-type]

    encoders, wrist = robot.encoders, robot.wrist
    half = replace(
        robot, encoders=replace(encoders, counts_per_revolution=encoders.counts_per_revolution // 2)
    )
    worn = replace(robot, wrist=replace(wrist, cross_leakage=6e-10))
    low = replace(robot, supply=replace(robot.supply, pressure=5.5e5))
    return {
        "valves swapped": broken("wrist valve", "swapped", 1.0, "wrist valve", "wrist and arm are swapped"),
        "valve reversed": broken("arm valve", "scale", -1.0, "arm valve", "opens the wrong way"),
        "spool stuck": broken("shoulder valve", "stuck", 0.0, "shoulder valve", "spool is stuck"),
        "spool stuck open": broken("arm valve", "stuck", 0.2, "arm valve", "spool is stuck"),
        "supply off": broken("supply", "scale", 0.6, "supply", "too low"),
        "encoders swapped": broken("arm encoder", "swapped", 2.0, "encoder", "are swapped"),
        "encoder stuck": broken("wrist encoder", "stuck", 0.0, "wrist encoder", "encoder is stuck"),
        "encoder of wrong scale": broken("shoulder encoder", "scale", 1.1, "shoulder encoder", "wrong scale"),
        "encoder of half the counts": WrongCase(half, (), "encoder", "wrong scale", 1),
        "valve off its centre": broken("wrist valve", "offset", 0.1, "wrist valve", "centre"),
        "chamber sensor off": broken("right arm B sensor", "offset", -2e4, "right arm B sensor", "zero"),
        "chamber sensor stuck": broken("right arm A sensor", "stuck", 101300.0, "arm valve", "its sensor"),
        "hose leaking": broken("arm valve", "leaking", 0.03, "air of the arm", "leaking hose", 3),
        "vents stay open": broken("vents", "stuck", 0.0, "vents", "A vent stays open", 3),
        "vents stay shut": broken("vents", "stuck", 1.0, "vents", "The vents stay shut", 1),
        "seal worn": WrongCase(worn, (), "air of the wrist", "seals", 3),
        "supply too low in service": WrongCase(low, (), "supply", "in service", 4),
        "encoder late": broken("arm encoder", "delayed", 0.008, "arm encoder", "later than the pressures", 5),
        "spool sticking": broken("wrist valve", "slow", 0.02, "wrist valve", "spool", 5),
    }
