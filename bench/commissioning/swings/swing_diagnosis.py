"""Which cause explains that a robot swung otherwise than the one that was measured?

A cause has one parameter. It changes the model or the recorded values: valve commands that a spool does not
follow, angles from an encoder that slips, pressures from a sensor with an offset. Each is fitted to the
recorded swing, with all measured values free within their standard errors. The diagnosis names a cause if its
misfit is much smaller than with any other cause and without one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from bench.base.errors import Refused
from bench.commissioning.machine.commissioning_step import (
    Arm,
    MachineFault,
    Mark,
    ParameterEstimate,
    PredictionFails,
    SwingSeries,
)
from bench.commissioning.machine.driver_machine import Stalled, StoppedByPerson
from bench.commissioning.machine.machine import Array
from bench.commissioning.swings._short_predictions import (
    PRESSURE,
    QUANTITIES,
    SCATTER,
    SPEED,
    Cycles,
    RecordedSwing,
    explained,
    robust_squares,
    table_rows,
)
from bench.commissioning.swings.speed_ramp import exceeded
from bench.control.measured_plant import value_at, with_values
from bench.simulation.safety import Loads
from bench.simulation.simulated_bench import ArmingFailed, Bench, ReturnFailed, SeriesSwing
from bench.swing.profile import Profile
from drivers.base import JOINTS
from drivers.base.compiled import compiled_with_arrays
from sim.plant import PlantParameters

Changed = Callable[[RecordedSwing, PlantParameters, float], Array]
"""Returns the errors of the windows with the cause at a value."""


class SwingCause(NamedTuple):
    """A cause with one parameter."""

    location: str
    what: str
    """The fault there: causes alike in place and fault are one."""
    errors: Changed
    values: tuple[float, ...]
    """Values to begin the search with, in rising order; between the first and the last it stays."""
    form: str
    """Format of the value times `scale`."""
    action: str
    scale: float = 1.0


_FORMS = {
    "factor": ("{:.2f} times", 1.0),
    "farther": ("{:.2f} times", 1.0),
    "turned": ("{:.2f} times", 1.0),
    "added": ("{:+.2g}", 1.0),
    "lagging": ("later by {:.0f} ms", 1e3),
    "stuck": ("stuck from {:.0f} ms", 1e3),
    "jumped": ("{:+.3f} rad", 1.0),
    "misread": ("{:+.2f} bar", 1e-5),
}
"""Format of a cause's value, and its scale, by its effect."""


def swing_causes(recorded: RecordedSwing) -> list[SwingCause]:
    """Return the causes of `causes.toml` that are looked at in a swing `recorded`."""
    instants = np.linspace(0.0, len(recorded) * recorded.tick, 25).tolist()
    causes = []
    for row, joint, chamber in table_rows("causes"):
        form, scale = _FORMS[row["acts"]]
        errors, values = _changed(row, joint, chamber), tuple(row.get("values", instants))
        causes.append(SwingCause(row["location"], row["what"], errors, values, form, row["action"], scale))
    return causes


def _changed(row: dict[str, Any], joint: int, chamber: int) -> Changed:
    """Return the errors of the windows with the cause of a `row` at a value."""
    acts, keys = row["acts"], row.get("keys", [])
    if acts in _COMMANDS:
        return _commanded(joint, _COMMANDS[acts])
    if acts in ("turned", "jumped"):
        return _slipping(joint, at_once=acts == "jumped")
    if acts == "misread":
        return _misread(chamber)

    def errors(recorded: RecordedSwing, plant: PlantParameters, value: float) -> Array:
        found = {key: float(value_at(plant, key)) for key in keys}
        changed = {key: value * at if acts == "factor" else value + at for key, at in found.items()}
        return recorded.errors(with_values(plant, changed))

    return errors


def _commanded(joint: int, change: Callable[[Array, float, float], Array]) -> Changed:
    """Return the errors if the spool of `joint` is where `change` of commands (n,), value and tick says."""

    def errors(recorded: RecordedSwing, plant: PlantParameters, value: float) -> Array:
        valve = recorded.valve.copy()
        valve[:, joint] = change(valve[:, joint], value, recorded.tick)
        return recorded.errors(plant, valve=valve)

    return errors


def _farther(command: Array, value: float, _: float) -> Array:
    """The valve opens `value` times as far."""
    return np.asarray(command * value)


def _lagging(command: Array, value: float, tick: float) -> Array:
    """The spool follows with a time constant of `value` s."""
    return np.asarray(_followed(command, tick / (value + tick)))


@compiled_with_arrays
def _followed(command: Array, share: float) -> Array:
    """Return `command` (n,) through a filter of first order that goes `share` of the way in each row."""
    out = command.copy()
    for k in range(1, len(out)):
        out[k] = out[k - 1] + share * (command[k] - out[k - 1])
    return out


def _stuck(command: Array, value: float, tick: float) -> Array:
    """The spool stays where it is from `value` s on."""
    row = min(max(round(value / tick), 0), len(command) - 1)
    command[row:] = command[row]
    return command


_COMMANDS = {"farther": _farther, "lagging": _lagging, "stuck": _stuck}


def _slipping(joint: int, *, at_once: bool) -> Changed:
    """The encoder turns `value` times as far as its joint; or slips `at_once`, by `value` rad (`jump`)."""

    def errors(recorded: RecordedSwing, plant: PlantParameters, value: float) -> Array:
        angle = recorded.raw_angle.copy()
        if at_once:
            angle[recorded.jump(joint) :, joint] -= value
        else:
            angle[:, joint] = angle[0, joint] + (angle[:, joint] - angle[0, joint]) / value
        return recorded.errors(plant, angle)

    return errors


def _misread(chamber: int) -> Changed:
    """The sensor reads `value` Pa too much."""
    return lambda recorded, plant, value: recorded.with_pressure(chamber, -value).errors(plant)


_NEAR = 2.0
"""Standard errors by which values may move for their effects to be taken there."""
_MIN_IMPROVEMENT = 0.5
"""Max share of the misfit that is left, for their effects to be taken there."""
_STEP = 0.3
"""Step of a derivative, in standard errors."""
_GUESSES = {"robot.l12": 1e-3, "robot.l16": 1e-3, "robot.l23": 1e-3, "robot.l56": 1e-3, "wrist_lever": 1e-3}
"""Standard errors of values that no step measures, m."""


def uncertain_values(found: Iterable[ParameterEstimate], plant: PlantParameters) -> list[ParameterEstimate]:
    """Return the values of `plant` with a standard error as `found`; the last of a key counts."""
    errors = {one.key: one.error for one in found}
    errors = {key: error for key, error in (_GUESSES | errors).items() if error > 0.0}
    return [ParameterEstimate(key, float(value_at(plant, key)), error) for key, error in errors.items()]


class Misfit(NamedTuple):
    """What stays unexplained of a swing."""

    cost: float
    """Mean of the squared errors of windows, in units of their scatter; large ones count less."""
    errors: Array
    """(k, QUANTITIES) what stays."""
    shift: Array
    """(p,) standard errors by which the uncertain values would be others than in the model."""


def swing_misfit(
    recorded: RecordedSwing, plant: PlantParameters, uncertain: list[ParameterEstimate]
) -> SwingMisfit:
    """Return the misfit of `recorded` around `plant`, or around likelier values where these explain it.

    Effects are not linear: the likelier values count if the misfit around them is clearly smaller. Otherwise
    they may only imitate a cause.
    """
    measured = SwingMisfit(recorded, plant, uncertain, np.zeros(len(uncertain)))
    moved = np.clip(measured.none.shift, -_NEAR, _NEAR)
    moves = zip(uncertain, moved.tolist(), strict=True)
    nearer = with_values(plant, {one.key: one.value + by * one.error for one, by in moves})
    likelier = SwingMisfit(recorded, nearer, uncertain, moved)
    return measured if likelier.none.cost > _MIN_IMPROVEMENT * measured.none.cost else likelier


class SwingMisfit:
    """Misfit of a recorded swing, with the effects of the uncertain values around a plant."""

    def __init__(
        self,
        recorded: RecordedSwing,
        plant: PlantParameters,
        uncertain: list[ParameterEstimate],
        moved: Array,
    ) -> None:
        """Take how `uncertain` values act on the windows, `moved` (p,) standard errors in `plant`."""
        self.recorded, self.plant, self._moved = recorded, plant, moved
        self.base = recorded.errors(plant)
        self.effects = np.stack([effect(recorded, plant, self.base, one) for one in uncertain], axis=-1)
        """(k, QUANTITIES, p) by standard error."""
        self.none = self.of(self.base)
        """Misfit without a cause."""

    def since(self, errors: Array) -> tuple[int, Misfit]:
        """Return the first window in which the model with `errors` is the better one, and the misfit.

        Before it the errors are those without a cause: windows do not depend on each other.
        """
        effect = np.einsum("kqi,i->kq", self.effects, self.none.shift)
        # The values may explain, without a cause, the effect of the cause.
        firsts = {0, _better_from(self.base, errors), _better_from(self.base - effect, errors - effect)}
        found = [(first, self.of(np.concatenate([self.base[:first], errors[first:]]))) for first in firsts]
        return min(found, key=lambda one: one[1].cost)

    def of(self, errors: Array) -> Misfit:
        """Return what stays of `errors` (k, QUANTITIES) with the best values."""
        shift, left, _ = explained(errors, self.effects, self._moved)
        total = float(robust_squares(left).sum() + np.sum((self._moved + shift) ** 2))
        return Misfit(total / max(len(left), 1), left.reshape(-1, QUANTITIES) * SCATTER, shift)


def _better_from(without: Array, within: Array) -> int:
    """Return the window from which on errors `within` (k, QUANTITIES) are smaller than those `without`."""
    gain = [robust_squares(errors / SCATTER).sum(axis=1) for errors in (without, within)]
    return int(np.argmax(np.append(np.cumsum((gain[0] - gain[1])[::-1])[::-1], 0.0)))


def effect(recorded: RecordedSwing, plant: PlantParameters, base: Array, one: ParameterEstimate) -> Array:
    """Return the effect of a standard error of `one` on the model's predictions (k, QUANTITIES)."""
    step = _STEP * one.error
    moved = recorded.errors(with_values(plant, {one.key: float(value_at(plant, one.key)) + step}))
    return np.asarray((base - moved) / _STEP)


CLEARLY = 1.5
"""Min ratio of the misfits without a cause and with the next best cause to that of the reported cause."""
_USUAL = 0.5
"""Misfit up to which no cause is looked for, and which is added to all in ratios; right robots had less."""
_FINE = 10
"""Max trials of a value between those that the search begins with."""
_REFINED = 8
"""Causes whose value is searched finely: the best ones of the coarse search."""


class FittedCause(NamedTuple):
    """A cause with the value that explains most."""

    cause: SwingCause
    value: float
    since: float
    """Start of the cause in the record (s)."""
    misfit: float


class Diagnosis(NamedTuple):
    """Diagnosis of the robot from a recorded swing."""

    named: FittedCause | None
    """Cause that clearly explains the swing; None without one."""
    fitted: tuple[FittedCause, ...]
    """The best of each place and kind, best first; none where the measured model fits."""
    misfit: float
    """Misfit without a cause, measured values free within their errors."""
    speed: Array
    """RMS error of the joint speeds (3,) predicted over a window (rad/s)."""
    pressure: Array
    """RMS error of the predicted chamber pressures (3,), one per joint (Pa)."""
    ratio: float
    """Misfit of the next best over that of the best."""

    @property
    def text(self) -> str:
        """Diagnosis as text, for the report."""
        joints = ", ".join(
            f"{joint} {speed:.2f} rad/s and {1e-2 * pressure:.0f} mbar"
            for joint, speed, pressure in zip(
                JOINTS, self.speed.tolist(), self.pressure.tolist(), strict=True
            )
        )
        scatter = f"RMS error of short predictions: {joints}"
        if not self.fitted:
            return f"over short times the robot moves as measured (misfit {self.misfit:.2g}; {scatter})"
        best, second = self.fitted[:2]
        left = f"misfit {self.misfit:.3g} without a cause, {best.misfit:.3g} with"
        if self.named is not None:
            other = f"{second.cause.location}: {second.cause.what}"
            return f"{_named(best)}; {left} it; {self.ratio:.1f} times as much with the next best, {other}"
        return (
            f"its record does not say clearly why: {left} {_named(best)}; {self.ratio:.1f} times as much "
            f"with {_named(second)}; {scatter}"
        )


def _named(one: FittedCause) -> str:
    value = one.cause.form.format(one.cause.scale * one.value)
    return f"{one.cause.location}: {one.cause.what} ({value}, from {one.since:.2f} s of the swing on)"


def diagnose(cycles: Cycles, plant: PlantParameters, found: Iterable[ParameterEstimate]) -> Diagnosis:
    """Return what CYCLE records of a swing say of the robot measured as `plant`, with its values `found`."""
    recorded = RecordedSwing(cycles, plant)
    misfit = swing_misfit(recorded, plant, uncertain_values(found, plant))
    none = misfit.none
    pairs = none.errors[:, PRESSURE].reshape(-1, 3, 2)
    scatter = _scatter(none.errors[:, SPEED], 0), _scatter(pairs, (0, 2))
    if not none.cost > _USUAL:
        return Diagnosis(None, (), none.cost, *scatter, 1.0)
    coarse = sorted((_coarse(cause, misfit) for cause in swing_causes(recorded)), key=_misfit_of)
    fitted = sorted([*(_fine(one, misfit) for one in coarse[:_REFINED]), *coarse[_REFINED:]], key=_misfit_of)
    best = dict[tuple[str, str], FittedCause]()
    for one in fitted:
        best.setdefault((one.cause.location, one.cause.what), one)
    ranked = list(best.values())
    least = ranked[0].misfit + _USUAL
    ratio = (ranked[1].misfit + _USUAL) / least
    clear = ratio >= CLEARLY and (none.cost + _USUAL) / least >= CLEARLY
    return Diagnosis(ranked[0] if clear else None, tuple(ranked), none.cost, *scatter, ratio)


def _scatter(errors: Array, axes: int | tuple[int, int]) -> Array:
    return np.asarray(np.sqrt(np.mean(np.square(errors), axis=axes)))


def _misfit_of(one: FittedCause) -> float:
    return one.misfit


def _coarse(cause: SwingCause, misfit: SwingMisfit) -> FittedCause:
    """Return `cause` with the best of the values that the search begins with."""
    return min((_tried(cause, value, misfit) for value in cause.values), key=_misfit_of)


def _fine(coarse: FittedCause, misfit: SwingMisfit) -> FittedCause:
    """Return the cause with its value refined around that of the `coarse` search."""
    cause = coarse.cause
    at, tried = cause.values.index(coarse.value), [coarse]
    bounds = cause.values[max(at - 1, 0)], cause.values[min(at + 1, len(cause.values) - 1)]

    def left(value: float) -> float:
        tried.append(_tried(cause, value, misfit))
        return tried[-1].misfit

    minimize_scalar(left, bounds=bounds, method="bounded", options={"maxiter": _FINE})
    return min(tried, key=_misfit_of)


def _tried(cause: SwingCause, value: float, misfit: SwingMisfit) -> FittedCause:
    first, found = misfit.since(cause.errors(misfit.recorded, misfit.plant, value))
    starts = misfit.recorded.starts()
    begin = starts[min(first, len(starts) - 1)] * misfit.recorded.tick
    return FittedCause(cause, value, float(begin), found.cost)


class DiagnosedRobot:
    """A robot whose last swing is one that a wrong machine explains."""

    def __init__(self, arm: Arm, found: Sequence[ParameterEstimate], records: Path) -> None:
        """Look at swings of the robot that `arm` arms, of which values were `found`.

        Wrong ones are stored in `records`.
        """
        self._arm, self._found, self._records = arm, found, records
        self._series: SwingSeries
        self._model: PlantParameters
        self.last: Diagnosis | None = None
        """Diagnosis of the last swing; None before the first."""

    def series(self, bench: Bench) -> DiagnosedRobot:
        """Arm `bench`, whose model is the robot as measured: the model-based check is on.

        Raises:
            Refused: the robot is not armed; its last records are stored.
        """
        watched = replace(bench, envelope=bench.envelope.with_model_check("always"))
        self._model = bench.plant
        try:
            self._series = self._arm(watched)
        except ArmingFailed as error:
            raise self._kept(error) from None
        return self

    def swing(self, profile: Profile, *, ball: bool = True) -> SeriesSwing:
        """Swing `profile`, and come back to the address.

        Raises:
            MachineFault: the swing is that of another robot than the measured one, and says of which.
            Refused: the robot does not come back, or is not armed again; its last records are stored then.
        """
        try:
            made = self._series.swing(profile, ball=ball)
        except ReturnFailed as error:
            self._look_at(error.swing, profile.name)
            raise
        except ArmingFailed as error:
            raise self._kept(error) from None
        self._look_at(made, profile.name)
        return made

    def loads(self) -> Loads | None:
        """Return the loads since the series was armed; None where nothing measures them."""
        return self._series.loads()

    def face_mark(self, swing: SeriesSwing) -> Mark | None:
        """Return the ball's mark on the face; None where it is not read."""
        return self._series.face_mark(swing)

    def _look_at(self, swing: SeriesSwing, name: str) -> None:
        self.last = diagnose(swing.cycles, self._model, self._found)
        if self.last.named is None:
            return
        self._store("wrong-swing.npz", swing.cycles)
        said = "; ".join([self.last.text, *exceeded(self._series.loads())])
        raise MachineFault(name, said, "the robot that was measured", self.last.named.cause.action)

    def _store(self, name: str, cycles: Cycles) -> Path:
        self._records.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(path := self._records / name, cycles=cycles)
        return path

    def _kept(self, error: ArmingFailed) -> Refused:
        path = self._store("failed-arming.npz", error.cycles)
        return Refused(error.location, f"{error.found}; records in {path}", error.expected, error.action)

    def explained(self, error: Refused) -> Refused:
        """Return `error` of a step with the diagnosis of the last swing, if that names no cause."""
        lasting = (PredictionFails, Stalled, StoppedByPerson)
        if self.last is None or self.last.named is not None or isinstance(error, lasting):
            return error
        return type(error)(error.location, f"{error.found}; {self.last.text}", error.expected, error.action)
