"""Replay of a record: its inputs through the cycle of today, the differences, and how near its limits came.

A replay begins with the controller's memory stored in the record (`bench.loop.snapshot`) and continues
with the tick after it. Every field of the cycle is one of three: an input, taken from the record (`INPUTS`);
decided by the controller, recomputed and compared (`DECIDED`); or measured around it, neither (`MEASURED`).
The command is compared with the one truly applied. While the device had itself become passive, it applied its
own command, which is not compared. A tick that failed in the driver's write cannot be repeated: from
there on the record may differ.

For wear, the record is replayed with the observer on and without a limit that could stop it. This shows how
near a swing came to the limits of the model-based check, also for a record made with the check off.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import nan
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from bench.base.errors import BenchError
from bench.base.from_toml import recorded_tables
from bench.base.lifecycle import Reaction
from bench.control.estimate.residual_monitor import BRAKING, KINDS, LEARNING, SHOCK, row_of
from bench.control.settings import (
    ControlSettings,
    EnvelopeSettings,
    EstimatorSettings,
    HomingSettings,
    LifecycleSettings,
    build_controller,
)
from bench.control.step_records import ControlParameters, ControlState
from bench.loop.loop import Cycle, CycleArray, Cycles
from bench.loop.snapshot import read_snapshot, unpack_snapshot
from bench.records.telemetry.cycle_record import FIELDS, Field
from bench.records.telemetry.swing_metadata import read_profile, since
from bench.simulation.lockstep import note_largest
from drivers.base import JOINTS, Command, DriverError, Readings
from drivers.base.records import TRUTH
from sim.plant import PlantParameters

TOLERANCE = 1e-9
_COPY, _VERSION = "Restore the record from a copy.", "Replay a record of this version."

_PERMISSIONS = ("lease_held", "support_ready", "supervisor_alive", "device_operational")
INPUTS = frozenset({*Readings._fields, "tick", "request", "request_number", *_PERMISSIONS})
"""Fields that the cycle takes from the record."""
MEASURED = frozenset({"wake_latency", "work_time", *(TRUTH.names or ())})
"""The machine's timing and the plant's truth, which the controller does not use."""
DECIDED = frozenset(field.name for field in FIELDS) - INPUTS - MEASURED
"""Fields that the cycle decides."""
APPLIED = frozenset({"applied_valve", "supply_enable", "exhaust_closed", "guard_lock", "beacon", "tee"})
"""Fields of DECIDED that a passive device sets, not the controller."""


class Difference(NamedTuple):
    """Comparison of one field of DECIDED over a replay."""

    field: str
    greatest: float
    """Max difference over ticks and components; infinite if only one of the two is NaN."""
    ticks: int
    """Ticks in which it is beyond the tolerance."""
    tick: int | None = None
    """First of these ticks; the values there follow."""
    time: float | None = None
    """Time on the record's clock (s)."""
    component: str = ""
    recorded: float = 0.0
    replayed: float = 0.0


@dataclass(frozen=True)
class Replay:
    """A record and its replay, tick by tick."""

    recorded: Cycles
    replayed: Cycles
    """Both records of CYCLE with the record's times, from the tick after the snapshot on."""
    defaults: tuple[str, ...]
    """Keys of the configuration that the record lacks; today's defaults replace them."""

    def differences(self, tolerance: float = TOLERANCE) -> list[Difference]:
        """Return one Difference for each field of DECIDED in storage order.

        Floats are equal within `tolerance`, absolute plus relative to the record; two NaN are equal.
        Codes and switches must be the same.
        """
        return [_difference(self, field, tolerance) for field in FIELDS if field.name in DECIDED]


class ReplayStart(NamedTuple):
    """Start of a replay: the inputs that follow, and the recorded controller."""

    recorded: Cycles
    """Records with the record's times, from the tick after the snapshot on."""
    begin: float
    """Loop time at the record's time zero, s."""
    state: ControlState
    parameters: ControlParameters
    defaults: tuple[str, ...]
    """Keys of the configuration that the record lacks; today's defaults replace them."""


def replay_cycles(
    cycles: Cycles,
    metadata: Mapping[str, Any],
    location: str,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Replay:
    """Replay `cycles` with their record's `metadata`; `location` names it, `progress` gets the ticks.

    Raises:
        BenchError, ExceptionGroup: as `replay_start`.
    """
    start = replay_start(cycles, metadata, location)
    replayed = run_replay(start, lambda state, tick, time: progress(tick, len(start.recorded)))
    progress(len(start.recorded), len(start.recorded))
    return Replay(start.recorded, since(replayed, start.begin), start.defaults)


def replay_start(cycles: Cycles, metadata: Mapping[str, Any], location: str) -> ReplayStart:
    """Return the start of a replay of `cycles` with their record's `metadata`; errors report `location`.

    Raises:
        BenchError: the record has no snapshot, one of another controller, or lost cycles.
        ExceptionGroup: a BenchError for each value of its configuration that today's program rejects.
    """
    snapshot = read_snapshot(metadata, location)
    if not metadata.get("replayable", False):
        lost = f"a record with {metadata.get('lost_records', 'some')} cycles lost"
        wanted = "every cycle, as the controller has a memory"
        raise BenchError(location, lost, wanted, "Replay a record without lost cycles.")
    begin = metadata.get("begin")
    if not isinstance(begin, int | float):
        raise BenchError(
            f"{location}: begin", repr(begin), "the loop time at the record's time zero, s", _COPY
        )
    first = int(np.searchsorted(cycles["tick"], snapshot["tick"][0], side="right"))
    recorded = cycles[first:]
    if first == 0 or cycles["tick"][first - 1] != snapshot["tick"][0] or len(recorded) == 0:
        whole = (
            f"one of {cycles['tick'][0]} to {cycles['tick'][-1] - 1}"
            if len(cycles)
            else "a record with cycles"
        )
        raise BenchError(f"{location}: snapshot", f"tick {snapshot['tick'][0]}", whole, _COPY)
    parameters, defaults = controller_of(metadata, location)
    return ReplayStart(recorded, float(begin), unpack_snapshot(snapshot), parameters, defaults)


def controller_of(metadata: Mapping[str, Any], location: str) -> tuple[ControlParameters, tuple[str, ...]]:
    """Return today's controller for a record's configuration and profile.

    Also returns the keys that the record lacks, as it is older than they are.

    Raises:
        BenchError: configuration or profile is missing or damaged.
        ExceptionGroup: a BenchError for each value that today's program rejects.
    """
    profile = read_profile(metadata, location)
    built, defaults = settings_of(metadata, location)
    try:
        return build_controller(built.pop("plant"), profile, **built), defaults
    except ValueError as error:
        raise BenchError(
            f"{location}: configuration", str(error), "settings of a controller", _VERSION
        ) from None


def settings_of(metadata: Mapping[str, Any], location: str) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return a record's settings by the names of `build_controller`, and the keys that the record lacks.

    Raises:
        BenchError: the configuration is missing.
        ExceptionGroup: a BenchError for each value that today's program rejects.
    """
    configuration = metadata.get("configuration")
    if not isinstance(configuration, Mapping):
        raise BenchError(f"{location}: configuration", "missing", "the bench's settings", _VERSION)
    action = "Replay it with the version of golfbench that wrote it, or renew the record."
    return recorded_tables(configuration, _SETTINGS, location, action)


_SETTINGS: Mapping[str, type[Any]] = {
    "plant": PlantParameters,
    "control": ControlSettings,
    "envelope": EnvelopeSettings,
    "estimator": EstimatorSettings,
    "lifecycle": LifecycleSettings,
    "homing": HomingSettings,
}
"""Arguments of `build_controller` by their table in the configuration."""


class _Recorded:
    """Driver of a replay: returns the recorded readings and applies any command."""

    operational = True

    def __init__(self, cycles: Cycles) -> None:
        columns = (cycles[name].tolist() for name in Readings._fields[1:])
        # The time of a reading is not recorded, as no decision depends on it.
        self._readings = [Readings(*row) for row in zip(cycles["time"].tolist(), *columns, strict=True)]
        self._operational = cycles["device_operational"].tolist()
        # `bench.loop.loop.Cycle` marks missing readings like this.
        self._failed = (np.isnan(cycles["encoder_age"]) & (cycles["encoder_valid"] == 0)).all(axis=1).tolist()
        self._tick = -1

    def open(self) -> None:
        """Nothing to open."""

    def read(self, time: float) -> Readings:
        """Return the recorded readings of this tick; DriverError if the driver gave none."""
        self._tick += 1
        self.operational = self._operational[self._tick]
        if self._failed[self._tick]:
            raise DriverError("as recorded: no readings")
        return self._readings[self._tick]

    def write(self, command: Command) -> Command:
        """Apply `command` as it is."""
        return command

    def make_passive(self) -> None:
        """Nothing to make passive."""

    def close(self) -> None:
        """Nothing to close."""


def run_replay(start: ReplayStart, watch: Callable[[ControlState, int, float], None]) -> Cycles:
    """Return the cycles, in loop times, of the controller at `start`.

    `watch` gets its memory, tick of the replay and time (s) after each tick.
    """
    inputs = since(start.recorded, -start.begin)
    kept = CycleArray(len(inputs))
    cycle = Cycle(_Recorded(inputs), start.parameters, kept, name="replay")
    cycle.state = start.state
    control = start.state.control
    for k, now in enumerate(inputs):
        for name in _PERMISSIONS:
            control[name] = now[name]
        control["tick"] = now["tick"] - 1  # ticks that the loop missed stay missed
        if now["request"]:
            control["request"], control["request_number"] = now["request"], now["request_number"]
        cycle.run_tick(float(now["time"]))
        watch(start.state, k, float(now["time"]))
    if cycle.publish_error is not None:
        raise cycle.publish_error
    return kept.cycles


def _difference(replay: Replay, field: Field, tolerance: float) -> Difference:
    recorded, replayed = (
        np.asarray(cycles[field.name]).reshape(len(cycles), -1)
        for cycles in (replay.recorded, replay.replayed)
    )
    a, b = recorded.astype(float), replayed.astype(float)
    apart = np.abs(a - b)
    apart[np.isnan(a) & np.isnan(b)] = 0.0
    apart[a == b] = 0.0  # infinities
    apart[np.isnan(apart)] = np.inf
    allowed = tolerance * (1.0 + np.abs(np.nan_to_num(a))) if field.dtype == "f8" else 0.0
    beyond = apart > allowed
    if field.name in APPLIED:
        beyond[~replay.recorded["device_operational"]] = False
        apart[~replay.recorded["device_operational"]] = 0.0
    greatest = float(apart.max(initial=0.0))
    if not beyond.any():
        return Difference(field.name, greatest, 0)
    tick, component = (int(i) for i in np.argwhere(beyond)[0])
    at = replay.recorded[tick]
    return Difference(
        field.name,
        greatest,
        int(beyond.any(axis=1).sum()),
        int(at["tick"]),
        float(at["time"]),
        field.components[component] if field.components else "",
        float(a[tick, component]),
        float(b[tick, component]),
    )


NEAR = 0.9
"""Share of a limit that is near it. Healthy robots reach 0.8: limits are a quarter above what those show."""
AHEAD = 200
"""Horizon (swings) within which a growing residual must not reach its limit; at most as many swings as were
recorded."""
FEW, _ENOUGH = 5, 10
"""Swings of a median, and least number of swings of a trend."""


def residual_shares(cycles: Cycles, metadata: Mapping[str, Any], location: str) -> NDArray[np.float64]:
    """Return the largest residuals of a record by comparison and joint, (5, 3), as shares of their limits.

    The limits are those that the bench used, KINDS in order; 0 where nothing was compared.

    Raises:
        BenchError, ExceptionGroup: as `bench.simulation.replay.replay_start`.
    """
    start = replay_start(cycles, metadata, location)
    limits, shares = start.parameters.model, np.zeros((len(KINDS), 3))
    allowed, first = np.stack([limits[kind][0] for kind in KINDS]), int(limits["first_row"][0])
    largest = np.zeros((len(KINDS), LEARNING, 3))
    watched = limits.copy()
    watched["check"] = True
    for kind in KINDS:
        watched[kind] = np.inf

    def watch(state: ControlState, tick: int, time: float) -> None:
        largest[:] = 0.0
        note_largest(largest, state, time)
        s = state.control[0]
        row = BRAKING + s["phase"] if s["reaction"] == Reaction.BRAKE else row_of(s)
        rows = [first + row, first + SHOCK] if state.model["blow"][0] > 0.0 else [first + row]
        np.maximum(shares, largest.max(axis=1) / allowed[:, rows].max(axis=1), out=shares)

    run_replay(start._replace(parameters=start.parameters._replace(model=watched)), watch)
    return shares


class Margin(NamedTuple):
    """One comparison of one joint over the swings, oldest first; shares of the limit."""

    kind: str
    joint: str
    before: float
    """Median of the first swings."""
    latest: float
    """Median of the latest swings."""
    growth: float
    """Growth per swing; NaN with too few swings, 0 if it may as well be none."""
    near: bool
    """Whether the latest are near the limit, or come there within as many swings again, `AHEAD` at most."""


def margins(shares: NDArray[np.float64]) -> list[Margin]:
    """Return the comparisons of `shares` (n, 5, 3), the largest latest ones first."""
    found = []
    for k, kind in enumerate(KINDS):
        for i, joint in enumerate(JOINTS):
            column = shares[:, k, i]
            before, latest = float(np.median(column[:FEW])), float(np.median(column[-FEW:]))
            growth = growth_of(column)
            ahead = latest + min(AHEAD, len(column)) * growth if growth > 0.0 else latest
            found.append(Margin(kind, joint, before, latest, growth, latest >= NEAR or ahead >= 1.0))
    return sorted(found, key=lambda one: -one.latest)


def growth_of(column: NDArray[np.float64]) -> float:
    """Return the slope per swing (Theil and Sen); 0 where its 95 % interval has both signs."""
    if len(column) < _ENOUGH:
        return nan
    slope = stats.theilslopes(column)
    return float(slope.slope) if slope.low_slope > 0.0 or slope.high_slope < 0.0 else 0.0
