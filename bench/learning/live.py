"""Learning on a running bench: correct, swing, read the record, get the delivery.

The learner uses the commands that a person at the bench has: it holds the lease, sends the correction at the
address, raises a ball, requests a swing. After a stop a person has to reset the bench; the learner releases
the lease and waits. A simulated bench resets, homes and arms itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import Refused
from bench.base.lifecycle import Answer, Cause, Request
from bench.learning.delivery import UNKNOWN, figures_from
from bench.learning.learn import LearningProblem, ObservedSwing
from bench.network.bench_operator import BenchOperator
from bench.network.bench_service import BenchStatus
from bench.network.client import BenchClient
from bench.network.status_words import launch_monitor_text
from bench.records.shot.recorded_shot import plant_of
from bench.records.shot.shot_message import launch_from_json
from bench.records.telemetry.record_file import SwingRecord
from bench.swing.correction import digest_of
from bench.swing.correction_terms import Source
from bench.swing.profile import Profile

Array = NDArray[np.float64]

_AGAIN = 3
"""Max attempts at a swing whose record has gaps before the ball."""


class LiveSwinger:
    """A running bench as a swinger; a context manager that releases the lease at its end."""

    def __init__(
        self,
        client: BenchClient,
        problem: LearningProblem,
        source: Source,
        say: Callable[[str], None],
        ask_mark: Callable[[], tuple[float, float] | None] = lambda: None,
        *,
        with_ball: bool = True,
        ask_person: Callable[[str], None],
        aborted: Callable[[], bool] = lambda: False,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> None:
        """`say` shows a message to a person; `ask_mark` asks for the mark on the face, mm.

        `ask_person`, `aborted` and `interrupted` as `BenchOperator` takes them.

        Raises:
            Refused: the bench has another profile, or no launch monitor if that is the source.
        """
        self._problem, self._source = problem, source
        self._say, self._ask_mark, self._with_ball = say, ask_mark, with_ball
        self._digest = digest_of(problem.bench.profile)
        status = client.status()
        self.simulated = status["driver"] == "sim"
        require_bench(status, problem.bench.profile, source)
        self._operator = BenchOperator(
            client,
            "learn",
            simulated=self.simulated,
            ask_person=ask_person,
            aborted=aborted,
            interrupted=interrupted,
        )
        self._operator.armed_anew = True

    def __enter__(self) -> Self:
        self._operator.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._operator.__exit__(*error)

    def __call__(self, weights: Array) -> ObservedSwing:
        """Swing with the correction `weights` (m,) and come to rest.

        Raises:
            BenchError: the bench does not answer, refuses, or stores nothing; no ball comes.
        """
        operator, planned_air = self._operator, bool(self._problem.bench.profile.air)
        for _ in range(_AGAIN):
            record = operator.swing(lambda _: self._send(weights), ball=self._with_ball)
            swung, whole = self._seen(record)
            settled, operator.armed_anew = planned_air or not operator.armed_anew, bool(swung.cause)
            if whole:
                return swung._replace(settled=settled)
            self._say("the record has gaps before the ball: the swing is repeated")
        found = f"{_AGAIN} records with gaps before the ball"
        raise operator.refused(found, "complete records", "Check the loop timing: golfbench status.")

    def correct(self, weights: Array) -> None:
        """Send the correction `weights` for the next swings, once the robot rests at its address."""
        self._operator.rest_at_address()
        self._send(weights)

    def _send(self, weights: Array) -> bool:
        self._operator.client.correct(self._digest, weights.tolist() if np.any(weights) else [])
        return True

    def _seen(self, record: SwingRecord) -> tuple[ObservedSwing, bool]:
        """Return the swing in `record`, and whether the record is complete up to the ball."""
        profile, metadata = self._problem.bench.profile, record.metadata
        cycles, missing = swung_cycles(record.cycles, len(profile.angle))
        cause = Cause[metadata["outcome"]["cause"]]
        if cause:
            return ObservedSwing(cycles, UNKNOWN, cause), True
        if missing[profile.begins[3] : profile.begins[6] + 1].any():
            return ObservedSwing(cycles, UNKNOWN, cause), False
        # Calibration from the record; masses and friction from the model.
        encoders = plant_of(metadata, str(record.path))[0].encoders
        plant = replace(self._problem.bench.plant, encoders=encoders)
        mark = self._ask_mark() if self._source == "impact-marks" else None
        speed, attack = self._monitored(record) if self._source == "launch-monitor" else (None, None)
        free = self._problem.response.free
        figures = figures_from(cycles, plant, free, mark=mark, club_speed=speed, attack_deg=attack)
        return ObservedSwing(cycles, figures, cause), True

    def _monitored(self, record: SwingRecord) -> tuple[float | None, float | None]:
        """Return club speed (m/s) and attack angle (deg) of the launch monitor; None if not measured."""
        shot = self._operator.message_about(record)
        if shot is None or shot["launch"] is None:
            self._say("no launch monitor data for this swing: encoder data are used")
            return None, None
        club = launch_from_json(shot["launch"]).club
        attack = None if club.attack_angle is None else float(np.degrees(club.attack_angle))
        silent = [
            name for name, value in (("speed", club.speed), ("angle of attack", attack)) if value is None
        ]
        if silent:
            self._say(f"no club {' and no '.join(silent)} from the launch monitor: encoder data are used")
        return club.speed, attack


def require_bench(status: BenchStatus, profile: Profile, source: Source) -> None:
    """Refuse a bench with another profile, or one that does not yield the `source`.

    Raises:
        Refused: the text says which.
    """
    if status["profile"] != profile.name:
        action = f"Start it with golfbench run --profile {profile.name}, or learn the swing that it runs."
        raise Refused(f"bench {status['bench']}", f"it swings {status['profile']}", profile.name, action)
    if source == "impact-marks" and status["driver"] != "sim":  # it gives no access to the club
        action = "Choose another --source; golfbench commission gives access to look at the mark."
        raise Refused(f"bench {status['bench']}", "a machine", "a simulated bench for impact marks", action)
    link = status["launch_monitor"]
    if source == "launch-monitor" and (link is None or not link["present"]):
        location, expected = f"bench {status['bench']}: launch monitor", "a launch monitor with club data"
        action = "Enable and connect it ([launch_monitor] enabled = true), or choose another --source."
        raise Refused(location, "disabled" if link is None else launch_monitor_text(link), expected, action)


def swung_cycles(cycles: np.ndarray[Any, Any], length: int) -> tuple[np.ndarray[Any, Any], NDArray[np.bool_]]:
    """Return `length` cycles, one a tick from the accepted swing on, and which of them are missing.

    A missing cycle repeats the one before it, with NaN as its angle.

    Raises:
        ValueError: no swing begins in `cycles`.
    """
    begins = np.flatnonzero((cycles["request"] == Request.SWING) & (cycles["answer"] == Answer.ACCEPTED))
    if not len(begins):
        raise ValueError("no swing begins in this record")
    first = int(cycles["tick"][begins[0]])
    wanted = np.arange(first, first + length)
    rows = np.searchsorted(cycles["tick"], wanted, side="right") - 1
    missing = cycles["tick"][rows] != wanted
    # As bytes: numpy copies records field by field, in milliseconds, and leaves their padding to chance.
    plain = np.asarray(cycles)
    whole = plain.view(np.dtype((np.void, plain.itemsize)))[rows].view(plain.dtype)
    whole["angle"][missing] = np.nan
    return whole, missing
