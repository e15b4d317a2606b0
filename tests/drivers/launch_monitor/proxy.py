"""Proxy between the simulated launch monitor and a bench: it sends what other monitors would send.

    python -m tests.drivers.launch_monitor.proxy DIALECT LISTEN_PORT BENCH_PORT

forwards until Ctrl-C. The monitor connects to LISTEN_PORT of this machine, with the ball's and the club's
figures in one message of version 1 (`golfbench launch-monitor --club`).
"""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

from drivers.launch_monitor.conversation import ObjectStream

Tree = dict[str, Any]
_YARD = 0.9144
_ZEROS = ("Speed", "VLA", "HLA", "TotalSpin", "SpinAxis", "BackSpin", "SideSpin", "CarryDistance")
_CLUB = ("AngleOfAttack", "FaceToTarget", "Path", "Loft", "VerticalFaceImpact", "HorizontalFaceImpact")


class Dialect(NamedTuple):
    """A monitor's messages for a message of the simulated one."""

    messages: Callable[[Tree], list[Tree]]
    per_shot: bool = False
    """Whether it opens a connection for each shot, and sends nothing else."""


def _ball(tree: Tree) -> Tree:
    options = {**tree["ShotDataOptions"], "ContainsClubData": False}
    return {**{k: v for k, v in tree.items() if k != "ClubData"}, "ShotDataOptions": options}


def _club(tree: Tree) -> Tree:
    options = {**tree["ShotDataOptions"], "ContainsBallData": False}
    return {**tree, "BallData": dict.fromkeys(_ZEROS, 0), "ShotDataOptions": options}


def _club_before_ball(tree: Tree) -> list[Tree]:
    number = 2 * tree["ShotNumber"]
    return [{**_club(tree), "ShotNumber": number}, {**_ball(tree), "ShotNumber": number + 1}]


def _metric(tree: Tree) -> list[Tree]:
    ball = {**tree["BallData"]}
    if "CarryDistance" in ball:
        ball["CarryDistance"] *= _YARD
    club = {**dict.fromkeys(_CLUB, 0.0), "Speed": tree["ClubData"]["Speed"]}
    return [{**tree, "Units": "Metric", "BallData": ball, "ClubData": club}]


DIALECTS: Mapping[str, Dialect] = {
    "club-after-ball": Dialect(lambda tree: [_ball(tree), _club(tree)]),
    "club-before-ball": Dialect(_club_before_ball),
    "version-2": Dialect(lambda tree: [{**tree, "APIversion": "2"}]),
    "connection-per-shot": Dialect(lambda tree: [tree], per_shot=True),
    "metric": Dialect(_metric),
}


class Proxy:
    """Serves one monitor at a time; `dialect` may be changed between shots."""

    def __init__(self, dialect: str, bench_port: int, port: int = 0) -> None:
        self.dialect = dialect
        self._bench = ("127.0.0.1", bench_port)
        self._listener = socket.create_server(("127.0.0.1", port))
        self._listener.settimeout(0.1)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="proxy")
        self._thread.start()

    @property
    def port(self) -> int:
        """Port it listens at."""
        port: int = self._listener.getsockname()[1]
        return port

    def close(self) -> None:
        """End."""
        self._ended.set()
        self._thread.join()
        self._listener.close()

    def _serve(self) -> None:
        while not self._ended.is_set():
            with suppress(OSError), self._listener.accept()[0] as monitor:  # a time-out, or either side went
                monitor.settimeout(0.02)
                self._forward(monitor)

    def _forward(self, monitor: socket.socket) -> None:
        stream, bench = ObjectStream(), None
        try:
            while not self._ended.is_set():
                per_shot = DIALECTS[self.dialect].per_shot
                if per_shot and bench is not None:
                    bench.close()
                    bench = None
                elif not per_shot and bench is None:
                    bench = self._connect()
                if bench is not None:
                    with suppress(TimeoutError):
                        if not (answer := bench.recv(65_536)):
                            return
                        monitor.sendall(answer)
                with suppress(TimeoutError):
                    if not (data := monitor.recv(65_536)):
                        return
                    for found in stream.feed(data):
                        self._send(json.loads(found), bench)
        finally:
            if bench is not None:
                bench.close()

    def _connect(self) -> socket.socket:
        bench = socket.create_connection(self._bench, 5.0)
        bench.settimeout(0.02)
        return bench

    def _send(self, tree: Tree, bench: socket.socket | None) -> None:
        dialect = DIALECTS[self.dialect]
        shot = tree["ShotDataOptions"]["ContainsBallData"]
        messages = [json.dumps(each).encode() for each in (dialect.messages(tree) if shot else [tree])]
        if bench is not None:
            for message in messages:
                bench.sendall(message)
        elif shot:
            with self._connect() as once:  # and gone, without reading the answer
                once.sendall(b"".join(messages))


if __name__ == "__main__":
    proxy = Proxy(sys.argv[1], int(sys.argv[3]), int(sys.argv[2]))
    with suppress(KeyboardInterrupt):
        while True:
            time.sleep(1.0)
    proxy.close()
