"""Kinds of calibration, with the valid range of each value in SI and radians; the digest of the wiring."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from hashlib import sha256
from math import degrees, pi, radians
from pathlib import Path
from typing import Annotated, Any

from bench.config import Configuration
from bench.errors import BenchError
from bench.from_toml import Builder, as_tree
from drivers.base import Triple
from drivers.base.ranges import Range
from sim.plant import Sign, ZeroCount

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
    """Preset and offset in each device at the calibration, as its driver tells them; empty if unknown."""

    def __post_init__(self) -> None:
        """Raise ValueError unless signs are ±1."""
        if 0 in self.sign:
            raise ValueError("sign: 1 or -1 for each joint")


def zero_counts(
    count: tuple[int, int, int], angle: Triple, sign: tuple[int, int, int], counts_per_revolution: int
) -> Triple:
    """Return the counts at angle zero of encoders that show `count` with the joints at `angle` (rad)."""
    per_radian = counts_per_revolution / (2 * pi)
    # Half a count: a reading is the floor of what the shaft shows.
    a, b, c = (
        (n + 0.5 - s * q * per_radian) % counts_per_revolution
        for n, q, s in zip(count, angle, sign, strict=True)
    )
    return a, b, c


@dataclass(frozen=True)
class BallPosition:
    """Centre of the ball on its tee, in the swing plane from the shoulder axis R1."""

    x: Coordinate
    y: Coordinate
    uncertainty: Annotated[float, Range(0.0, 0.05, "m")]


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
    """Inputs that a person was seen to change, one by one, and the supply's sensor beside its gauge."""

    seen: tuple[str, ...]
    """Names of the inputs, also of those found wrong."""
    wiring: str
    """Digest of the driver's settings at the check."""
    findings: tuple[str, ...] = field(default=(), metadata={"optional": True})
    """What was found wrong; arming is refused until a check finds nothing."""
    gauge: Annotated[float, Range(-2e6, 2e6, "Pa")] = field(default=0.0, metadata={"optional": True})
    """Largest deviation of the supply's sensor from the gauge."""


Values = EncoderZeros | BallPosition | ClubInMount | ValveCentres | SeenInputs

KINDS: Mapping[CalibrationKind, type[Values]] = {
    CalibrationKind.ENCODERS: EncoderZeros,
    CalibrationKind.BALL: BallPosition,
    CalibrationKind.CLUB: ClubInMount,
    CalibrationKind.VALVES: ValveCentres,
    CalibrationKind.INPUTS: SeenInputs,
}


def values_of(kind: CalibrationKind, content: Mapping[str, Any], place: str) -> Values:
    """Return the checked values of `content`, whose keys are the fields of the kind's class.

    Raises:
        ExceptionGroup: of BenchErrors at `place`, one for each key that is missing, unknown, of the wrong
            type or outside its range.
    """
    faults: list[BenchError] = []
    file = Path(place)
    builder = Builder(
        as_tree({key: _listed(value) for key, value in content.items()}, file, faults),
        file,
        "Measure again, or correct the value.",
        "Give it.",
        faults=faults,
    )
    values = builder.build(KINDS[kind])
    if faults:
        for fault in faults:
            fault.place = fault.place.removesuffix(": ")  # of the values as a whole
        raise ExceptionGroup(f"{place} is invalid", faults)
    return values  # type: ignore[no-any-return]


def content_of(values: Values) -> dict[str, Any]:
    """Return `values` as JSON has them; `values_of` reads them back."""
    return {key: _listed(value) for key, value in asdict(values).items()}


def _listed(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def in_words(values: Values) -> str:
    """Return `values` with their units."""
    match values:
        case EncoderZeros(zero, sign, counts, uncertainty, shifts):
            signs = "".join("+" if s > 0 else "-" for s in sign)
            known = f"± {degrees(uncertainty):.3g} deg"
            words = f"zero {_three(zero, '.1f')} of {counts} counts, sign {signs}, {known}"
            return f"{words}; in the devices {'; '.join(shifts)}" if any(shifts) else words
        case BallPosition(x, y, uncertainty):
            return f"x {x:.4f}, y {y:.4f} m ± {1e3 * uncertainty:.3g} mm"
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
            words = f"{len(seen)} seen to change, supply {1e-5 * gauge:+z.2f} bar beside the gauge"
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
    """Return whether `values` are a check of inputs that were wired otherwise than `configuration` has it."""
    return isinstance(values, SeenInputs) and values.wiring != wiring_digest(configuration)
