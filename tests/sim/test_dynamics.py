"""The plant's equations between events: energy, sticking, stops, air in closed chambers, flexible shaft."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from math import pi, sqrt
from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.base.compiled import new_record
from drivers.base.records import COMMAND
from sim.dynamics import STATES, _derivative
from sim.kane import bias_forces, mass_matrix
from sim.kinematics import joint_positions, theta2_from_right_arm
from sim.plant import Plant, PlantParameters, Shaft, Site, advance, build_plant, initial_state
from sim.pneumatics import Actuator, Friction
from sim.robot import RobotParameters

Array = NDArray[np.float64]

POSE = np.array([-0.4, 4.0, 5.6])
NONE = Friction(viscous=0.0, coulomb=0.0, static=0.0)
LOCKED = Friction(viscous=0.0, coulomb=1e9, static=1e9)
SHORTER = 100 if numba.config.DISABLE_JIT else 1
"""Plain Python takes some ten milliseconds a tick."""


def changed(parameters: PlantParameters, **fields: Any) -> PlantParameters:
    """Return `parameters` with the same changes to all three actuators."""
    return replace(
        parameters,
        **{name: replace(getattr(parameters, name), **fields) for name in ("shoulder", "right_arm", "wrist")},
    )


def airless(parameters: PlantParameters, *, friction: Friction = NONE) -> PlantParameters:
    """Return a plant whose pistons have no area and whose ground is out of the way."""
    return changed(replace(parameters, site=Site(ground=-3.0)), area_a=1e-30, area_b=1e-30, friction=friction)


def unstopped(parameters: PlantParameters) -> PlantParameters:
    return changed(parameters, lower=-100.0, upper=100.0)


def sealed(actuator: Actuator) -> dict[str, Any]:
    return {"valve": replace(actuator.valve, leakage=0.0), "cross_leakage": 0.0}


def command_of(**fields: Any) -> Any:
    command = new_record(COMMAND)
    command["exhaust_closed"] = True
    for name, value in fields.items():
        command[name] = value
    return command


def run(plant: Plant, state: Any, ticks: int, command: Any | None = None) -> None:
    command = command_of() if command is None else command
    for _ in range(ticks):
        advance(*plant.records, state, command)


def energy(robot: RobotParameters, q: Array, u: Array) -> float:
    """Kinetic and potential energy (J) of the five bodies."""
    _, r2, r3, r6, _ = joint_positions(robot, q)
    link, arm, club = (np.array([np.cos(a), np.sin(a)]) for a in np.cumsum(q))
    rod = (r6 - r3) / np.linalg.norm(r6 - r3)
    centres = (
        (robot.shoulder_link, link * robot.shoulder_link.centre_of_mass),
        (robot.left_arm, r2 + arm * robot.left_arm.centre_of_mass),
        (robot.club, r3 + club * robot.club.centre_of_mass),
        (robot.rod, r3 + rod * robot.rod.centre_of_mass),
        (robot.cylinder, r6 - rod * robot.cylinder.centre_of_mass),
    )
    height = sum(body.mass * centre[1] for body, centre in centres)
    return float(u @ mass_matrix(robot, q) @ u / 2 + robot.in_plane_gravity * height)


def plant_energy(plant: Plant, state: Any) -> float:
    return energy(plant.parameters.robot, state["angle"][0], state["speed"][0])


# Robot -----------------------------------------------------------------------------------------------


def test_plant_without_friction_and_air_conserves_energy() -> None:
    drift = []
    for substeps in (1, 2, 4):
        plant = build_plant(unstopped(airless(PlantParameters(substeps=substeps))))
        state = initial_state(plant, POSE)
        state["speed"] = (2.0, -1.0, 6.0)
        start = plant_energy(plant, state)
        run(plant, state, 400 // SHORTER)
        drift.append(abs(plant_energy(plant, state) - start))
    assert drift[0] > 12 * drift[1]
    assert drift[2] < 1e-7


def test_plant_friction_never_adds_energy() -> None:
    friction = Friction(viscous=0.1, coulomb=5.0, static=7.0)
    plant = build_plant(unstopped(airless(PlantParameters(), friction=friction)))
    state = initial_state(plant, POSE)
    energies = [plant_energy(plant, state)]
    for _ in range(1500 // SHORTER):
        run(plant, state, 1)
        energies.append(plant_energy(plant, state))
    assert np.max(np.diff(energies)) < 1e-9
    if SHORTER == 1:
        assert energies[0] - energies[-1] > 1.0


# Dry friction ----------------------------------------------------------------------------------------


def holding_friction(share: float, *, locked: bool = False) -> list[PlantParameters]:
    """Return plants with static friction `share` times the load at POSE: all joints, or one each."""
    parameters = airless(PlantParameters(), friction=LOCKED)
    robot, names = parameters.robot, ("shoulder", "right_arm", "wrist")
    load = np.abs(bias_forces(robot, POSE, np.zeros(3)))
    length = sqrt(robot.l62**2 + robot.l23**2 + 2 * robot.l62 * robot.l23 * np.cos(POSE[1]))
    levers = (1.0, robot.l62 * robot.l23 * np.sin(POSE[1]) / length, parameters.wrist_lever * np.cos(POSE[2]))
    bounds = [share * force / abs(lever) for force, lever in zip(load, levers, strict=True)]
    fields = {
        name: replace(getattr(parameters, name), friction=Friction(viscous=0.0, coulomb=0.8 * b, static=b))
        for name, b in zip(names, bounds, strict=True)
    }
    if locked:
        return [replace(parameters, **{name: actuator}) for name, actuator in fields.items()]
    return [replace(parameters, **fields)]


def test_joint_load_below_static_friction_stays_at_rest() -> None:
    plant = build_plant(holding_friction(1.001)[0])
    state = initial_state(plant, POSE)
    run(plant, state, 10_000 // SHORTER)
    assert state["angle"][0].tolist() == POSE.tolist()
    assert state["speed"][0].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("joint", [0, 1, 2])
def test_joint_load_above_static_friction_slides(joint: int) -> None:
    plant = build_plant(holding_friction(0.999, locked=True)[joint])
    state = initial_state(plant, POSE)
    run(plant, state, 500 // SHORTER)
    moved = np.abs(state["angle"][0] - POSE)
    assert moved[joint] > (5e-4 if SHORTER == 1 else 1e-8)
    assert np.count_nonzero(moved) == 1


def test_joint_under_coulomb_friction_stops_at_expected_angle() -> None:
    """The shoulder alone: u^2 = 2 (b / M) angle."""
    parameters = airless(PlantParameters(robot=RobotParameters(gravity=0.0)), friction=LOCKED)
    friction = Friction(viscous=0.0, coulomb=30.0, static=30.0)
    parameters = replace(parameters, shoulder=replace(parameters.shoulder, friction=friction))
    plant = build_plant(parameters)
    state = initial_state(plant, POSE)
    # A locked joint still yields to the shoulder's start by impulse only, so all start with it at rest.
    state["speed"] = (3.0, 0.0, 0.0)
    inertia = mass_matrix(parameters.robot, POSE)[0, 0]
    time = inertia * 3.0 / 30.0
    run(plant, state, round(time / parameters.tick) + 3)
    assert state["speed"][0].tolist() == [0.0, 0.0, 0.0]
    assert state["angle"][0, 0] - POSE[0] == pytest.approx(inertia * 9.0 / 60.0, abs=2e-6)
    assert state["angle"][0, 1:].tolist() == POSE[1:].tolist()


def test_joint_reversal_under_friction_matches_exact_speed() -> None:
    """Thrown against a constant force the shoulder turns round: exact by hand, sliding up and down."""
    area, coulomb, start = 4.0e-4, 20.0, -1.5
    errors = []
    for substeps in (1, 2, 4, 8):
        parameters = PlantParameters(robot=RobotParameters(gravity=0.0), substeps=substeps)
        parameters = airless(unstopped(parameters), friction=LOCKED)
        friction = Friction(viscous=0.0, coulomb=coulomb, static=coulomb)
        shoulder = replace(parameters.shoulder, friction=friction, area_a=area, dead_volume=1e9)
        shoulder = replace(shoulder, **sealed(shoulder))
        parameters = replace(parameters, shoulder=shoulder)
        plant = build_plant(parameters)
        state = initial_state(plant, POSE)
        state["pressure"][0, 0] += 1.5e5  # 60 N m
        state["speed"] = (start, 0.0, 0.0)
        inertia = mass_matrix(parameters.robot, POSE)[0, 0]
        force = 1.5e5 * area
        turn = inertia * -start / (force + coulomb)
        ticks = round(2 * turn / parameters.tick)
        run(plant, state, ticks)
        left = ticks * parameters.tick - turn
        errors.append(abs(state["speed"][0, 0] - (force - coulomb) / inertia * left))
    assert max(errors) < 1e-6  # constant force: the correction is exact


# Stops and ground ------------------------------------------------------------------------------------


def stop_hit(kinetic: float, damping_speed: float) -> tuple[Plant, Any, float]:
    """Let the shoulder, the others locked, run into its upper stop with `kinetic` J."""
    parameters = airless(PlantParameters(robot=RobotParameters(gravity=0.0)), friction=LOCKED)
    stop = replace(parameters.shoulder.stop, damping_speed=damping_speed)
    parameters = replace(parameters, shoulder=replace(parameters.shoulder, friction=NONE, stop=stop))
    plant = build_plant(parameters)
    pose = np.array([parameters.shoulder.upper - 0.01, *POSE[1:]])
    state = initial_state(plant, pose)
    inertia = mass_matrix(parameters.robot, pose)[0, 0]
    state["speed"] = (sqrt(2 * kinetic / inertia), 0.0, 0.0)
    run(plant, state, 150)
    return plant, state, inertia * float(state["speed"][0, 0]) ** 2 / 2


def test_end_stop_takes_kinetic_energy_and_returns_less() -> None:
    plant, state, after = stop_hit(30.0, 2.0)
    assert state["stop_energy"][0, 0].tolist() == pytest.approx([0.0, 30.0], rel=1e-3)
    assert state["speed"][0, 0] < 0.0
    assert after < 0.5 * 30.0
    assert 0.0 < state["stop_depth"][0, 0, 1] < plant.parameters.shoulder.stop.travel
    assert not state["stop_energy"][0, 1:].any()


def test_end_stop_undamped_returns_rated_energy_at_full_travel() -> None:
    stop = PlantParameters().shoulder.stop
    _, state, after = stop_hit(stop.energy, 1e12)
    assert state["stop_depth"][0, 0, 1] == pytest.approx(stop.travel, rel=1e-3)
    assert state["stop_energy"][0, 0, 1] == pytest.approx(stop.energy, rel=1e-3)
    assert after == pytest.approx(stop.energy, rel=1e-3)


@pytest.mark.parametrize("flexible", [False, True])
def test_ground_contact_takes_energy(flexible: bool) -> None:
    parameters = airless(PlantParameters(shaft=Shaft(flexible=flexible)))
    pose = np.array([0.2, 4.3, 6.0])
    height = joint_positions(parameters.robot, pose)[4, 1]
    site = Site(ground=float(height) - 0.08, sole_depth=0.03)
    plant = build_plant(replace(parameters, site=site))
    state = initial_state(plant, pose)
    state["speed"] = (0.0, 0.0, 3.0)
    total = FlexibleRobot(parameters).total if flexible else partial(plant_energy, plant)
    start = total(state)
    run(plant, state, 600 // SHORTER)
    lowest = float(state["lowest_clearance"][0])
    if SHORTER == 1:
        assert -0.03 < lowest < 0.0
        assert total(state) < start - 0.1


# Air -------------------------------------------------------------------------------------------------


def volumes(plant: Plant, q: Array) -> Array:
    """Chamber volumes (m3), A and B of each actuator, from the geometry."""
    parameters, robot = plant.parameters, plant.parameters.robot
    extension = sqrt(robot.l62**2 + robot.l23**2 + 2 * robot.l62 * robot.l23 * np.cos(q[1])) - robot.l56

    def stroke(theta3: float) -> float:
        return float(-parameters.wrist_lever * np.cos(theta3 + parameters.wrist_lever_angle - 1.5 * pi))

    wrist = parameters.wrist
    position = (q[0], extension, stroke(q[2]))
    result = []
    for i, actuator in enumerate(parameters.actuators):
        low, high = actuator.chamber_ends
        if actuator is wrist:
            low, high = stroke(low), stroke(high)
        result += [
            actuator.dead_volume + actuator.area_a * (position[i] - low),
            actuator.dead_volume + actuator.area_b * (high - position[i]),
        ]
    return np.array(result)


def closed_swing(exponent: float, mounted: float = 0.0) -> tuple[Plant, list[Any]]:
    """Let the robot bounce on the air shut up in its chambers."""
    parameters = changed(PlantParameters(site=Site(ground=-3.0), wrist_lever_angle=mounted), friction=NONE)
    parameters = changed(parameters, **sealed(parameters.wrist))
    parameters = replace(parameters, supply=replace(parameters.supply, polytropic_exponent=exponent))
    plant = build_plant(parameters)
    pose = np.array([0.3, float(theta2_from_right_arm(parameters.robot, 0.34 + 0.1)), 5.6])
    state = initial_state(plant, pose, pressurised=True)
    state["speed"] = (1.0, -1.0, 2.0)
    states = [state.copy()]
    for _ in range(200 // SHORTER):
        run(plant, state, 1)
        states.append(state.copy())
    return plant, states


@pytest.mark.parametrize("exponent", [1.0, 1.2, 1.4])
def test_closed_chamber_follows_polytropic_law(exponent: float) -> None:
    plant, states = closed_swing(exponent)
    constant = np.array([s["pressure"][0] * volumes(plant, s["angle"][0]) ** exponent for s in states])
    assert np.max(np.abs(constant / constant[0] - 1.0)) < 1e-6
    pressure = np.array([s["pressure"][0] for s in states])
    if SHORTER == 1:
        assert np.all(np.ptp(pressure, axis=0) > 0.02 * pressure[0])


@pytest.mark.parametrize("mounted", [0.0, 0.7, -0.3])
def test_closed_chambers_exchange_energy_without_loss(mounted: float) -> None:
    plant, states = closed_swing(1.4, mounted)
    atmosphere = plant.parameters.supply.atmosphere
    total = []
    for s in states:
        volume = volumes(plant, s["angle"][0])
        gas = float(np.sum(s["pressure"][0] * volume / 0.4 + atmosphere * volume))
        total.append(plant_energy(plant, s) + gas)
    assert np.ptp(total) < 1e-4  # of some 900 J in the air


def test_wrist_lever_angle_shifts_wrist_stroke() -> None:
    """Its cylinder cannot distinguish the mounting angle from the wrist's own."""
    turned = 0.7
    square, mounted = PlantParameters(), PlantParameters(wrist_lever_angle=turned)
    theta3 = np.linspace(4.4, 6.2, 7)
    assert mounted.wrist_stroke(theta3) == pytest.approx(square.wrist_stroke(theta3 + turned))
    assert mounted.wrist_slope(theta3) == pytest.approx(square.wrist_slope(theta3 + turned))
    assert mounted.wrist_authority(2 * pi - turned) == pytest.approx(1.0)
    step = 1e-6
    slope = (mounted.wrist_stroke(theta3 + step) - mounted.wrist_stroke(theta3 - step)) / (2 * step)
    assert mounted.wrist_slope(theta3) == pytest.approx(slope, rel=1e-8)
    assert mounted.wrist_authority(theta3) == pytest.approx(abs(slope) / mounted.wrist_lever, rel=1e-8)


def air_in(plant: Plant, state: Any) -> float:
    """p V of chambers and manifold (J); the mass of isothermal air is this over R T."""
    chambers = float(state["pressure"][0] @ volumes(plant, state["angle"][0]))
    return chambers + float(state["supply_pressure"][0]) * plant.parameters.supply.volume


def standing(**supply: Any) -> Plant:
    """A plant whose joints are locked and whose air is isothermal."""
    parameters = changed(PlantParameters(site=Site(ground=-3.0)), friction=LOCKED)
    parameters = changed(parameters, **sealed(parameters.wrist))
    return build_plant(
        replace(parameters, supply=replace(parameters.supply, polytropic_exponent=1.0, **supply))
    )


def test_manifold_and_chambers_conserve_air() -> None:
    plant = standing(feed_conductance=1e-30)
    state = initial_state(plant, POSE)
    state["supply_pressure"], state["supply_level"] = 8e5, 1.0
    before = air_in(plant, state)
    run(plant, state, 300 // SHORTER, command_of(valve=(0.5, 0.3, 0.7), supply_enable=True, guard_lock=True))
    assert air_in(plant, state) == pytest.approx(before, rel=1e-12)  # chambers B stay at the atmosphere
    if SHORTER == 1:
        assert np.all(state["pressure"][0, ::2] > 5e5)
        assert state["pressure"][0, ::2] == pytest.approx(float(state["supply_pressure"][0]), rel=1e-3)


def test_cross_leakage_keeps_air_in_actuator() -> None:
    plant = standing()
    leaking = changed(plant.parameters, cross_leakage=1e-8)
    plant = build_plant(leaking)
    state = initial_state(plant, POSE)
    state["pressure"] = (6e5, 2e5, 6e5, 2e5, 2e5, 6e5)
    volume = volumes(plant, POSE)
    before = (state["pressure"][0] * volume).reshape(3, 2).sum(axis=1)
    run(plant, state, 200 // SHORTER)
    after = (state["pressure"][0] * volume).reshape(3, 2).sum(axis=1)
    assert after == pytest.approx(before, rel=1e-12)
    assert abs(state["pressure"][0, 0] - state["pressure"][0, 1]) < 3.99e5


def test_spool_step_response_is_second_order() -> None:
    plant = build_plant(PlantParameters())
    state = initial_state(plant, POSE)
    valve = plant.parameters.wrist.valve
    omega, zeta = valve.natural_frequency, valve.damping_ratio
    damped = omega * sqrt(1 - zeta**2)
    command = command_of(valve=(0.8, 0.8, 0.8))
    for k in range(1, 16):
        run(plant, state, 1, command)
        t = k * plant.parameters.tick
        ringing = np.cos(damped * t) + zeta * omega / damped * np.sin(damped * t)
        expected = 0.8 * (1 - np.exp(-zeta * omega * t) * ringing)
        assert state["spool"][0] == pytest.approx(expected, abs=1e-12)


# Flexible shaft --------------------------------------------------------------------------------------


class FlexibleRobot:
    """Lagrange's equations of joints and deflection with numerical derivatives; no term of the plant's."""

    def __init__(self, parameters: PlantParameters) -> None:
        club = parameters.robot.club
        self.bare = replace(parameters.robot, club=replace(club, head_mass=1e-12))
        self.mass, self.length = club.head_mass, club.shaft_length
        omega = 2 * pi * parameters.shaft.frequency
        self.stiffness = self.mass * omega**2
        self.damping = 2 * parameters.shaft.damping_ratio * omega * self.mass

    def head(self, x: Any) -> Any:
        """Position of the head's mass; analytic, so `x` may be complex."""
        a1, a2, a3 = x[0], x[0] + x[1], x[0] + x[1] + x[2]
        r = self.bare
        return np.array(
            [
                r.l12 * np.cos(a1) + r.l23 * np.cos(a2) + self.length * np.cos(a3) - x[3] * np.sin(a3),
                r.l12 * np.sin(a1) + r.l23 * np.sin(a2) + self.length * np.sin(a3) + x[3] * np.cos(a3),
            ]
        )

    def matrix(self, x: Array) -> Array:
        jacobian = np.column_stack([self.head(x + 1e-30j * e).imag / 1e-30 for e in np.eye(4)])
        matrix: Array = self.mass * jacobian.T @ jacobian
        matrix[:3, :3] += mass_matrix(self.bare, x[:3])
        return matrix

    def potential_slope(self, x: Array) -> Array:
        weight = self.mass * self.bare.in_plane_gravity
        slope = np.array([weight * self.head(x + 1e-30j * e)[1].imag / 1e-30 for e in np.eye(4)])
        slope[:3] += bias_forces(self.bare, x[:3], np.zeros(3))
        slope[3] += self.stiffness * x[3]
        return slope

    def acceleration(self, x: Array, v: Array) -> Array:
        step = 1e-4
        slopes = [
            (
                8 * (self.matrix(x + step * e) - self.matrix(x - step * e))
                - (self.matrix(x + 2 * step * e) - self.matrix(x - 2 * step * e))
            )
            / (12 * step)
            for e in np.eye(4)
        ]
        rate = sum(slope * vi for slope, vi in zip(slopes, v, strict=True))
        force = np.array([v @ slope @ v / 2 for slope in slopes]) - rate @ v - self.potential_slope(x)
        force[3] -= self.damping * v[3]
        result: Array = np.linalg.solve(self.matrix(x), force)
        return result

    def total(self, state: Any) -> float:
        """Energy of joints, head and spring (J) in a PLANT_STATE."""
        x = np.array([*state["angle"][0], state["flex"][0]])
        v = np.array([*state["speed"][0], state["flex_speed"][0]])
        bare = energy(self.bare, x[:3], np.zeros(3))
        lifted = self.mass * self.bare.in_plane_gravity * float(self.head(x)[1])
        return bare + lifted + float(self.stiffness * x[3] ** 2 / 2 + v @ self.matrix(x) @ v / 2)


def flexible_plant(**shaft: Any) -> Plant:
    return build_plant(unstopped(airless(PlantParameters(shaft=Shaft(flexible=True, **shaft)))))


def test_flexible_shaft_accelerations_match_lagrange() -> None:
    plant = flexible_plant(frequency=5.0, damping_ratio=0.05)
    model = FlexibleRobot(plant.parameters)
    rng = np.random.default_rng(2)
    for _ in range(25):
        x = np.array([*rng.uniform((-1.5, 3.4, 4.8), (1.5, 4.4, 6.3)), rng.uniform(-0.15, 0.15)])
        v = np.array([*rng.normal(0, 8, 3), rng.normal(0, 3)])
        y, dy = np.zeros(STATES), np.zeros(STATES)
        y[:3], y[3:6], y[13], y[14] = x[:3], v[:3], x[3], v[3]
        y[6:13] = plant.parameters.supply.atmosphere
        terms = np.zeros(STATES)
        record, parameters, _ = plant.records
        _derivative(
            record[0], parameters[0], y, 0.0, 0.0, 0.0, 0.0, 0.0, np.ones(3), dy, terms, np.full(9, np.nan)
        )
        expected = model.acceleration(x, v)
        found = np.array([*dy[3:6], dy[14]])
        assert found == pytest.approx(expected, rel=1e-6, abs=1e-6 * float(np.abs(expected).max()))
        assert dy[13] == v[3]


def test_flexible_shaft_undamped_conserves_energy() -> None:
    plant = flexible_plant(damping_ratio=0.0)
    model = FlexibleRobot(plant.parameters)

    state = initial_state(plant, POSE)
    state["flex"] = 0.05
    state["speed"] = (1.0, -1.0, 3.0)
    start = model.total(state)
    run(plant, state, 400 // SHORTER)
    assert model.total(state) == pytest.approx(start, abs=1e-6)


@pytest.mark.parametrize("frequency", [4.5, 12.0])
def test_flexible_shaft_locked_joints_rings_at_set_frequency(frequency: float) -> None:
    parameters = PlantParameters(robot=RobotParameters(gravity=0.0))
    parameters = airless(
        replace(parameters, shaft=Shaft(flexible=True, frequency=frequency)), friction=LOCKED
    )
    plant = build_plant(parameters)
    state = initial_state(plant, POSE)
    state["flex"] = 0.02
    zeta, omega = 0.03, 2 * pi * frequency
    damped = omega * sqrt(1 - zeta**2)
    for k in range(1, 1 + 300 // SHORTER):
        run(plant, state, 1)
        t = k * plant.parameters.tick
        ringing = np.cos(damped * t) + zeta * omega / damped * np.sin(damped * t)
        assert state["flex"][0] == pytest.approx(0.02 * np.exp(-zeta * omega * t) * ringing, abs=1e-8)
    assert state["angle"][0].tolist() == POSE.tolist()


def test_flexible_shaft_stiff_matches_rigid_shaft() -> None:
    states = []
    for shaft in (Shaft(), Shaft(flexible=True, frequency=100.0, damping_ratio=1.0)):
        plant = build_plant(unstopped(airless(PlantParameters(shaft=shaft, substeps=16))))
        state = initial_state(plant, POSE)
        run(plant, state, 200 // SHORTER)
        states.append(state)
    assert states[0]["angle"][0] == pytest.approx(states[1]["angle"][0], abs=2e-3)
