"""Learned corrections in the bench's database: versioned, with conditions of validity; append-only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from hashlib import sha256
from typing import Any

import numpy as np
from sqlalchemy import Engine, select

from bench.base.errors import BenchError
from bench.learning.learn import LearningResult
from bench.store.database import LEARNED_SWINGS, add_version, transaction
from bench.swing.correction import Correction, basis_of, digest_of
from bench.swing.profile import Profile
from sim.plant import PlantParameters

PRESSURE_TOLERANCE = 0.02
"""Max difference of the supply from that of learning, as a share."""
TEMPERATURE_TOLERANCE = 8.0
"""Max difference in temperature, K; friction and air change with it."""


@dataclass(frozen=True)
class Conditions:
    """Conditions that a correction is valid for."""

    digest: str
    """Digest of the profile's tables, in simulation also of the robot; a correction is valid for its digest
    only."""
    club: str
    supply_pressure: float
    """Regulated pressure, Pa absolute."""
    temperature: float
    """Air temperature, K."""

    @staticmethod
    def of(
        profile: Profile, plant: PlantParameters, temperature: float, simulated: PlantParameters | None = None
    ) -> Conditions:
        """Return the conditions of a swing of `profile` on `plant`; `simulated`: the robot in simulation."""
        digest = digest_of(profile)
        if simulated is not None:
            # Supply and ball differ from shot to shot; the rest is another robot.
            alike = replace(simulated, supply=plant.supply, ball=plant.ball, seed=0)
            digest = sha256(f"{digest} {alike!r}".encode()).hexdigest()[:16]
        return Conditions(digest, plant.robot.club.name, plant.supply.pressure, temperature)

    def hold_for(self, other: Conditions) -> bool:
        """Return whether a correction learned under these conditions is valid under `other`."""
        return (
            self.digest == other.digest
            and self.club == other.club
            and abs(self.supply_pressure - other.supply_pressure)
            <= PRESSURE_TOLERANCE * other.supply_pressure
            and abs(self.temperature - other.temperature) <= TEMPERATURE_TOLERANCE
        )

    @property
    def text(self) -> str:
        """The conditions in words."""
        pressure, celsius = self.supply_pressure / 1e5, self.temperature - 273.15
        return f"club {self.club}, {pressure:.2f} bar absolute, {celsius:.0f} °C"


@dataclass(frozen=True)
class Learned:
    """A stored correction."""

    bench: str
    profile: str
    date: datetime
    simulated: bool
    source: str
    conditions: Conditions
    within: bool
    """Whether the target was reached."""
    weights: tuple[float, ...]
    content: Mapping[str, Any] = field(default_factory=dict)
    """Target, swings and scatter, for people."""
    version: int = 0

    def correction(self, profile: Profile) -> Correction:
        """Return the tables for `profile`, the one that it was learned with."""
        return basis_of(profile).correction(np.array(self.weights))

    @property
    def record(self) -> dict[str, Any]:
        """The entry as a JSON-ready record."""
        return asdict(self) | {"date": self.date.isoformat(timespec="seconds")}


def stored(
    result: LearningResult,
    bench: str,
    profile: str,
    conditions: Conditions,
    source: str,
    date: datetime,
    *,
    simulated: bool,
    beside: Mapping[str, Any] | None = None,
) -> Learned:
    """Return `result` as an entry of the store, with `beside` in its content."""
    content = {
        **(beside or {}),
        "target": result.target.shown,
        "chosen": result.chosen,
        "swings": [attempt.figures.shown | {"cause": attempt.cause.name} for attempt in result.attempts],
        "scatter_in_tolerances": [float(value) for value in result.scatter],
    }
    weights = tuple(map(float, result.weights))
    return Learned(bench, profile, date, simulated, source, conditions, result.within, weights, content)


def keep(database: Engine, entry: Learned) -> int:
    """Add `entry` as the next version of its bench and profile, and return that number."""
    values = asdict(entry)
    del values["version"]
    content = {"weights": list(values.pop("weights")), **values.pop("content")}
    values |= values.pop("conditions") | {"content": content}
    with transaction(database, writes=True) as connection:
        return add_version(connection, LEARNED_SWINGS, "profile", values)


def learned_swings(database: Engine, bench: str, profile: str) -> list[Learned]:
    """Return the corrections of `profile` learned on `bench`, oldest first.

    Raises:
        BenchError: an entry was not written by golfbench.
    """
    c = LEARNED_SWINGS.c
    wanted = select(LEARNED_SWINGS).where(c.bench == bench, c.profile == profile)
    with database.connect() as connection:
        rows = connection.execute(wanted.order_by(c.version)).all()
    return [_entry(row) for row in rows]


def _entry(row: Any) -> Learned:
    content = dict(row.content)
    weights = content.pop("weights", None)
    if not isinstance(weights, list) or not all(isinstance(value, float | int) for value in weights):
        location = f"learned swing {row.profile}, version {row.version}"
        raise BenchError(location, "no weights", "a list of numbers", "Learn it again: golfbench learn.")
    conditions = Conditions(row.digest, row.club, row.supply_pressure, row.temperature)
    return Learned(
        *(row.bench, row.profile, row.date, row.simulated, row.source, conditions, row.within),
        *(tuple(map(float, weights)), content, row.version),
    )


def newest_that_holds(
    database: Engine,
    bench: str,
    profile: str,
    conditions: Conditions,
    *,
    simulated: bool,
    until: datetime | None = None,
) -> Learned | None:
    """Return the newest correction of `profile` that holds for `conditions`; None without one.

    A correction learned in simulation is not valid on a machine, nor is one learned after `until`: a campaign
    keeps the corrections that it began with.
    """
    for entry in reversed(learned_swings(database, bench, profile)):
        if until is not None and entry.date > until:
            continue
        if entry.within and entry.simulated == simulated and entry.conditions.hold_for(conditions):
            return entry
    return None


def drifted(scatter: Sequence[float], errors: Sequence[Sequence[float]]) -> bool:
    """Return whether a block's shots have drifted from the learned delivery, so that it must be refreshed.

    `errors` (n, k) are the shots' deviations from the target, `scatter` (k,) their standard deviation when it
    was learned, both in tolerances. They have drifted if a mean deviation exceeds one tolerance and three
    standard errors, so the limit is higher with fewer shots.
    """
    values = np.asarray(errors, dtype=float)
    if not len(values):
        return False
    mean, noise = np.abs(values.mean(axis=0)), np.asarray(scatter) / np.sqrt(len(values))
    return bool(np.any((mean > 1.0) & (mean > 3.0 * noise)))
