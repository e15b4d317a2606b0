"""Records in shared memory that a simulated plant exchanges with others: their files and users.

`PLANT_REPORT` comes from the plant: `ContactMonitor` reads the struck balls from it, for a simulated launch
monitor. `PLANT_SURROUNDINGS` carries operator actions and faults to it: `SurroundingsWriter` writes them,
`HandledPlant` applies them.
"""

from __future__ import annotations

import dataclasses
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np

from drivers.base.compiled import fields
from drivers.base.records import COMMAND, READINGS, TRUTH
from drivers.base.shared_memory import SharedMemoryError, SharedRecord
from sim.ball import Ball
from sim.faults import Faults, turn_regulator
from sim.impact import impact_parameters
from sim.plant import Plant
from sim.sensors import Contact, contact_in

REPORT_FILE = "plant-report"
SURROUNDINGS_FILE = "plant-surroundings"


CONTACT = np.dtype(
    [
        ("struck", "?"),
        ("impact_time", "f8"),
        ("impact_head", "f8", (6,)),
        *fields("f8", "ball_velocity ball_spin", (3,)),
    ],
    align=True,
)
"""Contact with the last ball on the tee, as in PLANT_STATE: `sim.sensors.contact_in` reads it."""

NODE = np.dtype(
    [("operational", "?"), *fields("i8", "watchdog_trips command_tick passive_tick"), ("applied", COMMAND)],
    align=True,
)
"""The valve node: the ticks of the last applied command and of the last watchdog trip, and the command in
force."""

PLANT_REPORT = np.dtype(
    [
        ("readings", READINGS),
        ("truth", TRUTH),
        ("contact", CONTACT),
        ("contacts", "i8"),
        ("stop_energy", "f8", (3, 2)),
        ("peak_pressure", "f8", (6,)),
        *fields("f8", "lowest_clearance peak_head_speed"),
        ("node", NODE),
        *fields("i8", "ticks plant_slips slipped_ticks"),
        *fields("f8", "lateness max_lateness"),
    ],
    align=True,
)
"""One tick of the plant. Times are CLOCK_MONOTONIC (s). `contacts` counts struck balls, `ticks` the executed
ticks: the plant's own clock, which stops during a slip. `plant_slips` counts the slips, `slipped_ticks` the
ticks lost in them; `lateness` (s) is the delay of this tick."""

BALL = np.dtype([(field.name, "f8") for field in dataclasses.fields(Ball)[1:]], align=True)
"""Fields of a `sim.ball.Ball` after its name; all zero for the plan's ball."""

PLANT_SURROUNDINGS = np.dtype(
    [
        *fields("?", "emergency_stop_clear guard_closed local_reset"),
        ("encoder_valid", "u1", (3,)),
        ("frozen", "?"),
        ("regulated", "f8"),
        ("ball_handled", "i8"),
        ("ball_present", "?"),
        ("ball", BALL),
    ],
    align=True,
)
"""`frozen`: readings and their time stamps freeze. `regulated`: pressure to which the regulator is turned, Pa
absolute, at most that of the plan; 0: that of the plan. Whenever `ball_handled` changes, the ball is placed
or removed according to `ball_present`; `ball` is the next ball."""


class PlantFiles:
    """The two shared records; stale ones are replaced, and the files are removed at the end."""

    def __init__(self, folder: Path) -> None:
        """Create the files in `folder`; SharedMemoryError on failure."""
        self._stack = ExitStack()
        self._paths: dict[Path, int] = {}
        try:
            self.surroundings = self._make(folder / SURROUNDINGS_FILE, PLANT_SURROUNDINGS)
            self.report = self._make(folder / REPORT_FILE, PLANT_REPORT)
        except BaseException:
            self.close()
            raise

    @property
    def are_there(self) -> bool:
        """Whether the files still exist and have not been replaced."""
        return all(_number(path) == number for path, number in self._paths.items())

    def close(self) -> None:
        """Unmap and remove the files, but not those of a successor."""
        self._stack.close()

    def __enter__(self) -> PlantFiles:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _make(self, path: Path, dtype: np.dtype[Any]) -> SharedRecord:
        with suppress(OSError):  # an unwritable folder fails in the next line
            path.unlink(missing_ok=True)
        record = SharedRecord.create(path, dtype)
        self._paths[path] = _number(path)
        self._stack.callback(self._remove, path)
        self._stack.callback(record.close)
        return record

    def _remove(self, path: Path) -> None:
        if _number(path) == self._paths[path]:
            path.unlink(missing_ok=True)


def _number(path: Path) -> int:
    """Return the inode at `path`, 0 if missing."""
    try:
        return path.stat().st_ino
    except OSError:
        return 0


def undisturbed() -> np.ndarray[Any, Any]:
    """Return PLANT_SURROUNDINGS without operator actions and faults (a one-element array)."""
    record = np.zeros(1, PLANT_SURROUNDINGS)
    for name in ("emergency_stop_clear", "guard_closed", "encoder_valid"):
        record[name] = 1
    return record


def chosen_ball(folder: Path) -> Ball | None:
    """Return the ball that the tee of the plant in `folder` supplies; None for the plan's ball.

    Raises:
        SharedMemoryError: there is no plant, or one of other code.
    """
    record = np.zeros(1, PLANT_SURROUNDINGS)
    shared = SharedRecord.open(folder / SURROUNDINGS_FILE, PLANT_SURROUNDINGS)
    try:
        if not shared.read(record):
            return None
    finally:
        shared.close()
    return _ball_in(record["ball"][0])


def _ball_in(record: Any) -> Ball | None:
    """Return the ball in a BALL record, None for the plan's; ValueError if it is invalid."""
    values = dict(zip(BALL.names or (), record.item(), strict=True))
    return Ball("surroundings", **values) if any(values.values()) else None


class Surroundings(TypedDict, total=False):
    """Fields of PLANT_SURROUNDINGS that `SurroundingsWriter.change` changes."""

    emergency_stop_clear: bool
    guard_closed: bool
    local_reset: bool
    encoder_valid: tuple[bool, bool, bool]
    frozen: bool
    regulated: float


class SurroundingsWriter:
    """The single writer of the surroundings; values of an earlier writer remain until changed."""

    def __init__(self, folder: Path) -> None:
        """Attach to the plant with files in `folder`; SharedMemoryError if missing."""
        self._shared = SharedRecord.open(folder / SURROUNDINGS_FILE, PLANT_SURROUNDINGS)
        self._record = undisturbed()
        self._shared.read(self._record)

    def change(self, **values: Unpack[Surroundings]) -> None:
        """Change the given values only."""
        for name, value in values.items():
            self._record[name] = value
        self._shared.write(self._record)

    def place_ball(self) -> None:
        """Put the plan's ball on the tee by hand."""
        self.choose_ball(None)
        self._handle_ball(True)

    def take_ball(self) -> None:
        """Remove the ball, if present."""
        self._handle_ball(False)

    def choose_ball(self, ball: Ball | None) -> None:
        """Let the tee supply this ball from now on; None for the plan's ball."""
        self._record["ball"] = 0
        if ball is not None:
            for name in BALL.names or ():
                self._record["ball"][name] = getattr(ball, name)
        self._shared.write(self._record)

    def close(self) -> None:
        """Unmap the file; the surroundings remain. May be called twice."""
        self._shared.close()

    def __enter__(self) -> SurroundingsWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _handle_ball(self, present: bool) -> None:
        self._record["ball_handled"] += 1
        self._record["ball_present"] = present
        self._shared.write(self._record)


class HandledPlant:
    """Applies operator actions and surroundings to a plant and its state."""

    def __init__(self, plant: Plant, state: np.ndarray[Any, Any], faults: Faults | None) -> None:
        """Act on `plant`, its `state` (PLANT_STATE) and its `faults`."""
        self._plant, self._state, self._faults = plant, state, faults
        self.frozen = False
        """Whether readings and their time stamps are frozen."""
        self._regulated = 0.0
        self._ball_handled = 0
        self._ball = np.zeros(1, BALL).tobytes()

    def set_surroundings(self, record: np.ndarray[Any, Any]) -> None:
        """Apply a PLANT_SURROUNDINGS record."""
        state, new = self._state, record[0]
        for name in ("emergency_stop_clear", "guard_closed", "local_reset"):
            state[name] = bool(new[name])
        state["encoder_valid"] = new["encoder_valid"] != 0
        self.frozen = bool(new["frozen"])
        if new["regulated"] != self._regulated:
            self._regulated = float(new["regulated"])
            turn_regulator(self._plant, self._faults, self._regulated)
        if new["ball_handled"] != self._ball_handled:
            self._ball_handled = new["ball_handled"]
            state["ball_present"] = bool(new["ball_present"])
            if new["ball_present"]:
                state["struck"] = False
        if new["ball"].tobytes() != self._ball:
            self._ball = new["ball"].tobytes()
            self._change_ball(new["ball"])

    def _change_ball(self, ball: Any) -> None:
        """Use another ball from now on; an invalid one is ignored."""
        parameters = self._plant.parameters
        try:
            model = _ball_in(ball) or parameters.ball
            self._plant.impact[:] = impact_parameters(parameters.robot.club, model, parameters.robot.lie)
        except ValueError:
            return


def warm_up() -> None:
    """Compile the launch computation, so that the first ball is not delayed."""
    at_rest = (0.0, 0.0, 0.0)
    _ = Contact(0.0, at_rest, at_rest, (60.0, 10.0, 0.0), (0.0, 0.0, -300.0)).launch


class ContactMonitor:
    """Reads the report of the plant in a folder; the plant may stop and restart."""

    def __init__(self, folder: Path) -> None:
        """Watch the plant in `folder`; neither need exist yet."""
        self._path = folder / REPORT_FILE
        self._report = np.zeros(1, PLANT_REPORT)
        self._shared: SharedRecord | None = None
        self._inode = 0
        self._contacts = 0

    @property
    def attached(self) -> bool:
        """Whether a plant existed at the last call of `attach`."""
        return self._shared is not None

    def attach(self) -> None:
        """Attach to the plant if it exists or was replaced; call it occasionally.

        Raises:
            SharedMemoryError: the plant runs another version of the code.
        """
        try:
            inode = self._path.stat().st_ino
        except OSError:
            self.close()
            return
        if inode != self._inode:
            self.close()
            try:
                self._shared = SharedRecord.open(self._path, PLANT_REPORT)
            except SharedMemoryError:
                if self._path.exists():
                    raise
                return  # it was removed just now
            self._inode = inode
            self._contacts = int(self._report["contacts"][0]) if self._shared.read(self._report) else 0

    def look(self) -> Contact | None:
        """Return the newest contact, None if already returned."""
        if self._shared is None or not self._shared.read(self._report):
            return None
        contacts = int(self._report["contacts"][0])
        if contacts == self._contacts:
            return None
        self._contacts = contacts
        return contact_in(self._report["contact"])

    def close(self) -> None:
        """Unmap the plant's file. May be called twice."""
        if self._shared is not None:
            self._shared.close()
        self._shared, self._inode = None, 0
