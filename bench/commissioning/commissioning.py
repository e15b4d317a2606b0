"""The run through the steps: state stored after each, resumable, the machine passive whatever ends it."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple, TypedDict, TypeVar, get_type_hints

import numpy as np

from bench.base.atomic_file import NotStored, atomic_file, nearest_entry
from bench.base.errors import BenchError, Refused
from bench.base.from_toml import read_text
from bench.base.json_schema import require_fit
from bench.calibration.calibration import SeenInputs, wiring_digest
from bench.commissioning.machine.driver_machine import SimulatedMachine, Stalled
from bench.commissioning.machine.inputs import OperatorIO
from bench.commissioning.machine.machine import CommissionedMachine, MotionBounds, MotionTrace, Segment
from bench.commissioning.machine.machine_process import LiveRobot
from bench.commissioning.machine.step import (
    LEARNED_FILE,
    SWING_FILE,
    CommissioningStep,
    MachineFault,
    NamedStep,
    ParameterEstimate,
    RobotEstimate,
    StepResult,
    SwingingStep,
    SwungRobot,
    Traces,
)
from bench.commissioning.steps.friction_identification import FRICTION
from bench.commissioning.steps.inputs_check import INPUT_CHECK, check_inputs, raise_findings
from bench.commissioning.steps.pneumatic_identification import LEAKAGE
from bench.commissioning.steps.response_times import RESPONSE
from bench.commissioning.steps.wiring import VALVES, WIRING
from bench.commissioning.swings.robot_swings import LIMITS, with_following_limits
from bench.commissioning.swings.speed_ramp import LEARNING, SWINGS
from bench.commissioning.swings.swing_diagnosis import DiagnosedRobot
from bench.config import Configuration
from bench.control.measured_plant import value_at
from bench.supervisor.ownership import try_lock
from bench.swing.profile import load_profile
from sim.plant import PlantParameters

STATE_FILE, ROBOT_FILE, _LOCK_FILE = "commissioning.json", "robot.toml", "process"
_VERSION = 1
_DIGEST = "# as written by golfbench commission: "
"""Start of the last line of robot.toml, before the digest of the others."""
_REPEATS = 9
"""Max repetitions of a measuring step that a stall of the computer ended."""

STEPS = (WIRING, VALVES, LEAKAGE, FRICTION, RESPONSE)
"""The steps that measure, in their order."""
SWINGING_STEPS = (SWINGS, LEARNING, LIMITS)
"""The steps after them."""
_FILES = {SWINGS.name: SWING_FILE, LEARNING.name: LEARNED_FILE}
"""Files without which a step is repeated."""
ALL_STEPS: tuple[NamedStep, ...] = (INPUT_CHECK, *STEPS, *SWINGING_STEPS)


class DoneStep(NamedTuple):
    """A step that was done."""

    name: str
    title: str
    bounds: str
    date: str
    """ISO, UTC."""
    seconds: float
    """Time of the bench, s."""
    record: str
    """File of its traces, from the state's folder."""
    values: tuple[ParameterEstimate, ...]
    notes: tuple[str, ...]


class FaultRecord(NamedTuple):
    """What ended a commissioning."""

    step: str
    date: str
    location: str
    found: str
    expected: str
    action: str


_Part = TypeVar("_Part", DoneStep, FaultRecord, ParameterEstimate)


class _StoredState(TypedDict):
    """Content of the state's file."""

    version: int
    digest: str
    configuration: str
    simulated: bool
    robot: str
    done: tuple[DoneStep, ...]
    wrong: FaultRecord | None


@dataclass
class Commissioning:
    """State of a commissioning in its folder."""

    folder: Path
    digest: str
    """Digest of the configured robot."""
    configuration: str
    """File of the configuration, the last of its files."""
    simulated: bool
    robot: str = ""
    """File of the robot that truly moved last, simulated; empty: the configured one."""
    done: list[DoneStep] = field(default_factory=list)
    wrong: FaultRecord | None = None

    @property
    def values(self) -> list[ParameterEstimate]:
        """All values found, those of later steps last."""
        return [value for step in self.done for value in step.values]

    def has_done(self, step: NamedStep) -> bool:
        """Return whether `step` is done."""
        return step.name in {done.name for done in self.done}

    def save(self) -> None:
        """Store the state, whole or not at all."""
        self.folder.mkdir(parents=True, exist_ok=True)
        content = {
            "version": _VERSION,
            "digest": self.digest,
            "configuration": self.configuration,
            "simulated": self.simulated,
            "robot": self.robot,
            "done": [
                step._asdict() | {"values": [value._asdict() for value in step.values]} for step in self.done
            ],
            "wrong": None if self.wrong is None else self.wrong._asdict(),
        }
        with atomic_file(self.folder / STATE_FILE) as stream:
            stream.write(json.dumps(content, indent=1).encode())


def begin(folder: Path, configuration: Configuration, *, simulated: bool, resume: bool) -> Commissioning:
    """Return the commissioning in `folder`: a new one, or with `resume` the existing one.

    Steps are repeated from the first one whose file is missing, and all of them after a machine fault: the
    values may be those of a part that was replaced since. Nothing is written before its `save`.

    Raises:
        BenchError: one exists already, none exists to resume, it has another configuration, or robot.toml
            was edited.
    """
    digest = robot_digest(configuration, simulated=simulated)
    path, file = folder / STATE_FILE, str(configuration.files[-1].resolve())
    if resume:
        state = read_state(folder)
        measured = any(step.name != INPUT_CHECK.name for step in state.done)
        kept = not state.wrong and (simulated or measured)
        if state.simulated != simulated or (state.digest != digest and kept):
            kind = "simulated" if state.simulated else "not simulated"
            expected = f"the robot and wiring of {state.configuration}, {kind}"
            action = "Continue with the same --config and --sim, or begin in another folder."
            raise BenchError(str(path), "another configured robot", expected, action)
        if state.digest != digest:
            state.digest, state.configuration = digest, file
        lost = (i for i, one in enumerate(state.done) if not (folder / _FILES.get(one.name, "")).exists())
        state.done = state.done[: 0 if state.wrong else next(lost, None)]
        state.wrong = None
    else:
        if path.exists():
            action = "Continue it with --resume, or name another folder."
            raise BenchError(str(path), "an existing commissioning", "an empty folder", action)
        above = nearest_entry(folder)
        if not above.is_dir():
            raise NotStored(str(above), "no folder", "a folder", "Name another one with --output.")
        state = Commissioning(folder, digest, file, simulated)
    require_unedited(folder / ROBOT_FILE)
    return state


def with_digest(text: str) -> str:
    """Return the `text` of robot.toml with its digest in a last line."""
    return f"{text}{_DIGEST}{sha256(text.encode()).hexdigest()[:16]}\n"


def require_unedited(path: Path) -> None:
    """Raise Refused if the robot.toml at `path` is not as it was written."""
    if not path.exists():
        return
    action = "Move it to another name, or delete it; a change that stays goes into a file with it as `base`."
    found = read_text(path, "a text", action)
    if found != with_digest(found.rpartition(_DIGEST)[0]):
        raise Refused(str(path), "an edited file", "the file as golfbench commission wrote it", action)


def read_state(folder: Path) -> Commissioning:
    """Return the state stored in `folder`.

    Raises:
        BenchError: it is missing, or a value in it is invalid.
    """
    path, action = folder / STATE_FILE, "Begin again in another folder."
    location = f"{path}: state"
    text = read_text(path, "an existing commissioning", "Begin without --resume.")
    try:
        content: Any = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BenchError(str(path), f"no JSON: {error}", "the state of a commissioning", action) from None
    require_fit(content, _StoredState, location, action)
    stored: _StoredState = content
    if stored["version"] != _VERSION:
        found = f"version {stored['version']}"
        raise BenchError(f"{location}.version", found, f"version {_VERSION}", action)
    done = []
    for i, step in enumerate(content["done"]):
        values = tuple(_stored(ParameterEstimate, value) for value in step["values"])
        for j, value in enumerate(values):
            try:
                float(value_at(PlantParameters(), value.key))
            except (KeyError, IndexError, TypeError, ValueError):
                place = f"{location}.done[{i}].values[{j}].key"
                raise BenchError(place, repr(value.key), "a number below [plant]", action) from None
        done.append(_stored(DoneStep, step | {"values": values, "notes": tuple(step["notes"])}))
    wrong = None if content["wrong"] is None else _stored(FaultRecord, content["wrong"])
    digest, configuration, simulated = (content[k] for k in ("digest", "configuration", "simulated"))
    return Commissioning(folder, digest, configuration, simulated, stored["robot"], done, wrong)


def _stored(kind: type[_Part], content: Mapping[str, Any]) -> _Part:
    """Return the `kind`, a named tuple, with the values of its fields in `content`."""
    return kind(**{name: content[name] for name in get_type_hints(kind)})


def robot_digest(configuration: Configuration, *, simulated: bool) -> str:
    """Return the digest of the configured robot, unless `simulated` also of its bench and driver settings."""
    wired = [] if simulated else [configuration.bench.id, wiring_digest(configuration)]
    content = [asdict(configuration.plant), *wired]
    return sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:16]


class _CountedMachine:
    """A machine whose motions in a step are counted and shown."""

    def __init__(self, machine: CommissionedMachine, title: str, progress: Callable[[str], None]) -> None:
        self._machine, self._title, self._progress = machine, title, progress
        self._motions = 0

    def set_supply(self, pressure: float) -> None:
        self._machine.set_supply(pressure)

    def run(self, segments: tuple[Segment, ...], bounds: MotionBounds) -> MotionTrace:
        self._motions += 1
        self._progress(f"{self._title}: motion {self._motions}")
        return self._machine.run(segments, bounds)

    def vent(self, duration: float = 40.0) -> MotionTrace:
        self._progress(f"{self._title}: venting after motion {self._motions}")
        return self._machine.vent(duration)


def see_inputs(
    state: Commissioning,
    configuration: Configuration,
    machine: SimulatedMachine | LiveRobot,
    hands: OperatorIO,
    *,
    in_force: str | None,
    keep: Callable[[SeenInputs], object],
    on_step: Callable[[NamedStep], None] = lambda step: None,
    progress: Callable[[str], None] = lambda what: None,
) -> None:
    """Check the inputs if their check is due: nothing moves before it has passed.

    `in_force` names a check that is still in force, empty without one; None: a simulated robot, which is
    checked once. `keep` stores a check.

    Raises:
        MachineFault: an input is wrong; the state says so.
        Refused: no person is there, or the device fails.
    """
    if in_force is None and state.has_done(INPUT_CHECK):
        return

    def check() -> StepResult:
        if in_force:
            return StepResult((), (f"{in_force} is in force",))
        seen, findings = check_inputs(machine, hands, configuration, progress)
        keep(seen)
        raise_findings(findings)
        beside = f"supply sensor {1e-5 * seen.gauge:+z.2f} bar off the gauge"
        return StepResult((), (f"seen to change: {', '.join(seen.seen)}", beside))

    _do(state, INPUT_CHECK, (lambda step: None) if in_force else on_step, check)


def commission(
    state: Commissioning,
    nominal: PlantParameters,
    machine: SimulatedMachine | LiveRobot,
    *,
    observe: Callable[[], tuple[str, ...]] = tuple,
    on_step: Callable[[NamedStep], None] = lambda step: None,
    progress: Callable[[str], None] = lambda what: None,
) -> RobotEstimate:
    """Do the measuring steps of `state` that are not done; store it after each.

    The machine is passive at the end. `observe` returns further notes after a step, such as a simulated
    robot's loads; `progress` is given each motion within a step.

    Raises:
        MachineFault: a step found the machine wrong; the state says so.
        Refused: an interlock ended a step, or stalls ended it again and again; it is repeated when resumed.
    """
    known = RobotEstimate(nominal, state.values)
    try:
        for number, step in enumerate(STEPS, 1):
            if state.has_done(step):
                continue
            file = f"records/{number}-{step.name}.npz"

            def work(step: CommissioningStep = step, file: str = file) -> StepResult:
                counted = _CountedMachine(machine, step.title, progress)
                traces, stalls = _measured(step, counted, known, progress)
                write_traces(state.folder / file, traces)
                result = step.estimate(traces, known)
                values = tuple(value._replace(step=step.name) for value in result.values)
                return StepResult(values, (*result.notes, *stalls, *observe()))

            _do(state, step, on_step, work, file, lambda: machine.time)
            known.add(state.done[-1].values)
    finally:
        machine.make_passive()
    return known


def commission_swings(
    state: Commissioning,
    known: Configuration,
    robot: SwungRobot,
    *,
    on_step: Callable[[NamedStep], None] = lambda step: None,
    progress: Callable[[str], None] = lambda what: None,
) -> None:
    """Do the swinging steps of `state` that are not done, on `robot`, which is `known` as measured.

    Raises:
        MachineFault: a step found the machine wrong; the state says so.
        Refused: the robot did not come to its address; the step is repeated when resumed.
        BenchError: the package casadi is not installed.
    """
    records = state.folder / "records"
    records.mkdir(parents=True, exist_ok=True)
    for step in SWINGING_STEPS:
        if state.has_done(step):
            continue
        diagnosed = DiagnosedRobot(robot, state.values, records)

        def work(step: SwingingStep = step, diagnosed: DiagnosedRobot = diagnosed) -> StepResult:
            try:
                swung = known_with_swing(known, state.folder) if state.has_done(SWINGS) else known
                return step.swing(diagnosed, swung, state.folder, progress)
            except Refused as error:
                raise diagnosed.explained(error) from error.__cause__

        _do(state, step, on_step, work, "records")


def known_with_swing(known: Configuration, folder: Path) -> Configuration:
    """Return `known` with the limits for the swing in `folder`; before it is designed unchanged."""
    file = folder / SWING_FILE
    if not file.exists():
        return known
    profile = load_profile(file)
    return with_following_limits(known, profile).for_profile(profile, file)


def _do(
    state: Commissioning,
    step: NamedStep,
    on_step: Callable[[NamedStep], None],
    work: Callable[[], StepResult],
    record: str = "",
    clock: Callable[[], float] = time.monotonic,
) -> None:
    """Do `step` by `work`, timed by `clock` (s), and store in `state` that it is done, or its fault."""
    on_step(step)
    begun = clock()
    try:
        result = work()
    except MachineFault as error:
        date = datetime.now(UTC).isoformat()
        state.wrong = FaultRecord(step.name, date, error.location, error.found, error.expected, error.action)
        state.save()
        raise
    named, date = (step.name, step.title, step.bounds_text), datetime.now(UTC).isoformat()
    done = DoneStep(*named, date, clock() - begun, record, result.values, result.notes)
    others = [one for one in state.done if one.name != step.name]
    state.done = [done, *others] if step is INPUT_CHECK else [*others, done]
    state.save()


def _measured(
    step: CommissioningStep,
    machine: CommissionedMachine,
    known: RobotEstimate,
    progress: Callable[[str], None],
) -> tuple[Traces, tuple[str, ...]]:
    """Return the traces of `step` and the stalls after which it was repeated, from the vented machine.

    Raises:
        Stalled: after the last repetition.
    """
    stalls: tuple[str, ...] = ()
    while True:
        try:
            if stalls:
                machine.vent()
            return step.measure(machine, known), stalls
        except Stalled as stall:
            if len(stalls) == _REPEATS:
                found = f"{stall.found}; it was repeated {_REPEATS} times"
                raise Stalled(stall.location, found, stall.expected, stall.action) from None
            stalls = (*stalls, f"repeated: {stall.found}")
            progress(f"{step.title}: {stalls[-1]}")


def write_traces(path: Path, traces: Traces) -> None:
    """Write `traces` to `path`, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {
        f"{name}/{column}": array
        for name, trace in traces.items()
        for column, array in trace.arrays().items()
    }
    with atomic_file(path) as stream:
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold the lock on `folder`, which is made if it is missing.

    Raises:
        Refused: another process holds it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / _LOCK_FILE).open("a+", encoding="ascii") as file:
        if not try_lock(file.fileno()):
            found = f"process {_owner(folder)}, which commissions there"
            raise Refused(str(folder), found, "no other process", "Wait for it, or name another folder.")
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield


def commissioning_process(folder: Path) -> int | None:
    """Return the id of the process that commissions in `folder`; None without one."""
    try:
        with (folder / _LOCK_FILE).open("rb") as file:  # the lock needs no right to write
            return None if try_lock(file.fileno()) else _owner(folder)
    except OSError:
        return None


def _owner(folder: Path) -> int | None:
    text = (folder / _LOCK_FILE).read_text(encoding="ascii").strip()
    return int(text) if text.isdecimal() else None
