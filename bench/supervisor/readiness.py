"""Readiness of a bench: the only assessment before motion.

Configuration, calibrations in force, profile, club, ball and site are checked together. `golfbench check`,
the bench at its start and at each arming, and campaigns call it; commands that simulate this bench also use
its faults.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from datetime import datetime
from pathlib import Path

from bench.base.errors import BenchError
from bench.base.lifecycle import Block
from bench.calibration.archive import calibration_of
from bench.calibration.calibration import (
    Calibration,
    CalibrationKind,
    CalibrationProblem,
    ReplacedValues,
    apply,
    is_rewired,
    outdated,
    replaced_values,
)
from bench.config import Configuration, contradictions, unheard_phases
from bench.control.residual_thresholds import LimitsInUse
from bench.design.static_checks import Check, check_profile, other_rate, rate_faults
from bench.network.bench_service import ArmingBlock
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from sim.plant import PlantParameters
from sim.robot import Club

NO_MODEL_CHECK = "the model-based check is off (envelope.model.check): a stuck valve is found later"

FEEDBACK_ONLY = (
    "the model-based check is off (envelope.model.check): the spools' feedback detects stuck valves, but no "
    "leak and no wrong encoder"
)

HALF_BLIND = (
    "without a sensor in each chamber the model-based check finds some stuck valves too late to keep the "
    "absorbers within their ratings; fit chamber sensors"
)

_ON_THE_BALL_ONLY = frozenset(
    {
        "name",
        "loft",
        "face_angle",
        "restitution",
        "restitution_slope",
        "tangential_factor",
        "tangential_stiffness",
        "tangential_loss",
        "friction_factor",
        "bulge_radius",
        "roll_radius",
        "tee_shift",
    }
)
"""Fields of a club that do not act on the robot."""


@dataclass(frozen=True)
class Readiness:
    """Assessment of a bench and a profile."""

    configuration: Configuration
    """Configuration with the calibrations in force and the limits of the profile."""
    calibration: Calibration
    profile: Profile
    file: Path
    """File of the profile."""
    contradictions: tuple[BenchError, ...]
    """Contradictions between configuration and calibrations."""
    checks: tuple[Check, ...]
    """Checks of the profile on the calibrated machine."""
    limits: str
    """Source of the limits of the model-based check; empty if it is off or if there are stale ones."""
    warnings: tuple[str, ...]
    """Properties that do not block arming."""
    replaced: tuple[ReplacedValues, ...] = ()
    """Values of the configuration that the calibrations replace."""

    @property
    def faults(self) -> list[BenchError]:
        """Reasons why the swing is impossible here, in simulation and on a running bench."""
        return [*self.contradictions, *(fault for check in self.checks for fault in check.faults)]

    def require_possible(self) -> None:
        """Refuse a swing that is impossible here.

        Raises:
            ExceptionGroup: BenchErrors, one for each fault.
        """
        if faults := self.faults:
            raise ExceptionGroup(f"{self.file} cannot be swung here", faults)

    def blocks(self, now: datetime) -> list[ArmingBlock]:
        """Return the reasons that block arming at `now`."""
        swing = [fault for check in self.checks for fault in check.faults]
        return [
            *map(_contradiction_block, self.contradictions),
            *(arming_block(Block.SWING, fault) for fault in swing),
            *(arming_block(problem.code, problem) for problem in self.calibration.problems(now)),
        ]


def _contradiction_block(fault: BenchError) -> ArmingBlock:
    return arming_block(fault.code if isinstance(fault, CalibrationProblem) else Block.CONFIGURATION, fault)


def arming_block(code: Block, fault: BenchError) -> ArmingBlock:
    """Return `fault` as the bench reports it."""
    return ArmingBlock(
        code=code, location=fault.location, found=fault.found, expected=fault.expected, action=fault.action
    )


def assess_bench(
    configuration: Configuration,
    now: datetime,
    profile: str | None = None,
    *,
    club: str | None = None,
    running: bool = False,
) -> Readiness:
    """Return the readiness with the calibrations in force `now`; see `assess`.

    Profile and club are those of the configuration if no name is given.

    Raises:
        BenchError: profile, club, calibrations or limits cannot be read or applied.
    """
    mounted, calibration = mount(configuration, club, now)
    file = find_profile(profile or configuration.swing.profile)
    return assess(mounted, calibration, load_profile(file), file, running=running)


def mount(
    configuration: Configuration, club: str | None, when: datetime
) -> tuple[Configuration, Calibration]:
    """Return the configuration with `club` mounted, and the calibrations in force for it at `when`.

    A calibration of the tee at another place is left out: the tee is calibrated once it has been moved.

    Raises:
        BenchError: the club is unknown, or the calibrations cannot be read.
    """
    return configuration.with_club(club), calibration_of(configuration, when, club)


def assess(
    configuration: Configuration,
    calibration: Calibration,
    profile: Profile,
    file: Path,
    *,
    running: bool = False,
) -> Readiness:
    """Return the readiness of the bench in `configuration`, as loaded, for `profile`, read from `file`.

    `running`: for `golfbench run`; otherwise for lock-step, which needs a sample for each tick.

    Raises:
        BenchError: a calibration belongs to another machine, or a file of limits is invalid.
    """
    c = apply(calibration, configuration)
    replaced, warnings = replaced_values(calibration, configuration), list[str]()
    found = _contradictions(c, replaced)
    if running:
        c, found = c.running(), [*found, *unheard_phases(c)]
        if note := other_rate(profile, c.plant):
            warnings.append(note)
    else:
        found += rate_faults(profile, c.plant, str(file))
        found += [entry.problem for entry in calibration.unreadable]  # a running bench reports them itself
    tee = calibration.of(CalibrationKind.BALL)
    designed = _as_designed(configuration, c, profile)
    checks = check_profile(profile, designed, c.envelope, str(file), tee.name if tee else c.site_key)
    limits = ""
    real, model = running and c.is_machine, c.envelope.model
    old = [fault for one in replaced if (fault := outdated(one, configuration))]
    if real:
        found += [*old, *_rewired(calibration, c)]
    else:
        warnings += map(str, old)
    chambers_have_sensors, valves_have_feedback = _fitted_sensors(c)
    if model.check == "off":
        reason = model.off_reason.strip()
        words = FEEDBACK_ONLY if valves_have_feedback else NO_MODEL_CHECK
        warnings.append(f"{words}; the reason given: {reason}" if reason else words)
        if real and not reason:
            found.append(_unwatched(c))
    else:
        if not chambers_have_sensors:
            warnings.append(HALF_BLIND)
            if real and not model.off_reason.strip():
                found.append(_half_blind(c))
        used = c.limits_in_use(profile, file)
        c = replace(c, envelope=replace(c.envelope, model=used.settings))
        if used.stale and real:
            found.append(_stale(profile, used))
        elif used.stale:
            warnings.append(f"limits of the model-based check: {used.source}")
        else:
            limits = used.source
    return Readiness(
        c, calibration, profile, file, tuple(found), tuple(checks), limits, tuple(warnings), replaced
    )


def _contradictions(c: Configuration, replaced: Iterable[ReplacedValues]) -> list[BenchError]:
    """Return the contradictions in `c`, those of a replaced value at the calibration that it comes from."""
    sources = {key: one.entry.name for one in replaced for key, *_ in one.values}
    found = contradictions(c)
    for fault in found:
        file, _, key = fault.location.rpartition(": ")
        fault.location = f"{sources.get(key, file)}: {key}"
    return found


def _rewired(calibration: Calibration, c: Configuration) -> list[CalibrationProblem]:
    inputs = calibration.of(CalibrationKind.INPUTS)
    if inputs is None or not is_rewired(inputs.values, c):
        return []
    found, expected = "a check with other driver settings", "a check of the inputs with the settings in force"
    action = f"Run golfbench calibrate {inputs.kind}."
    return [CalibrationProblem(Block.INPUTS, inputs.name, found, expected, action)]


def _fitted_sensors(c: Configuration) -> tuple[bool, bool]:
    """Return whether each chamber has a pressure sensor, and whether each valve has spool feedback."""
    match c.driver.name:
        case "canopen":
            node = c.canopen.valve_node
            return all(node.chamber_pressures), all(node.spool_positions)
        case "daq":
            return all(c.daq.chamber_pressures), all(c.daq.spool_positions)
    return c.plant.pressure_sensors, c.plant.spool_feedback


def _unwatched(c: Configuration) -> BenchError:
    return BenchError(
        f"{', '.join(map(str, c.files))}: envelope.model.check",
        "off with a real robot",
        '"always", or a reason in envelope.model.off_reason: a stuck valve is found too late without it',
        'Set it to "always" once the robot is measured: golfbench commission does.',
    )


def _half_blind(c: Configuration) -> BenchError:
    section = {"canopen": "canopen.valve_node"}.get(c.driver.name, c.driver.name)
    return BenchError(
        f"{', '.join(map(str, c.files))}: {section}.chamber_pressures",
        "a chamber without a sensor",
        "a sensor in each chamber, or a reason in envelope.model.off_reason: some stuck valves are found too "
        "late for the absorbers without them",
        "Fit the sensors, then enter their inputs.",
    )


def _stale(profile: Profile, used: LimitsInUse) -> BenchError:
    return BenchError(
        f"limits of {profile.name}",
        used.source,
        "limits made for this robot, profile and controller, or none",
        f"Make them: golfbench profile limits {profile.name}",
    )


def _as_designed(nominal: Configuration, c: Configuration, profile: Profile) -> PlantParameters:
    """Return the plant of `c`, its club named as the profile's if both clubs act alike on the robot."""
    mounted = nominal.clubs.get(nominal.swing.club)
    if mounted is None or not mechanically_equal(mounted, nominal.clubs.get(profile.club)):
        return c.plant
    club = replace(c.plant.robot.club, name=profile.club)
    return replace(c.plant, robot=replace(c.plant.robot, club=club))


def with_face_of(club: Club, other: Club) -> Club:
    """Return a club with the mechanics of `club` and the face, head and name of `other`."""
    return replace(club, **{name: getattr(other, name) for name in _ON_THE_BALL_ONLY})


def mechanically_equal(club: Club, other: Club | None) -> bool:
    """Return whether two clubs are the same to the robot."""
    return other is not None and all(
        getattr(club, f.name) == getattr(other, f.name)
        for f in fields(Club)
        if f.name not in _ON_THE_BALL_ONLY
    )
