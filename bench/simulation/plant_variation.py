"""Plants with realistic deviations, and the largest residuals of the swings of a drawn robot."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import Refused
from bench.base.lifecycle import Cause, Phase, Reaction, Request
from bench.control.estimate.residual_monitor import KINDS, LEARNING
from bench.control.step_records import ControlParameters
from bench.simulation.lockstep import Lockstep
from bench.simulation.swing_operator import RETURN_TIMEOUT, LockstepEngine
from bench.swing.profile import PHASES, Profile
from sim.driver import hanging_pose
from sim.plant import PlantParameters, build_plant
from sim.pneumatics import Actuator

Three = tuple[float, float, float]
_ONES: Three = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Variation:
    """Factors on a plant's parameters, and additions to them; joints and valves in order."""

    friction: Three = _ONES
    """Factors on viscous, Coulomb and static friction."""
    flow: Three = _ONES
    """Factors on the valves' conductance."""
    volume: Three = _ONES
    """Factors on the dead volumes."""
    supply: float = 1.0
    """Factor on the regulated pressure."""
    vane: float = 1.0
    """Factor on the vane's area."""
    head_mass: float = 0.0
    """Added mass of the head, kg."""
    latency: float = 0.0
    """Added latency of the encoders, s."""

    def applied_to(self, plant: PlantParameters) -> PlantParameters:
        """Return `plant` with these deviations."""

        def varied(actuator: Actuator, i: int, area: float = 1.0) -> Actuator:
            friction, valve = actuator.friction, actuator.valve
            return replace(
                actuator,
                area_a=actuator.area_a * area,
                area_b=actuator.area_b * area,
                dead_volume=actuator.dead_volume * self.volume[i],
                friction=replace(
                    friction,
                    viscous=friction.viscous * self.friction[i],
                    coulomb=friction.coulomb * self.friction[i],
                    static=friction.static * self.friction[i],
                ),
                valve=replace(valve, conductance=valve.conductance * self.flow[i]),
            )

        robot, club = plant.robot, plant.robot.club
        return replace(
            plant,
            robot=replace(robot, club=replace(club, head_mass=club.head_mass + self.head_mass)),
            shoulder=varied(plant.shoulder, 0, self.vane),
            right_arm=varied(plant.right_arm, 1),
            wrist=varied(plant.wrist, 2),
            supply=replace(plant.supply, pressure=plant.supply.pressure * self.supply),
            encoders=replace(plant.encoders, latency=plant.encoders.latency + self.latency),
        )


WORN = Variation(
    friction=(1.4, 1.4, 1.4),
    flow=(0.92, 0.92, 0.92),
    supply=0.96,
    vane=1.03,
    head_mass=0.010,
    latency=0.001,
)
"""A worn robot with other valves and another head: all deviations at once."""


def worn(share: float) -> Variation:
    """Return a variation with `share` of the deviations of WORN."""

    def part(worst: Any, nominal: Any) -> Any:
        if isinstance(worst, tuple):
            return tuple(map(part, worst, nominal))
        return nominal + share * (worst - nominal)

    nominal = vars(Variation())
    return Variation(**{name: part(worst, nominal[name]) for name, worst in vars(WORN).items()})


def drawn(seed: int, plant: PlantParameters, spread: float = 0.10) -> Variation:
    """Return a variation with every factor uniform within 1 -+ `spread`, and up to 1 ms more latency."""
    random = np.random.default_rng(seed)

    def factors() -> Three:
        a, b, c = (1.0 + spread * random.uniform(-1, 1, 3)).tolist()
        return a, b, c

    friction, flow, volume = factors(), factors(), factors()
    supply, vane, mass = (spread * random.uniform(-1, 1, 3)).tolist()
    return Variation(
        friction,
        flow,
        volume,
        1.0 + supply,
        1.0 + vane,
        plant.robot.club.head_mass * mass,
        0.001 * float(random.uniform()),
    )


TOLERANCE = {
    "conductance": 0.025,
    "spool frequency": 0.05,
    "dead band": 0.15,
    "friction": 0.15,
    "dead volume": 0.05,
    "supply pressure": 0.01,
    "inertia": 0.01,
}
"""Shares of the nominal value that calibration and a good maker leave; assumption."""
CENTRE = 0.0015
"""Max offset of a valve's centre, in openings."""
LEAKAGE = 2.0
"""Leakages are up to this many times their nominal value above it, and half of it below."""
NOISE, JITTER = 1e-5, 2e-6
"""Max noise and jitter of the encoders, rad and s."""


def healthy_plant(plant: PlantParameters, seed: int, spread: float = 1.0) -> PlantParameters:
    """Return `plant` within `spread` times its tolerances, drawn with `seed`; seed 0 is the nominal one."""
    random = np.random.default_rng(seed)
    spread = spread if seed else 0.0

    def about_1(name: str) -> float:
        return float(1.0 + spread * TOLERANCE[name] * random.uniform(-1.0, 1.0))

    def leaking() -> float:
        return float(1.0 + spread * random.uniform(-0.5, LEAKAGE)) if spread else 1.0

    def actuator(a: Actuator) -> Actuator:
        coulomb = a.friction.coulomb * about_1("friction")
        static = max(a.friction.static * about_1("friction"), 1.05 * coulomb)
        friction = replace(
            a.friction, viscous=a.friction.viscous * about_1("friction"), coulomb=coulomb, static=static
        )
        valve = replace(
            a.valve,
            conductance=a.valve.conductance * about_1("conductance"),
            natural_frequency=a.valve.natural_frequency * about_1("spool frequency"),
            dead_band=a.valve.dead_band * about_1("dead band"),
            leakage=a.valve.leakage * leaking(),
            centre=a.valve.centre + spread * CENTRE * float(random.uniform(-1.0, 1.0)),
        )
        return replace(
            a,
            dead_volume=a.dead_volume * about_1("dead volume"),
            cross_leakage=a.cross_leakage * leaking(),
            friction=friction,
            valve=valve,
        )

    robot, supply = plant.robot, plant.supply
    left, link, club = robot.left_arm, robot.shoulder_link, robot.club
    return replace(
        plant,
        shoulder=actuator(plant.shoulder),
        right_arm=actuator(plant.right_arm),
        wrist=actuator(plant.wrist),
        supply=replace(supply, pressure=supply.pressure * about_1("supply pressure")),
        robot=replace(
            robot,
            left_arm=replace(left, inertia=left.inertia * about_1("inertia")),
            shoulder_link=replace(link, inertia=link.inertia * about_1("inertia")),
            club=replace(club, head_mass=club.head_mass * about_1("inertia")),
        ),
        encoders=replace(
            plant.encoders,
            noise=spread * NOISE * float(random.uniform()),
            jitter=spread * JITTER * float(random.uniform()),
        ),
        seed=seed + 1,
    )


def unknown_plant(plant: PlantParameters, seed: int) -> PlantParameters:
    """Return a robot to learn on, drawn with `seed`: every other one within 10 % of `plant`, the rest worn.

    All have the tolerances of a known one on top.
    """
    share = float(np.random.default_rng([seed, 1]).uniform())
    variation = worn(share) if seed % 2 else drawn(seed, plant)
    return variation.applied_to(healthy_plant(plant, seed))


Array = NDArray[np.float64]

_BEGIN, _HOLD = 200, 400
"""Ticks before arming, and at the address before a swing."""
_MAX_STOP_TICKS, _LOOK = 6_000, 20
"""Ticks of a stop at most, and between two looks at it."""
_MAX_VENT_TIME = 15.0
"""Time for the chambers to empty after a stop, s."""


class HealthyRun(NamedTuple):
    """Two swings of one robot, and stops of copies of it in all phases of the first."""

    largest: Array
    """(5, LEARNING, 3) largest deviations by comparison, row and joint; 0 where a row was not seen."""
    cause: Cause
    """Cause of a stopped swing; NONE if both swings returned to the address."""
    stops: int
    escalated: tuple[str, ...]
    """Stops that became more severe than requested, by phase and kind, or after which arming was stopped."""


def healthy_run(
    plant: PlantParameters, parameters: ControlParameters, profile: Profile, seed: int
) -> HealthyRun | None:
    """Swing twice on `plant`, once with a ball and once as `seed` has it, and stop copies of the first swing.

    `parameters` decide whether a deviation stops it. None if the robot does not reach its address.
    """
    random = np.random.default_rng([seed, 2])
    stepper = Lockstep(build_plant(plant), parameters, hanging_pose(plant))
    stepper.largest = largest = np.zeros((len(KINDS), LEARNING, 3))
    bench, trial = LockstepEngine(stepper), _StopTrial(random)
    stepper.advance(_BEGIN)
    try:
        bench.arm()
    except Refused:
        return None
    for swing in range(2):
        bench.tee_up(ball=swing == 1 or seed % 4 != 3)
        stepper.advance(_HOLD)
        bench.await_air()
        instants = [] if swing else _instants(profile, random)
        if instants:
            trial.stop(stepper)
        request, at = int(Request.SWING), 0
        for tick in (*instants, len(profile.angle)):
            stepper.advance(tick - at, request)
            request, at = 0, tick
            if tick in instants and not bench.cause:
                trial.stop(stepper)
        bench.run_to_hold(RETURN_TIMEOUT)
        if bench.cause:
            break
    return HealthyRun(largest, bench.cause, trial.number, tuple(trial.escalated))


def _instants(profile: Profile, random: np.random.Generator) -> list[int]:
    """Return ticks of a swing, one drawn in each of its phases that lasts, and one in the return."""
    ends = (*profile.begins[1:], len(profile.angle))
    spans = [
        (begin, end)
        for phase, begin, end in zip(PHASES, profile.begins, ends, strict=True)
        if phase is not Phase.HOLD and end - begin > 1
    ]
    return sorted({int(random.integers(max(begin, 1), end)) for begin, end in spans})


class _StopTrial:
    """Stops copies of a bench, by request and by the emergency stop in turn as drawn; arms one of them again.

    A stop leaves the robot at an end stop, or where friction holds it: arming from there deviates more than
    from hanging.
    """

    def __init__(self, random: np.random.Generator) -> None:
        self._random, self.number, self.escalated = random, 0, list[str]()
        self._armed_again = int(random.integers(1, len(PHASES) + 1))
        """Number of the stop after which the copy is armed again."""

    def stop(self, bench: Lockstep) -> None:
        """Stop a copy of `bench` and run it to standstill."""
        copy, emergency = bench.copy(), bool(self._random.integers(2))
        control, phase = copy.state.control, Phase(int(bench.state.control["phase"][0]))
        if emergency:
            copy.plant_state["emergency_stop_clear"] = False
        copy.advance(1, 0 if emergency else Request.STOP)
        severe = False
        for _ in range(_MAX_STOP_TICKS // _LOOK):
            severe = severe or control["reaction"][0] in (Reaction.PASSIVE, Reaction.BLIND_BRAKE)
            if control["phase"][0] == Phase.STANDING:
                break
            copy.advance(_LOOK)
        self.number += 1
        if severe or control["encoders_suspect"][0]:
            self.escalated.append(f"{phase.name}, {'emergency stop' if emergency else 'stop'}")
        if self.number == self._armed_again:
            if cause := _arm_again(copy):
                self.escalated.append(f"{phase.name}, armed again: {cause.name}")


def _arm_again(stepper: Lockstep) -> Cause:
    """Reset the stopped bench and arm it from where the robot stands; return what stopped that.

    A bench that trusts not all encoders is left alone.
    """
    bench = LockstepEngine(stepper)
    stepper.plant_state["emergency_stop_clear"] = True
    bench.wait_for(lambda: bool(bench.control["venting"]["emptied"][0]), _MAX_VENT_TIME)
    if bench.request(Request.RESET):
        with suppress(Refused):  # some robots do not reach their address in time
            bench.arm()
        return bench.cause
    return Cause.NONE
