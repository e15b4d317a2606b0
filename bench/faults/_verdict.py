"""The verdict on one case of the matrix: safe, harmless, undetected or unsafe.

It follows the plant's true state, not the bench's estimate; the outcome also has the bench's detection.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from math import hypot
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.base.lifecycle import CAUSE_TEXT, REFUSAL_TEXT, Answer, Cause, Phase, Reaction, State
from bench.faults._case_run import WatchedRun
from bench.faults.catalogue import Breakage, Event, Instant
from bench.loop.loop import Cycles
from bench.simulation.safety import SafetyLimits, unsafe_reasons

_MATTERS = {"speed": 0.01, "strike": 0.005, "pose": 0.02}
"""Share of the head's speed, m at the ball, rad at the end: differences that do not matter yet."""


@dataclass(frozen=True)
class CaseOutcome:
    """End of one case. Shares are of a rating or limit: 1 is the limit. Times are ticks from the fault."""

    breakage: str
    signal: str
    kind: str
    family: str
    phase: str
    instant: str
    verdict: str
    """safe, harmless, undetected or unsafe."""
    reasons: tuple[str, ...]
    detected_by: str
    detection_ticks: int
    """-1: never."""
    reaction: str
    reaction_ticks: int
    """Time until the first command of the reaction reaches a valve; -1: no reaction."""
    stop_share: float
    stop: str
    pressure_share: float
    overtravel: float
    """Max compression of an absorber, as a fraction of its travel."""
    clearance: float
    """Lowest of the head over the ground, m."""
    head_share: float
    """Fastest head, share of the profile's."""
    rest_ticks: int
    """Time until all joints stayed at rest; -1: they did not."""
    operator: str
    record: str
    change: str
    """Deviation from the fault-free run at impact or at rest; empty if negligible."""
    next_swing: str = ""
    """Finding that names the undetected fault by the next swing, before its ball is struck; empty without
    one."""

    def as_json(self) -> dict[str, Any]:
        """Return the outcome as a JSON-ready record."""
        return asdict(self) | {"reasons": list(self.reasons)}


class CaseLimits(NamedTuple):
    """Tick and limits that a case is judged by."""

    period: float
    """Tick (s)."""
    safety: SafetyLimits
    head_speed: float
    """Fastest head of the undisturbed swing, m/s."""


def judge_case(
    limits: CaseLimits, breakage: Breakage, instant: Instant, run: WatchedRun, healthy: WatchedRun
) -> CaseOutcome:
    """Return the outcome of `run` with `breakage` at `instant`; `healthy` is the undisturbed run."""
    cycles, loads = run.cycles, run.loads
    after = round(instant.delay / limits.period)
    detected_by, detected, reaction, reacted = _detection(run, healthy, _own_cause(breakage), after)
    change = _change(run, healthy) if not detected_by else ""
    head_share = _fastest_head(run, breakage, after, limits.period) / limits.head_speed
    reasons = unsafe_reasons(run.end(head_share), limits.safety)
    if reasons and not detected_by:
        reasons.append("the record says healthy")
    if reasons:
        verdict = "unsafe"
    elif detected_by:
        verdict = "safe"
    else:
        verdict = "undetected" if change else "harmless"
    if verdict == "undetected":
        reasons.append(change)
    cause, final = Cause(int(run.control[0]["cause"])), State(int(run.control[0]["state"]))
    found = Cause(int(run.control[0]["latest_cause"]))
    return CaseOutcome(
        breakage=breakage.name,
        signal=breakage.fault.signal,
        kind=breakage.fault.kind,
        family=breakage.family,
        phase=instant.phase,
        instant=instant.name,
        verdict=verdict,
        reasons=tuple(reasons),
        detected_by=detected_by,
        detection_ticks=detected,
        reaction=reaction,
        reaction_ticks=reacted,
        stop_share=round(loads.stop_share, 4),
        stop=loads.stop,
        pressure_share=round(loads.pressure_share, 4),
        overtravel=round(loads.depth_share, 4),
        clearance=round(loads.lowest_clearance, 4),
        head_share=round(head_share, 4),
        rest_ticks=run.rest_tick if run.rested else -1,
        operator="; then ".join(CAUSE_TEXT[c] for c in dict.fromkeys((cause, found)) if c)
        or "; ".join(f"{put.name.lower()} refused: {REFUSAL_TEXT[why]}" for put, why in run.refusals)
        or "nothing",
        record=f"{final.name}, cause {_causes(cycles, cause)}"
        + (f", reaction {reaction}" if reaction else ""),
        change=change,
    )


def _fastest_head(run: WatchedRun, breakage: Breakage, after: int, period: float) -> float:
    """Return the speed of the fastest head, m/s; one that comes off flies on with that of its last tick.

    The remaining bare shaft is faster than any head but has little energy: only its impact on the end stops
    counts.
    """
    lost = [fault.time for fault in breakage.faults if fault.signal == "club head"]
    if not lost:
        return run.loads.peak_head_speed
    until = after + round(min(lost) / period) + 1
    return float(run.cycles["plant_head_speed"][:until].max(initial=0.0))


_EVENT_CAUSES: dict[Event, Cause] = {
    "stop": Cause.OPERATOR_STOP,
    "emergency stop": Cause.EMERGENCY_STOP,
    "guard opened": Cause.GUARD,
}


def _own_cause(breakage: Breakage) -> Cause:
    """Return the cause that the case provokes on purpose; latching it does not count as detection."""
    if breakage.event == "stop" or breakage.family == "during a stop":
        return _EVENT_CAUSES[breakage.event]
    return Cause.NONE


def _detection(run: WatchedRun, healthy: WatchedRun, own: Cause, after: int) -> tuple[str, int, str, int]:
    """Return what detected the fault and at which tick, and the reaction and its tick; "" and -1: none.

    A latched `own`, caused by the case, is not a detection. Ticks count from the fault, `after` ticks into
    the run.
    """
    cycles = run.cycles
    ran = cycles["tick"] > 0
    latest = cycles["latest_cause"]
    tripped = _first(ran & (latest != Cause.NONE) & (latest != own))
    if tripped >= 0:
        detected_by = Cause(int(latest[tripped])).name
    else:
        detected_by, tripped = _other_detection(run, healthy)
    severity = cycles["reaction"]
    if own and tripped >= 0:
        harder = (
            np.flatnonzero((np.diff(severity) > 0) & ran[1:] & (np.arange(1, len(severity)) >= after)) + 1
        )
        reacted = int(harder[0]) if len(harder) and detected_by else -1
    else:
        reacted = _first(ran & (severity >= Reaction.COMPLETE)) if detected_by else -1
    reaction = Reaction(int(severity[reacted])).name if reacted >= 0 else ""
    if run.device_passive >= 0 and reacted < 0:
        reaction, reacted = "PASSIVE (valve node)", run.device_passive
    tripped = max(0, tripped - after) if tripped >= 0 else -1
    return detected_by, tripped, reaction, max(0, reacted - after) if reacted >= 0 else -1


def _causes(cycles: Cycles, last: Cause) -> str:
    """Return the latched causes in order: trapped pressure takes the place of the first one."""
    _, first = np.unique(cycles["cause"], return_index=True)
    names = [Cause(int(cycles["cause"][row])).name for row in sorted(first) if cycles["cause"][row] != 0]
    return " then ".join(dict.fromkeys([*names, last.name]))


def _first(mask: NDArray[np.bool_]) -> int:
    found = np.flatnonzero(mask)
    return int(found[0]) if len(found) else -1


def _other_detection(run: WatchedRun, healthy: WatchedRun) -> tuple[str, int]:
    """Return what detected the fault though no cause was latched, and at which tick."""
    if run.device_passive >= 0:
        return "watchdog of the valve node", run.device_passive
    news = [refusal for refusal in run.refusals if refusal not in healthy.refusals]
    if news:
        at = _first((run.cycles["answer"] == Answer.REFUSED) & (run.cycles["request"] != 0))
        return f"{news[0][0].name.lower()} refused", at
    for name, text in (("lease_held", "disarmed: no lease"), ("support_ready", "disarmed: nothing records")):
        gone = _first((run.cycles["tick"] > 0) & ~run.cycles[name])
        if gone >= 0:
            return text, gone
    left, struck = _ball_left(run.cycles), not _ball_left(healthy.cycles)
    if left and struck:
        return "no ball struck, reported with the shot", len(run.cycles) - 1
    ran = np.flatnonzero(run.cycles["tick"] > 0)
    late = run.cycles["measured_step"][ran] > 1.5 * np.median(run.cycles["measured_step"][ran])
    if late.any():
        return "missed ticks, counted with the swing", int(ran[np.flatnonzero(late)[0]])
    return "", -1


def _ball_left(cycles: Cycles) -> bool:
    """Return whether the ball sensor sees the ball after the impact; False without a swing."""
    seen = cycles["ball_present"][cycles["phase"] == Phase.FOLLOW_THROUGH]
    return bool(len(seen) and seen[-1])


def _change(run: WatchedRun, healthy: WatchedRun) -> str:
    """Return the difference to the undisturbed run at the ball or at rest; empty if it does not matter."""
    if (run.contact is None) != (healthy.contact is None):
        return "the ball was missed" if run.contact is None else "a ball was struck"
    if run.contact is not None and healthy.contact is not None:
        a, b = run.contact, healthy.contact
        speed, wanted = hypot(a[3], a[4]), hypot(b[3], b[4])
        if abs(speed - wanted) > _MATTERS["speed"] * wanted:
            return f"club speed at the ball {speed:.1f} instead of {wanted:.1f} m/s"
        # Offset across the club's path; along the path, contact occurs anyway.
        off = abs((a[0] - b[0]) * -b[4] + (a[1] - b[1]) * b[3]) / wanted
        if off > _MATTERS["strike"]:
            return f"struck {1e3 * off:.0f} mm off"
    apart = np.abs(run.angle - healthy.angle).max()
    if apart > _MATTERS["pose"] and not np.isnan(apart):
        return f"rests {apart:.2f} rad from where it should"
    return ""
