"""Identification: which robot swings as the recorded one did? Least squares on the simulated response.

The parameters are factors on the configured plant, and the encoders' latency. A trial arms the plant with
them and lets it swing as the recorded one did. It compares angles, valve openings, supply pressure and, where
they are fitted, chamber pressures up to the impact window. In closed loop, errors that feedback suppresses in
the angles appear in the openings. Openings are smoothed: their quick part is dither and noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.optimize import least_squares

from bench.base.atomic_file import write_whole
from bench.base.errors import BenchError, Refused
from bench.base.lifecycle import Phase
from bench.base.to_toml import toml_value
from bench.config import Configuration
from bench.control.measured_plant import value_at
from bench.records.telemetry.record_file import read_swing
from bench.records.telemetry.swing_metadata import read_profile
from bench.simulation.plant_variation import Variation
from bench.simulation.simulated_bench import Bench, Series, quiet
from bench.swing.correction import digest_of
from bench.swing.profile import Profile
from sim.plant import ACTUATOR_KEYS, PlantParameters

Array = NDArray[np.float64]
Cycles = np.ndarray[Any, Any]

_PARTS = "shoulder", "right arm", "wrist"
NAMES = (
    *(f"friction of the {part}" for part in _PARTS),
    *(f"flow of the {part}'s valve" for part in _PARTS),
    *(f"dead volume of the {part}" for part in _PARTS),
    "supply pressure",
    "vane area",
    "club inertia",
    "encoder latency",
)
"""Identified parameters: factors on the nominal values; the last one is ms added to the nominal latency."""
SURE = 0.05
"""Standard error up to which a parameter counts as identified."""
_SPACING = 5
"""Samples between those that are compared."""
_SMOOTHED = 41
"""Samples over which openings are averaged."""
_ANGLE, _OPENING, _PRESSURE = 0.003, 0.03, 5e3
"""Errors of equal weight (rad, opening, Pa): the scatter of repeated swings."""
_PRIOR = 0.4
"""Prior standard deviation of the factors on the parameters: wear multiplies friction by 1.4."""
_MAX_DECREASE, _MAX_INCREASE = 0.5, 1.0
_SUPPLY_START = 1.0 - 0.9 * _MAX_DECREASE, 1.0 + 0.9 * _MAX_INCREASE
_STEP = 0.05
_LATENCY = 5.0
"""Latency that counts as much as a factor of two (ms)."""
_ITERATIONS = 40
_POOR = 10.0
"""Remaining errors, over the scatter of swings alike, from which on a search has failed."""
_ALIKE = 100
"""Neighbouring samples that err alike and count as one."""
_SWINGS = 3
"""Simulated ones that are averaged; one before them is not, as it begins with the air of arming."""


def read_recorded(paths: Sequence[Path]) -> tuple[Profile, list[Cycles]]:
    """Return the profile of the swings in Parquet files, a correction included, and their CYCLE records.

    Raises:
        BenchError: none is given; one is no record, holds no whole swing, or differs in plan from the first.
    """
    if not paths:
        raise BenchError("identify", "no record", "at least one record", "Give the paths of recorded swings.")
    read = [(path, *read_swing(path)) for path in paths]
    first = read_profile(read[0][2], str(paths[0]))
    swings: list[Cycles] = []
    for path, cycles, metadata in read:
        profile = read_profile(metadata, str(path))
        if digest_of(first) != digest_of(profile):
            corrected = ", with another correction" if first.name == profile.name else ""
            expected, action = f"of {first.name}, as in the records before", "Identify one at a time."
            raise BenchError(str(path), f"a swing of {profile.name}{corrected}", expected, action)
        swings.append(from_first_tick(cycles, profile, str(path)))
    return first, swings


def from_first_tick(cycles: Cycles, profile: Profile, location: str) -> Cycles:
    """Return the records of a swing from its first tick on.

    Raises:
        BenchError: they hold no swing up to the impact window.
    """
    begun = np.flatnonzero(cycles["phase"] == Phase.BACKSWING)
    first = int(begun[0]) - profile.begins[1] if begun.size else -1
    swing = cycles[max(first, 0) :]
    if first < 0 or len(swing) < profile.begins[5] or swing["cause"][: profile.begins[5]].any():
        expected, action = "a swing from the address to the ball", "Give a record of a complete swing."
        raise BenchError(location, "no complete swing", expected, action)
    return swing


class Identified(NamedTuple):
    """Robot identified from records."""

    values: Array
    """Values in the order of NAMES."""
    error: Array
    """Standard error of each."""
    before: float
    """Root mean square of the weighted errors with the nominal plant."""
    after: float

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which parameters the records determine."""
        return np.asarray(self.error <= SURE)


def variation_of(values: Array, bench: Bench) -> Variation:
    """Return the robot with `values` in the order of NAMES as a variation of the bench's model."""
    f = values.tolist()
    # The head's mass for the club's inertia about the wrist, linearised.
    club = bench.plant.robot.club
    heavier = replace(club, head_mass=1.1 * club.head_mass)
    nominal, more = (one.inertia + one.mass * one.centre_of_mass**2 for one in (club, heavier))
    slope = more / nominal - 1.0
    factor = 1.0 + 0.1 * (f[11] - 1.0) / slope
    return Variation(
        (f[0], f[1], f[2]),
        (f[3], f[4], f[5]),
        (f[6], f[7], f[8]),
        supply=f[9],
        vane=f[10],
        head_mass=club.head_mass * (factor - 1.0),
        latency=1e-3 * f[12],
    )


def identify(
    bench: Bench,
    observed: Sequence[Cycles],
    asked: Sequence[str] = NAMES,
    progress: Callable[[float], None] = lambda part: None,
) -> Identified:
    """Return the parameters with which the model swings as in `observed`: CYCLE records from the first tick.

    All swings are of the bench's profile and not the first after arming. Parameters not `asked` stay nominal,
    with unknown errors. `progress` gets the share of the max number of trials that is done.
    """
    free = np.array([NAMES.index(name) for name in asked])
    seen = np.mean([_seen(bench.profile, cycles) for cycles in observed], axis=0)
    weight = 1.0 / np.sqrt(np.isfinite(seen).sum() / _ALIKE)
    trials, most = [0], _ITERATIONS * (2 * len(free) + 1)

    def values(factors: Array) -> Array:
        every = np.ones(len(NAMES))
        every[free] = factors
        # The added latency has no nominal value to scale.
        every[-1] = max(_LATENCY * (every[-1] - 1.0), -1e3 * bench.plant.encoders.latency)
        return every

    def residual(factors: Array) -> Array:
        trials[0] += 1
        progress(min(trials[0] / most, 1.0))
        errors = weight * _errors(bench, values(factors), seen)
        return np.concatenate([errors, weight * (factors - 1.0) / _PRIOR])

    start = np.ones(len(free))
    nominal = residual(start)

    def searched(start: Array) -> Any:
        return least_squares(
            residual,
            start,
            jac="3-point",
            bounds=(1.0 - _MAX_DECREASE, 1.0 + _MAX_INCREASE),
            diff_step=np.full(len(free), _STEP),
            max_nfev=_ITERATIONS,
            ftol=1e-4,
            xtol=1e-3,
            loss="soft_l1",
            f_scale=5.0 * weight,
        )

    found = searched(start)
    if np.linalg.norm(found.fun[: -len(free)]) > _POOR:
        # The search may have ended at a supply too weak to swing: start from the measured one.
        supply = np.mean([cycles["supply_pressure"][0] for cycles in observed]) / bench.plant.supply.pressure
        start[free == NAMES.index("supply pressure")] = np.clip(supply, *_SUPPLY_START)
        found = min(found, searched(start), key=lambda one: float(one.cost))
    before, after = (float(np.linalg.norm(e[: -len(free)])) for e in (nominal, found.fun))
    # Scaled by the remaining error, at least the declared one: a good fit makes nothing more certain.
    jacobian, samples = np.asarray(found.jac), 1.0 / weight**2
    variance = max(after**2 * samples / max(samples - jacobian.shape[1], 1.0) / _ALIKE, 1.0) / samples
    error = np.full(len(NAMES), np.nan)
    error[free] = np.sqrt(np.diag(variance * np.linalg.inv(jacobian.T @ jacobian)))
    return Identified(values(found.x), error, before, after)


def _seen(profile: Profile, cycles: Cycles) -> Array:
    """Return the compared values (k, 13), weighted; NaN from a stop on and without a sensor."""
    swing = cycles[: profile.begins[5]]
    openings = uniform_filter1d(swing["applied_valve"], _SMOOTHED, axis=0)
    pressures = np.column_stack([swing["supply_pressure"], swing["chamber_pressure"]])
    values = np.hstack([swing["angle"] / _ANGLE, openings / _OPENING, pressures / _PRESSURE])
    values[swing["cause"] != 0] = np.nan
    return np.asarray(values[::_SPACING])


def _errors(bench: Bench, values: Array, seen: Array) -> Array:
    """Return the error of the simulated swings against `seen`; bounded, large without a swing."""
    plant = quiet(variation_of(values, bench).applied_to(bench.plant))
    known = np.isfinite(seen)
    try:
        series = Series(bench, plant)
        series.swing(bench.profile)
        swings = [_seen(bench.profile, series.swing(bench.profile).cycles) for _ in range(_SWINGS)]
    except Refused:
        return np.full(int(known.sum()), 20.0)
    simulated = np.mean([np.where(np.isfinite(swing), swing, seen + 20.0) for swing in swings], axis=0)
    return np.asarray(np.clip((simulated - seen)[known], -50.0, 50.0))


_WRITTEN = (
    *(
        f"{actuator}.{key}"
        for actuator in ACTUATOR_KEYS
        for key in ("area_a", "area_b", "dead_volume", "valve.conductance")
        + ("friction.viscous", "friction.coulomb", "friction.static")
    ),
    "supply.pressure",
    "encoders.latency",
)
"""Keys below [plant] that a variation may change."""


def write_plant_file(
    path: Path, plant: PlantParameters, found: Identified, configuration: Configuration
) -> None:
    """Write TOML with the identified parameters of `plant` to `path`, based on the file of `configuration`.

    Comments have each parameter's standard error; uncertain ones are marked. Raises NotStored.
    """
    lines = ["# Identified from recorded swings: value, standard error."]
    for name, value, error, known in zip(NAMES, found.values, found.error, found.known, strict=True):
        unit = "ms more" if name == NAMES[-1] else "times nominal"
        doubt = "" if known else "; NOT identified, a guess"
        lines.append(f"# {name}: {value:.4f} {unit}, {error:.4f}{doubt}")
    lines += [f"base = {toml_value(str(configuration.files[-1].resolve()))}", ""]
    lines += [f"plant.{key} = {toml_value(value_at(plant, key))}" for key in _WRITTEN]
    club = plant.robot.club
    lines.append(f"clubs.{club.name}.head_mass = {toml_value(club.head_mass)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, "\n".join([*lines, ""]))
