"""The configuration of a bench as values: its own settings, and those of plant, drivers and control."""

from __future__ import annotations

import logging
import re
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import datetime
from math import pi, radians
from pathlib import Path
from typing import Annotated, Any, Literal

from bench.base.address import BenchSettings, NetworkSettings
from bench.base.errors import BenchError
from bench.base.from_toml import format_value
from bench.base.json_schema import json_value
from bench.control.residual_thresholds import LimitsFingerprint, LimitsInUse, limits_in_use, limits_path
from bench.control.settings import (
    ControlSettings,
    EnvelopeSettings,
    EstimatorSettings,
    HomingSettings,
    LifecycleSettings,
)
from bench.swing.profile import Profile
from drivers.base.ranges import Range
from drivers.canopen.settings import CanopenSettings
from drivers.daq.settings import DaqSettings
from drivers.launch_monitor.settings import LaunchMonitorSettings
from sim.ball import Air, Ball
from sim.faults import Fault
from sim.flight import Wind
from sim.ground import Turf
from sim.plant import PlantParameters, Site
from sim.robot import Club

_log = logging.getLogger("golfbench")
_PASSWORD = re.compile(r"(//[^:/@]*:)[^/]*@")


@dataclass(frozen=True)
class LoopSettings:
    """The control loop."""

    rate: Annotated[float, Range(100.0, 5000.0, "Hz")]
    """Rate of the control loop; one tick of the simulated plant is its inverse."""
    realtime: Literal["off", "prefer", "require"]
    """Real-time scheduling: "off"; "prefer": ask for it; "require": refuse to run without."""
    priority: Annotated[int, Range(1, 98, "")]
    """Priority of SCHED_FIFO: above the kernel's threaded interrupts (50), below its watchdogs (99)."""
    cpu: Annotated[int, Range(-1, 1023, "")]
    """Core of the loop; -1: any."""


@dataclass(frozen=True)
class DriverSettings:
    """The driver, which connects the loop with robot or simulation."""

    name: str
    """Driver: "sim", the simulated plant; "canopen", "daq", hardware; "mock", whose valves move the joints at
    once; or the name of a plug-in."""
    watchdog: Annotated[float, Range(0.005, 0.5, "s")]
    """Time without a command after which the device goes passive automatically (s)."""

    @property
    def paced(self) -> bool:
        """Whether a simulated plant runs in step with the loop's ticks; else ticks follow the wall clock."""
        return self.name == "sim"


@dataclass(frozen=True)
class SwingSettings:
    """Profile, club and ball that are used unless a command names others."""

    profile: str
    """Name of a profile that comes with golfbench, or a path."""
    club: str
    """Key of [clubs]."""
    ball: str
    """Key of [balls]."""


@dataclass(frozen=True)
class NotificationSettings:
    """Notifications of campaigns that wait for a person, are suspended or finish."""

    file: str = ""
    """File of the services' URLs, one a line, readable by its owner only; empty: no notifications."""


@dataclass(frozen=True)
class ClubSite(Site):
    """A site that holds for one club, with the tilt of the robot's mount that it asks for."""

    plane: Annotated[float, Range(radians(20.0), pi / 2, "rad")] = radians(53.0)
    """Swing plane to the ground (rad), set at the robot's mount; gravity in the plane follows it."""

    @classmethod
    def of(cls, plant: PlantParameters) -> ClubSite:
        """Return where `plant` stands."""
        return cls(**{f.name: getattr(plant.site, f.name) for f in fields(Site)}, plane=plant.robot.lie)

    def applied_to(self, plant: PlantParameters) -> PlantParameters:
        """Return `plant` on this site, in this plane."""
        site = Site(**{f.name: getattr(self, f.name) for f in fields(Site)})
        return replace(plant, robot=replace(plant.robot, lie=self.plane), site=site)


def _clubs() -> dict[str, Club]:
    return {club.name: club for club in (Club.driver(), Club.thesis())}


def _watched() -> EnvelopeSettings:
    return EnvelopeSettings().with_model_check("simulated")


@dataclass(frozen=True, kw_only=True)
class Configuration:
    """A checked configuration, SI and radians."""

    bench: BenchSettings
    loop: LoopSettings
    driver: DriverSettings
    canopen: CanopenSettings = field(default_factory=CanopenSettings)
    daq: DaqSettings = field(default_factory=DaqSettings)
    launch_monitor: LaunchMonitorSettings = field(default_factory=LaunchMonitorSettings)
    network: NetworkSettings
    notifications: NotificationSettings = field(default_factory=NotificationSettings)
    swing: SwingSettings
    plant: PlantParameters = field(default_factory=PlantParameters)
    """The simulated plant, with club and ball of `swing` and the loop's period as its tick."""
    control: ControlSettings = field(default_factory=ControlSettings)
    lifecycle: LifecycleSettings = field(default_factory=LifecycleSettings)
    homing: HomingSettings = field(default_factory=HomingSettings)
    envelope: EnvelopeSettings = field(default_factory=_watched)
    estimator: EstimatorSettings = field(default_factory=EstimatorSettings)
    clubs: dict[str, Club] = field(default_factory=_clubs)
    sites: dict[str, ClubSite] = field(default_factory=dict)
    """Sites of clubs by their key in `clubs`; a club without one stands on plant.site."""
    balls: dict[str, Ball] = field(default_factory=lambda: {"tour": Ball(name="tour")})
    air: Air = field(default_factory=Air)
    wind: Wind = field(default_factory=Wind)
    turf: Turf = field(default_factory=Turf)
    faults: dict[str, Fault] = field(default_factory=dict)
    """Faults of the simulated robot, by name."""
    files: tuple[Path, ...] = field(default=(), compare=False)
    """Files it was read from, the base first."""

    def plant_with(self, *, club: str | None = None, ball: str | None = None) -> PlantParameters:
        """Return the plant with another club or ball, with ground and ball height for that club.

        Raises:
            BenchError: none has that name.
        """
        plant = self.plant
        if club is not None:
            plant = self.plant_of(club, _choice(self, "clubs", club))
        return plant if ball is None else replace(plant, ball=_choice(self, "balls", ball))

    def with_club(self, name: str | None) -> Configuration:
        """Return the configuration with the club called `name` mounted, on its site; None keeps the club.

        Raises:
            BenchError: none has that name.
        """
        if name is None:
            return self
        return replace(self, plant=self.plant_with(club=name), swing=replace(self.swing, club=name))

    @property
    def site_key(self) -> str:
        """Key of the site of the mounted club, for messages."""
        return f"plant.site or sites.{self.swing.club}" if self.sites else "plant.site"

    def tee_of(self, club: str) -> tuple[float, float]:
        """Return the place (m) of the tee for the club called `club`; "" is the mounted one."""
        site = self.sites.get(club, self.plant.site)
        return site.ball_x, site.ball_y

    def plant_of(self, name: str, club: Club) -> PlantParameters:
        """Return the plant with `club` on the site of the club called `name`."""
        plant = replace(self.plant, robot=replace(self.plant.robot, club=club))
        return self.sites[name].applied_to(plant) if name in self.sites else plant

    def with_driver(self, driver: DriverSettings) -> Configuration:
        """Return the configuration with another driver, and its consequences.

        The model's limits are the simulated plant's: with any other driver that check is off, unless it is
        "always".
        """
        envelope = self.envelope
        if driver.name != "sim" and envelope.model.check == "simulated":
            envelope = envelope.with_model_check("off")
        return replace(self, driver=driver, envelope=envelope)

    def running(self) -> Configuration:
        """Return the configuration of a running bench.

        A plant on a separate clock follows commands a fraction of a tick earlier or later than the model
        assumes. The model's limits do not allow for this.
        """
        if self.driver.paced or self.envelope.model.check != "simulated":
            return self
        return replace(self, envelope=self.envelope.with_model_check("off"))

    def limits_files(self, profile: Path) -> tuple[Path, ...]:
        """Return where limits for the model-based check of the profile in file `profile` are looked for."""
        beside = limits_path(profile)
        return beside, self.bench.data_dir / "limits" / beside.name

    def limits_in_use(self, profile: Profile, file: Path) -> LimitsInUse:
        """Return the limits of the model-based check for `profile`, read from `file`.

        Raises:
            BenchError: a file of limits is invalid.
        """
        bench = LimitsFingerprint.of(profile, self.plant, self.control, self.envelope, self.estimator)
        return limits_in_use(self.envelope.model, bench, self.limits_files(file))

    def for_profile(self, profile: Profile, file: Path) -> Configuration:
        """Return the configuration with the limits of the model-based check for `profile`, read from `file`.

        Outdated limits are ignored; the log reports them.

        Raises:
            BenchError: a file of limits is invalid.
        """
        if self.envelope.model.check == "off":
            return self
        found = self.limits_in_use(profile, file)
        if found.stale:
            _log.warning("model-based check of %s: %s", profile.name, found.source)
        return replace(self, envelope=replace(self.envelope, model=found.settings))

    @property
    def commissioned(self) -> datetime | None:
        """Time at which the robot was commissioned; None if it never was."""
        text = self.bench.commissioned
        return datetime.fromisoformat(text) if text else None

    @property
    def is_machine(self) -> bool:
        """Whether something real moves; a bus of processes of this machine has only simulated nodes on it."""
        if self.driver.name == "canopen":
            return self.canopen.interface != "local_socket"
        return self.driver.name not in {"sim", "mock"}

    def driver_arguments(self) -> dict[str, Any]:
        """Return the keyword arguments that the factory of the driver `driver.name` takes."""
        settings = {"canopen": self.canopen, "daq": self.daq}.get(self.driver.name)
        if settings is None:
            return {}
        return {
            "settings": settings,
            "period": 1.0 / self.loop.rate,
            "watchdog": self.driver.watchdog,
            "counts_per_revolution": self.plant.encoders.counts_per_revolution,
        }

    def effective(self) -> dict[str, Any]:
        """Return all values nested as in the file, SI and radians, for records and reports; no password."""
        shown_here = replace(self.bench, database=_PASSWORD.sub(r"\1***@", self.bench.database))
        return {name: json_value(value) for name, value in asdict(replace(self, bench=shown_here)).items()}


def _choice(c: Configuration, section: str, name: str) -> Any:
    entries = getattr(c, section)
    if name in entries:
        return entries[name]
    files = ", ".join(map(str, c.files))
    raise BenchError(
        f"{files}: {section}", f"no {format_value(name)}", f"one of {', '.join(entries)}", "Add or rename it."
    )
