"""`golfbench run`: the supervisor of one bench. It starts and monitors the processes and answers commands.

Nothing here runs in real time. The loop makes all safety decisions; the supervisor sends it heartbeats,
permissions and requests.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from typing import Any

import numpy as np

from bench.base.errors import BenchError, ExitCode
from bench.base.interrupt import StopFlag, stop_on_signals
from bench.base.lifecycle import (
    CAUSE_TEXT,
    LATCHED,
    MOVING,
    Block,
    Cause,
    Phase,
    Reaction,
    Refusal,
    Request,
    State,
)
from bench.calibration.archive import calibration_of
from bench.config import Configuration
from bench.design.static_checks import beyond_range
from bench.loop.snapshot import SNAPSHOT
from bench.network.bench_service import (
    BAR_HOMING,
    ArmingBlock,
    BenchStatus,
    CommandAnswer,
    DeviceStatus,
    LaunchMonitorStatus,
    LeaseStatus,
    LoopStatus,
    ProcessStatus,
    refused,
)
from bench.network.command_plane import CommandPlane
from bench.network.lease import Lease
from bench.network.status_words import block_text
from bench.network.zenoh_session import close_session, open_daemon
from bench.records.shot.recorded_shot import FlightConditions
from bench.records.shot.shot_message import ShotJoin, shot_publication
from bench.records.telemetry.swing_metadata import run_id, versions
from bench.supervisor._loop_link import LoopLink
from bench.supervisor._timing_record import TimingReader, summary
from bench.supervisor.child_process import (
    TIMING_FILE,
    Child,
    LaunchMonitorPlan,
    LoopPlan,
    ManagedProcess,
    PublisherPlan,
    RecorderPlan,
)
from bench.supervisor.ownership import Ownership, take_bench
from bench.supervisor.readiness import arming_block, assess, assess_bench
from bench.supervisor.status import (
    BEFORE,
    NO_LAUNCH_MONITOR,
    RunMarker,
    cause_text,
    disarmed_for,
    notify_service,
    stall_note,
    status_of,
    supervisor_note,
    watchdog_interval,
)
from bench.swing.correction import basis_of, digest_of
from drivers.launch_monitor.open_connect import club_code

_log = logging.getLogger("golfbench")

_TURN = 0.01
"""Period of the supervisor, s."""
_LOOP_SILENCE = 0.5
"""Time without a tick after which the loop counts as frozen, s."""
_REOPENING = 30.0
"""Time that the loop may take to reopen a device that went passive, s; it moves nothing meanwhile."""
_START = 240.0
"""Startup time-out of a process, s: the first start compiles."""
_STOP_TIMEOUT = 20.0
"""Time-out of the loop for bringing the robot to rest and ending, s."""
_RECORDED = 65.0
"""Time that the longest record may take, s; at 1 kHz 40 MB of memory."""
_STATISTICS = 1.0
"""Period of the loop statistics, s."""


class LoopDied(BenchError):
    """The loop ended unexpectedly."""

    exit_code = ExitCode.DEVICE


class Daemon:
    """A running bench: a `BenchService`, and `run`, which ends when asked to stop."""

    def __init__(
        self,
        configuration: Configuration,
        *,
        read_only: bool = False,
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        """Load profile and calibration; `now` returns the date and time (UTC).

        A bench that cannot be armed starts all the same: its status and its answers give the reasons.

        Raises:
            BenchError: the profile or the calibration is invalid.
        """
        self._now, self.read_only = now, read_only
        self._nominal = configuration
        """Configuration without calibrations."""
        self._readiness = assess_bench(configuration, now(), running=True)
        self.calibration, self.profile = self._readiness.calibration, self._readiness.profile
        self.configuration = self._readiness.configuration
        self._blocks = self._readiness.blocks(now())
        for replaced in self._readiness.replaced:
            _log.info(replaced.text)
        for note in self._readiness.warnings:
            _log.warning(note)
        for block in self._blocks:
            _log.warning("arming blocked: %s", block_text(block))
        self._basis, self._profile_digest = basis_of(self.profile), digest_of(self.profile)
        self.wall = not configuration.driver.paced
        """Whether the loop runs in wall-clock time."""
        self.children: dict[str, Child] = {}
        self._run = run_id(now())
        self._support: list[ManagedProcess] = []
        self._launch_monitor: ManagedProcess | None = None
        self._monitored: LaunchMonitorStatus = NO_LAUNCH_MONITOR
        self._shots = ShotJoin()
        self._drift: list[str] = []
        """Warnings of the latest swing's record."""
        self._held: Callable[[], Lease | None] = lambda: None  # requests may come before the plane is bound
        self._real_time: dict[str, Any] = {}
        self._device = DeviceStatus(fault="", counters={})
        self._swings = 0
        self._stall = ""
        self._explain: Callable[[str], str] = lambda fault: ""
        """Explains the last stop by the device's fault, which may be known later."""
        self._disarmed = Cause.NONE
        """Cause of disarming since the last motion."""
        self._lease: LeaseStatus | None = None
        """Lease as last reported."""
        self._ending = False
        self._started = time.monotonic()

    # Commands ------------------------------------------------------------------------------------

    def request(self, request: Request, is_late: Callable[[], bool]) -> CommandAnswer:
        """Send `request` to the loop and wait for its answer; one that is not ready does not move.

        The database may delay the check of the readiness: a request that `is_late` then is refused.
        """
        if request in (Request.ARM, Request.HOME):
            self._blocks = self._assess_again()
            barred = set(Block) if request is Request.ARM else BAR_HOMING
            if blocks := [block for block in self._blocks if block["code"] in barred]:
                word = "arming" if request is Request.ARM else "homing"
                fact = f"{word} blocked: {'; '.join(map(block_text, blocks))}"
                content = {"arming_blocks": blocks}
                return refused(self._link.state, Refusal.BLOCKED, fact)._replace(content=content)
        if is_late():
            return refused(self._link.state, Refusal.TOO_LATE)
        self._grant()  # a lease taken since the last turn counts for this request
        return self._link.request(request)

    def _assess_again(self) -> list[ArmingBlock]:
        """Return what blocks arming with the calibrations in force now; the loop keeps those of its start."""
        now, before = self._now(), self._readiness
        try:
            calibration = calibration_of(self._nominal, now)
            if calibration.entries == before.calibration.entries:
                self._readiness = replace(before, calibration=calibration)
            else:
                self._readiness = assess(self._nominal, calibration, self.profile, before.file, running=True)
        except BenchError as error:
            return [arming_block(Block.UNREADABLE, error)]
        blocks = self._readiness.blocks(now)
        if self._readiness.configuration.plant != self.configuration.plant:
            blocks.append(
                ArmingBlock(
                    code=Block.CALIBRATION_NOT_LOADED,
                    location=f"calibrations of bench {self.configuration.bench.id}",
                    found=f"{calibration.summary()}, since the start",
                    expected=f"{self.calibration.summary()}, as the loop was started with",
                    action="Restart the bench: golfbench run.",
                )
            )
        return blocks

    def correct(self, profile: str, weights: Sequence[float]) -> CommandAnswer:
        """Apply a correction learned for this profile from now on; without weights none."""
        if profile != self._profile_digest:
            return self._not_corrected("learned for another profile, or another version of it")
        if len(weights) not in (0, self._basis.size):
            return self._not_corrected(f"{len(weights)} weights, expected {self._basis.size}")
        if weights and self.configuration.control.feed_forward != "planned":
            action = 'set control.feed_forward = "planned"'
            return self._not_corrected("corrections need planned openings", action)
        if weights:
            corrected = self._basis.corrected(self.profile, weights)
            if beyond := beyond_range(corrected, self.configuration.plant, self.configuration.envelope):
                return self._not_corrected(f"corrected, {beyond}", "learn again on a better model")
        return self._link.correct(weights)

    def _not_corrected(self, fact: str, action: str = "") -> CommandAnswer:
        return refused(self._link.state, Refusal.CORRECTION, fact, action)

    def stop(self, request: Request) -> CommandAnswer:
        """Stop according to the stopping table, or as with an open emergency stop circuit."""
        return self._link.stop(request)

    def status(self) -> BenchStatus:
        """Return the status; the command plane adds `lease` and `counts`."""
        children = [("loop", self.children["loop"], "")]
        children += [(one.name, one.child, one.note) for one in self._attending if one.child is not None]
        return status_of(
            self._link.newest(),
            self._stall,
            self._disarmed,
            bench=self.configuration.bench.id,
            swings=self._swings,
            drift=self._drift,
            wear=self._marker.wear,
            read_only=self.read_only,
            driver=self.configuration.driver.name,
            profile=self.profile.name,
            correction=self._link.correction,
            club=self.configuration.swing.club,
            series=self.configuration.lifecycle.hold_between_swings,
            arming_blocks=self._blocks,
            readiness_warnings=[*self._readiness.warnings, *filter(None, [self._marker.wear_fault])],
            support_ready=self._support_ready,
            launch_monitor=self._launch_monitor_status(),
            processes={
                name: ProcessStatus(pid=child.pid, alive=child.alive, note=child.ending or note)
                for name, child, note in children
            },
            device=self._device,
            loop=self._statistics,
            real_time=self._real_time,
            last_stop=self._marker.last_stop,
            uptime=time.monotonic() - self._started,
        )

    @property
    def _support_ready(self) -> bool:
        return bool(self._support) and all(supporter.ready for supporter in self._support)

    @property
    def _attending(self) -> list[ManagedProcess]:
        """All processes except the loop; arming does not depend on the launch monitor's."""
        return [*self._support, *filter(None, [self._launch_monitor])]

    def _launch_monitor_status(self) -> LaunchMonitorStatus | None:
        """Return the last status of the launch monitor process; not listening while it is not ready."""
        process, reported = self._launch_monitor, self._monitored
        if process is None or process.ready:
            return None if process is None else reported
        note = reported["note"] or process.note
        return {**reported, "listening": "", "present": False, "monitors": [], "note": note}

    # The run -------------------------------------------------------------------------------------

    def run(self, ready: Callable[[], None] = lambda: None) -> None:
        """Start all processes, run until SIGTERM or Ctrl-C, then bring the robot to rest and shut down.

        `ready` is called once commands are answered, and recorder and publisher work or have failed.

        Raises:
            BenchError: a process did not start, or the loop died (LoopDied).
        """
        c = self.configuration
        with ExitStack() as stack:
            stop = stack.enter_context(stop_on_signals())
            owner = stack.enter_context(take_bench(c.bench.id))
            self._marker = RunMarker(c.bench.data_dir, c.bench.id)
            clean = False
            stack.callback(lambda: self._marker.end(clean=clean))
            self._marker.begin(os.getpid(), self._now().isoformat())
            try:
                self._start(stack, owner)
                self._live(stop, ready)
                notify_service("STOPPING=1")
                self._bring_to_end()
                clean = True
            except Exception:
                clean = "loop" not in self.children  # nothing could move yet
                raise

    def _start(self, stack: ExitStack, owner: Ownership) -> None:
        """Start the loop, open the command plane, then start recorder and publisher."""
        c, folder = self.configuration, owner.folder
        self._link = LoopLink(folder)
        stack.callback(self._link.close)
        stack.callback(self._kill_all)
        first = Cause.RESTART if self._marker.was_killed else Cause.POWER_UP
        loop = Child.start(
            "loop",
            "bench.supervisor.loop_process",
            LoopPlan(
                c,
                self.profile,
                self._basis,
                folder,
                owner.descriptor,
                first,
                self.read_only,
                self.calibration.shifts,
            ),
            pass_fds=(owner.descriptor,),
        )
        self.children["loop"] = loop
        owner.note_loop(loop.pid)
        report = loop.wait_until_ready(_START)
        self._real_time = report["real_time"]
        _log.info("the loop is ready, a tick takes %.0f us", 1e-3 * report["tick_ns"])
        self._link.connect()
        self._timing = TimingReader(folder / TIMING_FILE)
        self._before_timing = self._timing.snapshot()
        self._advanced = self._turned = time.monotonic()
        self._summed_up = -np.inf
        self._sum_up(self._turned)
        self._turn_gap = 0.0
        self._reopening_until = -np.inf
        self._before = State.STARTING, Phase.STANDING, Reaction.NONE, Cause.NONE
        session = open_daemon(c.network)
        stack.callback(close_session, session)
        self._plane = CommandPlane(session, c.bench.id, self)
        self._held = self._plane.lease
        stack.callback(self._plane.close)
        self._support = [
            ManagedProcess("recorder", folder, self._start_recorder, self._note_record),
            ManagedProcess("publisher", folder, self._start_publisher),
        ]
        if c.launch_monitor.enabled:
            self._launch_monitor = ManagedProcess(
                "launch monitor", folder, self._start_launch_monitor, self._note_launch
            )
        self._folder = folder

    def _start_recorder(self) -> Child:
        c = self.configuration
        plan = RecorderPlan(
            data_dir=c.bench.data_dir,
            folder=self._folder,
            snapshot_dtype=SNAPSHOT,
            profile=self.profile,
            basis=self._basis,
            run={
                "bench": c.bench.id,
                "run": self._run,
                "configuration": c.effective(),
                "versions": versions(),
                "real_time": self._real_time,
                "calibrations": self.calibration.record(),
            },
            plant=None if c.launch_monitor.enabled else c.plant,
            around=FlightConditions(c.air, c.wind, c.turf),
            wall=self.wall,
            room=round(_RECORDED * c.loop.rate),
        )
        return Child.start("recorder", "bench.supervisor.recorder", plan, plain=True)

    def _start_publisher(self) -> Child:
        c = self.configuration
        plan = PublisherPlan(bench=c.bench.id, network=c.network, folder=self._folder, wall=self.wall)
        return Child.start("publisher", "bench.supervisor.publisher", plan)

    def _start_launch_monitor(self) -> Child:
        c = self.configuration
        plan = LaunchMonitorPlan(
            run=self._run,
            folder=self._folder,
            settings=c.launch_monitor,
            plant=c.plant,
            around=FlightConditions(c.air, c.wind, c.turf),
            club=c.launch_monitor.club or club_code(c.swing.club),
            wall=self.wall,
        )
        return Child.start("launch monitor", "bench.supervisor.launch_monitor", plan, plain=True)

    def _live(self, stop: StopFlag, ready: Callable[[], None]) -> None:
        """Run until asked to stop; reset systemd's watchdog only while the loop advances.

        Raises:
            LoopDied: the loop ended or froze.
        """
        interval, notified = watchdog_interval(os.environ, os.getpid()), -np.inf
        latest: float | None = time.monotonic() + _START
        while not stop.wait(_TURN):
            now = time.monotonic()
            self._turn_gap, self._turned = now - self._turned, now
            self._turn(now)
            if latest is not None and (now > latest or not any(s.starting for s in self._support)):
                latest = None
                notify_service(f"READY=1\nSTATUS=bench {self.configuration.bench.id}: {self._link.state}")
                ready()
            if interval is not None and now - notified >= interval / 3 and self._advanced == now:
                notify_service("WATCHDOG=1")
                notified = now

    def _turn(self, now: float) -> None:
        for supporter in self._attending:
            supporter.turn(now)
        self._grant()
        self._tell_lease()
        self._watch_loop(now)
        if now - self._summed_up >= _STATISTICS:
            self._marker.look_for_wear()
            self._sum_up(now)
        for message in self._shots.take(now):
            self._plane.publish_shot(message)
        self._plane.publish_state(self.status())

    def _grant(self) -> None:
        """Send heartbeat and permissions to the loop."""
        lease = self._held()
        self._link.beat(lease=0 if lease is None else lease.number, support_ready=self._support_ready)

    def _tell_lease(self) -> None:
        """Publish that the lease lapses soon, or that it has ended."""
        before, self._lease = self._lease, self._plane.lease_status()
        if before is not None and self._lease is None:
            self._plane.publish_event("lease ended", holder=before["holder"])
        elif self._lease is not None and self._lease["lapsing"] and not (before and before["lapsing"]):
            _log.warning("the lease of %s lapses soon", self._lease["holder"])
            left = self._lease["seconds_left"]
            self._plane.publish_event("lease lapses", holder=self._lease["holder"], seconds_left=left)

    def _sum_up(self, now: float) -> None:
        """Take the loop statistics since the last call."""
        after = self._timing.snapshot()
        timing, seconds = summary(after, self._before_timing), now - self._summed_up
        self._before_timing, self._summed_up = after, now
        wake, tick = timing["segments"]["wake_up"], timing["segments"]["tick"]
        self._statistics = LoopStatus(
            rate_hz=timing["ticks"] / seconds,
            skipped=int(after["skipped"][0]),
            late=int(after["late"][0]),
            page_faults=int(after["page_faults"][0]),
            preemptions=int(after["preemptions"][0]),
            stalls=summary(after)["stalls"],
            wake_p50_s=1e-6 * (wake["p50_us"] or 0.0),
            wake_p99_s=1e-6 * (wake["p99_us"] or 0.0),
            tick_p99_s=1e-6 * (tick["p99_us"] or 0.0),
        )

    def _watch_loop(self, now: float) -> None:
        """Process the loop's records and events since the last turn.

        Raises:
            LoopDied: it ended, or was killed because it froze.
        """
        cycles = self._link.news()
        if len(cycles):
            self._advanced = now
            self._note_changes(cycles)
        loop = self.children["loop"]
        for event in loop.take_events():
            if event["event"] == "exception":
                _log.error("the loop: %s", event["text"])
                self._plane.publish_event("exception", text=event["text"])
            elif event["event"] == "device":
                self._device = DeviceStatus(fault=event["fault"], counters=event["counters"])
                self._link.fault = event["fault"]
                self._stall = self._explain(event["fault"]) or self._stall
            elif event["event"] == "reopening":
                self._reopening_until = now + _REOPENING
            elif event["event"] == "reopened":
                self._reopening_until = -np.inf
        if now < self._reopening_until:
            self._advanced = now
        if self._ending:
            return  # unlocking its memory stalls it longer than allowed otherwise
        if not loop.alive:
            raise self._loop_died(loop.ending)
        if now - self._advanced > _LOOP_SILENCE:
            loop.kill()
            raise self._loop_died(f"froze for {now - self._advanced:.1f} s and was killed")

    def _loop_died(self, how: str) -> LoopDied:
        state, phase, _, _ = self._before
        text = f"the loop {how} in state {state.name}, phase {phase.name}"
        self._marker.note_stop(self._stop_entry("RESTART", text, state, phase), fatal=True)
        self._plane.publish_event("loop died", text=text)
        return LoopDied(
            f"bench {self.configuration.bench.id}: loop",
            f"it {how}; state {state.name}, phase {phase.name}",
            "a running loop; the device went passive by its watchdog",
            "Check the robot, then restart the bench: it starts in ESTOP.",
        )

    def _note_changes(self, cycles: np.ndarray[Any, Any]) -> None:
        """Log and publish every change of state, phase, reaction and cause in `cycles`."""
        keys = np.stack([cycles[name] for name in ("state", "phase", "reaction", "cause")], axis=1)
        before = np.vstack([np.array([self._before], dtype=keys.dtype), keys[:-1]])
        for k in np.flatnonzero(np.any(keys != before, axis=1)):
            old = self._before
            s, p, r, c = keys[k].tolist()
            state, phase, reaction, cause = State(s), Phase(p), Reaction(r), Cause(c)
            self._before = state, phase, reaction, cause
            if cause is not old[3]:
                envelope, period = self.configuration.envelope, 1.0 / self.configuration.loop.rate
                last = cycles[max(k - BEFORE, 0) : k + 1].copy()
                self._explain = partial(stall_note, last, cause, envelope.encoder_timeout, period)
                self._stall = self._explain(self._device["fault"])
                gap = max(self._turn_gap, time.monotonic() - self._turned)
                silence = self.configuration.lifecycle.supervisor_timeout
                self._stall = self._stall or supervisor_note(cause, gap, silence)
                if self._stall:
                    _log.warning("%s: %s", cause.name, self._stall)
            if state is State.SWINGING and old[0] is not State.SWINGING:
                self._swings += 1
            if state is not old[0] or cause is not old[3] or reaction is not old[2]:
                _log.info(
                    "%s, phase %s, reaction %s, cause %s", state.name, phase.name, reaction.name, cause.name
                )
            if state in MOVING and old[0] not in MOVING:
                self._disarmed = Cause.NONE
            elif found := disarmed_for(
                cycles[k], old[0], series=self.configuration.lifecycle.hold_between_swings
            ):
                self._disarmed = found
                _log.warning("%s: %s", found.name, CAUSE_TEXT[found])
            self._marker.note_state(state.name, phase.name)
            self._plane.publish_event(
                "change",
                state=state.name,
                phase=phase.name,
                reaction=reaction.name,
                cause=(cause or self._disarmed).name,
                tick=int(cycles["tick"][k]),
                loop_time=float(cycles["time"][k]),
            )
            if state in LATCHED and cause not in (Cause.NONE, old[3], Cause.POWER_UP, Cause.RESTART):
                self._marker.note_stop(
                    self._stop_entry(cause.name, cause_text(cause, self._stall), old[0], old[1])
                )

    def _stop_entry(self, cause: str, text: str, state: State, phase: Phase) -> dict[str, Any]:
        return {
            "cause": cause,
            "text": text,
            "state": state.name,
            "phase": phase.name,
            "time_utc": self._now().isoformat(),
        }

    def _note_record(self, event: dict[str, Any]) -> None:
        if event["event"] != "stored" or event["kind"] != "swing":
            return
        self._drift = event["warnings"]
        for text in self._drift:
            _log.warning("swing %s: %s", event["number"], text)
        known = ("number", "tick", "lost_records", "complete", "replayable", "cause")
        facts = {name: event[name] for name in known} | {"record": os.path.abspath(event["path"])}
        if (shot := event["shot_id"]) is not None:
            self._shots.note_record(shot, facts)
        self._plane.publish_shot(shot_publication(shot_id=shot, shot=event["shot"], **facts))

    def _note_launch(self, event: dict[str, Any]) -> None:
        """Store the launch monitor's status, or queue the outcome of a swing or launch for publishing."""
        if event["event"] == "link":
            self._monitored = event["link"]
        elif event["event"] == "shot":
            self._shots.note_outcome(event["message"], time.monotonic())

    def _bring_to_end(self) -> None:
        """Let the loop bring the robot to rest, then stop the other processes in the order of the data flow.

        Raises:
            LoopDied: the loop did not end in time.
        """
        self._link.shut_down()
        for supporter in self._attending:
            supporter.stop_restarting()
        loop, deadline = self.children["loop"], time.monotonic() + _STOP_TIMEOUT
        self._ending = True
        while loop.alive and time.monotonic() < deadline:
            self._turn(time.monotonic())
            time.sleep(_TURN)
        if loop.ending != "ended with exit code 0":
            loop.kill()
            raise self._loop_died(loop.ending)
        for supporter in self._attending:
            supporter.end()

    def _kill_all(self) -> None:
        for supporter in self._attending:
            supporter.end()
        for child in self.children.values():
            child.kill()
