"""Checks of the inputs, and the pressure regulator during them.

A person acts, and the bench monitors all inputs at once. The stages of `inputs.toml` are the complete check:
outputs, the person's act, and the inputs that then differ from the robot at rest. Over all stages each input
has a unique column, so that two exchanged cables show each other's column. While outputs are energised the
regulator is turned down to zero: the stop contacts open without air behind them.
"""

from __future__ import annotations

import math
import shlex
import subprocess
import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import combinations
from math import inf, isnan
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from bench.base.errors import BenchError, ExitCode, Refused
from bench.commissioning.machine.commissioning_step import MachineFault, Mark
from drivers.base import PASSIVE, Command, Readings
from drivers.base.shared_memory import SharedMemoryError
from sim.exchange import SurroundingsWriter


class Act(NamedTuple):
    """Act of a person."""

    key: str
    """Name for programs."""
    text: str
    field: str
    """Field of the plant that it changes, in simulation."""
    value: bool


_TABLES: dict[str, Any] = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))

ACTS: Mapping[str, Act] = {key: Act(key, *row) for key, row in _TABLES["acts"].items()}
"""Acts by their keys."""


class Input(NamedTuple):
    """An input that is on or off."""

    reading: str
    """Field of `Readings`, in a tuple with its index."""
    rest: bool
    """Its level while the robot stands passive behind its closed guard."""
    off: str
    on: str
    """Words for its levels."""
    action: str

    def level(self, readings: Readings) -> float:
        """Return its level in `readings`; NaN if it is not fitted."""
        name, _, index = self.reading.partition(".")
        value = getattr(readings, name)
        return float(value[int(index)] if index else value)


INPUTS: Mapping[str, Input] = {
    name: Input(reading, rest, off, on, action.format_map(_TABLES["actions"]))
    for name, (reading, rest, off, on, action) in _TABLES["inputs"].items()
}
"""Inputs by their names."""


def levels(readings: Readings) -> tuple[float, ...]:
    """Return the levels of all inputs, in the order of INPUTS; one that is not fitted is -1."""
    shown = (one.level(readings) for one in INPUTS.values())
    return tuple(-1.0 if isnan(level) else level for level in shown)


FEEDBACKS = ("vent 1", "vent 2", "shut-off")
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
_OUTPUTS = {
    "passive": PASSIVE,
    "energised": _ENERGISED,
    "unlocked": _ENERGISED._replace(guard_lock=False),
    "open": Command(guard_lock=False),
}
_AT_STOP, _AT_GUARD = "emergency stop pressed", "guard opened"

STAGES: tuple[Stage, ...] = tuple(
    Stage(name, _OUTPUTS[outputs], act, tuple(changed))
    for name, (outputs, act, changed) in _TABLES["stages"].items()
)
"""The check, in its order."""
_RESET_STAGES = ("local reset pressed", "local reset released")


def stages(*, local_reset: bool) -> tuple[Stage, ...]:
    """Return the stages, those of the local reset only where one is wired."""
    return tuple(stage for stage in STAGES if local_reset or stage.name not in _RESET_STAGES)


Column = tuple[bool, ...]


def fitted(readings: Readings, *, local_reset: bool) -> tuple[str, ...]:
    """Return the names of the inputs that are fitted, by `readings`."""
    return tuple(
        name
        for name, one in INPUTS.items()
        if not isnan(one.level(readings)) and (local_reset or name != "local reset")
    )


def judged(done: Sequence[Stage], seen: Sequence[Readings], names: Sequence[str]) -> list[MachineFault]:
    """Return the findings of inputs `names` that read `seen` in the stages `done`."""
    wanted = {name: tuple(INPUTS[name].rest != (name in stage.changed) for stage in done) for name in names}
    read = {name: tuple(INPUTS[name].level(r) > 0.5 for r in seen) for name in names}
    findings = list[MachineFault]()
    _take_welded(done, wanted, read, findings)
    wrong = [name for name in names if read[name] != wanted[name]]
    for a, b in combinations(list(wrong), 2):
        if {a, b} <= set(wrong) and read[a] == wanted[b] and read[b] == wanted[a]:
            wrong = [name for name in wrong if name not in (a, b)]
            findings.append(
                MachineFault(
                    f"{a} and {b}",
                    "each shows the levels of the other: they are exchanged",
                    "each shows its own",
                    f"Exchange the cables of {a} and {b}, or their numbers in the configuration.",
                )
            )
    findings += [_wrong(name, done, wanted[name], read[name]) for name in wrong]
    return findings


def _take_welded(
    done: Sequence[Stage], wanted: dict[str, Column], read: dict[str, Column], findings: list[MachineFault]
) -> None:
    """Find stages that all position switches sleep through, and count those as read in them."""
    shown = [name for name in FEEDBACKS if name in read]
    for at, stage in enumerate(done):
        moved = [name for name in shown if wanted[name][at] != wanted[name][at - 1]]
        if stage.name not in (_AT_STOP, _AT_GUARD) or not moved:
            continue
        if all(read[name][at] == wanted[name][at - 1] for name in moved):
            findings.append(
                MachineFault(
                    "stop contacts",
                    f"{' and '.join(moved)} unchanged with {stage.name}: a contact is welded or bridged",
                    "outputs without energy, whatever the bench commands",
                    "Replace the safety relay, and look for a bridge over its contacts.",
                )
            )
            for name in moved:
                read[name] = (*read[name][:at], wanted[name][at], *read[name][at + 1 :])


def _wrong(name: str, done: Sequence[Stage], wanted: Column, read: Column) -> MachineFault:
    """Return the finding of input `name`, which is not exchanged with another one."""
    one = INPUTS[name]
    word = {False: one.off, True: one.on}
    if len(set(read)) == 1:
        found = f"reads {word[read[0]]!r} all the time"
        action = (
            one.action if read[0] else f"Look for a cut cable, a loose plug or a lost supply. {one.action}"
        )
        return MachineFault(name, found, "a change when it is acted on", action)
    if all(a != b for a, b in zip(wanted, read, strict=True)):
        action = "Wire the contact that opens when acted on, or the other one of a position switch."
        return MachineFault(name, "reads the opposite at all times", "the right way round", action)
    at = next(k for k in range(len(done)) if wanted[k] != read[k])
    return MachineFault(
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
            last[0] = math.nan  # until it is turned
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


INSIDE = 5.0
"""Factor of the time for an act with the guard released: a pin is set or removed; persons are counted."""
_PRESSED = 0.05
"""Time without a change after which the local reset counts as pressed or released (s)."""
SIMULATED_TIMEOUT = 2.0
"""Time for each act of simulated hands (s)."""


class WatchedMachine(Protocol):
    """A machine whose local reset is seen."""

    def may_move(self) -> bool:
        """Return whether a fitted local reset was pressed since guard or emergency stop last opened."""

    def watch(
        self, command: Command, before: Readings | None, air: float, settled: float, timeout: float
    ) -> Readings:
        """Return the readings once they differ from `before` and are settled (s), or at the timeout (s)."""


def without_press() -> Refused:
    """Return the error of a motion that no person at the robot permitted."""
    action = "Count the persons, close the guard, then repeat it (commission: --resume)."
    return Refused(
        "local reset", "no press and release behind a closed guard", "one before air comes on", action
    )


def await_local_reset(machine: WatchedMachine, hands: OperatorIO) -> None:
    """Return once the local reset, if fitted, was pressed and released since an interlock was last open.

    Raises:
        Refused: it was not pressed alone, or the device fails.
    """
    if machine.may_move():
        return
    hands.say("Air is to come on: count the persons outside the guard, then open the supply.")
    readings: Readings | None = None
    for key, pressed in (("", False), ("press-reset", True), ("release-reset", False)):
        if key:
            hands.act(ACTS[key])
        readings = machine.watch(PASSIVE, readings, inf, _PRESSED, INSIDE * hands.timeout)
        if readings.local_reset != pressed or not readings.guard_closed:
            raise without_press()


def of_simulation(folder: Path) -> Regulator:
    """Return the regulator of the simulated plant with its files in `folder`.

    When called it raises RegulatorNotTurned if the plant has ended.
    """

    def turn(pressure: float) -> None:
        try:
            with SurroundingsWriter(folder) as surroundings:
                surroundings.change(regulated=0.0 if math.isinf(pressure) else pressure)
        except SharedMemoryError as error:  # the plant has ended
            action = "Continue with --resume."
            raise RegulatorNotTurned("simulated regulator", str(error), "a plant", action) from None

    return turn


def act_in_simulation(folder: Path, act: Act) -> None:
    """Do `act` at the inputs of the simulated plant with its files in `folder`."""
    with SurroundingsWriter(folder) as surroundings:
        if act.field != "ball_present":
            surroundings.change(**{act.field: act.value})  # type: ignore[arg-type]
        elif act.value:
            surroundings.place_ball()
        else:
            surroundings.take_ball()


def in_simulation(folder: Path, service: float, atmosphere: float) -> OperatorIO:
    """Return the hands at the plant with its files in `folder`; its gauge shows the regulator's setting.

    `service` and `atmosphere` are in Pa absolute.
    """
    turn, last = of_simulation(folder), [service]

    def turned(pressure: float) -> None:
        last[0] = min(pressure, service)
        turn(pressure)

    act = partial(act_in_simulation, folder)
    return OperatorIO(turned, act=act, gauge=lambda: last[0] - atmosphere, timeout=SIMULATED_TIMEOUT)
