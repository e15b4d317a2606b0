"""Monitor of pressure sensors, vents and shut-off valve.

A pressure sensor counts as fitted after one plausible value, or if its driver reports INVALID. It fails after
DEAD_AFTER without a plausible value; until then its last value counts. While a sensor has failed, arming,
homing and reset are refused. Access then needs other evidence for a chamber, and is refused for the manifold.

The chambers vent through either of two valves. Each may report its position; the monitor reports one that
does not follow its command at that switching, while the other still vents. It checks the shut-off valve,
which keeps the manifold empty while people are inside, in the same way.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base.lifecycle import Cause, Phase, State
from bench.control.envelope import relay_closed
from drivers.base.compiled import compiled

SENSORS = 7
"""Supply first, then the chambers in the order of `drivers.base.CHAMBERS`."""
VENTS = 2
FAULTS = (
    *(Cause(Cause.SUPPLY_SENSOR + k) for k in range(SENSORS)),
    *(Cause(Cause.VENT_1 + k) for k in range(VENTS)),
    Cause.SUPPLY_VALVE,
    Cause.SUPPLY_DECAY,
    Cause.GUARD_LOCK,
    Cause.SHUT_OFF,
    *(Cause(Cause.SHOULDER_A_EXHAUST + k) for k in range(SENSORS - 1)),
)
"""Causes of `air_fault`, by bit; the manifold is `bench.control.monitor.venting_monitor`'s, the lock
`bench.control.monitor.position_monitor`'s, exhausts `bench.control.monitor.venting_monitor`'s."""

DEAD_AFTER = 0.1
"""Time without a plausible value after which a sensor counts as failed (s)."""
RECOVERY = 0.25
"""Suspicion that a second of believable values takes away (s): one value in five may be missing for ever."""
SWITCHING = 0.5
"""Max time for a vent to follow its command, in addition to its delay (s)."""
MAX_FALL = 1.0e5
"""Max fall of a sensor in a tick while the chambers vent (Pa): more is a jump."""
_MAX_STEP = 0.02
"""Max time that one tick adds to a suspicion (s): a stalled loop has read nothing."""


@compiled
def _is_believable(p: Any, pressure: float) -> bool:
    return bool(np.isfinite(pressure) and p.lowest_pressure <= pressure <= p.highest_pressure)


@compiled
def monitor_pressures(s: Any, p: Any, readings: Any, exhaust_closed: bool, step: float, time: float) -> None:
    """Judge sensors and vents `step` s after the last tick; `exhaust_closed` was commanded in it."""
    r, sensors, vents = readings[0], s.sensors, s.vents
    passed = min(step, _MAX_STEP)
    # Nothing that has been open to the air for so long holds less than the atmosphere.
    emptied = s.phase == Phase.STANDING and time - s.venting.start > p.vent_timeout
    for k in range(SENSORS):
        pressure = r.supply_pressure if k == 0 else r.chamber_pressure[k - 1]
        if _is_believable(p, pressure) and not (emptied and pressure < p.rest_pressure):
            fell = sensors.seen[k] != 0 and sensors.shown[k] - pressure > MAX_FALL
            sensors.seen[k], sensors.shown[k] = 1, pressure
            sensors.doubt[k] = max(sensors.doubt[k] - RECOVERY * passed, 0.0)
            if s.phase != Phase.STANDING:
                sensors.emptied[k] = pressure > p.vented_pressure
            elif fell:
                sensors.emptied[k] = 0
            elif pressure > p.vented_pressure:
                sensors.emptied[k] = 1
        elif sensors.seen[k] != 0 or not np.isnan(pressure):
            sensors.doubt[k] = min(sensors.doubt[k] + passed, DEAD_AFTER)
        if sensors.doubt[k] >= DEAD_AFTER:
            sensors.dead[k] = 1
        elif sensors.doubt[k] <= 0.0:
            sensors.dead[k] = 0
    wanted = 0.0 if exhaust_closed else 1.0
    # A passive device or an open safety relay opens the vents automatically.
    opened = not s.device_operational or not relay_closed(readings)
    allowed = SWITCHING + (0.0 if exhaust_closed else p.vent_delay)
    for k in range(VENTS):
        if s.tick <= 1:
            vents.agreed[k] = time
        position = r.vent_open[k]
        fitted = vents.fitted[k] != 0 or not np.isnan(position)
        vents.fitted[k] = fitted
        if not fitted or position == wanted or (exhaust_closed and opened):
            vents.agreed[k] = time
        vents.wrong[k] = fitted and time - vents.agreed[k] > allowed
    _monitor_shut_off(s.shut_off, p, r.shut_off_open, exhaust_closed, opened, s.tick <= 1, time)


@compiled
def _monitor_shut_off(
    valve: Any, p: Any, position: float, powered: bool, opened: bool, first: bool, time: float
) -> None:
    """Judge the shut-off valve's `position`; open while `powered`, but where the vents `opened`.

    `valve` is its SHUT_OFF; `first` says that this is the first tick.
    """
    if first:
        valve.agreed = time
    valve.fitted = valve.fitted or not np.isnan(position)
    if not valve.fitted or position == (1.0 if powered else 0.0) or (powered and opened):
        valve.agreed = time
    allowed = SWITCHING + (0.0 if powered else p.shut_off_delay)
    valve.wrong = valve.fitted and time - valve.agreed > allowed


@compiled
def air_cause(s: Any) -> int:
    """Return the cause that names the first dead sensor, wrong vent or manifold, or 0."""
    for k in range(SENSORS):
        if s.sensors.dead[k] != 0:
            return Cause.SUPPLY_SENSOR + k
    for k in range(VENTS):
        if s.vents.wrong[k] != 0:
            return Cause.VENT_1 + k
    if s.shut_off.wrong:
        return Cause.SHUT_OFF
    if s.manifold.wrong:
        return Cause.SUPPLY_VALVE
    if s.manifold.unproven and not s.manifold.excused:
        return Cause.SUPPLY_DECAY
    return 0


@compiled
def air_fault(s: Any) -> int:
    """Return what fails as bits, in the order of FAULTS."""
    bits = 0
    for k in range(SENSORS):
        if s.sensors.dead[k] != 0:
            bits |= 1 << k
    for k in range(VENTS):
        if s.vents.wrong[k] != 0:
            bits |= 1 << (SENSORS + k)
    if s.manifold.wrong:
        bits |= 1 << (SENSORS + VENTS)
    if s.manifold.unproven:
        bits |= 2 << (SENSORS + VENTS)
    if s.lock.wrong:
        bits |= 4 << (SENSORS + VENTS)
    if s.shut_off.wrong:
        bits |= 8 << (SENSORS + VENTS)
    for k in range(SENSORS - 1):
        if s.exhausts.slow[k] != 0:
            bits |= 16 << (SENSORS + VENTS + k)
    return bits


@compiled
def is_alive(sensors: Any, k: int) -> bool:
    """Return whether sensor `k` was seen and has not failed since."""
    return bool(sensors.seen[k] != 0 and sensors.dead[k] == 0)


@compiled
def chambers_show_pressure(sensors: Any, p: Any) -> bool:
    """Return whether a living sensor shows pressure in its chamber."""
    for k in range(1, SENSORS):
        if is_alive(sensors, k) and sensors.shown[k] > p.vented_pressure:
            return True
    return False


@compiled
def manifold_shows_pressure(sensors: Any, p: Any) -> bool:
    """Return whether a living sensor shows pressure in the manifold."""
    return bool(is_alive(sensors, 0) and sensors.shown[0] > p.vented_pressure)


@compiled
def nothing_is_held_up(sensors: Any, p: Any) -> bool:
    """Return whether no working sensor, the manifold's included, shows air that may hold an arm up."""
    for k in range(SENSORS):
        if is_alive(sensors, k) and sensors.shown[k] > p.holding_pressure:
            return False
    return True


@compiled
def all_chambers_are_seen(sensors: Any) -> bool:
    """Return whether a living sensor shows each chamber's pressure."""
    for k in range(1, SENSORS):
        if not is_alive(sensors, k):
            return False
    return True


@compiled
def emptiness_is_proven(s: Any, p: Any, readings: Any, time: float) -> bool:
    """Return whether manifold and chambers that show no pressure are verified as empty.

    With a sensor in each chamber, each reading must have fallen since venting started. A sensor that showed
    no pressure even then, or jumped, may be stuck: `vent_timeout` must pass. With a failed sensor, a vent
    must report open, and `vent_timeout` plus `rest_time_without_encoders` must pass. Without a sensor in each
    chamber, `vent_timeout` must pass. If vents have feedback and none reports open, nothing verifies the
    chambers: the air left below `vented_pressure` carries an arm, which sinks as it leaks away. Nothing
    verifies a manifold whose sensor has failed, or whose shut-off valve does not follow its command: only
    the supply valve keeps it empty. A suspect sensor prevents access, but does not end it.
    """
    whole, dead, fell = True, False, True
    for k in range(SENSORS):
        if s.sensors.dead[k] == 0 and s.sensors.doubt[k] > 0.0 and s.state != State.ACCESS:
            return False
        if k > 0:
            dead = dead or s.sensors.dead[k] != 0
            whole = whole and s.sensors.seen[k] != 0
            fell = fell and s.sensors.emptied[k] != 0
    fitted = s.vents.fitted[0] != 0 or s.vents.fitted[1] != 0
    opened = readings[0].vent_open[0] == 1.0 or readings[0].vent_open[1] == 1.0
    passed = time - s.venting.start
    if s.sensors.dead[0] != 0 or s.shut_off.wrong:
        return False
    if fitted and not opened and s.state != State.ACCESS:
        return False
    if dead:
        return bool(opened and passed >= p.vent_timeout + p.rest_time_without_encoders)
    if whole:
        return bool(fell or passed >= p.vent_timeout)
    return bool(passed >= p.vent_timeout and (opened or not fitted))
