"""Reports of the supervisor: status, stalls that caused a stop, state for its next run, systemd."""

from __future__ import annotations

import json
import logging
import os
import socket
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from bench.base.atomic_file import atomic_file
from bench.base.errors import BenchError
from bench.base.json_schema import json_object, json_value, require_fit
from bench.base.lifecycle import (
    CAUSE_TEXT,
    CAUSE_WORDS,
    REFUSAL_WORDS,
    Cause,
    Phase,
    Reaction,
    Refusal,
    Request,
    State,
    Words,
    in_one,
)
from bench.control.monitor.pressure_monitor import FAULTS
from bench.network.bench_service import (
    STATUS_VERSION,
    BenchStatus,
    CauseStatus,
    LaunchMonitorStatus,
    WearFinding,
)
from bench.records.telemetry.cycle_record import CYCLE

_log = logging.getLogger("golfbench")

_ENCODERS = (Cause.SHOULDER_ENCODER, Cause.ARM_ENCODER, Cause.WRIST_ENCODER)
_JUMPS = (Cause.SHOULDER_JUMP, Cause.ARM_JUMP, Cause.WRIST_JUMP)
_JUST = 4
"""Records up to the stop in which a stall explains a jump."""
_ROUNDING = 5e-5
"""Rounding of the times of ticks (s)."""
BEFORE = 20
"""Records before the stop in which a stall of the loop explains it: one that begins there ends there."""


def stall_note(
    cycles: np.ndarray[Any, Any], cause: Cause, encoder_timeout: float, period: float, fault: str = ""
) -> str:
    """Return what explains a stop with `cause` better than a broken encoder; empty if nothing does.

    `fault` is why the device does not follow commands, if that is known.

    `cycles` (n,) of CYCLE end with the record in which the stop begins. Without a reading for
    `encoder_timeout` (s) an encoder is lost; the loop's `period` is in s. A loop that stands still misses
    the readings of all three, and so does one whose simulated robot or bus does, one of them perhaps a tick
    earlier or shorter: a cable or its plug loses one. Late is a sample older than the newest of its encoder
    by that time: over a bus it is taken at the tick, of a polled encoder up to a tick earlier.
    """
    if cause is Cause.DEVICE_PASSIVE:
        gap = float(cycles["measured_step"][-BEFORE:].max()) if len(cycles) else 0.0
        late = fault and gap - period >= encoder_timeout / 2  # the node missed this loop
        return f"{fault}, after {_stood_still(gap)}" if late else fault
    homing = cause is Cause.HOMING_FAILED
    if not (homing or cause in _ENCODERS + _JUMPS):
        return ""
    last = cycles[cycles["phase"] == Phase.HOMING] if homing else cycles[-BEFORE:]
    if not len(last):
        return ""
    lost, jump = last["encoder_valid"] == 0, homing or cause in _JUMPS
    span = _JUST if cause in _JUMPS else len(last)
    # A moving joint is elsewhere after a single missed tick; contacts with the stops are found more slowly.
    least = period if cause in _JUMPS else encoder_timeout / 2
    age = last["encoder_age"]
    older = age - np.fmin.reduce(age, axis=0)
    old = (age >= least + period) & (cause in _ENCODERS)
    late = np.all(lost | old | (older >= least - _ROUNDING), axis=1)
    gap = float(last["measured_step"][-span:].max())
    if gap - period >= least:
        when = "while homing" if homing else "just before"
        return f'{_stood_still(gap, when)}; the simulated robot of driver "sim" waits for the loop'
    if fault and not jump:
        return fault
    if late[-span if jump else -2 :].any():
        return (
            f"all three encoders were {'late' if jump else 'lost'} at once: check their bus and supply; with "
            "simulated nodes their process stood still, a stall of this machine; driver "
            '"sim" waits for the loop'
        )
    return ""


def supervisor_note(cause: Cause, gap: float, silence: float) -> str:
    """Return the explanation of a stop with `cause` after a supervisor's pause of `gap` s; empty if none.

    The loop stops after `silence` (s) without a heartbeat. A supervisor that continues afterwards was
    not broken: the machine did not run it.
    """
    if cause is not Cause.SUPERVISOR or gap < silence / 2:
        return ""
    return (
        f"the supervisor stood still for {gap:.1f} s, a stall of this machine: run golfbench doctor, and end "
        "what else keeps its processors busy"
    )


Cycles = np.ndarray[Any, Any]

NO_LAUNCH_MONITOR = LaunchMonitorStatus(
    listening="",
    presence="connected",
    present=False,
    seen_s=None,
    monitors=[],
    note="",
    outcomes={},
    settled_s=0.0,
    refused=0,
    refusal="",
    simulator=None,
)
"""Status before the first report of the launch monitor process."""


def status_of(newest: Cycles | None, stall: str, disarmed: Cause, **beside: Any) -> BenchStatus:
    """Return the status from the loop's `newest` record (None if it has not run yet).

    `stall` is what `stall_note` found at the stop; `disarmed` is why the robot was disarmed since it last
    moved; `beside` are the keys of the status not in the record. The command plane adds lease and counts.
    """
    r = np.zeros(1, CYCLE)[0] if newest is None else newest[0]
    cause, latest = Cause(int(r["cause"])), Cause(int(r["latest_cause"]))
    status: dict[str, Any] = {
        "version": STATUS_VERSION,
        "state": State(int(r["state"])).name,
        "phase": Phase(int(r["phase"])).name,
        "reaction": Reaction(int(r["reaction"])).name,
        "cause": _cause(cause or disarmed, stall),
        "latest_cause": _cause(latest) if latest != cause else None,
        "homed": bool(r["homed"]),
        "vented": bool(r["vented"]),
        "tick": int(r["tick"]),
        "time": float(r["time"]),
        "lease": None,
        "joints_deg": json_value(np.rad2deg(r["angle"]).tolist()),
        "supply_pressure_pa": json_value(float(r["supply_pressure"])),
        "chamber_pressure_pa": json_value(r["chamber_pressure"].tolist()),
        "spool_positions": json_value(r["spool_position"].tolist()),
        "air_faults": [CAUSE_TEXT[fault] for fault in air_faults(r["air_fault"])],
        "vents_open": [_position(x) for x in r["vent_open"]],
        "shut_off_open": _position(r["shut_off_open"]),
        "emergency_stop_clear": bool(r["emergency_stop_clear"]),
        "guard_closed": bool(r["guard_closed"]),
        "guard_locked": bool(r["guard_locked"]),
        "ball_present": bool(r["ball_present"]),
        "counts": {"commands": 0, "refused": 0, "malformed": 0, "dropped": 0},
        **beside,
    }
    return cast(BenchStatus, status)


def _stood_still(gap: float, when: str = "just before") -> str:
    return (
        f"the loop stood still for {1e3 * gap:.1f} ms {when}, a stall of this machine: run golfbench doctor"
    )


def cause_text(cause: Cause, stall: str) -> str:
    """Return the operator's text for `cause`; with a stall in place of its action, if there was one."""
    fact, action = CAUSE_WORDS[cause]
    return in_one((fact, stall or action))


def disarmed_for(cycle: Any, before: State, *, series: bool) -> Cause:
    """Return why the robot was disarmed in the record `cycle`, which follows one in state `before`.

    NONE without a disarming, after a requested one or a stop, and after a swing that is to vent. With
    `series` the robot holds its address for the next swing.
    """
    state, stops = State(int(cycle["state"])), cycle["cause"] != Cause.NONE
    ends = state in (State.READY, State.SAFE)
    held = before in (State.ARMED, State.HOMING)
    on_the_way = before is State.ARMED and state is State.RECOVERING
    after_swing = before is State.RECOVERING and ends and series
    if stops or cycle["request"] == Request.DISARM or not ((held and ends) or on_the_way or after_swing):
        return Cause.NONE
    if not cycle["lease_held"]:
        return Cause.LEASE
    if not cycle["support_ready"]:
        return Cause.SUPPORT
    return Cause.ARMED_TIME if before is State.ARMED else Cause.NONE


def air_faults(bits: int) -> list[Cause]:
    """Return the causes of the failing sensors, vents and exhausts in the `bits` of a record."""
    return [fault for k, fault in enumerate(FAULTS) if int(bits) >> k & 1]


def refusal_words(refusal: Refusal, fault: str, air: int) -> Words:
    """Return the operator's words for `refusal`; the device's `fault`, if known, in place of its action.

    A chamber that vents too slowly, by the bits `air` of the record, does not pass: it is the reason.
    """
    slow = [found for found in air_faults(air) if found >= Cause.SHOULDER_A_EXHAUST]
    if refusal is Refusal.NOT_VENTED and slow:
        return CAUSE_WORDS[slow[0]]
    fact, action = REFUSAL_WORDS[refusal]
    return fact, fault if fault and refusal in (Refusal.READINGS, Refusal.DEVICE) else action


def _cause(cause: Cause, stall: str = "") -> CauseStatus | None:
    fact, action = CAUSE_WORDS[cause]
    return CauseStatus(name=cause.name, text=fact, action=stall or action) if cause else None


def _position(seen: float) -> bool | None:
    """Return whether a valve is seen open; None without feedback."""
    return bool(seen) if isfinite(seen) else None


# State kept between two runs of a bench ---------------------------------------------------------------


def wear_file(data_dir: Path, bench_id: str) -> Path:
    """Return the file of the findings of `golfbench wear`."""
    return data_dir / "state" / f"{bench_id}.wear.json"


class StoredWear(NamedTuple):
    """The latest analysis of `golfbench wear`."""

    time_utc: str
    """Time of its last swing, ISO; empty: no analysis."""
    findings: list[WearFinding]


def write_wear(path: Path, wear: StoredWear) -> None:
    """Store `wear` in place of the analysis before.

    Raises:
        BenchError: the file cannot be written.
    """
    with suppress(OSError):  # the file reports it
        path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as stream:
        stream.write(json.dumps({"version": 1} | wear._asdict(), indent=1).encode())


def read_wear(path: Path) -> StoredWear:
    """Return the stored analysis; without a file an empty one.

    Raises:
        BenchError: the file cannot be read, or has another content.
    """
    action = f"Run golfbench wear again, or delete {path}."
    try:
        content = json.loads(path.read_bytes())
    except FileNotFoundError:
        return StoredWear("", [])
    except (OSError, ValueError, RecursionError) as error:
        raise BenchError(str(path), str(error), "findings of golfbench wear", action) from None
    match content:
        case {"version": 1, "time_utc": str(time_utc), "findings": findings}:
            require_fit(findings, list[WearFinding], f"{path}: findings", action)
            return StoredWear(time_utc, findings)
    raise BenchError(str(path), "another content", "findings of golfbench wear, version 1", action)


class RunMarker:
    """The file `state/<bench id>.json` in the data folder, written by a separate thread.

    The thread also reads the findings of wear. Access to a disk may take longer than the
    supervisor's heartbeat time-out.
    """

    def __init__(self, data_dir: Path, bench_id: str) -> None:
        """Read the state of the previous run.

        Raises:
            BenchError: the folder cannot be created.
        """
        self.path = data_dir / "state" / f"{bench_id}.json"
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BenchError(
                str(self.path.parent),
                str(error.strerror),
                "a folder that can be created",
                "Set bench.data_dir to a folder with write access.",
            ) from error
        before: Mapping[str, Any] = {}
        with suppress(OSError):  # missing or corrupt: start without state
            before = json_object(self.path.read_bytes()) or {}
        self.was_killed = bool(before.get("running"))
        """Whether the previous shutdown was unclean."""
        self.last_stop: dict[str, Any] | None = before.get("last_stop")
        """Last stop, also of previous runs."""
        if self.was_killed and not before.get("stopped"):
            self.last_stop = {
                "cause": "RESTART",
                "text": "the supervisor was killed, or the machine lost power",
                "state": before.get("state", ""),
                "phase": before.get("phase", ""),
                "run_started_utc": before.get("started_utc"),
            }
        self._content: dict[str, Any] = {}
        self.wear: list[WearFinding] = []
        """Findings of wear that were read last."""
        self.wear_fault = ""
        """Fault of their file, or empty."""
        self._wear_file = wear_file(data_dir, bench_id)
        self._reading: Future[None] | None = None
        self._writer = ThreadPoolExecutor(1, "run marker")

    def begin(self, pid: int, started_utc: str) -> None:
        """Mark this run as started; until `end` it counts as killed."""
        self._put({"version": 1, "running": True, "pid": pid, "started_utc": started_utc})

    def note_state(self, state: str, phase: str) -> None:
        """Store state and phase, for a later report on a killed run."""
        self._put({**self._content, "state": state, "phase": phase})

    def note_stop(self, stop: dict[str, Any], *, fatal: bool = False) -> None:
        """Store `stop`; `fatal` marks that the run ends with it."""
        self.last_stop = stop
        self._put({**self._content, **({"stopped": True} if fatal else {})})

    def look_for_wear(self) -> None:
        """Read the findings of wear, without waiting for it."""
        if self._reading is None or self._reading.done():
            self._reading = self._writer.submit(self._read_wear)

    def _read_wear(self) -> None:
        try:
            self.wear, fault = read_wear(self._wear_file).findings, ""
        except BenchError as error:
            self.wear, fault = [], str(error)
        if fault and fault != self.wear_fault:
            _log.warning("%s", fault)
        self.wear_fault = fault

    def end(self, *, clean: bool) -> None:
        """Store whether the shutdown was clean, and wait until it is written."""
        if clean:
            self._put({**self._content, "running": False})
        self._writer.shutdown()

    def _put(self, content: dict[str, Any]) -> None:
        self._content = {**content, "last_stop": self.last_stop}
        self._writer.submit(self._write, json.dumps(self._content, indent=1).encode())

    def _write(self, content: bytes) -> None:
        try:
            with atomic_file(self.path) as stream:
                stream.write(content)
        except BenchError as error:
            _log.warning("state of the bench not stored: %s", error)


# systemd ---------------------------------------------------------------------------------------------


def notify_service(message: str, environment: Mapping[str, str] = os.environ) -> bool:
    """Send `message` to systemd (sd_notify(3)), without waiting; return whether it was sent.

    Without systemd, or with its socket gone or full, nothing is sent.
    """
    address = environment.get("NOTIFY_SOCKET", "")
    if address[:1] not in ("/", "@"):
        return False
    name = os.fsencode(address.replace("@", "\0", 1) if address[:1] == "@" else address)
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)
        sender.sendto(message.encode(), name)
        return True
    return False


def watchdog_interval(environment: Mapping[str, str], pid: int) -> float | None:
    """Return systemd's watchdog time for process `pid` (s), None if not watched."""
    try:
        interval = int(environment["WATCHDOG_USEC"]) * 1e-6
        watched = int(environment.get("WATCHDOG_PID", pid))
    except (KeyError, ValueError):
        return None
    return interval if interval > 0.0 and watched == pid else None
