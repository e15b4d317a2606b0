"""What the process that has the machine does: sequences, swings, and in between holding or being passive."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from bench.clock import Clock
from bench.commissioning.driver_machine import DriverMachine
from bench.commissioning.live_series import LiveSeries, Say
from bench.commissioning.machine import MotionBounds, Segment
from bench.config import Configuration
from bench.simulation.series import Bench
from bench.swing.profile import Profile
from drivers.base import Command, Driver, Readings


class Run(NamedTuple):
    """Run segments within bounds; answered with the MotionTrace."""

    segments: tuple[Segment, ...]
    bounds: MotionBounds


class WatchInputs(NamedTuple):
    """Hold outputs and watch the switches; answered with the Readings."""

    command: Command
    before: Readings | None
    air: float
    """Pa absolute in the manifold that end it."""
    settled: float
    """s"""
    patience: float
    """s"""


class Vent(NamedTuple):
    """Be passive until the chambers are empty; answered with the MotionTrace."""

    duration: float
    """s"""


class BePassive(NamedTuple):
    """Centre the spools, shut the supply, open the vents; a robot that swings is brought to rest first."""


class ArmFor(NamedTuple):
    """Arm for swings of a bench; answered once the robot holds its address."""

    bench: Bench


class Swing(NamedTuple):
    """Swing a profile; answered with the SeriesSwing."""

    profile: Profile
    ball: bool


class LetIn(NamedTuple):
    """Release the guard for a person; answered once it may be opened."""


class LockGuard(NamedTuple):
    """Lock the guard that a person has closed."""


Order = LetIn | LockGuard | Run | WatchInputs | Vent | BePassive | ArmFor | Swing


class MachineServer:
    """A machine that obeys orders, one after the other; `hold` is its tick in between."""

    def __init__(
        self,
        driver: Driver,
        configuration: Configuration,
        clock: Clock,
        *,
        stop: Callable[[], bool],
        say: Say,
        inputs_only: bool = False,
    ) -> None:
        """Open `driver` of `configuration`; `stop` ends a motion, `say` calls a person.

        `inputs_only`: its inputs are watched, and nothing else is done.

        Raises:
            Refused: it gives no readings, or an interlock is open.
            DriverError: the device is unsuitable.
        """
        self._driver, self._clock, self._stop, self._say = driver, clock, stop, say
        self._configuration = configuration
        self._series: LiveSeries | None = None
        warning = configuration.lifecycle.warning_time
        self._machine = DriverMachine(
            driver, configuration.plant, clock, warning=warning, stop=stop, inputs_only=inputs_only
        )

    @property
    def time(self) -> float:
        """Time of the machine since it was opened, s."""
        return self._machine.time

    def obey(self, order: Order) -> object:
        """Do `order` and return its answer.

        Raises:
            WrongMachine, Refused: as the machine and the series.
            DriverError: the device failed; it is passive.
        """
        match order:
            case Swing(profile, ball):
                return self._armed().swing(profile, ball=ball)
            case LetIn():
                self._armed().let_in()
                return None
            case LockGuard():
                self._armed().lock()
                return None
            case ArmFor(bench):
                self._end_series()
                self._machine.make_passive()
                c = self._configuration
                self._series = LiveSeries(
                    self._driver,
                    c.driver.name,
                    bench,
                    self._clock,
                    c.lifecycle,
                    c.homing,
                    stop=self._stop,
                    say=self._say,
                )
                return None
        self._end_series()
        match order:
            case Run(segments, bounds):
                return self._machine.run(segments, bounds)
            case WatchInputs():
                return self._machine.watch(*order)
            case Vent(duration):
                return self._machine.vent(duration)
            case BePassive():
                self._machine.make_passive()
                return None

    def hold(self) -> None:
        """Go on for one tick as the last order left the machine."""
        if self._series is None:
            self._machine.hold()
        else:
            self._series.hold()

    def close(self) -> None:
        """Bring the robot to rest, be passive, and close the device."""
        try:
            self._end_series()
        finally:
            for _ in range(3):  # a frame on a bus may be lost
                self._machine.make_passive()
            self._driver.close()

    def _armed(self) -> LiveSeries:
        if self._series is None:
            raise ValueError("a swing of a robot that is not armed")
        return self._series

    def _end_series(self) -> None:
        series, self._series = self._series, None
        if series is not None:
            series.end()
