"""A hundred thousand invalid messages: each is answered, or dropped and counted.

`fuzz` sends them to any command plane: random bytes, broken and mutated JSON, wrong types, unknown verbs,
overlong, repeated, out of order, without a lease. `run` does so against a plane in a separate process, whose
memory is monitored.
"""

from __future__ import annotations

import json
import random
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import psutil
import zenoh

from bench.config import Configuration
from bench.network.bench_service import CountStatus
from bench.network.client import BenchClient
from bench.network.command import (
    LAST_SEQUENCE,
    MAX_COMMAND_BYTES,
    Verb,
    encode_command,
    parse_answer,
    parse_error,
)
from bench.network.lease import new_key
from bench.network.zenoh_session import open_client
from tests.bench.fake_bench_service import FakeDesk, loopback_configuration, running_plane
from tests.benchmarks.row import Row, numbers

WINDOW = 512
"""Messages under way at once: more than a lane of the plane takes."""


VERBS = tuple(map(str, Verb))
_LETTERS = "abcdefghijklmnopqrstuvwxyz0123456789-_é"
_JSON_BITS = (*'"{}[],:', "1e999", "NaN", "null", "\\ud800", "\x00", '"version": 1', "-0", "é")


class Sent(NamedTuple):
    """One message to be sent."""

    kind: str
    verb: str
    payload: bytes


@dataclass
class Tally:
    """What became of the messages, as their sender saw it."""

    sent: Counter[str] = field(default_factory=Counter)
    """By kind."""
    answered: Counter[str] = field(default_factory=Counter)
    """accepted, refused, malformed, and none for those without an answer."""
    unreadable: list[bytes] = field(default_factory=list)
    """Answers that are none."""
    seconds: float = 0.0


def messages(source: random.Random, key: str) -> Iterator[Sent]:
    """Yield messages without end, none of which is to move the bench.

    `key` is of a lease whose sequence is used up. A fifth of the messages is well formed: looking, stopping,
    and commands that come too late in their sequence or without a lease.
    """
    makers: tuple[tuple[str, Callable[[], tuple[str, bytes]]], ...] = (
        ("bytes", lambda: (source.choice(VERBS), source.randbytes(source.randrange(200)))),
        ("empty", lambda: (source.choice(VERBS), b"")),
        ("broken", lambda: _broken(source, key)),
        ("mutated", lambda: _mutated(source, key)),
        ("bits of JSON", lambda: (source.choice(VERBS), "".join(source.choices(_JSON_BITS, k=12)).encode())),
        ("deep", lambda: (source.choice(VERBS), source.choice((b"[", b'{"a":')) * source.randrange(1, 800))),
        ("unknown verb", lambda: (_word(source), _valid(source, "status", key))),
        ("wild verb", lambda: (source.choice(("*", "**", "a/b", "*/stop", "status/*")), b"{}")),
        ("too long", lambda: (source.choice(VERBS), b" " * source.randrange(MAX_COMMAND_BYTES + 1, 60_000))),
        ("much too long", lambda: _seldom(source, lambda: (source.choice(VERBS), b"x" * 900_000), 200)),
        ("no lease", lambda: _keyed(source, new_key(), source.randrange(1, 1000))),
        ("out of order", lambda: _keyed(source, key, source.randrange(1, LAST_SEQUENCE))),
        ("bad key", lambda: _keyed(source, _word(source), 1)),
        ("holds", lambda: _holds(source)),
    )
    while True:
        kind, make = source.choice(makers)
        yield Sent(kind, *make())


def _word(source: random.Random) -> str:
    return "".join(source.choices(_LETTERS, k=source.randrange(1, 30)))


def _valid(source: random.Random, verb: str, key: str) -> bytes:
    values: dict[str, Any] = {"key": key, "sequence": source.randrange(1, 10)}
    if verb == Verb.LEASE:
        values |= {"action": source.choice(("renew", "release"))}
    return encode_command(Verb(verb), **({} if verb in ("status", "stop", "estop", "disarm") else values))


def _broken(source: random.Random, key: str) -> tuple[str, bytes]:
    """A message cut, or with a byte changed; the rest may hold, then it is out of order."""
    verb = source.choice(VERBS)
    payload = bytearray(_valid(source, verb, key))
    if source.random() < 0.5:
        return verb, bytes(payload[: source.randrange(len(payload))])
    payload[source.randrange(len(payload))] = source.randrange(256)
    return verb, bytes(payload)


def _mutated(source: random.Random, key: str) -> tuple[str, bytes]:
    """A message with a key left out, added or of another type."""
    verb = source.choice(VERBS)
    message = json.loads(_valid(source, verb, key))
    value = source.choice([None, True, -1, 1.5, "x", [], {}, "x" * 3000, 2**64, [[1]], {"a": {"b": 1}}])
    match source.randrange(3):
        case 0:
            del message[source.choice(list(message))]
        case 1:
            message[_word(source)] = value
        case _:
            message[source.choice(list(message))] = value
    return verb, json.dumps(message).encode()


def _keyed(source: random.Random, key: str, sequence: int) -> tuple[str, bytes]:
    verb = source.choice((Verb.HOME, Verb.ARM, Verb.ACCESS, Verb.SECURE, Verb.SWING, Verb.TEE, Verb.RESET))
    return verb, encode_command(verb, key=key, sequence=sequence)


def _holds(source: random.Random) -> tuple[str, bytes]:
    verb = source.choice((Verb.STATUS, Verb.STATUS, Verb.STATUS, Verb.DISARM, Verb.STOP, Verb.ESTOP))
    return verb, encode_command(verb)


def _seldom(source: random.Random, make: Callable[[], tuple[str, bytes]], share: int) -> tuple[str, bytes]:
    return make() if source.randrange(share) == 0 else (source.choice(VERBS), b" " * (MAX_COMMAND_BYTES + 1))


def fuzz(
    session: zenoh.Session,
    bench: str,
    count: int,
    key: str,
    seed: int = 1,
    each: Callable[[int], None] = lambda number: None,
) -> Tally:
    """Send `count` messages to `bench` and wait until each is answered or given up.

    `each` is called with the number of each message sent.
    """
    tally, lock, free = Tally(), threading.Lock(), threading.Semaphore(WINDOW)
    stream = messages(random.Random(seed), key)
    began = time.monotonic()
    for number in range(count):
        message = next(stream)
        tally.sent[message.kind] += 1
        free.acquire()
        _send(session, f"golfbench/{bench}/command/{message.verb}", message.payload, tally, lock, free)
        each(number)
    for _ in range(WINDOW):
        if not free.acquire(timeout=30.0):
            raise TimeoutError("a message is neither answered nor given up")
    tally.seconds = time.monotonic() - began
    return tally


def _send(
    session: zenoh.Session,
    selector: str,
    payload: bytes,
    tally: Tally,
    lock: threading.Lock,
    free: threading.Semaphore,
) -> None:
    outcomes: list[str] = []

    def heard(reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            answer = reply.ok.payload.to_bytes()
            outcomes.append("accepted" if parse_answer(answer).accepted else "refused")
        elif reply.err is not None and reply.err.encoding == zenoh.Encoding.APPLICATION_JSON:
            answer = reply.err.payload.to_bytes()
            outcomes.append("malformed")
            if parse_error(answer).location == "answer of the bench":
                tally.unreadable.append(answer)

    def done() -> None:
        with lock:
            tally.answered[outcomes[0] if len(outcomes) == 1 else f"{len(outcomes)} answers"] += 1
        free.release()

    session.get(selector, zenoh.handlers.Callback(heard, done, indirect=False), payload=payload, timeout=20.0)


def use_up(client: BenchClient) -> str:
    """Take the lease, use its last sequence number, return its key: all that follows is out of order."""
    held = client.take_lease("fuzz", 600.0)
    held.sequence = LAST_SEQUENCE - 1
    client.renew_lease()
    return held.key


def uncounted(tally: Tally, before: CountStatus, after: CountStatus) -> int:
    """Return how many messages are neither answered nor in the plane's counts as dropped (required: 0).

    The plane also counts the two reads of its status, or one of them: `after` includes itself.
    """
    counted = {name: after[name] - before[name] for name in ("commands", "refused", "malformed", "dropped")}
    counted["commands"] -= 1  # the look at `after`
    seen = {
        "commands": tally.answered["accepted"],
        "refused": tally.answered["refused"],
        "malformed": tally.answered["malformed"],
        "dropped": tally.answered["0 answers"],
    }
    return sum(abs(counted[name] - seen[name]) for name in seen)


@contextmanager
def plane_process() -> Iterator[tuple[Configuration, psutil.Process]]:
    """Yield the configuration and the process of a command plane in front of a desk without a bench."""
    configuration = loopback_configuration()
    port = configuration.network.endpoint.rpartition(":")[2]
    command = [sys.executable, "-m", "tests.benchmarks.command_fuzz", port]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        if process.stdout is None or process.stdout.readline() != b"ready\n":
            raise RuntimeError("the command plane did not start")
        yield configuration, psutil.Process(process.pid)
        process.terminate()


def fuzz_plane(count: int) -> list[Row]:
    """Return the figures of `count` messages."""
    memory: list[float] = []
    with plane_process() as (configuration, process):
        with BenchClient.connect(configuration) as client:
            key = use_up(client)
            before = client.status()["counts"]

            def watch(number: int) -> None:
                if number % (count // 50) == 0:
                    memory.append(process.memory_info().rss / 2**20)

            with open_client(configuration.network, "bench1") as session:
                tally = fuzz(session, configuration.bench.id, count, key, each=watch)
            after = client.status()["counts"]
    name = "command plane under fuzz"
    answered = sum(tally.answered[kind] for kind in ("accepted", "refused", "malformed"))
    kinds = ", ".join(f"{number} {kind}" for kind, number in sorted(tally.sent.items()))
    # The first fifth warms up allocators and threads.
    settled = memory[len(memory) // 5 :]
    return [
        Row(name, "sent", count, "messages", f"{count / tally.seconds:.0f} a second: {kinds}"),
        Row(name, "answered", answered, "messages", str(dict(tally.answered))),
        Row(name, "neither answered nor counted", uncounted(tally, before, after), "messages", at_most=0),
        Row(name, "unreadable answers", len(tally.unreadable), "messages", at_most=0),
        Row(name, "memory", settled[-1], "MiB", f"{memory[0]:.1f} at the start"),
        Row(name, "growth of memory over the last four fifths", settled[-1] - settled[0], "MiB", at_most=4.0),
    ]


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Fuzz a plane in a separate process."""
    return fuzz_plane(numbers("command_fuzz", arguments, messages=100_000).messages)


def serve(port: int) -> None:
    """Be a command plane at `port` until SIGTERM."""
    with running_plane(FakeDesk(), loopback_configuration(port)) as running:
        print("ready", flush=True)
        while True:
            running.plane.publish_state(running.service.status())
            time.sleep(0.01)


if __name__ == "__main__":
    serve(int(sys.argv[1]))
