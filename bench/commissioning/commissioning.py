"""The run through the steps: state stored after each, resumable, the machine passive whatever ends it.

Its results: the commissioned robot as a configuration over the one it began with, and the report to sign.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from hashlib import sha256
from importlib.resources import files
from math import inf
from pathlib import Path
from shlex import quote
from textwrap import wrap
from typing import Any, NamedTuple, TypedDict, TypeVar, get_type_hints

import jinja2
import numpy as np

from bench.base.atomic_file import NotStored, atomic_file, nearest_entry
from bench.base.errors import BenchError, Refused
from bench.base.from_toml import read_text
from bench.base.json_schema import json_value, require_fit
from bench.base.to_toml import toml_value
from bench.calibration.calibration import SeenInputs, wiring_digest
from bench.commissioning.machine.commissioning_step import (
    LEARNED_FILE,
    SWING_FILE,
    Arm,
    CommissioningStep,
    MachineFault,
    NamedStep,
    ParameterEstimate,
    RobotEstimate,
    StepResult,
    Traces,
)
from bench.commissioning.machine.driver_machine import REPEATS, SimulatedMachine, Stalled
from bench.commissioning.machine.inputs import OperatorIO, RegulatorNotTurned
from bench.commissioning.machine.machine import CommissionedMachine, MotionBounds, MotionTrace, Segment
from bench.commissioning.machine.machine_process import LiveRobot
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
from bench.control.settings import EnvelopeSettings
from bench.supervisor.ownership import try_lock
from bench.swing.profile import load_profile
from sim.plant import ACTUATOR_KEYS, PlantParameters

STATE_FILE, ROBOT_FILE, _LOCK_FILE = "commissioning.json", "robot.toml", "process"
_VERSION = 2
_DIGEST = "# as written by golfbench commission: "
"""Start of the last line of robot.toml, before the digest of the others."""

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


class Resumption(NamedTuple):
    """A continuation after an interruption."""

    date: str
    interrupted: str
    """Date of the last state before it."""
    repaired: str
    """Parts repaired, replaced or adjusted in between, by the person who resumed."""


NOTHING = "nothing"
"""Statement that nothing was repaired."""

_Part = TypeVar("_Part", DoneStep, FaultRecord, ParameterEstimate, Resumption)


class _StoredState(TypedDict):
    """Content of the state's file."""

    version: int
    digest: str
    configuration: str
    simulated: bool
    robot: str
    done: tuple[DoneStep, ...]
    wrong: FaultRecord | None
    resumed: tuple[Resumption, ...]
    saved: str


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
    resumed: list[Resumption] = field(default_factory=list)
    saved: str = ""
    """Date of the stored state."""

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
        self.saved = datetime.now(UTC).isoformat()
        content = {"version": _VERSION} | json_value(vars(self))
        del content["folder"]
        with atomic_file(self.folder / STATE_FILE) as stream:
            stream.write(json.dumps(content, indent=1).encode())


def begin(
    folder: Path, configuration: Configuration, *, simulated: bool, repaired: str | None = None
) -> Commissioning:
    """Return the commissioning in `folder`: a new one, or with a statement of `repaired` the stored one.

    Steps are repeated from the first one whose file is missing, and all of them after a machine fault or a
    repair: the values may be those of a part that was replaced since. Nothing is written before its `save`.

    Raises:
        BenchError: one exists already, none exists to resume, it has another configuration, or robot.toml
            was edited.
    """
    digest = robot_digest(configuration, simulated=simulated)
    path, file = folder / STATE_FILE, str(configuration.files[-1].resolve())
    if repaired is not None:
        state = read_state(folder)
        state.resumed.append(Resumption(datetime.now(UTC).isoformat(), state.saved, repaired))
        measured = any(step.name != INPUT_CHECK.name for step in state.done)
        repeated = state.wrong or repaired.casefold() != NOTHING
        kept = not repeated and (simulated or measured)
        if state.simulated != simulated or (state.digest != digest and kept):
            kind = "simulated" if state.simulated else "not simulated"
            expected = f"the robot and wiring of {state.configuration}, {kind}"
            action = "Continue with the same --config and --sim, or begin in another folder."
            raise BenchError(str(path), "another configured robot", expected, action)
        if state.digest != digest:
            state.digest, state.configuration = digest, file
        lost = (i for i, one in enumerate(state.done) if not (folder / _FILES.get(one.name, "")).exists())
        state.done = state.done[: 0 if repeated else next(lost, None)]
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
    version = content.get("version") if isinstance(content, dict) else None
    if version is not None and version != _VERSION:
        raise BenchError(f"{location}.version", f"version {version}", f"version {_VERSION}", action)
    require_fit(content, _StoredState, location, action)
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
    plain = {key: content[key] for key in ("digest", "configuration", "simulated", "robot", "saved")}
    resumed = [_stored(Resumption, one) for one in content["resumed"]]
    return Commissioning(folder, done=done, wrong=wrong, resumed=resumed, **plain)


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

    def run(self, segments: tuple[Segment, ...], bounds: MotionBounds, doing: str = "") -> MotionTrace:
        self._motions += 1
        self._progress(f"{self._title}: motion {self._motions}")
        return self._machine.run(segments, bounds, doing)

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
    with _doing(state, INPUT_CHECK, (lambda step: None) if in_force else on_step) as done:
        if in_force:
            done(StepResult((), (f"{in_force} is in force",)))
            return
        seen, findings = check_inputs(machine, hands, configuration, progress)
        keep(seen)
        raise_findings(findings)
        beside = f"supply sensor {1e-5 * seen.gauge:+z.2f} bar off the gauge"
        done(StepResult((), (f"seen to change: {', '.join(seen.seen)}", beside)))


@contextmanager
def safe_after_error(machine: SimulatedMachine | LiveRobot, plant: PlantParameters) -> Iterator[None]:
    """Make `machine` passive and turn its regulator down after an error."""
    try:
        yield
    except BaseException:
        machine.make_passive()
        with suppress(RegulatorNotTurned):  # the first error says more
            machine.set_supply(plant.supply.atmosphere)
        raise


def commission(
    state: Commissioning,
    nominal: PlantParameters,
    machine: SimulatedMachine | LiveRobot,
    *,
    permit: Callable[[], object] = lambda: None,
    observe: Callable[[], tuple[str, ...]] = tuple,
    on_step: Callable[[NamedStep], None] = lambda step: None,
    progress: Callable[[str], None] = lambda what: None,
) -> RobotEstimate:
    """Do the measuring steps of `state` that are not done; store it after each.

    The machine is passive at the end, its regulator in service, after an error turned down. `permit` returns
    once a person permits the motions of a step, `observe` further notes after it, such as a simulated robot's
    loads; `progress` is given each motion.

    Raises:
        MachineFault: a step found the machine wrong; the state says so.
        Refused: an interlock ended a step, or stalls ended it again and again; it is repeated when resumed.
    """
    known = RobotEstimate(nominal, state.values)
    with safe_after_error(machine, nominal):
        for number, step in enumerate(STEPS, 1):
            if state.has_done(step):
                continue
            permit()
            file = f"records/{number}-{step.name}.npz"
            with _doing(state, step, on_step, file, lambda: machine.time) as done:
                counted = _CountedMachine(machine, step.title, progress)
                traces, stalls = _measured(step, counted, known, progress, permit)
                write_traces(state.folder / file, traces)
                result = step.estimate(traces, known)
                values = tuple(value._replace(step=step.name) for value in result.values)
                done(StepResult(values, (*result.notes, *stalls, *observe())))
            known.add(values)
    machine.make_passive()
    machine.set_supply(inf)
    return known


def commission_swings(
    state: Commissioning,
    known: Configuration,
    arm: Arm,
    *,
    on_step: Callable[[NamedStep], None] = lambda step: None,
    progress: Callable[[str], None] = lambda what: None,
) -> None:
    """Do the swinging steps of `state` that are not done; `arm` arms the robot, which is `known` as measured.

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
        diagnosed = DiagnosedRobot(arm, state.values, records)
        with _doing(state, step, on_step, "records") as done:
            try:
                swung = known_with_swing(known, state.folder) if state.has_done(SWINGS) else known
                done(step.swing(diagnosed.series, swung, state.folder, progress))
            except Refused as error:
                raise diagnosed.explained(error) from error.__cause__


def known_with_swing(known: Configuration, folder: Path) -> Configuration:
    """Return `known` with the limits for the swing in `folder`; before it is designed unchanged."""
    file = folder / SWING_FILE
    if not file.exists():
        return known
    profile = load_profile(file)
    return with_following_limits(known, profile).for_profile(profile, file)


@contextmanager
def _doing(
    state: Commissioning,
    step: NamedStep,
    on_step: Callable[[NamedStep], None],
    record: str = "",
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Callable[[StepResult], None]]:
    """Yield what stores the result of `step`, timed by `clock` (s), in `state`; a fault of it is stored."""
    on_step(step)
    begun = clock()

    def store(result: StepResult) -> None:
        named, date = (step.name, step.title, step.bounds_text), datetime.now(UTC).isoformat()
        done = DoneStep(*named, date, clock() - begun, record, result.values, result.notes)
        others = [one for one in state.done if one.name != step.name]
        state.done = [done, *others] if step is INPUT_CHECK else [*others, done]
        state.save()

    try:
        yield store
    except MachineFault as error:
        date = datetime.now(UTC).isoformat()
        state.wrong = FaultRecord(step.name, date, error.location, error.found, error.expected, error.action)
        state.save()
        raise


def _measured(
    step: CommissioningStep,
    machine: CommissionedMachine,
    known: RobotEstimate,
    progress: Callable[[str], None],
    permit: Callable[[], object],
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
                permit()  # a long stall voids the permission
            return step.measure(machine, known), stalls
        except Stalled as stall:
            if len(stalls) == REPEATS:
                found = f"{stall.found}; it was repeated {REPEATS} times"
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


GUESSES = (
    "lengths",
    "masses and inertias whose standard error is 7 %",
    "damping of the spools",
    "Stribeck speeds",
    "polytropic exponent of the chambers",
    "feed, manifold, dump and vent conductances of the supply",
    "end stops",
    "ball and ground",
)
"""Parts of the plant that no step measures yet: they stay as configured."""

NO_CALIBRATION = (
    "The zeros of the encoders hold for the presets that these have now, which no file holds. A bench with "
    "hardware arms only with calibrations in force (golfbench calibrate list), of which the encoders' stores "
    "the presets that the running bench has read, for comparison at each start. For encoders and valves:"
)
"""Why robot.toml does not replace a calibration, for its reader."""

_WIDTH = 108
_MIN_UNCERTAINTY_DEG = 0.001
"""Smallest standard uncertainty that is entered for a zero, deg."""
_CLUB, _SUPPLY, _ENCODERS, _SPOOL = "robot.club", "supply.pressure", "encoders", ("centre", "dead_band")


def robot_file(
    known: RobotEstimate,
    base: str,
    made: datetime,
    envelope: EnvelopeSettings | None = None,
    following: Mapping[str, tuple[float, float, float]] | None = None,
    profile: Path | None = None,
    file: Path = Path("robot.toml"),
) -> str:
    """Return TOML of the robot in `known` over the configuration file `base`, commissioned at `made`.

    The limits of the supply's pressure, of `envelope`, follow the supply that was found; `following` are
    those of following errors, by phase. `profile` is the file of its swing, `file` that of the robot.
    """
    lines = [
        f"# Commissioned on {made:%Y-%m-%d}: values with standard errors, and the steps that found them.",
        "# Not measured, as configured: " + "; ".join(GUESSES) + ".",
        f"base = {toml_value(base)}",
        "",
        "[bench]",
        f"commissioned = {toml_value(made.isoformat(timespec='seconds'))}",
    ]
    if profile is not None:
        lines += ["", "[swing]", f"profile = {toml_value(str(profile.resolve()))}"]
    tables: dict[str, list[str]] = {}
    for key, found in _keys(known.found.values()).items():
        table, _, name = key.rpartition(".")
        text = toml_value(value_at(known.plant, key))
        errors = ", ".join(f"{one.error:.3g}" for one in found)
        unit = f" {found[0].unit}" if found[0].unit else ""
        note = f"± {errors}{unit}; {found[0].step}"
        tables.setdefault(table, []).append(f"{name} = {text}  # {note}")
    for table in sorted(tables):
        location = f"clubs.{known.plant.robot.club.name}" if table == _CLUB else f"plant.{table}".rstrip(".")
        lines += [""]
        lines += _calibration(known, file) if table == _ENCODERS else []
        lines += [f"[{location}]", *tables[table]]
    if envelope is not None and _SUPPLY in known.found:
        share = known.plant.supply.pressure / known.nominal.supply.pressure
        low, high = share * envelope.min_supply_pressure, share * envelope.max_supply_pressure
        lines += ["", "[envelope]"]
        lines += [f"min_supply_pressure = {low:.0f}.0", f"max_supply_pressure = {high:.0f}.0"]
    if following:
        lines += ["", "[envelope.max_following_error]"]
        lines += [f"{phase} = {toml_value(limits)}" for phase, limits in following.items()]
    lines += ["", "[envelope.model]", 'check = "always"  # this robot was measured']
    lines += ["", "[envelope.model.standard_errors]"]
    lines += [
        f'"{found.key}" = {toml_value(found.error)}' for found in known.found.values() if found.error > 0.0
    ]
    return with_digest("\n".join(lines) + "\n")


def _calibration(known: RobotEstimate, file: Path) -> list[str]:
    """Return comments with the commands that store zeros and valves in `file` as calibrations."""
    encoders = known.plant.encoders
    uncertainty = _max_error(known, f"{_ENCODERS}.zero_count") * 360.0 / encoders.counts_per_revolution
    zeros, signs = (" ".join(map(str, values)) for values in (encoders.zero_count, encoders.sign))
    command = f"# golfbench --config {quote(str(file.resolve()))} calibrate"
    lines = [
        *(f"# {line}" for line in wrap(NO_CALIBRATION, _WIDTH)),
        f"{command} encoders --zero-counts {zeros} --sign {signs} "
        f"--uncertainty-deg {max(uncertainty, _MIN_UNCERTAINTY_DEG):.2g}",
    ]
    if error := _max_error(known, *(f"{key}.valve.{name}" for key in ACTUATOR_KEYS for name in _SPOOL)):
        valves = [actuator.valve for actuator in known.plant.actuators]
        centre, band = (" ".join(f"{getattr(valve, name):.5f}" for valve in valves) for name in _SPOOL)
        lines.append(f"{command} valves --centre {centre} --dead-band {band} --uncertainty {error:.2g}")
    return lines


def _max_error(known: RobotEstimate, *keys: str) -> float:
    """Return the max standard error of the values found at or below `keys`, 0 if there are none."""
    return max((one.error for key, one in known.found.items() if key.startswith(keys)), default=0.0)


def _keys(found: Iterable[ParameterEstimate]) -> dict[str, list[ParameterEstimate]]:
    """Return the values by their keys, elements of a list under the list's."""
    keys: dict[str, list[ParameterEstimate]] = {}
    for value in found:
        name, _, last = value.key.rpartition(".")
        keys.setdefault(name if last.isdigit() else value.key, []).append(value)
    return keys


def commissioning_report(state: Commissioning, nominal: PlantParameters, made: datetime) -> str:
    """Return the report of `state` as HTML; `nominal` is the robot as configured."""
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(
        (files("bench.commissioning") / "commissioning.html.j2").read_text(encoding="utf-8")
    )
    known = RobotEstimate(nominal, state.values)
    done = {step.name for step in state.done}
    return template.render(
        state=state,
        made=made,
        minutes=sum(step.seconds for step in state.done) / 60,
        configured=lambda key: f"{value_at(known.nominal, key):.6g}",
        left=[step.title for step in ALL_STEPS if step.name not in done],
        guesses=GUESSES,
        no_calibration=NO_CALIBRATION,
        steps=len(ALL_STEPS),
    )
