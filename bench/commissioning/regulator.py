"""Who turns the pressure regulator between the steps: a person, a program of the bench, or the simulation."""

from __future__ import annotations

import math
import shlex
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from bench.commissioning.inputs import Act
from bench.errors import BenchError, ExitCode
from sim.live.surroundings import SurroundingsWriter

Regulator = Callable[[float], None]
"""Turns the regulator to a pressure, Pa absolute; infinite: to that of service."""

SERVICE = "service"
"""Word for the pressure of service, to a program."""
_LONGEST = 60.0
"""s in which a program turns it."""


class RegulatorNotTurned(BenchError):
    """The pressure regulator stands where it stood."""

    exit_code = ExitCode.DEVICE


def turned_once(turn: Regulator) -> Regulator:
    """Return `turn`, called only where the pressure is another one than before."""
    last = [math.nan]

    def wanted(pressure: float) -> None:
        if pressure != last[0]:
            turn(pressure)
            last[0] = pressure

    return wanted


def by_person(ask: Callable[[str], None], service: float, atmosphere: float) -> Regulator:
    """Return a regulator that a person turns; `ask` waits until it is done.

    `service` and `atmosphere` are in Pa absolute.
    """

    def turn(pressure: float) -> None:
        wanted = service if math.isinf(pressure) else pressure
        ask(
            f"Turn the pressure regulator to {1e-5 * (wanted - atmosphere):.1f} bar on its gauge "
            f"({1e-5 * wanted:.1f} bar absolute)"
        )

    return turn


def by_program(command: str) -> Regulator:
    """Return a regulator that `command` turns: called with the pressure in bar absolute, or `service`.

    What it raises when called: RegulatorNotTurned, with what the program said.
    """
    words = shlex.split(command)

    def turn(pressure: float) -> None:
        value = SERVICE if math.isinf(pressure) else f"{1e-5 * pressure:.3f}"
        try:
            done = subprocess.run(
                [*words, value], capture_output=True, text=True, timeout=_LONGEST, check=False
            )
            found = (
                "" if done.returncode == 0 else f"exit code {done.returncode}: {done.stderr.strip()[-200:]}"
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            found = str(error)
        if found:
            raise RegulatorNotTurned(
                f"--regulator {command} {value}", found, "exit code 0", "Correct the program, then --resume."
            )

    return turn


def of_simulation(folder: Path) -> Regulator:
    """Return the regulator of the simulated plant with its files in `folder`."""

    def turn(pressure: float) -> None:
        with SurroundingsWriter(folder) as surroundings:
            surroundings.change(regulated=0.0 if math.isinf(pressure) else pressure)

    return turn


def act_in_simulation(folder: Path) -> Callable[[Act], None]:
    """Return what acts at the inputs of the simulated plant with its files in `folder`."""

    def act(one: Act) -> None:
        with SurroundingsWriter(folder) as surroundings:
            if one.field != "ball_present":
                surroundings.change(**{one.field: one.value})  # type: ignore[arg-type]
            elif one.value:
                surroundings.place_ball()
            else:
                surroundings.take_ball()

    return act


class SimulatedHands(NamedTuple):
    """Hands at a simulated plant in a process of its own."""

    turn: Regulator
    act: Callable[[Act], None]
    gauge: Callable[[], float]


def in_simulation(folder: Path, service: float, atmosphere: float) -> SimulatedHands:
    """Return the hands at the plant with its files in `folder`; its gauge shows what the regulator is set to.

    `service` and `atmosphere` are in Pa absolute.
    """
    turn, last = of_simulation(folder), [service]

    def turned(pressure: float) -> None:
        last[0] = min(pressure, service)
        turn(pressure)

    return SimulatedHands(turned, act_in_simulation(folder), lambda: last[0] - atmosphere)
