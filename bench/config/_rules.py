"""Rules of a configuration: bounds of values that safety depends on, and agreement of several keys."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Set
from dataclasses import replace
from importlib.metadata import entry_points
from math import asin, ceil, degrees, hypot, inf, pi, radians
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from bench.base.address import address_mistakes, database_url
from bench.base.errors import BenchError
from bench.base.from_toml import Mistake, TomlValue, Tree, format_value
from bench.config._settings import Configuration
from bench.control.measured_plant import value_at
from bench.control.settings import (
    MODEL_PHASES,
    OPTIONAL_ROWS,
    ControlSettings,
    EnvelopeSettings,
    ModelSettings,
)
from drivers.base.ranges import Range, short
from sim.faults import MAX_DELAY
from sim.plant import ACTUATOR_KEYS
from sim.sensors import HISTORY


class Bound(NamedTuple):
    """Bounds of a value of the configuration, or of each number of a list."""

    key: str
    """Dotted name in the configuration."""
    simulated: tuple[float, float]
    real: tuple[float, float]
    unit: str
    reason: str

    def allowed(self, *, is_machine: bool) -> Range:
        """Return the range for a real or a simulated robot."""
        return Range(*(self.real if is_machine else self.simulated), self.unit)


BOUNDS = (
    Bound("lifecycle.warning_time", (0.0, inf), (1.0, 60.0), "s",
          "people at the robot must have time to see the beacon and step back"),
    Bound("lifecycle.armed_timeout", (0.0, inf), (1.0, 600.0), "s",
          "a pressurised robot without use for ten minutes is forgotten"),
    Bound("lifecycle.vented_pressure", (0.5e5, 3e5), (1.05e5, 1.5e5), "Pa",
          "half a bar above the atmosphere lifts an arm; below the atmosphere nothing ever counts as empty"),
    Bound("lifecycle.vent_timeout", (0.0, inf), (1.0, 120.0), "s",
          "without chamber sensors it is the proof itself, and throttled vents take seconds"),
    Bound("lifecycle.rest_time_vented", (0.0, inf), (0.5, 60.0), "s",
          "a raised arm hangs on what little air is left, and sinks late"),
    Bound("lifecycle.rest_time_without_encoders", (0.0, inf), (5.0, 120.0), "s",
          "without encoder readings only time shows that a raised arm has sunk"),
    Bound("lifecycle.access_delay", (0.0, inf), (5.0, 120.0), "s",
          "an encoder that is stuck shows rest while a raised arm sinks"),
    Bound("lifecycle.local_reset_time", (0.0, inf), (0.5, 30.0), "s",
          "an older press does not prove that a person is still at the robot"),
    Bound("lifecycle.supervisor_timeout", (0.0, inf), (0.05, 2.0), "s",
          "if a stop over the network cannot arrive, the robot must stop automatically"),
    Bound("control.rest_speed", (0.0, 1.0), (0.0, 0.2), "rad/s",
          "a faster joint does not rest: its club's head moves by more than 0.3 m/s"),
    Bound("control.rest_time", (0.0, inf), (0.02, 1.0), "s",
          "a joint that reverses also rests for an instant"),
    Bound("control.brake_timeout", (0.05, inf), (0.5, 10.0), "s",
          "a brake that ends sooner vents a robot that still moves, which then nothing brakes"),
    Bound("control.open_loop_settling_time", (0.0, inf), (0.1, 10.0), "s",
          "after an open-loop brake closed chambers stop the remaining motion"),
    Bound("control.address_tolerance", (0.0, 0.2), (0.0, 0.05), "rad",
          "a swing that begins elsewhere than designed passes elsewhere over the ground"),
    Bound("envelope.max_tick_interval", (0.0, 0.5), (0.0, 0.02), "s",
          "during a gap the head moves without feedback, 0.8 m at 40 m/s in 0.02 s"),
    Bound("envelope.encoder_timeout", (0.0, 0.5), (0.0, 0.012), "s",
          "for an encoder that is lost for longer, braking starts too late"),
    Bound("driver.watchdog", (0.0, inf), (0.0, 0.02), "s",
          "until loss of communication is detected the last valve commands stay in force"),
    Bound("homing.tolerance", (0.0, 6.3), (0.0, 0.35), "rad",
          "a larger tolerance verifies no encoder zero"),
    Bound("homing.head_tolerance", (0.0, 1.0), (0.0, 0.03), "m",
          "with zeros 0.1 rad off, 0.15 m at the head, the club passes 2 mm over the ground"),
)  # fmt: skip
"""Bounds of each value in simulation and with a real robot, and their reasons."""


def check_safety(c: Configuration, tree: Any) -> Iterator[Mistake]:
    """Yield the values that are unsafe for a person at the robot; `tree` is not used."""
    for bound in BOUNDS:
        value = attrgetter(bound.key)(c)
        allowed = bound.allowed(is_machine=c.is_machine)
        values = value if isinstance(value, tuple) else (value,)
        for wrong in [number for number in values if not allowed.low <= number <= allowed.high][:1]:
            wanted = f"{'with a real robot ' * c.is_machine}{allowed}: {bound.reason}"
            yield bound.key, f"{short(wrong)} {bound.unit}", wanted, f"Set {bound.key} within these bounds."
    if not c.is_machine:
        return
    if not c.lifecycle.local_reset:
        wanted = "true with a real robot: a remote operator cannot see people near it"
        yield "lifecycle.local_reset", "false", wanted, "Wire the button and set the key to true."
    if c.loop.realtime != "require":
        found, action = format_value(c.loop.realtime), "Set it, and try it with `golfbench doctor`."
        wanted = '"require" with a real robot: a loop that other work delays stops swings, or brakes late'
        yield "loop.realtime", found, wanted, action
    if not c.homing.stops:
        wanted = "true with a real robot: neither pose nor index shows a coupling that slipped a little"
        yield "homing.stops", "false", wanted, "Set it to true."
    if c.driver.name in ("daq", "canopen"):
        yield from _shut_off_proof(c)
        yield from _vent_proof(c)


def _shut_off_proof(c: Configuration) -> Iterator[Mistake]:
    """Yield a missing position switch of a real robot's shut-off valve.

    Only this valve keeps the manifold empty during access if the supply valve stays open. Nothing else shows
    beforehand that it is stuck.
    """
    if c.driver.name == "daq":
        key, fitted = "daq.shut_off_feedback", bool(c.daq.shut_off_feedback)
    else:
        bit = c.canopen.valve_node.inputs.shut_off_open
        key, fitted = "canopen.valve_node.inputs.shut_off_open", bit >= 0
    if not fitted:
        wanted = "the shut-off valve's position switch: nothing else shows that it is stuck open"
        yield key, "not fitted", wanted, "Fit the switch and name its input."


def _vent_proof(c: Configuration) -> Iterator[Mistake]:
    """Yield the missing pressure sensors of a real robot whose venting only time would verify.

    Time proves no vent, and a vent's position no flow: behind a clogged silencer chambers stay full. Only a
    pressure shows that they are empty. It needs a sensor in each chamber and in the manifold, or pressure
    switches outside the bench on the manifold and on each actuator's exhaust.
    """
    node = c.canopen.valve_node
    settings = c.daq if c.driver.name == "daq" else node
    if settings.vent_proof:
        return
    section = "daq" if c.driver.name == "daq" else "canopen.valve_node"
    action = f"Fit sensors, or name in {section}.vent_proof the switches on the manifold and on each exhaust."
    if not settings.supply_pressure:
        wanted = f"a sensor, or {section}.vent_proof: nothing else shows the pressure in the manifold"
        yield f"{section}.supply_pressure", "no sensor", wanted, action
    if not all(settings.chamber_pressures):
        found = "no sensor" if not any(settings.chamber_pressures) else "a chamber without sensor"
        wanted = (
            f"a sensor in each chamber, or {section}.vent_proof: neither time nor a vent's position proves "
            "that air flows out"
        )
        yield f"{section}.chamber_pressures", found, wanted, action


MAX_SUBSTEP = 0.00025
"""Internal step up to which the plant's delivery is converged (s)."""

MAX_READ_SHARE = 0.7
"""Share of the loop's period that a tick may wait for the encoders; the rest is for deciding."""

COST_OF_A_SYNC = 2.2
"""Ticks without a sample after a lost SYNC: the tick of that SYNC; the next tick, whose sample might answer
the lost SYNC; and the max delay of a tick."""

MIN_RELIEF_RATIO = 1.1
"""Min ratio of the relief valve's opening pressure to the regulated pressure."""


def _address(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    return address_mistakes(c)


def _names(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    if c.bench.database:
        try:
            database_url(c.bench.database, c.bench.data_dir)
        except BenchError as error:
            yield error.location, error.found, error.expected, error.action
    try:
        zoned = c.commissioned is None or c.commissioned.tzinfo is not None
    except ValueError:
        zoned = False
    if not zoned:
        found, expected = format_value(c.bench.commissioned), "a time such as 2026-11-29T12:00:00+00:00"
        yield "bench.commissioned", found, expected, "Copy it from robot.toml of golfbench commission."
    for key, entries in (("club", c.clubs), ("ball", c.balls)):
        name = getattr(c.swing, key)
        if name not in entries:
            known = f"one of {', '.join(entries) or 'none'}"
            yield f"swing.{key}", format_value(name), known, f"Choose one, or add [{key}s.{name}]."
    drivers = sorted({entry.name for entry in entry_points(group="golfbench.drivers")})
    if c.driver.name not in drivers:
        action = "Choose one, or install the plug-in that provides it."
        yield "driver.name", format_value(c.driver.name), f"one of {', '.join(drivers)}", action
    if c.driver.name == "daq" and c.homing.method != "index":
        action = "The card's counters do not know the angle until the index has passed."
        yield "homing.method", format_value(c.homing.method), 'with driver "daq" "index"', action
    yield from _phases(c.envelope, EnvelopeSettings(), "envelope", "max_following_error", set())
    for kind in MODEL_PHASES:
        yield from _phases(c.envelope.model, ModelSettings(), "envelope.model", kind, OPTIONAL_ROWS)
    for name in c.envelope.model.standard_errors:
        try:
            float(value_at(c.plant, name))
        except (KeyError, IndexError, TypeError, ValueError):
            key, found = f"envelope.model.standard_errors.{name}", "no number below [plant]"
            yield key, found, "a key such as shoulder.area_a", "Correct or delete it."


def _phases(given: Any, default: Any, section: str, table: str, optional: Set[str]) -> Iterator[Mistake]:
    """Yield the phases that `table` of `given` lacks, or that `default` does not know."""
    wanted = [name for name in getattr(default, table) if name not in optional]
    for name in sorted((getattr(given, table).keys() - optional) ^ set(wanted)):
        found = "nothing" if name in wanted else "an unknown phase"
        yield f"{section}.{table}.{name}", found, f"each of {', '.join(wanted)} once", "Correct the table."


def _actuators(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    for name in ACTUATOR_KEYS:
        actuator, key = getattr(c.plant, name), f"plant.{name}"
        if not actuator.lower < actuator.upper:
            found = f"{short(actuator.lower)}, with upper {short(actuator.upper)}"
            yield f"{key}.lower", found, "less than upper", "Correct one of the two."
        friction = actuator.friction
        if friction.static < friction.coulomb:
            found = f"{short(friction.static)}, with coulomb {short(friction.coulomb)}"
            yield f"{key}.friction.static", found, "at least coulomb", "Correct one of the two."
        if actuator.pressure_rating < c.plant.supply.pressure:
            found = f"{short(actuator.pressure_rating)} Pa"
            least = f"at least the supply's {short(c.plant.supply.pressure)} Pa"
            yield f"{key}.pressure_rating", found, least, "Lower plant.supply.pressure."
        deeper = (actuator.stop.travel - actuator.clearance) * (
            c.plant.wrist_lever if name == "wrist" else 1.0
        )
        taken = deeper * max(actuator.area_a, actuator.area_b)
        if taken >= 0.8 * actuator.dead_volume:
            found = f"{short(actuator.stop.travel)}, which takes {short(taken)} m3 of a chamber's dead volume"
            most = f"less than {short(0.8 * actuator.dead_volume)} m3"
            yield f"{key}.stop.travel", found, most, "Set a shorter absorber travel or more clearance."
        stop, energy = actuator.stop, f"{key}.stop.energy"
        rated = _leaf(tree, f"{key}.stop.rated")
        if stop.rated > stop.energy and _is_below(rated, _leaf(tree, energy), c.files):
            found = f"{short(stop.energy)} J without `rated`, which stays {short(stop.rated)} J"
            yield energy, found, "both in one file", "Also give `rated`; 0 if it is `energy`."
        travel = actuator.upper - actuator.lower + 4 * actuator.stop.travel
        if name != "right_arm" and travel >= 2 * pi:
            found = f"{short(travel)} rad of travel with twice the absorbers"
            yield f"{key}.upper", found, "less than one turn, all that the encoder sees", "Narrow the range."


def _linkage(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    robot, arm, wrist = c.plant.robot, c.plant.right_arm, c.plant.wrist
    shortest, longest = abs(robot.l62 - robot.l23) - robot.l56, robot.l62 + robot.l23 - robot.l56
    low, high = max(0.0, shortest), min(robot.stroke, longest)
    for end in ("lower", "upper"):
        key, position = f"plant.right_arm.{end}", getattr(arm, end)
        if not low <= position <= high:
            wanted = f"{low:.4g} to {high:.4g} m: inside the rod's stroke and the linkage's reach"
            action = "Correct this position, or the lengths in [plant.robot]."
            yield key, f"{short(position)} m", wanted, action
        leaf = _leaf(tree, key)
        if leaf is not None and leaf.suffix:
            yield key, format_value(leaf.value), "a rod extension in m", f"Write {end} = ... in m."
        # Thesis figure 11: the cylinder turns the wrist with lever d sin(beta), beta = theta3 - 3 pi / 2.
        # Mounted at an angle it does so for a range that is cocked further.
        dead, mounted = asin(c.envelope.min_lever), c.plant.wrist_lever_angle
        theta3 = getattr(wrist, end)
        if not 1.5 * pi + dead - mounted <= theta3 <= 2.5 * pi - dead - mounted:
            low, high = (degrees(end * pi - mounted) for end in (1.5, 2.5))
            wanted = f"{low + degrees(dead):.1f} to {high - degrees(dead):.1f} deg: where the lever turns it"
            action = "Narrow the range; envelope.min_lever says how little lever may be left."
            yield f"plant.wrist.{end}", f"{degrees(theta3):.1f} deg", wanted, action


def _leaf(tree: Tree, path: str) -> TomlValue | None:
    node: Any = tree
    for part in path.split("."):
        node = node.get(part, {})
    return node if isinstance(node, TomlValue) else None


def _times(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    substep = c.plant.tick / c.plant.substeps
    if substep > MAX_SUBSTEP * (1 + 1e-9):
        least = -(-c.plant.tick // MAX_SUBSTEP)
        found = f"{c.plant.substeps}, internal steps of {1e3 * substep:.3g} ms at {short(c.loop.rate)} Hz"
        wanted = (
            f"at least {least:.0f}: steps of {1e3 * MAX_SUBSTEP:g} ms, up to which the plant is converged"
        )
        yield "plant.substeps", found, wanted, "Raise it."
    longest = (HISTORY - 2) * substep
    if c.plant.encoders.latency > longest:
        found = f"{short(c.plant.encoders.latency)} s"
        yield "plant.encoders.latency", found, f"at most {short(longest)} s with these substeps", "Lower it."
    for name in ("encoder_timeout", "max_tick_interval"):
        value = getattr(c.envelope, name)
        if value <= c.plant.tick:
            found, wanted = f"{short(value)} s", f"more than one tick, {short(c.plant.tick)} s"
            yield f"envelope.{name}", found, wanted, "Raise it, or loop.rate."
    lost, gap = c.envelope.encoder_timeout, c.envelope.max_tick_interval
    if lost > gap:
        wanted = f"at most envelope.max_tick_interval, {short(gap)} s"
        yield "envelope.encoder_timeout", f"{short(lost)} s", wanted, "Lower it."


_HAND_GAINS = ("pid.proportional", "pid.integral", "pid.derivative", "damping", "move_gain")


def _gains(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    """Check that no gain is set by hand in the file that takes them from the machine, or above it."""
    if c.control.gains == "hand":
        return
    chosen, known = _leaf(tree, "control.gains"), ControlSettings()
    for name in _HAND_GAINS:
        key = f"control.{name}"
        leaf, value = _leaf(tree, key), attrgetter(name)(c.control)
        if value == attrgetter(name)(known) or _is_below(leaf, chosen, c.files):
            continue
        action = 'Delete it, or set control.gains = "hand".'
        yield key, format_value(value), 'not set, as gains are from the "machine"', action


def _is_below(leaf: TomlValue | None, other: TomlValue | None, files: tuple[Path, ...]) -> bool:
    """Return whether `leaf` is of a file that `other`'s is laid over."""
    return leaf is not None and other is not None and _layer(leaf, files) < _layer(other, files)


def _layer(leaf: TomlValue, files: tuple[Path, ...]) -> int:
    """Return the layer of a value's configuration file; -1 for the defaults."""
    return files.index(leaf.file) if leaf.file in files else -1


def _air(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    supply, least = c.plant.supply, c.envelope.min_supply_pressure
    action = "Correct the pressure; the unit is Pa absolute."
    if not supply.atmosphere < least < supply.pressure:
        wanted = (
            f"more than the atmosphere's {short(supply.atmosphere)}, less than {short(supply.pressure)} Pa"
        )
        yield "envelope.min_supply_pressure", f"{short(least)} Pa", wanted, action
    if (most := c.envelope.max_supply_pressure) <= supply.pressure:
        wanted = f"more than {short(supply.pressure)} Pa"
        yield "envelope.max_supply_pressure", f"{short(most)} Pa", wanted, action
    rating = min(actuator.pressure_rating for actuator in c.plant.actuators)
    if supply.manifold_relief_ratio < MIN_RELIEF_RATIO or supply.manifold_relief_pressure >= rating:
        yield (
            "plant.supply.manifold_relief_ratio",
            f"{short(supply.manifold_relief_ratio)}, {short(supply.manifold_relief_pressure)} Pa",
            f"at least {MIN_RELIEF_RATIO}, and less than the lowest pressure_rating, {short(rating)} Pa",
            "Set it; a valve that opens nearer to the regulated pressure takes part in a healthy swing.",
        )


LEVEL = 5e-4
"""Uncertainty of a height above the ground (m): a ball or sole no deeper in the ground lies on it."""


def _site(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    site, robot = c.plant.site, c.plant.robot
    lowest = site.ground + c.plant.ball.radius
    if site.ball_y < lowest - LEVEL:
        found, wanted = f"{short(site.ball_y)} m", f"at least {lowest:.4f} m, the ball's centre on the ground"
        yield "plant.site.ball_y", found, wanted, "Raise it; y0 points up."
    reach = robot.l12 + robot.l23 + robot.club.length_to_face
    distance = hypot(site.ball_x, site.ball_y)
    if distance > reach:
        found = f"{distance:.3f} m from the shoulder axis"
        wanted = f"at most {reach:.3f} m, the reach of arm and club"
        yield "plant.site.ball_y", found, wanted, "Move the ball nearer, or take a longer club."
    if site.divot > 0.0 and site.surface == "none":
        found, wanted = f"{short(site.divot)} m into a bare floor", '0, or plant.site.surface "turf" or "mat"'
        yield "plant.site.divot", found, wanted, "Name the surface, or keep the sole off the ground."


MAX_TOE_TILT = radians(5.0)
"""Max difference (rad) of a swing plane from the lie of the club swung in it."""


def _club_sites(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    """Check the sites of clubs as `_site` does the common one, and the plane against the club's lie."""
    for name, site in c.sites.items():
        key, club = f"sites.{name}", c.clubs.get(name)
        if club is None:
            yield key, "no such club", f"one of {', '.join(c.clubs)}", f"Rename it, or add [clubs.{name}]."
            continue
        # A club without a separate site uses the plant's, which is checked there.
        if _leaf(tree, f"{key}.plane") is None:
            continue
        for part, found, wanted, action in _site(replace(c, plant=c.plant_of(name, club)), tree):
            yield part.replace("plant.site", key), found, wanted, action
        tilt = site.plane - club.lie
        if abs(tilt) > MAX_TOE_TILT + 1e-9:
            found = f"{degrees(site.plane):.1f} deg, with the club's lie at {degrees(club.lie):.1f} deg"
            wanted = f"within {degrees(MAX_TOE_TILT):g} deg of it"
            yield f"{key}.plane", found, wanted, "Tilt the mount to the lie, or correct the club's."
        deep = site.ground - (site.ball_y - site.sole_depth)
        if deep > LEVEL:
            found = f"{short(site.sole_depth)} m, a sole {1e3 * deep:.1f} mm in the ground at the ball"
            action = "Raise the ball (ball_y), or correct the depth of the sole."
            yield f"{key}.sole_depth", found, f"at most {site.ball_y - site.ground:.4f} m", action


def _bus(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    if c.driver.name != "canopen":
        return
    from drivers.canopen.frames import MAX_LOAD, bus_load, max_rate

    bus, period = c.canopen, 1.0 / c.loop.rate
    load = bus_load(bus, period, c.driver.watchdog)
    if load > MAX_LOAD:
        found = f"{bus.bitrate} bit/s, a bus load of {load:.0%} at {short(c.loop.rate)} Hz"
        action = f"Raise it, or set loop.rate to {int(max_rate(bus, c.driver.watchdog))} Hz."
        yield "canopen.bitrate", found, f"at most {MAX_LOAD:.0%}", action
    lost = c.envelope.encoder_timeout
    if lost < COST_OF_A_SYNC * period:
        found = f"{short(lost)} s at {short(c.loop.rate)} Hz"
        least, faster = short(COST_OF_A_SYNC * period), ceil(COST_OF_A_SYNC / lost)
        wanted = f"at least {COST_OF_A_SYNC:g} ticks, {least} s: a lost SYNC costs two samples"
        action = f"Set loop.rate to {faster} Hz or more, or raise it: 0.009 s was proven safe."
        yield "envelope.encoder_timeout", found, wanted, action
    longest = MAX_READ_SHARE * period
    if bus.sync_timeout > longest:
        found = f"{short(bus.sync_timeout)} s"
        yield "canopen.sync_timeout", found, f"at most {short(longest)} s, part of the period", "Lower it."


def unheard_phases(configuration: Configuration) -> list[BenchError]:
    """Return the faults that would never begin on a running bench: only a plant in step knows the phase."""
    if configuration.driver.paced:
        return []
    location = ", ".join(map(str, configuration.files))
    return [
        BenchError(
            f"{location}: faults.{name}.phase",
            format_value(fault.phase),
            '"any": a plant with a separate clock does not know the phase',
            'Set a time, or a joint and an angle, instead of the phase; or use driver "sim".',
        )
        for name, fault in configuration.faults.items()
        if fault.phase != "any"
    ]


_LOOPS_OWN = frozenset({"clock", "loop", "supervisor", "recorder", "lease", "launch monitor"})


def _faults(c: Configuration, tree: Tree) -> Iterator[Mistake]:
    """Check faults: only for a simulated robot, and only of signals that a running bench can disturb."""
    for name, fault in c.faults.items():
        key = f"faults.{name}"
        if c.is_machine or c.driver.name == "mock":
            found, wanted = (
                f"a fault, with driver {format_value(c.driver.name)}",
                'none: faults are for driver "sim"',
            )
            yield key, found, f"{wanted} and simulated nodes", "Delete it, or set driver.name."
        if fault.signal in _LOOPS_OWN:
            found, wanted = format_value(fault.signal), "a signal or part of the simulated robot"
            action = "End or freeze the process itself; `golfbench faults run` tries the rest."
            yield f"{key}.signal", found, wanted, action
        if fault.kind == "delayed" and fault.value > (longest := MAX_DELAY * c.plant.tick):
            yield f"{key}.value", f"{short(fault.value)} s", f"at most {short(longest)} s", "Lower it."


RULES: tuple[Callable[[Configuration, Tree], Iterator[Mistake]], ...] = (
    _address,
    _names,
    _actuators,
    _linkage,
    _times,
    _gains,
    _air,
    _site,
    _club_sites,
    _bus,
    _faults,
    check_safety,
)
"""Each yields the mistakes of a configuration; the tree is that of its files, empty without files."""


def contradictions(configuration: Configuration) -> list[BenchError]:
    """Return the contradictions in a configuration that was changed after it was loaded."""
    location = ", ".join(map(str, configuration.files))
    return [
        BenchError(f"{location}: {key}", found, wanted, action)
        for rule in RULES
        for key, found, wanted, action in rule(configuration, {})
    ]
