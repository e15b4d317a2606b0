"""Checks of the inputs, and the pressure regulator during them.

A person acts, and the bench monitors all inputs at once. The table of stages is the complete check: outputs,
the person's act, and the inputs that then differ from the robot at rest. Over all stages each input has a
unique column, so that two exchanged cables show each other's column. While the outputs are energised the
regulator is turned down to zero: the stop contacts open without air behind them.
"""

from __future__ import annotations

import math
import shlex
import subprocess
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from math import isnan
from pathlib import Path
from typing import NamedTuple

from bench.base.errors import BenchError, ExitCode
from bench.commissioning.machine.commissioning_step import Mark
from drivers.base import PASSIVE, Command, Readings
from sim.exchange import SurroundingsWriter


class Act(NamedTuple):
    """Act of a person."""

    key: str
    """Name for programs."""
    text: str
    field: str
    """Field of the plant that it changes, in simulation."""
    value: bool


ACTS: Mapping[str, Act] = {
    act.key: act
    for act in (
        Act("press-stop", "Press an emergency stop, each day another one", "emergency_stop_clear", False),
        Act(
            "release-stop",
            "Release the emergency stop, and reset the safety relay",
            "emergency_stop_clear",
            True,
        ),
        Act("press-reset", "Press the local reset and keep it pressed", "local_reset", True),
        Act("release-reset", "Release the local reset", "local_reset", False),
        Act("open-guard", "The guard is released: open it", "guard_closed", False),
        Act("place-ball", "Put a ball on the tee", "ball_present", True),
        Act("take-ball", "Take the ball off the tee", "ball_present", False),
        Act("close-guard", "Leave, and close the guard", "guard_closed", True),
    )
}
"""Acts by their keys."""


class Input(NamedTuple):
    """An input that is on or off."""

    level: Callable[[Readings], float]
    rest: bool
    """Its level while the robot stands passive behind its closed guard."""
    off: str
    on: str
    """Words for its levels."""
    action: str


_CONTACT = "Look for a bridge, a welded contact or a short circuit, and for its plug and cable."
_VALVE = "Look at the valve, its coil and its position switch."

INPUTS: Mapping[str, Input] = {
    "emergency stop": Input(lambda r: r.emergency_stop_clear, True, "pressed", "clear", _CONTACT),
    "guard closed": Input(lambda r: r.guard_closed, True, "open", "closed", _CONTACT),
    "guard locked": Input(lambda r: r.guard_locked, True, "released", "locked", _CONTACT),
    "local reset": Input(lambda r: r.local_reset, False, "not pressed", "pressed", _CONTACT),
    "ball sensor": Input(lambda r: r.ball_present, False, "no ball", "a ball", "Clean, align or replace it."),
    "vent 1": Input(lambda r: r.vent_open[0], True, "shut", "open", _VALVE),
    "vent 2": Input(lambda r: r.vent_open[1], True, "shut", "open", _VALVE),
    "shut-off": Input(lambda r: r.shut_off_open, False, "shut", "open", _VALVE),
}
"""Inputs by their names."""


def levels(readings: Readings) -> tuple[float, ...]:
    """Return the levels of all inputs, in the order of INPUTS; one that is not fitted is -1."""
    shown = (one.level(readings) for one in INPUTS.values())
    return tuple(-1.0 if isnan(level) else float(level) for level in shown)


VENTS = ("vent 1", "vent 2")
FEEDBACKS = (*VENTS, "shut-off")
"""Inputs that show the effect of the stop contacts."""


class Stage(NamedTuple):
    """A stage of the check."""

    name: str
    outputs: Command
    act: str
    """Key of the person's act; empty: only the outputs change."""
    changed: tuple[str, ...]
    """Inputs that then differ from the robot at rest."""


_ENERGISED = Command(supply_enable=True, exhaust_closed=True, beacon=True)
_UNLOCKED = _ENERGISED._replace(guard_lock=False)
_OPEN = Command(guard_lock=False)
_AT_STOP, _AT_GUARD = "emergency stop pressed", "guard opened"


STAGES: tuple[Stage, ...] = (
    Stage("at rest", PASSIVE, "", ()),
    Stage("outputs energised", _ENERGISED, "", FEEDBACKS),
    Stage(_AT_STOP, _ENERGISED, "press-stop", ("emergency stop",)),
    Stage("emergency stop released", PASSIVE, "release-stop", ()),
    Stage("local reset pressed", PASSIVE, "press-reset", ("local reset",)),
    Stage("local reset released", PASSIVE, "release-reset", ()),
    Stage("outputs energised again", _ENERGISED, "", FEEDBACKS),
    Stage("guard lock released", _UNLOCKED, "", ("guard locked", *VENTS)),
    Stage(_AT_GUARD, _UNLOCKED, "open-guard", ("guard locked", "guard closed")),
    Stage("ball on the tee", _OPEN, "place-ball", ("guard locked", "guard closed", "ball sensor")),
    Stage("ball taken", _OPEN, "take-ball", ("guard locked", "guard closed")),
    Stage("guard closed", _OPEN, "close-guard", ("guard locked",)),
    Stage("guard locked", PASSIVE, "", ()),
)
"""The check, in its order."""
_RESET_STAGES = ("local reset pressed", "local reset released")


def stages(*, local_reset: bool) -> tuple[Stage, ...]:
    """Return the stages, those of the local reset only where one is wired."""
    return tuple(stage for stage in STAGES if local_reset or stage.name not in _RESET_STAGES)


class InputFinding(NamedTuple):
    """Something wrong with an input."""

    location: str
    found: str
    expected: str
    action: str

    @property
    def text(self) -> str:
        """The finding as a sentence."""
        return f"{self.location}: {self.found}; expected {self.expected}. {self.action}"


Column = tuple[bool, ...]


def fitted(readings: Readings, *, local_reset: bool) -> tuple[str, ...]:
    """Return the names of the inputs that are fitted, by `readings`."""
    return tuple(
        name
        for name, one in INPUTS.items()
        if not isnan(one.level(readings)) and (local_reset or name != "local reset")
    )


def judged(done: Sequence[Stage], seen: Sequence[Readings], names: Sequence[str]) -> list[InputFinding]:
    """Return the findings of inputs `names` that read `seen` in the stages `done`."""
    wanted = {name: tuple(INPUTS[name].rest != (name in stage.changed) for stage in done) for name in names}
    read = {name: tuple(INPUTS[name].level(r) > 0.5 for r in seen) for name in names}
    findings = list[InputFinding]()
    _take_welded(done, wanted, read, findings)
    wrong = [name for name in names if read[name] != wanted[name]]
    for a, b in combinations(list(wrong), 2):
        if {a, b} <= set(wrong) and read[a] == wanted[b] and read[b] == wanted[a]:
            wrong = [name for name in wrong if name not in (a, b)]
            findings.append(
                InputFinding(
                    f"{a} and {b}",
                    "each shows the levels of the other: they are exchanged",
                    "each shows its own",
                    f"Exchange the cables of {a} and {b}, or their numbers in the configuration.",
                )
            )
    findings += [_wrong(name, done, wanted[name], read[name]) for name in wrong]
    return findings


def _take_welded(
    done: Sequence[Stage], wanted: dict[str, Column], read: dict[str, Column], findings: list[InputFinding]
) -> None:
    """Find stages that all position switches sleep through, and count those as read in them."""
    shown = [name for name in FEEDBACKS if name in read]
    for at, stage in enumerate(done):
        moved = [name for name in shown if wanted[name][at] != wanted[name][at - 1]]
        if stage.name not in (_AT_STOP, _AT_GUARD) or not moved:
            continue
        if all(read[name][at] == wanted[name][at - 1] for name in moved):
            findings.append(
                InputFinding(
                    "stop contacts",
                    f"{' and '.join(moved)} unchanged with {stage.name}: a contact is welded or bridged",
                    "outputs without energy, whatever the bench commands",
                    "Replace the safety relay, and look for a bridge over its contacts.",
                )
            )
            for name in moved:
                read[name] = (*read[name][:at], wanted[name][at], *read[name][at + 1 :])


def _wrong(name: str, done: Sequence[Stage], wanted: Column, read: Column) -> InputFinding:
    """Return the finding of input `name`, which is not exchanged with another one."""
    one = INPUTS[name]
    word = {False: one.off, True: one.on}
    if len(set(read)) == 1:
        found = f"reads {word[read[0]]!r} all the time"
        action = (
            one.action if read[0] else f"Look for a cut cable, a loose plug or a lost supply. {one.action}"
        )
        return InputFinding(name, found, "a change when it is acted on", action)
    if all(a != b for a, b in zip(wanted, read, strict=True)):
        action = "Wire the contact that opens when acted on, or the other one of a position switch."
        return InputFinding(name, "reads the opposite at all times", "the right way round", action)
    at = next(k for k in range(len(done)) if wanted[k] != read[k])
    return InputFinding(
        name, f"reads {word[read[at]]!r} with {done[at].name}", f"{word[wanted[at]]!r}", one.action
    )


Regulator = Callable[[float], None]
"""Turns the regulator to a pressure, Pa absolute; infinite: to that of service."""

SERVICE = "service"
"""Word for the pressure of service, to a program."""
_PROGRAM_TIMEOUT = 60.0
"""Timeout of a program that turns it (s)."""


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

    When called it raises RegulatorNotTurned, with the program's error, if the program fails.
    """
    words = shlex.split(command)

    def turn(pressure: float) -> None:
        value = SERVICE if math.isinf(pressure) else f"{1e-5 * pressure:.3f}"
        try:
            done = subprocess.run(
                [*words, value], capture_output=True, text=True, timeout=_PROGRAM_TIMEOUT, check=False
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


class OperatorIO(NamedTuple):
    """Work at a robot by hand."""

    regulator: Regulator
    say: Callable[[str], None] = lambda text: None
    """Says to a person what to do."""
    confirm: Callable[[str], None] = lambda text: None
    """Says to a person what to do, and waits until it is done."""
    person: Callable[[], Mark | None] | None = None
    """Asks a person at the club for the ball's mark; None: no person is there."""
    look: Callable[[], Mark | None] = lambda: None
    """Reads the mark of a simulated ball."""
    act: Callable[[Act], None] = lambda act: None
    """Does something at the inputs, or says to a person what to do."""
    gauge: Callable[[], float] | None = None
    """Returns the reading of the gauge behind the regulator, Pa over the atmosphere; None: no person."""
    timeout: float = 60.0
    """Time for each act at the inputs, s."""


SIMULATED_TIMEOUT = 2.0
"""Time for each act of simulated hands (s)."""


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


def in_simulation(folder: Path, service: float, atmosphere: float) -> OperatorIO:
    """Return the hands at the plant with its files in `folder`; its gauge shows the regulator's setting.

    `service` and `atmosphere` are in Pa absolute.
    """
    turn, last = of_simulation(folder), [service]

    def turned(pressure: float) -> None:
        last[0] = min(pressure, service)
        turn(pressure)

    return OperatorIO(
        turned, act=act_in_simulation(folder), gauge=lambda: last[0] - atmosphere, timeout=SIMULATED_TIMEOUT
    )
