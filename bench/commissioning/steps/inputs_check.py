"""Step 0 of commissioning, and the daily check: an input is valid only after it has changed as expected.

The switches are checked with centred spools and the regulator turned down to zero. The guard is released,
and a person sent to the tee, only while no sensor shows air that may hold an arm up. Then air enters the
manifold, behind a closed guard with open vents, to compare the supply sensor with a gauge at two pressures. A
measured robot rests meanwhile; an unmeasured one may drift, as a spool may be off its centre.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf, isfinite, isnan

from bench.base.errors import Refused
from bench.base.lifecycle import REFUSAL_WORDS, Refusal
from bench.calibration.calibration import SeenInputs, wiring_digest
from bench.commissioning.machine.commissioning_step import MachineFault, NamedStep
from bench.commissioning.machine.driver_machine import REPEATS, LongStall, SimulatedMachine, Stalled
from bench.commissioning.machine.inputs import (
    ACTS,
    INSIDE,
    OperatorIO,
    Stage,
    await_local_reset,
    fitted,
    judged,
    stages,
)
from bench.commissioning.machine.machine import DRIFT
from bench.commissioning.machine.machine_process import LiveRobot
from bench.config import Configuration
from bench.control.settings import holding_pressure, zero_tolerance
from drivers.base import CHAMBERS, PASSIVE, Command, Readings
from sim.plant import PlantParameters

PRESSURES = (2.5e5, 4.0e5)
"""Pressures at which the gauge is read, Pa absolute."""
TOLERANCE, TOLERANCE_SHARE = 0.1e5, 0.02
"""Max deviation of a sensor (Pa), and share of the pressure on top: a gauge of class 1 to 10 bar."""
_EMPTY = 0.5e5
"""Max manifold pressure above the atmosphere with the regulator turned down (Pa)."""
_MIN_SHARE = 0.7
"""Share of the wanted pressure that the gauge shows at least: two readings of no air prove no span."""
_SETTLED, _FILLED = 1.0, 3.0
"""Time without a change beyond the valves' own delays, and to fill the manifold (s)."""
_UNSEEN = (
    f"{REFUSAL_WORDS[Refusal.GAUGE][0]}: lock the supply, open all hand valves until they have blown out, "
    "read 0 at both gauges"
)
"""Request before the guard is released, where not each chamber and the manifold have a valid sensor."""

_WARNING = Command(beacon=True)


INPUT_CHECK = NamedStep(
    "inputs",
    "Interlocks, buttons and switches, one by one; supply sensor against the gauge",
    "no air for the switches, then "
    f"{' and '.join(f'{1e-5 * p:.1f}' for p in PRESSURES)} bar absolute in the manifold, vents open, "
    f"spools centred; a joint whose spool is off its centre drifts, at {DRIFT:g} rad/s at most",
)
"""Step 0."""


def check_inputs(
    machine: SimulatedMachine | LiveRobot,
    hands: OperatorIO,
    configuration: Configuration,
    progress: Callable[[str], None] = lambda what: None,
) -> tuple[SeenInputs, list[MachineFault]]:
    """Return the inputs seen, and findings; the machine is passive afterwards.

    Only without findings and errors the regulator is turned up to service, else down to zero.

    Raises:
        Refused: no person reads the gauge, air is on or off where it may not be, the guard is open when air
            is to come, or the device fails.
        MachineFault: a joint moves.
    """
    if hands.gauge is None:
        action = "Run it in a terminal, or golfbench calibrate inputs before."
        raise _refused("no person at the machine", "a person who acts and reads", action)
    c, atmosphere = configuration, configuration.plant.supply.atmosphere
    done = stages(local_reset=c.lifecycle.local_reset)
    after = atmosphere
    hands.say("Lock the supply, and open all hand valves until they have blown out.")
    hands.regulator(atmosphere)
    try:
        seen = _watched(machine, hands, c, done, progress)
        names = fitted(seen[0], local_reset=c.lifecycle.local_reset)
        findings = off_at_rest(seen[-1], c.plant)
        if len(seen) == len(done):
            findings = judged(done, seen, names) + findings
        deviation = 0.0
        if not findings and not isnan(seen[-1].supply_pressure):  # no air behind a guard that is not proven
            progress("supply sensor against its gauge")
            deviation, findings = _beside_the_gauge(machine, hands, hands.gauge, c)
        after = atmosphere if findings else inf  # no air behind a guard that is not proven
    finally:
        machine.make_passive()
        hands.regulator(after)
    found = tuple(f"{one.location}: {one.found}; expected {one.expected}. {one.action}" for one in findings)
    return SeenInputs(names, wiring_digest(c), found, deviation), findings


def _refused(found: str, expected: str, action: str) -> Refused:
    return Refused("check of the inputs", found, expected, action)


def raise_findings(findings: list[MachineFault]) -> None:
    """Raise MachineFault with all `findings`, if there are any."""
    if findings:
        location, found, expected, action = (
            "; ".join(dict.fromkeys(part)) for part in zip(*(one.args for one in findings), strict=True)
        )
        raise MachineFault(location, found, expected, action)


def _watched(
    machine: SimulatedMachine | LiveRobot,
    hands: OperatorIO,
    c: Configuration,
    done: tuple[Stage, ...],
    progress: Callable[[str], None],
) -> list[Readings]:
    """Return the readings at the end of each stage, up to the first that has the guard released over air.

    A stall of the computer repeats a stage; those before it count, as the inputs were unwatched but for a
    moment. After a long stall the check begins again, by a person.
    """
    seen, stalls, stalled = list[Readings](), 0, False
    while len(seen) < len(done):
        stage, previous = done[len(seen)], done[max(len(seen) - 1, 0)]
        timeout = hands.timeout
        try:
            if not stage.outputs.guard_lock:
                # Air may have come in a stall.
                now = _watch(machine, c, PASSIVE, None, timeout) if stalled else seen[-1]
                if _holds_air(now, c.plant):
                    return [*seen[:-1], now]
                if stalled or previous.outputs.guard_lock:
                    _require_gauges(now, hands)
                timeout *= INSIDE
            progress(stage.name)
            if stage.act:
                hands.act(ACTS[stage.act])
            seen.append(_watch(machine, c, stage.outputs, seen[-1] if stage.act else None, timeout))
            stalled = False
        except Stalled as stall:
            stalls, stalled = stalls + 1, True
            if stalls > REPEATS or isinstance(stall, LongStall):
                raise
            hands.say(f"{stall.found}. Repeated: {stage.name}; the {len(seen)} parts before it count.")
    return seen


def _require_gauges(readings: Readings, hands: OperatorIO) -> None:
    """Have the gauges read where a sensor in `readings` shows no pressure."""
    if not all(map(isfinite, (readings.supply_pressure, *readings.chamber_pressure))):
        hands.confirm(_UNSEEN)


def _watch(
    machine: SimulatedMachine | LiveRobot,
    c: Configuration,
    outputs: Command,
    before: Readings | None,
    timeout: float,
) -> Readings:
    """Return the readings with `outputs` once they differ from `before`, if given, or after `timeout` (s).

    Raises:
        Refused: the manifold holds air, or the device fails.
    """
    supply = c.plant.supply
    settled, air = _SETTLED + max(supply.vent_delay, supply.shut_off_delay), supply.atmosphere + _EMPTY
    readings = machine.watch(outputs, before, air, settled, timeout + settled)
    if isfinite(readings.supply_pressure) and readings.supply_pressure > air:
        found = f"{1e-5 * readings.supply_pressure:.2f} bar absolute in the manifold"
        action = "Turn the regulator down until its gauge shows 0, and begin again."
        raise _refused(found, "none, with the regulator turned down", action)
    return readings


def _holds_air(readings: Readings, plant: PlantParameters) -> bool:
    """Return whether a sensor shows air that may hold an arm up, by the bound of access."""
    shown = (readings.supply_pressure, *readings.chamber_pressure)
    return any(isfinite(pressure) and pressure > holding_pressure(plant) for pressure in shown)


def off_at_rest(readings: Readings, plant: PlantParameters) -> list[MachineFault]:
    """Return the fitted pressure sensors that do not show the atmosphere, vented, as access requires it."""
    atmosphere, tolerance = plant.supply.atmosphere, zero_tolerance(plant)
    sensors = ("supply", *CHAMBERS)
    shown = (readings.supply_pressure, *readings.chamber_pressure)
    return [
        MachineFault(
            f"{name} sensor",
            f"{1e-5 * pressure:.3f} bar absolute, vented" if isfinite(pressure) else "no believable reading",
            f"{1e-5 * atmosphere:.3f} bar within {1e-5 * tolerance:.3f}: above, access is refused; below, "
            "held air is not seen",
            "If above, lock the supply, open hand valves in pairs, clean its silencer. If it stays, set the "
            "sensor's zero and span, or replace it; if all differ alike, correct plant.supply.atmosphere.",
        )
        for name, pressure in zip(sensors, shown, strict=True)
        if not isnan(pressure) and not abs(pressure - atmosphere) <= tolerance
    ]


def _allowed(pressure: float) -> float:
    return TOLERANCE + TOLERANCE_SHARE * pressure


def _beside_the_gauge(
    machine: SimulatedMachine | LiveRobot, hands: OperatorIO, gauge: Callable[[], float], c: Configuration
) -> tuple[float, list[MachineFault]]:
    """Return the largest deviation of the supply's sensor from the gauge (Pa), and findings."""
    atmosphere, worst = c.plant.supply.atmosphere, 0.0
    findings = list[MachineFault]()
    for pressure in PRESSURES:
        readings = _at_pressure(machine, hands, c, pressure)
        if not (readings.guard_closed and readings.guard_locked and machine.may_move()):
            action = "Close the guard, release the emergency stop, and begin again."
            raise _refused("the guard or the emergency stop", "closed, and clear", action)
        over = gauge()
        if not over >= _MIN_SHARE * (pressure - atmosphere):
            found = f"{1e-5 * over:.2f} bar on the gauge"
            expected = f"about {1e-5 * (pressure - atmosphere):.1f} bar"
            raise _refused(found, expected, "Open the air, turn the regulator up, and begin again.")
        shown = atmosphere + over
        off = readings.supply_pressure - shown
        if not abs(off) <= _allowed(shown):
            findings.append(
                MachineFault(
                    "supply sensor",
                    f"{1e-5 * readings.supply_pressure:.2f} bar absolute, {1e-5 * shown:.2f} by the gauge",
                    f"the same within {1e-5 * _allowed(shown):.2f} bar",
                    "Correct pressure_at_full_scale, or replace the sensor; mind the true pressure.",
                )
            )
        worst = off if isfinite(off) and abs(off) > abs(worst) else worst
    return worst, findings


def _at_pressure(
    machine: SimulatedMachine | LiveRobot, hands: OperatorIO, c: Configuration, pressure: float
) -> Readings:
    """Return the readings with the manifold filled to `pressure` (Pa absolute), again after a stall."""
    a, b, d = (actuator.valve.centre for actuator in c.plant.actuators)
    on = Command(valve=(a, b, d), supply_enable=True, beacon=True)
    hands.regulator(pressure)
    for left in reversed(range(REPEATS + 1)):
        try:
            await_local_reset(machine, hands)
            machine.watch(_WARNING, None, inf, c.lifecycle.warning_time, c.lifecycle.warning_time)
            return machine.watch(on, None, inf, _FILLED, _FILLED)
        except Stalled as stall:
            if not left or isinstance(stall, LongStall):
                raise
            hands.say(f"{stall.found}. Repeated: supply sensor against its gauge; all inputs count.")
    raise AssertionError("unreachable")
