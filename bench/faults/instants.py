"""Instants of the undisturbed bench at which the matrix breaks something."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from bench.base.lifecycle import Phase
from bench.swing.profile import PHASES as SWING_PHASES
from bench.swing.profile import Profile


@dataclass(frozen=True)
class Instant:
    """Instant of a fault: a phase, and ticks from the start of the swing (or of homing)."""

    phase: str
    tick: int
    label: str = ""
    delay: float = 0.0
    """Time from the stop, which comes at the instant, to the fault, s."""

    @property
    def name(self) -> str:
        """Phase, label and delay."""
        later = f" +{1e3 * self.delay:.0f} ms" if self.delay else ""
        return f"{self.phase} {self.label}".strip() + later


INTO_A_STOP = (0.01, 0.03, 0.06, 0.1, 0.2)
"""Time from a stop to a fault during it, s."""
_DENSE = 12
"""Ticks between the dense instants."""

START = (Instant("start", 0, "absolute"), Instant("start", 0, "index"))
"""The bench is switched on with the fault, and homes by either method."""
ACCESS = (Instant("access", 0, "before"), Instant("access", 0, "inside"))
"""The fault comes while the robot is armed, before it vents for access; or when the guard is released."""


def phase_name(phase: Phase) -> str:
    """Return the name of `phase` in fault matrices."""
    return phase.name.lower().replace("_", "-")


def _spans(profile: Profile) -> dict[Phase, tuple[int, int]]:
    ends = (*profile.begins[1:], len(profile.angle))
    return dict(zip(SWING_PHASES, zip(profile.begins, ends, strict=True), strict=True))


def dense_instants(profile: Profile) -> tuple[Instant, ...]:
    """Return instants 12 ms apart from downswing to follow-through, where stops are hit."""
    return tuple(
        Instant(phase_name(phase), tick, f"at {tick} ms")
        for phase, (begin, end) in _spans(profile).items()
        if Phase.DOWNSWING <= phase <= Phase.FOLLOW_THROUGH
        for tick in range(begin + (-begin) % _DENSE, end, _DENSE)
    )


def stopped_instants(profile: Profile, delays: Sequence[float] = INTO_A_STOP) -> tuple[Instant, ...]:
    """Return the instants of the moving swing, each with all `delays` (s) after its stop begins."""
    return tuple(
        replace(instant, delay=delay)
        for instant in instants_of(profile)
        if instant.phase not in ("standing", "homing", "hold", "return")
        for delay in delays
    )


def instants_of(profile: Profile) -> tuple[Instant, ...]:
    """Return the instants of a fault that comes alone, in order."""
    spans = _spans(profile)
    impact = round(profile.impact_time / profile.period)

    def at(phase: Phase, *shares: float) -> list[Instant]:
        begin, end = spans[phase]
        name = phase_name(phase)
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
