"""The bench in the guest: golfbench's own units run by systemd, the simulated nodes on another card."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from math import ceil
from pathlib import Path

import numpy as np

from bench.base.lifecycle import Phase, State
from bench.calibration.archive import add_calibration
from bench.calibration.calibration import (
    BallPosition,
    ClubInMount,
    EncoderZeros,
    SeenInputs,
    Values,
    ValveCentres,
    wiring_digest,
)
from bench.config import Configuration, database_url, load_configuration
from bench.network.client import BenchClient, CommandRefused
from bench.records.telemetry.ring import RingReader
from bench.simulation.safety import pressure_shares, stop_shares
from bench.store.database import open_database
from bench.supervisor._timing_record import TimingReader
from bench.supervisor.child_process import RING_FILE, TIMING_FILE
from bench.supervisor.ownership import bench_folder
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile, save_profile
from drivers.base.shared_memory import SharedRecord
from sim.exchange import PLANT_REPORT, REPORT_FILE, SurroundingsWriter
from tests.vm.guest import CARDS, CONFIGURATIONS, NODES_FOLDER, SYSTEM, UNITS, configuration, run, say

UNIT = "golfbench@bench1"
CONFIG = CONFIGURATIONS / "bench1.toml"
SLOWER = 3
"""A sample in so many of the profile is kept: at 500 Hz the whole bench fills the guest's processor."""
RATE = 1000.0 / SLOWER
"""Hz."""
LONGEST = 120.0
"""Guest seconds that anything may take."""

_MORE = """[bench]
id = "bench1"
data_dir = "/var/lib/golfbench"
[lifecycle]
hold_between_swings = true
[swing]
profile = "{profile}"
"""
_AFTER_LINK = """[Unit]
Wants=golfbench-can@{link}.service
After=golfbench-can@{link}.service
"""


def install(link: str) -> Configuration:
    """Install the units as the manual states, configure the bench on `link`, calibrate it."""
    etc = Path("/etc")
    for unit in UNITS.glob("*.service"):
        shutil.copy(unit, SYSTEM)
    for kind in ("sysusers", "tmpfiles"):
        (etc / f"{kind}.d").mkdir(exist_ok=True)
        shutil.copy(UNITS / f"golfbench.{kind}", etc / f"{kind}.d/golfbench.conf")
    shutil.copy(UNITS / "golfbench.rules", etc / "udev/rules.d/60-golfbench.rules")
    if link in CARDS:
        more = SYSTEM / f"{UNIT}.service.d"
        more.mkdir()
        (more / "can.conf").write_text(_AFTER_LINK.format(link=link))
    profile = CONFIGURATIONS / "slower.toml"
    save_profile(profile, slower(load_profile(find_profile("default")), SLOWER))
    CONFIG.write_text(configuration(RATE, link) + _MORE.format(profile=profile))
    run("systemd-sysusers")
    run("systemd-tmpfiles", "--create", "golfbench.conf")
    run("udevadm", "control", "--reload")
    run("udevadm", "trigger", "--name-match=cpu_dma_latency", "--settle")
    run("systemctl", "daemon-reload")
    c = load_configuration(CONFIG)
    _calibrate(c)
    run("chown", "-R", "golfbench:golfbench", "/var/lib/golfbench", "/var/cache/golfbench")
    return c


def slower(profile: Profile, times: int) -> Profile:
    """Return the same swing for a loop that ticks `times` less often."""
    angle, spacing = profile.angle[::times], round(profile.blind_spacing / times)
    begun = np.arange(0, len(angle), spacing) * times  # samples of the profile at which a blind stop begins
    nearest = np.minimum(np.rint(begun / profile.blind_spacing).astype(int), len(profile.blind_brake) - 1)
    return replace(
        profile,
        period=times * profile.period,
        begins=tuple(ceil(begin / times) for begin in profile.begins),
        angle=angle,
        velocity=profile.velocity[::times],
        valve=profile.valve[::times],
        blind_spacing=spacing,
        blind_brake=profile.blind_brake[nearest],
    )


def _calibrate(c: Configuration) -> None:
    """Store the values that the configuration has: an interface of SocketCAN counts as a machine."""
    encoders, site, club = c.plant.encoders, c.plant.site, c.plant.robot.club
    now = datetime.now(UTC)
    values: tuple[Values, ...] = (
        EncoderZeros(
            encoders.zero_count,
            encoders.sign,
            encoders.counts_per_revolution,
            0.001,
            ("preset 0, offset 0",) * 3,
        ),
        BallPosition(site.ball_x, site.ball_y, 0.001),
        ClubInMount(club.name, club.length_to_face, club.loft, club.lie, 0.001, 0.001),
        ValveCentres((0.0, 0.0, 0.0), (0.02, 0.02, 0.02), 0.001),
        SeenInputs((), wiring_digest(c)),
    )
    with open_database(database_url(c.bench.database, c.bench.data_dir), now) as database:
        for value in values:
            add_calibration(
                database,
                c.bench.id,
                value,
                date=now,
                expires=now + timedelta(days=30),
                by="test",
                method="values of the simulated robot",
            )


class GuestBench:
    """The running bench: asked over the network, looked at in its shared memory."""

    def __init__(self, configuration: Configuration) -> None:
        """Attach to the bench, which runs."""
        self.configuration = configuration
        folder = bench_folder(configuration.bench.id)
        self.client = BenchClient.connect(configuration, timeout=10.0)
        self.ring = RingReader(folder / RING_FILE)
        self.timing = TimingReader(folder / TIMING_FILE)
        self._report = SharedRecord.open(NODES_FOLDER / REPORT_FILE, PLANT_REPORT)

    def close(self) -> None:
        """Close the connections."""
        self.client.close()
        self.ring.close()
        self._report.close()

    def report(self) -> np.void:
        """Return the plant's report."""
        record = np.zeros(1, PLANT_REPORT)
        self._report.read(record)
        found: np.void = record[0]
        return found

    def now(self) -> np.void:
        """Return the newest cycle record."""
        newest = self.ring.newest()
        if newest is None:
            raise RuntimeError("the loop has written nothing")
        record: np.void = newest[0]
        return record

    def wait_phase(self, phase: Phase, longest: float = 30.0) -> None:
        """Wait until the robot is in `phase`; looks 500 times a second."""
        deadline = time.monotonic() + longest
        while self.now()["phase"] != phase:
            if time.monotonic() > deadline:
                raise RuntimeError(f"not in {phase.name} but {self.words()}")
            time.sleep(0.002)

    def words(self) -> str:
        """Return state, phase and cause."""
        status = self.client.status()
        cause = status["cause"]
        return f"{status['state']}, {status['phase']}, {cause['name'] if cause else 'no cause'}"

    def take_address(self) -> None:
        """Come to the address from wherever it rests: reset, home and arm."""
        self.client.renew_lease()
        deadline = time.monotonic() + LONGEST
        while True:
            state, phase = State(int(self.now()["state"])), Phase(int(self.now()["phase"]))
            if state is State.ARMED and phase is Phase.HOLD:
                return
            if time.monotonic() > deadline:
                raise RuntimeError(f"not at the address but {self.words()}")
            asks: dict[State, Callable[[], object]] = {
                State.ESTOP: self.reset,
                State.FAULT: self.reset,
                State.SAFE: self.client.home,
                State.READY: self.client.arm,
            }
            if (ask := asks.get(state)) is not None:
                with suppress(CommandRefused):  # not vented yet, not at rest
                    ask()
            time.sleep(0.1)

    def reset(self) -> None:
        """Press the local reset button, then reset."""
        with SurroundingsWriter(NODES_FOLDER) as hand:
            for pressed in (False, True, False):
                hand.change(local_reset=pressed)
                time.sleep(0.1)
        self.client.reset()

    def swing(self) -> None:
        """Swing as soon as it rests at its address, with a ball on the tee."""
        deadline, said = time.monotonic() + LONGEST, ""
        while True:
            try:
                self.client.tee()
                self.client.swing()
                return
            except CommandRefused as refusal:
                if time.monotonic() > deadline or self.now()["state"] != State.ARMED:
                    raise
                if str(refusal) != said:
                    said = str(refusal)
                    say(f"swing: {said}")
                time.sleep(0.5)

    def stop_share(self) -> float:
        """Return the greatest energy that a stop has taken since the plant began, of its rating."""
        return float(stop_shares(self.report()["stop_energy"], self.configuration.plant).max())

    def pressure_share(self) -> float:
        """Return the greatest chamber pressure since the plant began, of its rating."""
        return float(pressure_shares(self.report()["peak_pressure"], self.configuration.plant).max())


@contextmanager
def alone_on_processor() -> Iterator[None]:
    """Run before loop and nodes: values counted meanwhile belong to one instant."""
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(90))
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def service(name: str, unit: str = UNIT) -> str:
    """Return a property of a unit."""
    return run("systemctl", "show", "--property", name, "--value", unit)


def journal(unit: str = UNIT) -> str:
    """Return the journal of a unit."""
    return run("journalctl", "--no-pager", "--output=cat", f"--unit={unit}")
