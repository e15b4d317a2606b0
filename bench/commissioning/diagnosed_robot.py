"""A robot whose swings are looked at: does the measured model still explain each, and if not, what would?"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench.commissioning.known_robot import FoundValue
from bench.commissioning.rising_swings import exceeded
from bench.commissioning.swing_diagnosis import Diagnosis, diagnose
from bench.commissioning.swung_robot import Mark, SwingSeries, SwungRobot
from bench.commissioning.wrong_machine import PredictionFails, WrongMachine
from bench.errors import Refused
from bench.simulation.loads import Loads
from bench.simulation.series import Bench, NotReturned, SeriesSwing
from bench.swing.profile import Profile


class DiagnosedRobot:
    """A SwungRobot of which a swing that a wrong machine explains is the last one."""

    def __init__(self, robot: SwungRobot, found: Sequence[FoundValue], records: Path) -> None:
        """Look at the swings of `robot`, of which values were `found`; wrong ones are stored in `records`."""
        self._robot, self._found, self._records = robot, found, records
        self.last: Diagnosis | None = None
        """What the last swing says; None before the first."""

    def series(self, bench: Bench) -> DiagnosedSeries:
        """Arm `bench`, whose model is the robot as measured: the model-based check is on."""
        watched = bench._replace(envelope=bench.envelope.with_model_check("always"))
        return DiagnosedSeries(self._robot.series(watched), bench, self)

    def look_at(self, swing: SeriesSwing, bench: Bench, name: str, loads: Loads | None) -> None:
        """Keep what `swing` of the profile `name` says.

        Raises:
            WrongMachine: it names a cause.
        """
        self.last = diagnose(swing.cycles, bench.model, self._found)
        if self.last.named is None:
            return
        self._records.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(self._records / "wrong-swing.npz", cycles=swing.cycles)
        said = "; ".join([self.last.text, *exceeded(loads)])
        raise WrongMachine(name, said, "the robot that was measured", self.last.named.cause.action)

    def explained(self, error: Refused) -> Refused:
        """Return `error` of a step with what the last swing says, where that says no cause."""
        if self.last is None or self.last.named is not None or isinstance(error, PredictionFails):
            return error
        return type(error)(error.place, f"{error.found}; {self.last.text}", error.expected, error.action)


class DiagnosedSeries:
    """Swings that are looked at."""

    def __init__(self, series: SwingSeries, bench: Bench, robot: DiagnosedRobot) -> None:
        """Swing `series` of `bench`."""
        self._series, self._bench, self._robot = series, bench, robot

    def swing(self, profile: Profile, *, ball: bool = True) -> SeriesSwing:
        """Swing `profile`, and come back to the address.

        Raises:
            WrongMachine: the swing is that of another robot than the measured one, and says of which.
            Refused: the robot does not come back.
        """
        try:
            made = self._series.swing(profile, ball=ball)
        except NotReturned as error:
            self._robot.look_at(error.swing, self._bench, profile.name, self._series.loads())
            raise
        self._robot.look_at(made, self._bench, profile.name, self._series.loads())
        return made

    def loads(self) -> Loads | None:
        """Return the loads since the series was armed; None where nothing measures them."""
        return self._series.loads()

    def face_mark(self, swing: SeriesSwing) -> Mark | None:
        """Return the ball's mark on the face; None where it is not read."""
        return self._series.face_mark(swing)
