"""Python client of a running bench, with the verbs of the command line.

with BenchClient.connect(load_address()) as bench, bench.lease("Ann"):
    bench.home()
    bench.wait_for("READY")
    bench.arm()
    bench.wait_until_armed()
    bench.swing()
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from threading import Event, Lock, Thread
from typing import TYPE_CHECKING, Any, Self, cast

import zenoh

from bench.base import lifecycle
from bench.base.address import root_key
from bench.base.errors import BenchError, Refused
from bench.base.json_schema import json_object
from bench.base.lifecycle import ACCEPTED_IN, PASSING, Refusal, State
from bench.network import status_words
from bench.network.bench_service import STATUS_VERSION, BenchStatus, CommandAnswer
from bench.network.command import (
    REQUESTS,
    STOPS,
    Verb,
    encode_command,
    not_understood,
    parse_answer,
    parse_error,
)
from bench.network.lease import CAMPAIGN_HOLDER, DEFAULT_SECONDS
from bench.network.zenoh_session import NoAnswer, close_session, open_client

if TYPE_CHECKING:
    from bench.base.address import Addressed, NetworkSettings
    from bench.records.shot.shot_message import ShotPublication

TIMEOUT = 2.0
"""Time-out of an answer, s: longer than a request may wait in the bench for its turn and for the loop."""

REST = 1.0
"""Time at rest at the address before a swing (s): the air in the chambers settles later than the robot."""

SETTLING_TIMEOUT = 10.0
"""Time for which home, arm and reset wait until the robot rests, and arm until no chamber shows pressure, s.

It covers the sinking of a raised arm, and venting with the default `lifecycle.vent_timeout`.
"""

PRESSURE_TIMEOUT = 60.0
"""Max wait of a swing for its address pressures, s; a bench that cannot reach them ends the wait."""

_LOOK_FOR_REST = 0.1
"""Period of the retries, s."""

_LOOK_AT_SWING = 0.5
"""Period of the status requests during a swing, s."""

STOP_TIMEOUT = 20.0
"""Max time from a stop until the robot stands, s; a swing that completes and returns takes longest."""

LATCHED = frozenset(state.name for state in lifecycle.LATCHED)
_MOVING = frozenset(state.name for state in lifecycle.MOVING)

_COMMANDS = {Verb.SECURE: "access --end"}
"""Commands whose name differs from their verb."""

_PASSING_STATES = {Verb.HOME: ("RECOVERING",), Verb.ARM: ("HOMING", "RECOVERING")}
"""States that refuse a verb and end automatically in one that accepts it. None for a swing: two requests must
not make two swings."""

Watch = Callable[[BenchStatus], None]
"""Gets every status while a client waits."""


class CommandRefused(Refused):
    """A request refused by the bench, with its `answer`."""

    def __init__(self, bench: str, verb: Verb, answer: CommandAnswer) -> None:
        self.verb, self.answer = verb, answer
        location, blocks = _location(verb, bench), answer.content.get("arming_blocks", ())
        if blocks:
            found, expected, actions = (
                dict.fromkeys(parts)
                for parts in zip(
                    *((f"{b['location']} {b['found']}", b["expected"], b["action"]) for b in blocks),
                    strict=True,
                )
            )
            super().__init__(location, "; ".join(found), "; ".join(expected), " ".join(actions))
            return
        wrong_state = answer.refusal == Refusal.STATE.name
        command = f"Next: {status_words.COMMANDS[State[answer.state]]}."
        action = status_words.sentence(answer.action.removesuffix("."))
        if wrong_state and answer.state == State.ARMED.name and verb in (Verb.HOME, Verb.ACCESS):
            action, command = "Disarm first.", "Next: golfbench disarm."
        super().__init__(
            location,
            f"refused in state {answer.state}: {answer.reason}",
            _accepted_in(verb) if wrong_state else "no blocking condition",
            " ".join(filter(None, (action, command if wrong_state else ""))) or "Look at golfbench status.",
        )

    @property
    def refusal(self) -> Refusal:
        """Why it was refused."""
        return Refusal[self.answer.refusal]

    @property
    def passes(self) -> bool:
        """Whether the reason passes without action, so that a later retry is enough."""
        if self.refusal is Refusal.STATE:
            return self.answer.state in _PASSING_STATES.get(self.verb, ())
        return self.refusal in PASSING


@dataclass
class HeldLease:
    """A lease, as its holder stores it."""

    holder: str
    key: str = field(repr=False)
    seconds: float
    """Duration of the lease from each take or renewal, s."""
    sequence: int = 0
    """Sequence number of the newest command sent with it."""


class BenchClient:
    """A connection to a running bench; closes it at the end of a `with`.

    Its methods may be called from several threads. All raise `NoAnswer` when the bench does not answer
    in time, `CommandRefused` when it says no, and BenchError when it did not understand.
    """

    def __init__(self, session: zenoh.Session, bench: str, network: NetworkSettings, timeout: float) -> None:
        self.bench, self._network, self._timeout = bench, network, timeout
        self._session, self._root = session, root_key(bench)
        self._lock = Lock()
        self.held: HeldLease | None = None
        """The lease from `take_lease`, or one stored earlier."""

    @classmethod
    def connect(cls, address: Addressed, timeout: float = TIMEOUT) -> Self:
        """Connect to the bench at `address` (`load_address()`, or a whole configuration).

        `timeout` (s) applies to each answer.

        Raises:
            NoAnswer: no bench listens at its endpoint.
        """
        network, bench = address.network, address.bench.id
        return cls(open_client(network, bench), bench, network, timeout)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def sibling(self) -> Self:
        """Return a client without a lease on the same connection, not to be closed."""
        return type(self)(self._session, self.bench, self._network, self._timeout)

    def close(self) -> None:
        """End the connection; a lease stays until it expires."""
        close_session(self._session)

    # Looking -------------------------------------------------------------------------------------

    def status(self) -> BenchStatus:
        """Return the state of the bench."""
        return checked_status(self._ask(Verb.STATUS).content)

    def states(self, timeout: float) -> Generator[BenchStatus | None, None, None]:
        """Yield each state that the bench publishes, and None whenever `timeout` s pass without one."""
        newest: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(1)
        subscriber = self._session.declare_subscriber(f"{self._root}/state", newest)
        try:
            due = time.monotonic() + timeout
            while True:
                sample = subscriber.try_recv()
                if sample is not None:
                    payload = sample.payload.to_bytes()
                    yield checked_status(json_object(payload) or payload[:40])
                elif time.monotonic() >= due:
                    yield None
                else:
                    time.sleep(0.01)
                    continue
                due = time.monotonic() + timeout
        finally:
            subscriber.undeclare()

    @contextmanager
    def shots(self) -> Iterator[Callable[[], ShotPublication | None]]:
        """Yield a function that returns the next message about a shot, None before the first.

        Paths of records are those of the bench's machine. The function raises BenchError where it does not
        understand a message.
        """
        from bench.records.shot.shot_message import read_shot_message  # not for a stop

        channel: zenoh.handlers.FifoChannel[zenoh.Sample] = zenoh.handlers.FifoChannel(64)
        subscriber = self._session.declare_subscriber(f"{self._root}/shot", channel)

        def following() -> ShotPublication | None:
            sample = subscriber.try_recv()
            return None if sample is None else read_shot_message(sample.payload.to_bytes())

        try:
            yield following
        finally:
            subscriber.undeclare()

    @contextmanager
    def publish_campaign(self, campaign: str) -> Iterator[Callable[[Mapping[str, Any]], None]]:
        """Yield a function that publishes the state of `campaign`; later queries get the newest state."""
        key, last = f"{self._root}/campaign/{campaign}", [b""]

        def answer(query: zenoh.Query) -> None:
            with query:
                query.reply(key, last[0], encoding=zenoh.Encoding.APPLICATION_JSON)

        queryable = self._session.declare_queryable(key, answer)

        def publish(message: Mapping[str, Any]) -> None:
            last[0] = json.dumps(message).encode()
            self._session.put(key, last[0], encoding=zenoh.Encoding.APPLICATION_JSON)

        try:
            yield publish
        finally:
            queryable.undeclare()

    def campaigns(self) -> list[dict[str, Any]]:
        """Return the state of each campaign that a runner publishes now, see `bench.campaign.run.progress`.

        Raises:
            BenchError: one of them is no JSON object.
        """
        found = []
        for reply in self._session.get(f"{self._root}/campaign/*", timeout=self._timeout):
            if reply.ok is None or not (content := reply.ok.payload.to_bytes()):
                continue
            if (message := json_object(content)) is None:
                location = f"bench {self.bench}, {reply.ok.key_expr}"
                raise BenchError(
                    location,
                    "no JSON object",
                    "the state of a campaign",
                    "Update golfbench on the bench's machine.",
                )
            found.append(message)
        return found

    def wait_for(self, state: str, *, timeout: float = 30.0, watch: Watch | None = None) -> BenchStatus:
        """Wait up to `timeout` s for `state`; return the status.

        `watch` gets every status on the way.

        Raises:
            Refused: ESTOP or FAULT instead, or time-out.
        """

        def on_the_way(status: BenchStatus) -> bool:
            return status["state"] not in LATCHED

        return self._wait(lambda status: status["state"] == state, state, on_the_way, timeout, watch)

    def wait_until_armed(self, *, timeout: float = 60.0, watch: Watch | None = None) -> BenchStatus:
        """Wait up to `timeout` s until the robot rests at its address, ready to swing; return the status.

        `watch` gets every status on the way.

        Raises:
            Refused: no longer ARMED (stopped, disarmed, lease expired), or time-out.
        """
        since = float("inf")

        def reached(status: BenchStatus) -> bool:
            nonlocal since
            at_rest = status["phase"] == "HOLD"
            since = min(since, status["time"]) if at_rest else float("inf")
            return status["time"] - since >= REST

        wanted = "ARMED, at rest at the address"
        return self._wait(reached, wanted, lambda status: status["state"] == "ARMED", timeout, watch)

    def wait_for_stop(self, *, timeout: float = STOP_TIMEOUT, watch: Watch | None = None) -> BenchStatus:
        """Wait up to `timeout` s after a stop until the robot stands; return the status.

        Raises:
            Refused: time-out.
        """
        return self._wait(
            lambda status: status["state"] not in _MOVING, "at rest", lambda _: True, timeout, watch
        )

    def _wait(
        self,
        reached: Callable[[BenchStatus], bool],
        wanted: str,
        on_the_way: Callable[[BenchStatus], bool],
        timeout: float,
        watch: Watch | None,
    ) -> BenchStatus:
        """Wait until `reached` accepts the status; refuse a status that `on_the_way` rejects."""
        deadline = time.monotonic() + timeout
        status = self.status()
        with closing(self.states(min(0.5, timeout))) as states:
            while not reached(status):
                if watch is not None:
                    watch(status)
                found = f"{status['state']} in phase {status['phase']}"
                if cause := status["cause"]:
                    found += f": {cause['text']}"
                if not on_the_way(status):
                    raise Refused(f"bench {self.bench}", found, wanted, action_of(status))
                if time.monotonic() >= deadline:
                    action = "Wait longer, or look at golfbench status."
                    raise Refused(f"bench {self.bench} after {timeout:g} s", found, wanted, action)
                heard = next(states)
                # One with an older tick was under way before, or the bench has restarted.
                status = heard if heard is not None and heard["tick"] >= status["tick"] else self.status()
        return status

    # The lease -----------------------------------------------------------------------------------

    def take_lease(self, holder: str, seconds: float = DEFAULT_SECONDS) -> HeldLease:
        """Take the bench for `seconds`; later commands carry the lease, and it expires unless renewed."""
        answer = self._ask(Verb.LEASE, action="take", holder=holder, seconds=seconds)
        match answer.content:
            case {"key": str(key)}:
                self.held = HeldLease(holder, key, seconds)
                return self.held
        raise not_understood(repr(answer.content)[:60], "the key of the lease")

    def renew_lease(self, seconds: float | None = None) -> float:
        """Renew the lease for `seconds` from now (default: as taken); return them."""
        held = self._require_lease(Verb.LEASE)
        held.seconds = held.seconds if seconds is None else seconds
        self._ask_keyed(Verb.LEASE, action="renew", seconds=held.seconds)
        return held.seconds

    def release_lease(self) -> None:
        """Release the lease; an armed bench disarms."""
        self._require_lease(Verb.LEASE)
        self._ask_keyed(Verb.LEASE, action="release")
        self.held = None

    @contextmanager
    def lease(self, holder: str, seconds: float = DEFAULT_SECONDS) -> Iterator[HeldLease]:
        """Hold the lease for a block: taken at its start, renewed in the background, released at its end.

        A lease lost on the way (the daemon restarted) is not taken again: commands are refused.
        """
        held = self.take_lease(holder, seconds)
        ended = Event()

        def renew() -> None:
            while not ended.wait(seconds / 3):
                with suppress(BenchError):  # the next command fails with the reason
                    self.renew_lease()

        renewing = Thread(target=renew, name="lease", daemon=True)
        renewing.start()
        try:
            yield held
        finally:
            ended.set()
            renewing.join()
            with suppress(BenchError):
                self.release_lease()

    # Verbs ---------------------------------------------------------------------------------------

    def home(self, retry_timeout: float = SETTLING_TIMEOUT, watch: Watch | None = None) -> CommandAnswer:
        """Prove the encoders' zeros.

        While it is refused for a passing reason (the robot sways or returns, chambers vent), it is retried
        for `retry_timeout` (s), also in arm, swing, tee and reset; `watch` gets the states meanwhile.
        """
        return self._ask_again(Verb.HOME, retry_timeout, watch)

    def arm(self, retry_timeout: float = SETTLING_TIMEOUT, watch: Watch | None = None) -> CommandAnswer:
        """Warn, switch the air on, go to the address."""
        return self._ask_again(Verb.ARM, retry_timeout, watch)

    def disarm(self) -> CommandAnswer:
        """Disarm: vent if at rest, otherwise brake first; needs no lease."""
        return self._ask(Verb.DISARM)

    def access(self) -> CommandAnswer:
        """Unlock the guard of a vented bench."""
        return self._ask_keyed(Verb.ACCESS)

    def secure(self) -> CommandAnswer:
        """End the access: lock the guard."""
        return self._ask_keyed(Verb.SECURE)

    def swing(self, retry_timeout: float = PRESSURE_TIMEOUT, watch: Watch | None = None) -> CommandAnswer:
        """Swing from the address, once the robot rests there and its air is as the profile plans it."""
        return self._ask_again(Verb.SWING, retry_timeout, watch)

    def swing_through(
        self, *, retry_timeout: float = PRESSURE_TIMEOUT, timeout: float = 60.0, watch: Watch | None = None
    ) -> ShotPublication:
        """Swing, and return the shot within `timeout` s: once its record is stored and the ball is measured.

        Raises:
            Refused: no record of it came.
        """
        before, stored, looked = self.status(), None, 0.0
        monitor = before["launch_monitor"]
        with self.shots() as following:
            self.swing(retry_timeout, watch)
            end = time.monotonic() + timeout
            while (now := time.monotonic()) < end:
                message = following()
                if message is None:
                    if watch is not None and now - looked > _LOOK_AT_SWING:
                        looked = now
                        watch(self.status())
                    time.sleep(0.01)
                elif message["outcome"] is not None:
                    if stored is not None and message["shot_id"] == stored["shot_id"]:
                        return message
                elif (tick := message["tick"]) is not None and tick >= before["tick"]:
                    stored = message
                    if monitor is None:
                        return stored
                    end = max(end, now + monitor["settled_s"] + TIMEOUT)
        if stored is not None:
            return stored
        location, action = (
            f"swing of bench {self.bench}",
            "Look at golfbench status: is the recorder running?",
        )
        raise Refused(location, f"no record within {timeout:g} s", "the record of the swing", action)

    def tee(self, retry_timeout: float = SETTLING_TIMEOUT) -> CommandAnswer:
        """Raise the next ball."""
        return self._ask_again(Verb.TEE, retry_timeout, None)

    def reset(self, retry_timeout: float = SETTLING_TIMEOUT) -> CommandAnswer:
        """Leave ESTOP or FAULT once the cause is cleared; never moves the robot."""
        return self._ask_again(Verb.RESET, retry_timeout, None)

    def correct(self, profile: str, weights: Sequence[float]) -> CommandAnswer:
        """Apply the correction `weights` of the profile with digest `profile` to the coming swings.

        Without weights they are made as designed. It applies until another is given or the bench restarts.
        """
        return self._ask_keyed(Verb.CORRECT, profile=profile, weights=list(weights))

    def stop(self) -> CommandAnswer:
        """Stop as the stopping table says; needs no lease."""
        return self._ask(Verb.STOP)

    def emergency_stop(self) -> CommandAnswer:
        """Stop and latch ESTOP; needs no lease. A convenience, not a safety function."""
        return self._ask(Verb.ESTOP)

    # Asking --------------------------------------------------------------------------------------

    def _require_lease(self, verb: Verb) -> HeldLease:
        if self.held is None:
            action = "Take it: golfbench lease take."
            if campaign := self._campaign():
                action = (
                    f"Answer the campaign's prompt: golfbench campaign answer {campaign}. "
                    f"Or stop it: golfbench campaign stop {campaign}."
                )
            raise Refused(_location(verb, self.bench), "no lease", "the lease of the bench", action)
        return self.held

    def _campaign(self) -> str:
        """Return the ID of the campaign that holds the lease; empty if unknown."""
        try:
            lease = self.status()["lease"]
        except NoAnswer:
            return ""
        holder = lease["holder"] if lease else ""
        return holder.removeprefix(CAMPAIGN_HOLDER) if holder.startswith(CAMPAIGN_HOLDER) else ""

    def _ask_keyed(self, verb: Verb, **values: Any) -> CommandAnswer:
        # One at a time: two that overtake each other would be out of order.
        with self._lock:
            held = self._require_lease(verb)
            held.sequence += 1
            return self._ask(verb, key=held.key, sequence=held.sequence, **values)

    def _ask_again(self, verb: Verb, retry_timeout: float, watch: Watch | None) -> CommandAnswer:
        """Send `verb`; retry for up to `retry_timeout` (s) while it is refused for a passing reason."""
        end = time.monotonic() + retry_timeout
        while True:
            try:
                return self._ask_keyed(verb)
            except CommandRefused as refused:
                if not refused.passes or time.monotonic() >= end:
                    raise
            if watch is not None:
                watch(self.status())
            time.sleep(_LOOK_FOR_REST)

    def _ask(self, verb: Verb, **values: Any) -> CommandAnswer:
        payload = self.send(verb, encode_command(verb, **values))
        answer = parse_answer(payload)
        if not answer.accepted:
            raise CommandRefused(self.bench, verb, answer)
        return answer

    def send(self, verb: str, message: bytes) -> bytes:
        """Send `message` to `verb` unchanged and return the bench's raw answer.

        Raises:
            NoAnswer: time-out.
            BenchError: the message is invalid.
        """
        priority = zenoh.Priority.REAL_TIME if verb in STOPS else zenoh.Priority.INTERACTIVE_HIGH
        began = time.monotonic()
        replies = self._session.get(
            f"{self._root}/command/{verb}",
            payload=message,
            encoding=zenoh.Encoding.APPLICATION_JSON,
            timeout=self._timeout,
            priority=priority,
        )
        for reply in replies:
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            # An error of zenoh itself, such as its time-out, is no JSON.
            if reply.err is not None and reply.err.encoding == zenoh.Encoding.APPLICATION_JSON:
                raise parse_error(reply.err.payload.to_bytes())
        waited = f"waited {time.monotonic() - began:.1f} s"
        raise NoAnswer(self.bench, self._network.endpoint, waited)


def _location(verb: Verb, bench: str) -> str:
    """Return the command that was refused, in the user's words, and its bench."""
    return f"{_COMMANDS.get(verb, verb)} of bench {bench}"


def _accepted_in(verb: Verb) -> str:
    if verb is Verb.SECURE:  # a stop latched in an access keeps the guard unlocked once it was opened
        return "an access, or a guard opened in one"
    states = sorted(state.name for state in ACCEPTED_IN[REQUESTS[verb]]) if verb in REQUESTS else []
    return f"state {' or '.join(states)}"


def action_of(status: BenchStatus) -> str:
    """Return what to do in the state of the bench: about its cause, then the next step and its command."""
    cause = status["cause"]
    action = status_words.sentence(cause["action"]) if cause else ""
    return f"{action or status_words.next_step(status)} Next: {status_words.next_command(status)}."


def checked_status(read: Any) -> BenchStatus:
    """Return `read` as a status; raises BenchError: it is incomplete or of another version."""
    expected = f"a status of version {STATUS_VERSION}"
    if not isinstance(read, dict) or read.get("version") != STATUS_VERSION:
        raise not_understood(repr(read)[:60], expected)
    if missing := BenchStatus.__required_keys__ - read.keys():
        raise not_understood(f"no {', '.join(sorted(missing))}"[:60], expected)
    return cast(BenchStatus, read)
