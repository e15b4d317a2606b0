"""`golfbench demo --engine python|compiled`: the demo in lock-step, in this process and ten times as fast.

A swing of the simulated robot repeats bit for bit. So that the report has something to judge, small
things differ from shot to shot as they do on a real bench; they are drawn from a seed and named.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import islice
from math import degrees
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.campaign.report import Setup, write_report
from bench.campaign.shot_table import write_shot_table
from bench.config import Configuration
from bench.demonstration.screen import Screen
from bench.errors import BenchError, Refused
from bench.interrupt import deferred_interrupt
from bench.shot.shot_record import ShotRecord
from bench.simulate import Engine, SimulatedBench, Surroundings, SwingResult, simulate_swing, simulate_swings
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from bench.swing.validate import require_possible
from bench.telemetry.recorder import write_swing
from bench.viewer.recording import write_recording
from sim.ball import Ball


@dataclass(frozen=True)
class Scatter:
    """Standard deviations of what differs from shot to shot; assumptions, of the usual size."""

    supply: float = 0.001
    """Share of the supply's pressure: a pressure regulator's repeatability."""
    restitution: float = 0.001
    """Share of the ball's restitution: one ball of a box to the next."""
    encoders: float = 5e-6
    """rad, noise of a reading: a tenth of a count."""

    def __str__(self) -> str:
        """Return what differs, in words."""
        return (
            f"supply pressure {100 * self.supply:g} %, restitution of the ball {100 * self.restitution:g} %, "
            f"noise of the encoders {1e6 * self.encoders:g} µrad (standard deviations)"
        )


@dataclass(frozen=True)
class Series:
    """What is swung: the same club and profile at balls that take turns."""

    configuration: Configuration
    profile: Profile
    balls: tuple[Ball, ...]
    swings: int
    seed: int
    engine: Engine
    scatter: Scatter = field(default_factory=Scatter)

    @property
    def words(self) -> str:
        """Return what the series is, in a line."""
        balls = " and ".join(ball.name for ball in self.balls)
        return (
            f"{self.swings} simulated swings: {self.configuration.plant.robot.club.name}, "
            f"profile {self.profile.name}, {'balls' if len(self.balls) > 1 else 'ball'} {balls}"
        )

    def bench(self, number: int) -> SimulatedBench:
        """Return the bench as shot `number` (from 1) finds it: the same for the same seed."""
        c, scatter = self.configuration, self.scatter
        random = np.random.default_rng((self.seed, number))
        pressure, restitution = random.standard_normal(2)
        ball = self.balls[(number - 1) % len(self.balls)]
        factor = ball.restitution_factor * (1.0 + scatter.restitution * restitution)
        plant = replace(
            c.plant,
            ball=replace(ball, restitution_factor=factor),
            supply=replace(
                c.plant.supply, pressure=c.plant.supply.pressure * (1.0 + scatter.supply * pressure)
            ),
            encoders=replace(
                c.plant.encoders, noise=float(np.hypot(c.plant.encoders.noise, scatter.encoders))
            ),
            seed=int(random.integers(2**31)),
        )
        around = Surroundings(c.air, c.wind, c.turf)
        return SimulatedBench(
            self.profile, plant, c.control, c.envelope, c.estimator, around, engine=self.engine
        )

    def setup(self) -> Setup:
        """Return the head of the report."""
        c = self.configuration
        club, air = c.plant.robot.club, c.air
        names = ("golfbench", "numpy", "numba", "scipy", "filterpy", "rerun-sdk")
        facts = {
            "Series": "golfbench demo",
            "Bench": "simulation",
            "Club": f"{club.name}, {degrees(club.loft):.1f}°",
            "Profile": self.profile.name,
            "Seed": str(self.seed),
            "Air": f"{air.temperature - 273.15:.0f} °C, {air.pressure / 100:.0f} hPa, "
            f"{100 * air.relative_humidity:.0f} %",
        }
        return Setup(
            f"{' and '.join(ball.name for ball in self.balls)}: {club.name}, simulated robot",
            c.plant.robot,
            c.plant.site,
            c.plant.ball,
            facts,
            {name: version(name) for name in names} | {"python": platform.python_version()},
            c.effective(),
            (
                "Every figure is simulated: robot, air, impact and flight are models. Values that are "
                'assumptions are marked so in config.toml ("assumption"), beside the reason.',
                f"From shot to shot differ, drawn from seed {self.seed}: {self.scatter}.",
            ),
        )


class Files(NamedTuple):
    """What a demo leaves in its folder."""

    report: Path
    recording: Path
    shots: Path
    swings: Path

    @classmethod
    def within(cls, folder: Path) -> Files:
        """Return the files' paths in `folder`."""
        return cls(folder / "report.html", folder / "demo.rrd", folder / "shots.csv", folder / "swings")


def plan_series(configuration: Configuration, swings: int, seed: int, engine: Engine) -> Series:
    """Return a series with the configured club and profile, its ball and the next one in the file.

    Raises:
        BenchError: the profile cannot be read.
        ExceptionGroup: of BenchErrors, the reasons why it cannot be swung here.
    """
    path = find_profile(configuration.swing.profile)
    profile = load_profile(path)
    require_possible(profile, configuration.plant, configuration.envelope, str(path))
    first = configuration.plant.ball
    second = islice((ball for ball in configuration.balls.values() if ball.name != first.name), 1)
    return Series(configuration, profile, (first, *second), swings, seed, engine)


def run_demo(
    configuration: Configuration, output: Path | None, swings: int, seed: int, engine: Engine
) -> bool:
    """Check, swing, show and store; return whether every swing gave a valid shot.

    Shots are stored as they come. After a stop nothing arms again by itself: the series ends there. After
    Ctrl-C the shots so far and their table are stored whole, without report and recording.

    Raises:
        BenchError: the profile does not hold, or `output` cannot be used.
        ExceptionGroup: of BenchErrors, the reasons why the profile cannot be swung here.
        KeyboardInterrupt: Ctrl-C, after the robot was brought to rest and the files were written.
    """
    series = plan_series(configuration, swings, seed, engine)
    begin = datetime.now(UTC)
    files = Files.within(new_folder(output, configuration, begin))
    setup, records = series.setup(), list[ShotRecord]()
    with Screen(series.words, swings) as screen:
        screen.say("arming (the first time the model is compiled: half a minute)")
        list(simulate_swings(series.bench(1), []))
        files.swings.mkdir(parents=True, exist_ok=True)
        with deferred_interrupt() as asked:
            screen.say("swinging")
            for record in _shots(series, files.swings, asked.is_set):
                records.append(record)
                screen.add(record.shot)
            if records:
                write_shot_table(files.shots, [record.shot for record in records])
            if records and not asked.is_set():
                screen.say("writing the report")
                write_report(files.report, records, setup)
                screen.step()
                screen.say("writing the recording")
                write_recording(
                    files.recording,
                    records,
                    configuration.plant,
                    files.recording.parent.name,
                )
                screen.step()
            written = [path for path in files if path.exists()]
            rest = "brought to rest and its air let out; no report, no recording"
            stopped = f"Ctrl-C: the robot was {rest}" if asked.is_set() else ""
            screen.finish(str(series.scatter), seed, written, stopped)
    return len(records) == swings and all(record.valid for record in records)


def _shots(series: Series, folder: Path, stop: Callable[[], bool]) -> Iterator[ShotRecord]:
    """Swing and store shot by shot; a shot that ended in a stop is the last."""
    for number in range(1, series.swings + 1):
        bench = series.bench(number)
        try:
            result = simulate_swing(bench, stop=stop)
        except KeyboardInterrupt:  # while arming: there is no swing yet
            return
        record = _stored(series, number, bench, result, folder)
        yield record
        if result.cause or result.interrupted:
            return


def _stored(
    series: Series, number: int, bench: SimulatedBench, result: SwingResult, folder: Path
) -> ShotRecord:
    """Store the swing of shot `number` with all it was made with, and return it."""
    turns = len(series.balls)
    record = result.shot(
        number,
        block=1 + (number - 1) // turns,
        position=1 + (number - 1) % turns,
        time_utc=datetime.now(UTC),
    )
    shot = asdict(record.shot) | {"time_utc": record.shot.time_utc.isoformat()}
    notes = {
        "series": {"command": "demo", "seed": series.seed, "scatter": asdict(series.scatter)},
        "shot": shot,
    }
    write_swing(
        folder / f"{number:03d}.parquet", record.cycles, bench.metadata(notes | result.replay_metadata())
    )
    return record


def new_folder(output: Path | None, configuration: Configuration, begin: datetime) -> Path:
    """Return the folder to write to, which is made.

    Raises:
        Refused: there are files in it.
        BenchError: it cannot be made.
    """
    folder = output or configuration.bench.data_dir / f"demo-{begin:%Y%m%dT%H%M%SZ}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        used = any(folder.iterdir())
    except OSError as error:
        raise BenchError(
            str(folder),
            error.strerror or str(error),
            "a folder to write to",
            "Name another one with --output.",
        ) from error
    if used:
        raise Refused(str(folder), "files in it", "a new or empty folder", "Name another one with --output.")
    return folder
