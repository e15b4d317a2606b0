"""Kinds of calibration with the valid range of each value, and the calibrations in force on a bench."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from enum import StrEnum
from hashlib import sha256
from math import degrees, hypot, pi, radians
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from bench.base.errors import BenchError, Refused
from bench.base.from_toml import checked_values
from bench.base.lifecycle import Block, Phase, State
from bench.config import Configuration, contradictions
from bench.config.files import changed_values
from bench.records.telemetry.encoder_preset import CalibratedShifts
from bench.records.telemetry.ring import RingReader
from drivers.base import JOINTS, Triple
from drivers.base.ranges import Range
from sim.plant import ACTUATOR_KEYS, Sign, ZeroCount
from sim.robot import Club

Coordinate = Annotated[float, Range(-3.0, 3.0, "m")]
Centre = Annotated[float, Range(-0.2, 0.2, "")]
DeadBand = Annotated[float, Range(0.0, 0.5, "")]


class CalibrationKind(StrEnum):
    """Kind of calibration."""

    ENCODERS = "encoders"
    BALL = "ball"
    CLUB = "club"
    VALVES = "valves"
    INPUTS = "inputs"


VALID_DAYS: Mapping[CalibrationKind, int] = {
    CalibrationKind.ENCODERS: 365,
    CalibrationKind.BALL: 30,
    CalibrationKind.CLUB: 90,
    CalibrationKind.VALVES: 180,
    CalibrationKind.INPUTS: 1,
}
"""Default days until a calibration expires. Assumption: absolute encoders hold until they
are taken off, a tee is moved often, a club works loose in its mount, seals and springs age; switches are
bridged and cables exchanged on any day."""


@dataclass(frozen=True)
class EncoderZeros:
    """Counts of the three encoders at joint angle zero, and which way they count."""

    zero_count: tuple[ZeroCount, ZeroCount, ZeroCount]
    sign: tuple[Sign, Sign, Sign]
    counts_per_revolution: Annotated[int, Range(256, 2**24, "counts")]
    """Counts per revolution of the calibrated encoders."""
    uncertainty: Annotated[float, Range(0.0, radians(5.0), "rad")]
    zero_shift: tuple[str, str, str] = field(default=("", "", ""), metadata={"optional": True})
    """Preset and offset in each device at the calibration, as its driver reports; empty if unknown."""

    def __post_init__(self) -> None:
        """Raise ValueError unless signs are ±1."""
        if 0 in self.sign:
            raise ValueError("sign: 1 or -1 for each joint")


def zero_counts(
    count: Iterable[int], angle: Iterable[float], sign: Iterable[int], counts_per_revolution: int
) -> Triple:
    """Return the counts at angle zero of encoders that show `count` with the joints at `angle` (rad)."""
    per_radian = counts_per_revolution / (2 * pi)
    # Half a count: a reading is the floor of the shaft's position.
    a, b, c = (
        (n + 0.5 - s * q * per_radian) % counts_per_revolution
        for n, q, s in zip(count, angle, sign, strict=True)
    )
    return a, b, c


_MIN_RECORDS = 20
"""Min number of records: fewer mean that the loop hardly runs."""
_STILL = 8
"""Max noise of a locked joint, counts."""


def standing_counts(ring: Path, counts_per_revolution: int, seconds: float = 0.5) -> tuple[int, int, int]:
    """Watch the cycles in `ring` for `seconds` and return the median count of each joint.

    Raises:
        NoRing: no bench runs here.
        Refused: the control loop does not run, the robot is not vented, so that no person has put it in its
            pose, an encoder gives no valid reading, or a joint moves.
    """
    reader = RingReader(ring)
    try:
        reader.read()
        time.sleep(seconds)
        cycles = reader.read(limit=100_000)
    finally:
        reader.close()
    location = "calibrate encoders --from-pose"
    if len(cycles) < _MIN_RECORDS:
        found = f"{len(cycles)} cycles in {seconds:g} s"
        raise Refused(location, found, "a running loop", "Start `golfbench run` again.")
    if not (cycles["vented"] & (cycles["phase"] == Phase.STANDING)).all():
        found = f"state {State(int(cycles['state'][-1])).name}, robot not vented or in motion"
        action = "Disarm, open the access, lock the robot at its mechanical reference, then retry."
        raise Refused(location, found, "a vented robot at rest, as for access", action)
    middles = []
    for joint, name in enumerate(JOINTS):
        if not cycles["encoder_valid"][:, joint].all():
            found = f"{name}: invalid readings"
            raise Refused(location, found, "valid readings", f"Check the cable of the {name} encoder.")
        counts = cycles["encoder_count"][:, joint]
        # Around the last one, so that a count at the range's end does not split.
        half = counts_per_revolution // 2
        around = (counts - counts[-1] + half) % counts_per_revolution - half
        spread = int(np.ptp(around))
        if spread > _STILL:
            found = f"{name}: it moved by {spread} counts in {seconds:g} s"
            raise Refused(location, found, f"{_STILL} at most", "Lock the robot at its mechanical reference.")
        middles.append(int(counts[-1] + round(float(np.median(around)))) % counts_per_revolution)
    a, b, c = middles
    return a, b, c


@dataclass(frozen=True)
class BallPosition:
    """Centre of the ball on its tee, in the swing plane from the shoulder axis R1."""

    x: Coordinate
    y: Coordinate
    uncertainty: Annotated[float, Range(0.0, 0.05, "m")]
    club: str = field(default="", metadata={"optional": True})
    """Club for which the tee stood there; empty if unknown."""


@dataclass(frozen=True)
class ClubInMount:
    """One club as clamped in the mount."""

    club: str
    """Name in the configuration."""
    length_to_face: Annotated[float, Range(0.3, 1.5, "m")]
    """Wrist axis R3 to the centre of the face."""
    loft: Annotated[float, Range(0.0, radians(70.0), "rad")]
    lie: Annotated[float, Range(radians(35.0), radians(80.0), "rad")]
    length_uncertainty: Annotated[float, Range(0.0, 0.05, "m")]
    angle_uncertainty: Annotated[float, Range(0.0, radians(5.0), "rad")]


@dataclass(frozen=True)
class ValveCentres:
    """Commands at which the three spools are centred, and the overlap to either side of that."""

    centre: tuple[Centre, Centre, Centre]
    dead_band: tuple[DeadBand, DeadBand, DeadBand]
    uncertainty: Annotated[float, Range(0.0, 0.1, "")]


@dataclass(frozen=True)
class SeenInputs:
    """Inputs that a person switched one by one, and the supply's sensor compared with its gauge."""

    seen: tuple[str, ...]
    """Names of the inputs, also of those found wrong."""
    wiring: str
    """Digest of the driver's settings at the check."""
    findings: tuple[str, ...] = field(default=(), metadata={"optional": True})
    """Faults found; arming is refused until a check finds none."""
    gauge: Annotated[float, Range(-2e6, 2e6, "Pa")] = field(default=0.0, metadata={"optional": True})
    """Max deviation of the supply sensor from the gauge (Pa)."""


Values = EncoderZeros | BallPosition | ClubInMount | ValveCentres | SeenInputs

KINDS: Mapping[CalibrationKind, type[Values]] = {
    CalibrationKind.ENCODERS: EncoderZeros,
    CalibrationKind.BALL: BallPosition,
    CalibrationKind.CLUB: ClubInMount,
    CalibrationKind.VALVES: ValveCentres,
    CalibrationKind.INPUTS: SeenInputs,
}


def kind_of(values: Values) -> CalibrationKind:
    """Return the kind of `values`."""
    return next(kind for kind, of_kind in KINDS.items() if isinstance(values, of_kind))


def values_of(kind: CalibrationKind, content: Mapping[str, Any], location: str) -> Values:
    """Return the checked values of `content`, whose keys are the fields of the kind's class.

    Raises as `checked_values`.
    """
    return checked_values(KINDS[kind], content, location, "Measure again, or correct the value.")


def content_of(values: Values) -> dict[str, Any]:
    """Return `values` as values of JSON; `values_of` reverses this."""
    return {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(values).items()}


def in_words(values: Values) -> str:
    """Return `values` with their units."""
    match values:
        case EncoderZeros(zero, sign, counts, uncertainty, shifts):
            signs = "".join("+" if s > 0 else "-" for s in sign)
            known = f"± {degrees(uncertainty):.3g} deg"
            words = f"zero {_three(zero, '.1f')} of {counts} counts, sign {signs}, {known}"
            return f"{words}; in the devices {'; '.join(shifts)}" if any(shifts) else words
        case BallPosition(x, y, uncertainty):
            words = f"x {x:.4f}, y {y:.4f} m ± {1e3 * uncertainty:.3g} mm"
            return f"{words}, with club {values.club}" if values.club else words
        case ClubInMount():
            v = values
            return (
                f"length {v.length_to_face:.4f} m ± {1e3 * v.length_uncertainty:.3g} mm, "
                f"loft {degrees(v.loft):.2f}, lie {degrees(v.lie):.2f} deg "
                f"± {degrees(v.angle_uncertainty):.3g} deg"
            )
        case ValveCentres(centre, band, uncertainty):
            return f"centre {_three(centre, 'z.4f')}, dead band {_three(band, 'z.4f')} ± {uncertainty:.2g}"
        case SeenInputs(seen, _, findings, gauge):
            words = f"{len(seen)} seen to change, supply {1e-5 * gauge:+z.2f} bar off the gauge"
            return f"wrong: {'; '.join(findings)}" if findings else words


def _three(values: tuple[float, float, float], form: str) -> str:
    return " ".join(format(value, form) for value in values)


def wiring_digest(configuration: Configuration) -> str:
    """Return the digest of the driver's settings and of whether the local reset is wired."""
    c = configuration
    settings = c.driver_arguments().get("settings")
    wired = [c.driver.name, c.lifecycle.local_reset, None if settings is None else asdict(settings)]
    return sha256(json.dumps(wired, sort_keys=True).encode()).hexdigest()[:16]


def is_rewired(values: Values, configuration: Configuration) -> bool:
    """Return whether `values` are a check of inputs whose wiring differs from `configuration`."""
    return isinstance(values, SeenInputs) and values.wiring != wiring_digest(configuration)


@dataclass(frozen=True)
class Entry:
    """One stored calibration."""

    id: int
    bench: str
    kind: CalibrationKind
    version: int
    """Rises by one per bench and kind."""
    date: datetime
    expires: datetime
    by: str
    method: str
    note: str
    values: Values

    @property
    def subject(self) -> str:
        """Name of the calibrated part if there are several of a kind (the club), else empty."""
        return self.values.club if isinstance(self.values, ClubInMount) else ""

    @property
    def name(self) -> str:
        """Kind, subject and version for messages."""
        return _name(self.kind, self.subject, self.version)

    def expired(self, now: datetime) -> bool:
        """Return whether it has expired at `now`."""
        return now >= self.expires

    def record(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {
            "id": self.id,
            "bench": self.bench,
            "kind": self.kind.value,
            "version": self.version,
            "subject": self.subject,
            "date": self.date.isoformat(),
            "expires": self.expires.isoformat(),
            "by": self.by,
            "method": self.method,
            "note": self.note,
            "values": content_of(self.values),
        }


@dataclass(frozen=True)
class UnreadableEntry:
    """One stored calibration that cannot be read."""

    kind: str
    """Kind as stored; "aerodynamics" for a ball."""
    version: int
    subject: str
    """Club or ball; empty if the kind has none."""
    reason: str

    @property
    def name(self) -> str:
        """Kind, subject and version for messages."""
        return _name(self.kind, self.subject, self.version)

    @property
    def problem(self) -> CalibrationProblem:
        """The row with its mistake and the command that supersedes it."""
        fact, expected = f"in the database is unreadable ({self.reason})", "a row as golfbench writes it"
        action = " ".join(filter(None, ("golfbench calibrate", self.kind, self.subject)))
        return CalibrationProblem(Block.UNREADABLE, self.name, fact, expected, action)

    @property
    def text(self) -> str:
        """The problem for people."""
        return self.problem.text

    def record(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return asdict(self)


def _name(kind: str, subject: str, version: int) -> str:
    return " ".join(filter(None, ("calibration", kind, subject, f"version {version}")))


class CalibrationProblem(Refused):
    """Calibration that blocks arming: missing, unreadable, expired or dated in the future."""

    def __init__(self, code: Block, location: str, found: str, expected: str, action: str) -> None:
        super().__init__(location, found, expected, action)
        self.code = code

    @property
    def text(self) -> str:
        """Problem and action in one sentence."""
        return f"{self.location} {self.found}: {self.action}"


@dataclass(frozen=True)
class Calibration:
    """The newest of each kind; a kind without one is nominal: as the configuration has it."""

    bench: str
    club: str
    """The mounted club; calibrations of other clubs are not in force."""
    when: datetime
    entries: tuple[Entry, ...] = field(default=())
    """Entries in force, at most one of each kind, in the order of Kind."""
    required: bool = False
    """Whether a missing calibration is a problem: with a machine, not in simulation."""
    later: tuple[Entry, ...] = field(default=())
    """Newer ones dated after `when`, which are not in force: the clock was set back since."""
    unreadable: tuple[UnreadableEntry, ...] = field(default=())
    """Newest of kinds, none of which is in force then."""
    moved: Entry | None = None
    """Newest one of the tee, if it stood elsewhere: not in force until it is measured for this club."""

    @property
    def nominal(self) -> tuple[CalibrationKind, ...]:
        """The kinds that have no calibration in force."""
        return tuple(kind for kind in CalibrationKind if self.of(kind) is None)

    def of(self, kind: CalibrationKind) -> Entry | None:
        """Return the calibration of `kind` in force, if any; it may have expired."""
        return next((entry for entry in self.entries if entry.kind is kind), None)

    @property
    def shifts(self) -> CalibratedShifts | None:
        """Zero shifts in the encoders at their calibration; None if they were never calibrated."""
        entry = self.of(CalibrationKind.ENCODERS)
        if entry is None or not isinstance(entry.values, EncoderZeros):
            return None
        return CalibratedShifts(entry.name, entry.values.zero_shift)

    def problems(self, at: datetime, now: datetime | None = None) -> list[CalibrationProblem]:
        """Return the reasons against arming `at` a time; empty if there are none.

        The texts state expiry as of `now`, by default the time `at`.
        """
        found = list[CalibrationProblem]()
        for entry in self.entries:
            # Of a simulated robot nothing is wired; its check is an exercise.
            if entry.expired(at) and (self.required or entry.kind is not CalibrationKind.INPUTS):
                word = "expired" if entry.expired(now or at) else "expires"
                fact, expected = f"{word} on {entry.expires:%Y-%m-%d %H:%M} UTC", "one that has not expired"
                action = f"golfbench calibrate {entry.kind}"
                code = Block.INPUTS if entry.kind is CalibrationKind.INPUTS else Block.CALIBRATION_EXPIRED
                found.append(CalibrationProblem(code, entry.name, fact, expected, action))
        for entry in self.later:
            fact = f"is of {entry.date:%Y-%m-%d %H:%M} UTC, later than this machine's clock"
            expected, action = (
                "a date before now",
                f"set the clock; if it is right, run golfbench calibrate {entry.kind}",
            )
            found.append(CalibrationProblem(Block.CALIBRATION_AHEAD, entry.name, fact, expected, action))
        found += [entry.problem for entry in self.unreadable]
        return found + (self._of_machine() if self.required else [])

    def _of_machine(self) -> list[CalibrationProblem]:
        """Return faulty inputs and missing kinds."""
        found = [
            CalibrationProblem(
                *(Block.INPUTS, entry.name, f"found {text}"),
                "a check of the inputs that finds nothing wrong",
                f"follow it, then golfbench calibrate {entry.kind}",
            )
            for entry in self.entries
            if isinstance(entry.values, SeenInputs)
            for text in entry.values.findings
        ]
        unreadable = {entry.kind for entry in self.unreadable}
        for kind in (kind for kind in self.nominal if kind not in unreadable):
            name = f"club {self.club}" if kind is CalibrationKind.CLUB else kind
            where = f"{name} of bench {self.bench}"
            code = Block.INPUTS if kind is CalibrationKind.INPUTS else Block.CALIBRATION_MISSING
            fact, action = "never calibrated", f"golfbench calibrate {kind}"
            if kind is CalibrationKind.BALL and self.moved is not None:
                fact = f"calibrated for the tee of another club ({self.moved.name})"
                action = f'set the tee for club {self.club}, then {action} with swing.club = "{self.club}"'
            expected = "a calibration in force, as on every machine"
            found.append(CalibrationProblem(code, where, fact, expected, action))
        return found

    def record(self) -> dict[str, Any]:
        """Return the record for each swing: calibrations in force, and kinds that are nominal."""
        return {
            "bench": self.bench,
            "club": self.club,
            "when": self.when.isoformat(),
            "in_force": [entry.record() for entry in self.entries],
            "expired": [entry.kind.value for entry in self.entries if entry.expired(self.when)],
            "nominal": [kind.value for kind in self.nominal],
            "unreadable": [entry.record() for entry in self.unreadable],
        }

    def summary(self) -> str:
        """Return a summary in one line."""
        parts = [f"{entry.kind} version {entry.version} of {entry.date:%Y-%m-%d}" for entry in self.entries]
        if self.nominal:
            parts.append(f"nominal: {', '.join(self.nominal)}")
        parts += [f"unreadable: {entry.kind} version {entry.version}" for entry in self.unreadable]
        return "; ".join(parts)


def apply(calibration: Calibration, configuration: Configuration) -> Configuration:
    """Return `configuration` with the values in force, expired ones too: they are the best known.

    Raises:
        BenchError: a calibration belongs to other encoders, or to a club that is not configured.
    """
    for entry in calibration.entries:
        configuration = _corrected(configuration, entry.values, entry.name)
    return configuration


class ReplacedValues(NamedTuple):
    """Values of the configuration that a calibration replaces."""

    entry: Entry
    values: tuple[tuple[str, str, str], ...]
    """Key, value in the configuration and value used."""

    @property
    def text(self) -> str:
        """Return calibration, date and values for people."""
        changes = ", ".join(f"{key} {stated} by {used}" for key, stated, used in self.values)
        return f"{self.entry.name} of {self.entry.date:%Y-%m-%d %H:%M} UTC replaces {changes}"


def replaced_values(calibration: Calibration, configuration: Configuration) -> tuple[ReplacedValues, ...]:
    """Return the values of `configuration` that `apply` replaces by others. Raises as `apply`."""
    changed = (
        (one, tuple(changed_values(configuration, _corrected(configuration, one.values, one.name))))
        for one in calibration.entries
    )
    return tuple(ReplacedValues(entry, values) for entry, values in changed if values)


def precedes_commissioning(entry: Entry, configuration: Configuration) -> bool:
    """Return whether the robot of `configuration` was commissioned after `entry`."""
    return configuration.commissioned is not None and entry.date < configuration.commissioned


def outdated(replaced: ReplacedValues, configuration: Configuration) -> Refused | None:
    """Return the fault of a calibration that replaces values commissioned later; None if it does not."""
    entry, commissioned = replaced.entry, configuration.commissioned
    measured = entry.kind in (CalibrationKind.ENCODERS, CalibrationKind.VALVES)
    if not (measured and precedes_commissioning(entry, configuration)):
        return None
    return Refused(
        entry.name,
        f"{replaced.text}, which were commissioned later",
        f"a calibration since {commissioned:%Y-%m-%d %H:%M} UTC (bench.commissioned)",
        f"Run golfbench calibrate {entry.kind}.",
    )


def _corrected(c: Configuration, values: Values, name: str) -> Configuration:
    match values:
        case EncoderZeros():
            return _with_zeros(c, values, name)
        case BallPosition():
            return _with_ball(c, values)
        case ClubInMount():
            return _with_club(c, values, name)
        case ValveCentres():
            return _with_valves(c, values)
    return c


def _with_ball(c: Configuration, ball: BallPosition) -> Configuration:
    """Return `c` with the tee measured, also for the other clubs whose site has it at the same place."""
    before = c.plant.site
    sites = {
        name: replace(site, ball_x=ball.x, ball_y=ball.y)
        if (site.ball_x, site.ball_y) == (before.ball_x, before.ball_y)
        else site
        for name, site in c.sites.items()
    }
    plant = replace(c.plant, site=replace(before, ball_x=ball.x, ball_y=ball.y))
    return replace(c, plant=plant, sites=sites)


def _with_zeros(c: Configuration, zeros: EncoderZeros, name: str) -> Configuration:
    counts = c.plant.encoders.counts_per_revolution
    if zeros.counts_per_revolution != counts:
        found = f"encoders of {zeros.counts_per_revolution} counts per revolution"
        expected = f"{counts}, as plant.encoders.counts_per_revolution says"
        raise BenchError(name, found, expected, "Calibrate the encoders again, or correct the configuration.")
    encoders = replace(c.plant.encoders, zero_count=zeros.zero_count, sign=zeros.sign)
    return replace(c, plant=replace(c.plant, encoders=encoders))


def _with_club(c: Configuration, measured: ClubInMount, name: str) -> Configuration:
    if measured.club not in c.clubs:
        found, expected = f'"{measured.club}", which is not configured', f"one of {', '.join(c.clubs)}"
        raise BenchError(name, found, expected, "Choose one, or add it under [clubs].")
    club = c.clubs[measured.club]
    club = replace(
        club,
        # Clamping a club further out also moves the mass of its head outwards.
        shaft_length=club.shaft_length + measured.length_to_face - club.length_to_face,
        length_to_face=measured.length_to_face,
        loft=measured.loft,
        lie=measured.lie,
    )
    c = replace(c, clubs=c.clubs | {measured.club: club})
    if measured.club != c.swing.club:
        return c
    return replace(c, plant=replace(c.plant, robot=replace(c.plant.robot, club=club)))


def _with_valves(c: Configuration, valves: ValveCentres) -> Configuration:
    actuators = {
        name: replace(
            getattr(c.plant, name),
            valve=replace(
                getattr(c.plant, name).valve, centre=valves.centre[i], dead_band=valves.dead_band[i]
            ),
        )
        for i, name in enumerate(ACTUATOR_KEYS)
    }
    return replace(c, plant=replace(c.plant, **actuators))


_BALL_MOVED, _CLUB_MOVED, _CLUB_TURNED = 0.15, 0.05, 6.0
"""Distances from the configured place or length (m) and from loft or lie (deg), beyond which a measurement is
a mistake: a tee is moved by hand's breadths, a club slips in its mount by centimetres, and lofts of a number
differ by a few degrees between makers."""
MAX_CENTRE, MAX_BAND = 0.06, 0.10
"""Max offset and overlap of a valve that is right."""
VALVE_MOVED = 0.02
"""Change of a commissioned valve's centre or overlap from which on the valve is worn."""


def require_plausible(values: Values, configuration: Configuration) -> None:
    """Check `values` against the `configuration` they are to correct.

    Raises:
        BenchError: they belong to another part, or are too far from the configured values.
        ExceptionGroup: BenchErrors of the configuration, which they would make inconsistent.
    """
    kind = kind_of(values)
    location = f"calibrate {kind}"
    corrected = _corrected(configuration, values, location)
    match values:
        case BallPosition(x, y):
            site, key = configuration.plant.site, configuration.site_key
            told = f"({x:g}, {y:g}) m, configured as ({site.ball_x:g}, {site.ball_y:g}) m in {key}"
            _require_near(location, told, hypot(x - site.ball_x, y - site.ball_y), _BALL_MOVED)
        case ClubInMount(name):
            _require_club(f"{location} {name}", f"clubs.{name}", values, configuration.clubs[name])
        case ValveCentres():
            _require_valves(location, values, configuration)
    if faults := contradictions(corrected):
        raise ExceptionGroup(f"calibrate {kind}: invalid for this bench", faults)


def _require_club(location: str, key: str, values: ClubInMount, club: Club) -> None:
    """Check length, loft and lie against those configured as `club`."""
    told = f"{values.length_to_face:g} m, configured as {club.length_to_face:g} m in {key}.length_to_face"
    _require_near(location, told, abs(values.length_to_face - club.length_to_face), _CLUB_MOVED)
    for name in ("loft", "lie"):
        angle = degrees(getattr(values, name))
        off = abs(angle - degrees(getattr(club, name)))
        if off > _CLUB_TURNED:
            found = f"{name} {angle:.3g} deg, {off:.1f} deg from {key}.{name}_deg"
            action = f"Enter degrees, not radians; if the club is another one, correct [{key}] first."
            raise BenchError(location, found, f"{_CLUB_TURNED:g} deg at most", action)


def _require_valves(location: str, values: ValveCentres, c: Configuration) -> None:
    """Check centres and overlaps against those of valves that are right, and the commissioned ones."""
    for name, most in (("centre", MAX_CENTRE), ("dead_band", MAX_BAND)):
        for key, joint, value in zip(ACTUATOR_KEYS, JOINTS, getattr(values, name), strict=True):
            path, words = f"{key}.valve.{name}", name.replace("_", " ")
            before = getattr(getattr(c.plant, key).valve, name)
            if abs(value) > most:
                expected, action = f"{most:g} at most", "Measure again, or adjust the valve by its manual."
                raise BenchError(f"{location}: {joint}", f"{words} {value:g}", expected, action)
            if path in c.envelope.model.standard_errors and abs(value - before) > VALVE_MOVED:
                found = f"{words} {value:g}, commissioned as {before:.4g} (plant.{path})"
                action = "Measure again; if the valve was cleaned or replaced, commission again."
                raise BenchError(f"{location}: {joint}", found, f"{VALVE_MOVED:g} from it at most", action)


def _require_near(location: str, found: str, distance: float, most: float) -> None:
    if distance > most:
        action = "Measure again; if the machine was rebuilt, correct the configuration first."
        raise BenchError(location, found, f"{most:g} m from it at most", action)
