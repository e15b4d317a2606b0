"""Values of calibrations in words, with their units."""

from __future__ import annotations

from math import degrees

from bench.calibration.values import (
    BallPosition,
    ClubInMount,
    EncoderZeros,
    SeenInputs,
    Values,
    ValveCentres,
)


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
