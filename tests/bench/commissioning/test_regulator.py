"""The pressure regulator: who turns it, and the error if it is not turned."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest

from bench.commissioning.machine.inputs import (
    RegulatorNotTurned,
    by_person,
    by_program,
    of_simulation,
    turned_once,
)


def test_by_person_prompts_gauge_and_absolute_pressure() -> None:
    asked: list[str] = []
    turn = by_person(asked.append, service=8.0e5, atmosphere=1.0e5)
    turn(1.3e5)
    turn(math.inf)
    assert [text.split(" to ")[1] for text in asked] == [
        "0.3 bar on its gauge (1.3 bar absolute)",
        "7.0 bar on its gauge (8.0 bar absolute)",
    ]


def test_turned_once_same_pressure_is_requested_once() -> None:
    asked: list[float] = []
    turn = turned_once(asked.append)
    for pressure in (3e5, 3e5, 4.5e5, math.inf, math.inf, 3e5):
        turn(pressure)
    assert asked == [3e5, 4.5e5, math.inf, 3e5]


def test_turned_once_interrupted_turn_is_repeated_back() -> None:
    """A person may have turned it before the prompt ended."""
    asked: list[float] = []

    def turn(pressure: float) -> None:
        asked.append(pressure)
        if pressure == 3e5:
            raise KeyboardInterrupt

    regulator = turned_once(turn)
    regulator(1e5)
    with pytest.raises(KeyboardInterrupt):
        regulator(3e5)
    regulator(1e5)
    assert asked == [1e5, 3e5, 1e5]


def test_turned_once_failed_turn_is_requested_again() -> None:
    asked: list[float] = []

    def fail(pressure: float) -> None:
        asked.append(pressure)
        raise RegulatorNotTurned("regulator", "stuck", "turned", "Loosen it.")

    turn = turned_once(fail)
    for _ in range(2):
        with pytest.raises(RegulatorNotTurned):
            turn(3e5)
    assert asked == [3e5, 3e5]


def test_of_simulation_without_plant_raises(tmp_path: Path) -> None:
    with pytest.raises(RegulatorNotTurned, match="--resume"):
        of_simulation(tmp_path)(1e5)


def test_by_program_passes_pressure_in_bar(tmp_path: Path) -> None:
    noted = tmp_path / "noted"
    program = tmp_path / "turn.py"
    program.write_text(f"import sys\nopen({str(noted)!r}, 'a').write(' '.join(sys.argv[1:]) + '\\n')\n")
    turn = by_program(f"{sys.executable} {program} --channel 2")
    turn(1.3e5)
    turn(math.inf)
    assert noted.read_text().splitlines() == ["--channel 2 1.300", "--channel 2 service"]


def test_by_program_failed_or_missing_program_raises(tmp_path: Path) -> None:
    program = tmp_path / "turn.py"
    program.write_text("import sys\nsys.exit('no answer from the regulator')\n")
    with pytest.raises(RegulatorNotTurned, match=r"1\.300(?s:.)*no answer from the regulator(?s:.)*--resume"):
        by_program(f"{sys.executable} {program}")(1.3e5)
    with pytest.raises(RegulatorNotTurned, match="No such file"):
        by_program(str(tmp_path / "missing"))(1.3e5)
