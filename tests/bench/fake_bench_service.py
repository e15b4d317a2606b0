"""A desk without a bench, and a command plane in front of it on a free port of the loopback."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import zenoh

from bench.base.address import free_port
from bench.base.lifecycle import ACCEPTED_IN, CAUSE_WORDS, Cause, Refusal, Request, State
from bench.config import Configuration, NetworkSettings, load_configuration, shipped_configuration
from bench.network.bench_service import (
    BenchStatus,
    CauseStatus,
    CommandAnswer,
    CountStatus,
    DeviceStatus,
    LoopStatus,
    ProcessStatus,
    refused,
)
from bench.network.command_plane import CommandPlane
from bench.network.zenoh_session import open_daemon
from bench.records.shot.recorded_shot import shot_to_json
from bench.records.shot.shot import Shot, ShotStatus
from bench.records.shot.shot_message import ShotPublication, shot_publication

NEXT = {
    Request.RESET: State.SAFE,
    Request.HOME: State.READY,
    Request.ARM: State.ARMED,
    Request.SWING: State.READY,
    Request.DISARM: State.READY,
    Request.ACCESS: State.ACCESS,
    Request.SECURE: State.SAFE,
    Request.TEE: State.ARMED,
}


class FakeDesk:
    """Changes state at once, and records its requests."""

    def __init__(self, state: State = State.ESTOP) -> None:
        self.state = state
        self.requests: list[Request] = []
        self.late: list[bool] = []
        """Whether each request was late after its wait; it is done all the same."""
        self.corrections: list[tuple[str, tuple[float, ...]]] = []
        self.stops: list[tuple[str, float]] = []
        self.free = threading.Event()
        """While it is clear, requests wait."""
        self.free.set()
        self.error: Exception | None = None
        self.sways = 0
        """Requests that are still refused because a joint moves."""
        self.vents = 0
        """Requests to arm or home that are still refused because a chamber shows pressure."""
        self.fills = 0
        """Requests to swing that are still refused because the chambers are not as planned."""
        self.refuse = Refusal.NONE
        """Why every request is refused."""
        self.armed_phase = "HOLD"
        """"RETURN" while the robot is on its way to the address."""
        self.publish_shot: Callable[[ShotPublication], None] = lambda message: None
        """Gets the shot of each swing, as the recorder stores it at once."""
        self.cause = Cause.NONE
        """Cause of a disarming; POWER_UP in ESTOP and FAULT."""
        self._began = time.monotonic()

    def request(self, request: Request, is_late: Callable[[], bool]) -> CommandAnswer:
        self.requests.append(request)
        self.free.wait()
        self.late.append(is_late())
        if self.error is not None:
            raise self.error
        if self.refuse:
            return refused(self.state.name, self.refuse)
        if self.state not in ACCEPTED_IN[request]:
            return refused(self.state.name, Refusal.STATE)
        if self.sways and request in (Request.HOME, Request.ARM, Request.RESET):
            self.sways -= 1
            return refused(self.state.name, Refusal.MOVING)
        if self.vents and request in (Request.HOME, Request.ARM):
            self.vents -= 1
            return refused(self.state.name, Refusal.NOT_VENTED)
        if self.fills and request is Request.SWING:
            self.fills -= 1
            return refused(self.state.name, Refusal.AIR)
        self.state = NEXT[request]
        if request is Request.SWING:
            self.publish_shot(a_shot(self.requests.count(Request.SWING)))
        return CommandAnswer(True, self.state.name)

    def correct(self, profile: str, weights: Sequence[float]) -> CommandAnswer:
        if self.state is State.SWINGING:
            return refused(self.state.name, Refusal.MOVING)
        self.corrections.append((profile, tuple(weights)))
        return CommandAnswer(True, self.state.name)

    def stop(self, request: Request) -> CommandAnswer:
        self.stops.append(("stop" if request is Request.STOP else "estop", time.monotonic()))
        if self.error is not None:
            raise self.error
        self.state = State.FAULT if request is Request.STOP else State.ESTOP
        return CommandAnswer(True, self.state.name)

    def status(self) -> BenchStatus:
        stopped = self.state in (State.ESTOP, State.FAULT)
        why = Cause.POWER_UP if stopped else self.cause
        fact, action = CAUSE_WORDS[why]
        cause = CauseStatus(name=why.name, text=fact, action=action) if why else None
        return BenchStatus(
            version=1,
            bench="bench1",
            state=self.state.name,
            phase=self.armed_phase if self.state is State.ARMED else "STANDING",
            reaction="NONE",
            cause=cause,
            latest_cause=None,
            homed=self.state not in (State.ESTOP, State.SAFE),
            vented=self.state is not State.ARMED,
            tick=123456,
            time=123.456 + (time.monotonic() - self._began),
            swings=self.requests.count(Request.SWING),
            lease=None,
            arming_blocks=[],
            readiness_warnings=[],
            read_only=False,
            driver="sim",
            profile="default",
            correction=len(self.corrections),
            club="driver",
            series=False,
            joints_deg=[32.71, 237.3, None],
            supply_pressure_pa=8.01e5,
            chamber_pressure_pa=[1.013e5, 1.013e5, 1.02e5, 1.013e5, None, None],
            spool_positions=[0.0, -0.01, None],
            air_faults=[],
            drift=[],
            wear=[],
            vents_open=[True, True],
            shut_off_open=False,
            emergency_stop_clear=True,
            guard_closed=True,
            guard_locked=False,
            ball_present=False,
            support_ready=True,
            launch_monitor=None,
            processes={
                "loop": ProcessStatus(pid=4711, alive=True, note=""),
                "recorder": ProcessStatus(pid=4712, alive=False, note="killed by signal 9"),
            },
            device=DeviceStatus(
                fault="node 10 (valves and interlocks) has restarted",
                counters={"frames": 123456, "missing": 7, "bus_off": 0},
            ),
            loop=LoopStatus(
                rate_hz=999.98,
                skipped=3,
                late=5,
                page_faults=1,
                preemptions=40,
                stalls={"preemption": 4, "page_fault": 0, "long_tick": 0, "machine": 1},
                wake_p50_s=8e-6,
                wake_p99_s=41e-6,
                tick_p99_s=93e-6,
            ),
            real_time={
                "mode": "prefer",
                "held": False,
                "settings": {
                    "memory lock": {"name": "memory lock", "asked": "all", "granted": "none", "held": False},
                    "scheduling": {"name": "scheduling", "asked": "80", "granted": "80", "held": True},
                },
            },
            counts=CountStatus(commands=0, refused=0, malformed=0, dropped=0),
            last_stop={"cause": "POWER_UP", "text": "", "time_utc": "2026-11-21T12:00:00+00:00"},
            uptime=12.5,
        )


def a_shot(number: int) -> ShotPublication:
    """Return the message about a swing whose ball was struck."""
    row = Shot(
        number,
        1,
        1,
        "driver",
        "default",
        ShotStatus.VALID,
        club_speed_mps=43.05,
        attack_angle_deg=1.94,
        strike_x_mm=0.1,
        strike_y_mm=-0.14,
        ball_speed_mps=64.15,
        launch_angle_deg=12.4,
        spin_rpm=2406.0,
        carry_m=208.0,
        carry_source="model",
    )
    return shot_publication(
        shot_id=f"run-{number}",
        record=f"/data/{number}.parquet",
        number=number,
        tick=123456 + number,
        lost_records=0,
        complete=True,
        replayable=True,
        cause=Cause.NONE.name,
        shot=shot_to_json(row),
    )


class RunningPlane(NamedTuple):
    plane: CommandPlane
    service: FakeDesk
    configuration: Configuration
    session: zenoh.Session
    """The daemon's."""


@cache
def _shipped() -> Configuration:
    return load_configuration(shipped_configuration())


def loopback_configuration(port: int | None = None) -> Configuration:
    """Return the shipped configuration with `port`, a free one by default."""
    endpoint = f"tcp/127.0.0.1:{free_port() if port is None else port}"
    return replace(_shipped(), network=NetworkSettings(endpoint))


@contextmanager
def running_plane(
    service: FakeDesk, configuration: Configuration, clock: Callable[[], float] = time.monotonic
) -> Iterator[RunningPlane]:
    with open_daemon(configuration.network) as session:
        plane = CommandPlane(session, configuration.bench.id, service, clock)
        service.publish_shot = plane.publish_shot
        try:
            yield RunningPlane(plane, service, configuration, session)
        finally:
            service.free.set()
            plane.close()


@contextmanager
def publishing(running: RunningPlane) -> Iterator[threading.Event]:
    """Publish the state until the block's end; while the yielded event is clear, stay silent."""
    ended, speaking = threading.Event(), threading.Event()
    speaking.set()

    def publish() -> None:
        while not ended.wait(0.02):
            if speaking.is_set():
                running.plane.publish_state(running.service.status())

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield speaking
    finally:
        ended.set()
        thread.join()
