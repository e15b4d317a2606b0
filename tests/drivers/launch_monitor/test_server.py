from __future__ import annotations

import gc
import json
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from math import radians

import pytest

from drivers.base import DriverError
from drivers.launch_monitor import server as server_module
from drivers.launch_monitor.open_connect import write_heartbeat
from drivers.launch_monitor.record import ClubRecord, RefusedRecord
from drivers.launch_monitor.server import MAX_CONNECTIONS, LaunchMonitorServer
from drivers.launch_monitor.settings import LaunchMonitorSettings, SimulatorSettings
from tests.drivers.launch_monitor.stream import LAUNCH, receive, serving, shot
from tests.waiting import wait_until


class Clock:
    """A clock that a test moves on."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def server(clock: Clock) -> Iterator[LaunchMonitorServer]:
    with serving(clock=clock) as made:
        yield made


@pytest.fixture
def connect(server: LaunchMonitorServer) -> Iterator[Callable[[], socket.socket]]:
    made: list[socket.socket] = []

    def one() -> socket.socket:
        made.append(socket.create_connection(server.address, 10.0))
        return made[-1]

    yield one
    for connection in made:
        connection.close()


Connect = Callable[[], socket.socket]


def test_server_shot_is_answered_and_taken_once(server: LaunchMonitorServer, connect: Connect) -> None:
    connection = connect()
    connection.sendall(shot(5))
    assert b'"Code": 200' in receive(connection, 1)
    (record,) = server.take()
    assert record.launch == pytest.approx(LAUNCH, abs=1e-4)
    assert (record.number, record.device, record.time, record.doubts) == (5, "monitor", 100.0, ())
    assert server.take() == []


def test_server_split_and_joined_messages_are_parsed(server: LaunchMonitorServer, connect: Connect) -> None:
    connection = connect()
    data = shot(1) + shot(2).rstrip() + shot(3)
    for start in range(0, len(data), 97):
        connection.sendall(data[start : start + 97])
    assert receive(connection, 3).count(b'"Code": 200') == 3
    assert [record.number for record in server.take()] == [1, 2, 3]


def test_server_heartbeat_updates_monitor_without_answer(
    server: LaunchMonitorServer, connect: Connect
) -> None:
    connection = connect()
    connection.sendall(write_heartbeat(0, "monitor") + shot())
    assert receive(connection, 1).count(b"Code") == 1
    (connected,) = server.link().connected
    assert (connected.device, connected.ready, connected.ball_detected) == ("monitor", True, False)


def test_server_refused_message_gets_501_and_continues(server: LaunchMonitorServer, connect: Connect) -> None:
    connection = connect()
    connection.sendall(b'xx{"a": }, {"BallData": 3}' + shot())
    answers = receive(connection, 3)
    assert answers.count(b'"Code": 501') == 2
    assert answers.count(b'"Code": 200') == 1
    counts = server.link().counts
    assert (counts.objects, counts.shots, counts.refused, counts.passed_over) == (3, 1, 2, 5)


def test_server_endless_object_is_disconnected(server: LaunchMonitorServer, connect: Connect) -> None:
    connection, other = connect(), connect()
    with pytest.raises(OSError):  # noqa: PT011, PT012 - reset or broken pipe
        for _ in range(10_000):
            connection.sendall(b'{"a": "' + b"x" * 10_000)
    other.sendall(shot())
    assert b"200" in receive(other, 1)
    wait_until(lambda: len(server.link().connected) == 1)
    assert (server.link().counts.too_large, server.link().disconnected) == (1, 1)


def test_server_truncated_object_is_dropped_and_next_parsed(
    server: LaunchMonitorServer, connect: Connect, clock: Clock
) -> None:
    connection = connect()
    connection.sendall(shot()[:100])
    wait_until(lambda: server.link().counts.received == 100)
    clock.now += 2.5
    connection.sendall(shot(2))
    receive(connection, 1)
    assert [record.number for record in server.take()] == [2]
    assert server.link().counts.cut_off == 1


def test_server_monitor_not_reading_is_disconnected(server: LaunchMonitorServer, connect: Connect) -> None:
    connection = connect()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    with pytest.raises(OSError):  # noqa: PT011, PT012 - reset or broken pipe
        for _ in range(1000):
            connection.sendall(b'{"a":1}' * 5000)
    wait_until(lambda: not server.link().connected)
    assert server.link().disconnected == 1


def test_server_silence_disconnects_only_after_heartbeats(
    server: LaunchMonitorServer, connect: Connect, clock: Clock
) -> None:
    beating, quiet = connect(), connect()
    beating.sendall(3 * write_heartbeat(0, "beating"))
    quiet.sendall(shot())
    wait_until(lambda: server.link().counts.objects == 4)
    clock.now += 31.0
    wait_until(lambda: len(server.link().connected) == 1)
    assert server.link().connected[0].device == "monitor"
    assert beating.recv(10) == b""
    assert server.link().counts.statuses == 3  # what is gone is still counted


def adapter_beat(ready: str) -> bytes:
    """Return a heartbeat of a radar's adapter, which sends one on connection and one per change."""
    return (
        b'{"DeviceID":"GSPRO-R10","Units":"Yards","ShotNumber":0,"APIVersion":"1","BallData":null,'
        b'"ClubData":null,"ShotDataOptions":{"ContainsBallData":false,"ContainsClubData":false,'
        b'"LaunchMonitorIsReady":%s,"LaunchMonitorBallDetected":%s,"IsHeartBeat":true}}'
    ).replace(b"%s", ready.encode())


def test_server_heartbeats_on_changes_alone_keep_idle_monitor(
    server: LaunchMonitorServer, connect: Connect, clock: Clock
) -> None:
    """A radar's adapter beats on connection and on changes: cut off while idle, it is absent 5 s per 35 s."""
    connection = connect()
    connection.sendall(b"".join(map(adapter_beat, ("false", "true"))))
    for number in range(3):
        connection.sendall(shot(number) + adapter_beat("true"))
        receive(connection, 1)
    wait_until(lambda: server.link().counts.statuses == 5)
    clock.now += 300.0
    seen = server.link().connected[0].silent
    time.sleep(0.6)  # two checks
    assert seen == 300.0
    assert len(server.link().connected) == 1
    connection.sendall(shot(3))
    assert b'"Code": 200' in receive(connection, 1)


def test_server_unreachable_machine_is_given_up_after_silence(
    server: LaunchMonitorServer, connect: Connect
) -> None:
    connect()
    wait_until(lambda: server.link().connected)
    (client,) = server._clients
    options = (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_USER_TIMEOUT)
    opened = client.writer.get_extra_info("socket")
    held = [opened.getsockopt(socket.IPPROTO_TCP, option) for option in options]
    assert held == [15, 5, 30_000]


def test_server_monitor_reconnects(server: LaunchMonitorServer, connect: Connect) -> None:
    for number in range(5):
        connection = connect()
        connection.sendall(shot(number))
        receive(connection, 1)
        connection.close()
    wait_until(lambda: not server.link().connected)
    assert server.link().connections == 5
    assert [record.number for record in server.take()] == [0, 1, 2, 3, 4]


CLUB = b'{"DeviceID": "monitor", "ClubData": {"Speed": 96, "Path": %s}}'


def test_server_take_asides_returns_club_and_refusal(
    server: LaunchMonitorServer, connect: Connect, clock: Clock
) -> None:
    connection = connect()
    connection.sendall(CLUB % b"0.4" + b'{"Ball": 1}')
    assert b'"Code": 200' in receive(connection, 2)
    club, refused = server.take_asides()
    assert isinstance(club, ClubRecord)
    assert isinstance(refused, RefusedRecord)
    assert club.device == "monitor"
    assert club.club.speed == pytest.approx(96 * 0.44704)
    assert refused == RefusedRecord(100.0, "neither BallData nor ShotDataOptions")
    link = server.link()
    assert (link.counts.clubs, link.understood, link.refusal) == (1, 100.0, refused.reason)
    assert (server.take(), server.take_asides()) == ([], [])
    clock.now += 1.0
    connection.sendall(shot()[:50])
    connection.close()
    wait_until(lambda: server.link().refusal == "an object cut off after 50 bytes")


def test_server_club_zero_counts_after_other_value(server: LaunchMonitorServer, connect: Connect) -> None:
    for path in (b"0", b"0.4", b"0"):  # a connection each
        connection = connect()
        connection.sendall((CLUB % path).replace(b"Path", b'AngleOfAttack": 1.5, "Path'))
        receive(connection, 1)
    clubs = [club for club in server.take_asides() if isinstance(club, ClubRecord)]
    assert [club.club.path for club in clubs] == [None, pytest.approx(radians(0.4)), 0.0]
    assert ("club.path", "0 in each message so far: not measured") in clubs[0].absent


def test_server_per_shot_connection_is_taken_without_greeting(clock: Clock) -> None:
    with serving(clock=clock, presence="per_shot") as per_shot:
        per_shot.announce_player("DR")
        for number in range(50):
            with socket.create_connection(per_shot.address, 10.0) as connection:
                connection.sendall(shot(number))
        with socket.create_connection(per_shot.address, 10.0) as connection:
            connection.sendall(shot(50))
            assert json.loads(receive(connection, 1))["Code"] == 200
        wait_until(lambda: per_shot.link().counts.shots == 51)
        assert [record.number for record in per_shot.take()] == list(range(51))


def test_server_connections_above_limit_are_rejected(server: LaunchMonitorServer, connect: Connect) -> None:
    first = [connect() for _ in range(server_module.MAX_CONNECTIONS)]
    wait_until(lambda: len(server.link().connected) == len(first))
    assert connect().recv(1) == b""
    assert server.link().rejected == 1
    assert server.link().refusal == "connection from 127.0.0.1: 8 are connected"


def test_server_player_is_announced_to_present_and_new_clients(
    server: LaunchMonitorServer, connect: Connect
) -> None:
    before = connect()
    wait_until(lambda: server.link().connected)
    server.announce_player("I7")
    assert b'"Club": "I7"' in receive(before, 1)
    assert b'"Club": "I7"' in receive(connect(), 1)


def test_server_sends_player_ready_and_end_codes(server: LaunchMonitorServer, connect: Connect) -> None:
    server.announce_player("DR")
    connection = connect()
    wait_until(lambda: server.link().connected)
    greeting = receive(connection, 2)
    first, end = json.JSONDecoder().raw_decode(greeting.decode())
    assert first["Player"] == {"Handed": "RH", "Club": "DR", "DistanceToTarget": 251.5}
    assert (first["Code"], json.loads(greeting[end:])["Code"]) == (201, 202)
    assert b"\n" not in greeting
    server.announce_player("DR")
    again = receive(connection, 2)
    assert (again.count(b'"Code": 201'), again.count(b'"Code": 202')) == (1, 1)
    connection.sendall(shot())
    assert b'"Code": 200' in receive(connection, 1)
    server.close()
    assert receive(connection, 2).count(b'"Code": 203') == 1


def test_server_player_and_ready_come_in_separate_reads(
    server: LaunchMonitorServer, connect: Connect
) -> None:
    """A camera monitor's connector takes each read for one object, and arms at neither of two in one."""
    server.announce_player("I7")
    connection = connect()
    assert [json.loads(connection.recv(4096))["Code"] for _ in range(2)] == [201, 202]
    server.announce_player("I7")
    assert [json.loads(connection.recv(4096))["Code"] for _ in range(2)] == [201, 202]


def test_server_resting_ball_is_status_with_answer(server: LaunchMonitorServer, connect: Connect) -> None:
    """A camera monitor's connector, with a ball at rest: one such message each 2 s."""
    connection = connect()
    resting = (
        b'{"DeviceID": "SquareGolf", "ShotNumber": 2, "BallData": {"Speed": 0.0}, "ShotDataOptions": '
        b'{"ContainsBallData": true, "LaunchMonitorBallDetected": true, "LaunchMonitorIsReady": true, '
        b'"IsHeartBeat": false}}'
    )
    connection.sendall(resting)
    answer = json.loads(receive(connection, 1))
    assert answer == {"Code": 200, "Message": "No shot: a ball of speed 0"}
    link = server.link()
    assert (link.counts.statuses, link.counts.refused, link.refusal) == (1, 0, "")
    assert link.understood == 100.0
    (connected,) = link.connected
    assert (connected.device, connected.ready, connected.ball_detected) == ("SquareGolf", True, True)
    assert (server.take(), server.take_asides()) == ([], [])


def test_server_doubtful_shot_is_kept_with_reason(server: LaunchMonitorServer, connect: Connect) -> None:
    connection = connect()
    connection.sendall(shot().replace(b'"VLA": 11.4592', b'"VLA": 0.0'))
    assert b"200" in receive(connection, 1)
    (record,) = server.take()
    assert record.launch is not None
    assert not record.valid
    assert "launch angle" in record.reason


def test_server_untaken_records_above_limit_count_as_lost(
    server: LaunchMonitorServer, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "MAX_WAITING", 3)
    connection = connect()
    connection.sendall(b"".join(map(shot, range(5))))
    receive(connection, 5)
    assert [record.number for record in server.take()] == [2, 3, 4]
    assert server.link().lost == 2


def test_server_internal_error_closes_only_affected_connection(
    server: LaunchMonitorServer, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError

    connection = connect()
    with monkeypatch.context() as patched:
        patched.setattr("drivers.launch_monitor.conversation.read_message", fail)
        connection.sendall(shot())
        assert connection.recv(10) == b""
    assert server.link().failures == 1
    again = connect()
    again.sendall(shot())
    assert b"200" in receive(again, 1)


def test_server_close_releases_thread_and_sockets(clock: Clock) -> None:
    before = len(os.listdir("/proc/self/fd"))
    server = LaunchMonitorServer(LaunchMonitorSettings(), port=0, clock=clock)
    server.close()
    for _ in range(3):
        server.open()
        with socket.create_connection(server.address) as connection:
            wait_until(lambda: server.link().connected)
            with pytest.raises(DriverError, match="already open"):
                server.open()
            server.close()
            assert connection.recv(1) == b""
        server.close()
        with pytest.raises(DriverError, match="closed"):
            _ = server.address
    assert len(os.listdir("/proc/self/fd")) == before
    assert not [thread for thread in threading.enumerate() if "launch" in thread.name]


def test_server_close_ends_during_connection(clock: Clock) -> None:
    for _ in range(20):
        server = LaunchMonitorServer(LaunchMonitorSettings(), port=0, clock=clock)
        server.open()
        with socket.create_connection(server.address), socket.create_connection(server.address):
            closing = threading.Thread(target=server.close)
            closing.start()
            closing.join(10.0)
            assert not closing.is_alive()


def test_server_close_with_waiting_connections_leaves_no_socket_open(clock: Clock) -> None:
    gc.collect()
    for pause in 4 * (0.0, 0.001, 0.02):
        before = len(os.listdir("/proc/self/fd"))
        server = LaunchMonitorServer(LaunchMonitorSettings(), port=0, clock=clock)
        server.open()
        clients = [socket.create_connection(server.address) for _ in range(MAX_CONNECTIONS + 4)]
        time.sleep(pause)
        server.close()
        assert len(os.listdir("/proc/self/fd")) == before + len(clients)
        for client in clients:
            client.close()
    gc.collect()  # a transport that nobody closed warns here


def test_server_port_in_use_is_refused(server: LaunchMonitorServer) -> None:
    second = LaunchMonitorServer(LaunchMonitorSettings(), port=server.address[1])
    with pytest.raises(DriverError, match=r"Address already in use.*launch_monitor\.port"):
        second.open()
    second.close()


def test_launch_monitor_settings_network_requires_clients() -> None:
    with pytest.raises(ValueError, match="clients"):
        LaunchMonitorSettings(address="0.0.0.0")  # noqa: S104
    with pytest.raises(ValueError, match="IP address"):
        LaunchMonitorSettings(address="localhost")
    with pytest.raises(ValueError, match="IP address"):
        LaunchMonitorSettings(clients=("somebody",))
    with pytest.raises(ValueError, match="IP address"):
        SimulatorSettings(address="")
    named = LaunchMonitorSettings(address="192.0.2.1", clients=("192.0.2.7",))
    assert named.accepts("192.0.2.7")
    assert not named.accepts("127.0.0.1")
    assert LaunchMonitorSettings().accepts("127.0.0.1")


def test_server_unlisted_client_is_rejected(clock: Clock) -> None:
    with serving(clock=clock, clients=("192.0.2.7",)) as server:
        with socket.create_connection(server.address) as connection:
            assert connection.recv(1) == b""
        assert server.link().rejected == 1


def test_server_ipv6_shot_is_answered() -> None:
    if (
        not socket.has_ipv6
        or not os.path.exists("/proc/net/if_inet6")
        or not os.path.getsize("/proc/net/if_inet6")
    ):
        pytest.skip("this machine has no IPv6")
    with serving(address="::1") as server, socket.create_connection(server.address) as connection:
        connection.sendall(shot())
        assert b"200" in receive(connection, 1)
