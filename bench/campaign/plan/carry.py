"""The carry of a shot: three quantities that are never mixed, and the one that the plan compares.

Reference: flown from the launch with the reference ball's aerodynamics, all balls alike. Monitor: as the
launch monitor reported it. Measured: flown with the coefficients that were measured on this ball. A simulated
ball also has the flight of its model, "simulated"; a report of hardware never shows it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bench.base.errors import Refused
from bench.calibration.ball_aerodynamics import AerodynamicsEntry, aerodynamics_from_record
from bench.campaign.plan.plan import FLOWN, CampaignPlan
from bench.records.shot.recorded_shot import FlightConditions
from bench.records.shot.shot import flight_columns
from drivers.base import Launch
from sim.ball import REFERENCE_BALL, Ball
from sim.flight import Flight

Measured = Mapping[str, AerodynamicsEntry]


def measured_of(calibrations: Mapping[str, Any], location: str) -> dict[str, AerodynamicsEntry]:
    """Return the measured aerodynamics at the start of a campaign, from its `calibrations`."""
    stored = calibrations.get("aerodynamics", {})
    return {
        ball: aerodynamics_from_record(entry, f"{location}: aerodynamics") for ball, entry in stored.items()
    }


def require_carry(plan: CampaignPlan, measured: Measured) -> None:
    """Refuse a plan whose carry cannot be known on hardware.

    Raises:
        Refused: it compares a carry without saying which, or a ball's aerodynamics were not measured.
    """
    location, a = f"plan {plan.campaign.name}: analysis.carry", plan.analysis
    if a.quantity in FLOWN and not a.carry:
        raise Refused(
            location,
            f"empty, while {a.quantity} is compared",
            '"reference", "monitor" or "measured"',
            'Name the carry: "monitor" as the launch monitor reports it, "measured" flown with coefficients '
            'of golfbench calibrate aerodynamics, "reference" flown with one ball\'s coefficients for all, '
            "which compares launches only.",
        )
    missing = [name for name in plan.ball_names if name not in measured]
    if a.carry == "measured" and missing:
        found = f'"measured", but no aerodynamics of {", ".join(missing)}'
        action = f"golfbench calibrate aerodynamics {missing[0]} FLIGHTS.csv --source TEXT"
        raise Refused(location, found, "measured coefficients of each ball", action)


def carry_columns(
    plan: CampaignPlan,
    measured: Measured,
    ball: str,
    launch: Launch,
    around: FlightConditions,
    reported: float | None,
    simulated: Ball | None,
) -> tuple[dict[str, Any], str]:
    """Return the carry columns of the shot table, and why there is no `carry_m` although it is compared.

    `launch` is that of `ball`, as measured; `reported` the monitor's carry (m), `simulated` the simulated
    ball, None on hardware.
    """
    entry, error, outside = measured.get(ball), None, ""
    try:
        flights: dict[str, Flight | None] = {"reference": around.fly(launch, REFERENCE_BALL)}
        flights["simulated"] = None if simulated is None else around.fly(launch, simulated)
        if entry is not None and not (outside := entry.values.outside(launch)):
            v = entry.values
            flights["measured"] = around.fly(launch, v.as_flown, v.aerodynamics)
            error = v.carry_error(launch, around.air, around.wind, around.turf)
    except ValueError as fault:
        return {}, f"no flight: {fault}"
    source: str = plan.analysis.carry or "reference"
    if simulated is not None and (not plan.analysis.carry or (source == "measured" and entry is None)):
        source = "simulated"  # a simulated ball without measurement has its model's flight
    flight_source = "simulated" if source == "monitor" else source
    flight = flights.get(flight_source)
    carry = reported if source == "monitor" else None if flight is None else flight.carry
    columns: dict[str, Any] = {
        f"carry_{name}_m": None if (flown := flights.get(name)) is None else flown.carry
        for name in ("reference", "measured")
    }
    columns |= {"carry_monitor_m": reported, "carry_measured_error_m": error}
    if carry is not None:
        columns |= {"carry_m": carry, "carry_source": source}
    if flight is not None:
        columns |= flight_columns(flight) | {"flight_source": flight_source}
    if carry is None and plan.analysis.quantity in FLOWN:
        return columns, outside or f"no carry: {_NONE[source]}"
    return columns, ""


_NONE = {
    "monitor": "the launch monitor reported none",
    "measured": "the aerodynamics of the ball were not measured",
}
