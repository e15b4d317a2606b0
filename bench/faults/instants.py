"""Instants of the undisturbed bench at which the matrix breaks something."""

from __future__ import annotations

from dataclasses import dataclass

from bench.lifecycle import Phase
from bench.swing.profile import PHASES as SWING_PHASES
from bench.swing.profile import Profile


@dataclass(frozen=True)
class Instant:
    """Instant of a fault: a phase, and ticks from the start of the swing (or of the search)."""

    phase: str
    tick: int
    label: str = ""

    @property
    def name(self) -> str:
        """Phase and label."""
        return f"{self.phase} {self.label}".strip()


def instants_of(profile: Profile) -> tuple[Instant, ...]:
    """Return the instants of the matrix in order."""
    spans = dict(
        zip(
            SWING_PHASES,
            zip(profile.begins, (*profile.begins[1:], len(profile.angle)), strict=True),
            strict=True,
        )
    )
    impact = round(profile.impact_time / profile.period)

    def at(phase: Phase, *shares: float) -> list[Instant]:
        begin, end = spans[phase]
        name = phase.name.lower().replace("_", "-")
        return [Instant(name, begin + round(s * (end - 1 - begin)), f"{100 * s:.0f} %") for s in shares]

    return (
        Instant("standing", 0),
        *(Instant("homing", tick, f"{tick} ms") for tick in (2500, 3500, 5000)),
        Instant("hold", 0),
        *at(Phase.BACKSWING, 0.1, 0.5, 0.9),
        *at(Phase.TOP, 0.5),
        *at(Phase.DOWNSWING, 0.2, 0.8),
        *at(Phase.COMMITTED, 0.1, 0.6),
        *(Instant("impact", impact + ms, f"{ms:+d} ms") for ms in (-10, 0, 10)),
        *at(Phase.FOLLOW_THROUGH, 0.1, 0.4, 0.8),
        *(Instant("return", len(profile.angle) + ticks, f"{ticks} ms") for ticks in (300, 1200)),
    )
