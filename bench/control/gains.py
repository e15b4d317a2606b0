"""The gains of all three joints at one pose."""

from __future__ import annotations

from typing import NamedTuple

Triple = tuple[float, float, float]


class Gains(NamedTuple):
    """Opening per rad, rad s, rad/s and rad/s2; and per rad/s of the reference in slow moves."""

    proportional: Triple
    integral: Triple
    derivative: Triple
    damping: Triple
    move: Triple

    def with_joint(self, joint: int, **values: float) -> Gains:
        """Return these gains with some gains of one `joint` replaced."""

        def put(triple: Triple, value: float) -> Triple:
            a, b, c = (value if i == joint else other for i, other in enumerate(triple))
            return a, b, c

        return self._replace(**{name: put(getattr(self, name), value) for name, value in values.items()})
