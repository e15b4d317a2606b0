"""The gains of all three joints that tuning finds."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from bench.control.settings import ControlSettings, PidSettings

Triple = tuple[float, float, float]


class Gains(NamedTuple):
    """Opening per rad, rad s, rad/s and rad/s2; joints in order."""

    proportional: Triple
    integral: Triple
    derivative: Triple
    damping: Triple

    @staticmethod
    def of(control: ControlSettings) -> Gains:
        """Return the gains of `control`."""
        pid = control.pid
        return Gains(pid.proportional, pid.integral, pid.derivative, control.damping)

    def put_into(self, control: ControlSettings) -> ControlSettings:
        """Return `control` with these gains."""
        pid = PidSettings(self.proportional, self.integral, self.derivative)
        return replace(control, pid=pid, damping=self.damping)

    def with_joint(self, joint: int, **values: float) -> Gains:
        """Return these gains with some gains of one `joint` replaced."""

        def put(triple: Triple, value: float) -> Triple:
            a, b, c = (value if i == joint else other for i, other in enumerate(triple))
            return a, b, c

        return self._replace(**{name: put(getattr(self, name), value) for name, value in values.items()})
