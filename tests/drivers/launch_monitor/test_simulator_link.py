from __future__ import annotations

import json
import math
import socket
from collections.abc import Iterator
from contextlib import closing

import pytest

from drivers.base import DriverError
from drivers.launch_monitor.open_connect import write_answer, write_player
from drivers.launch_monitor.record import ClubFigures
from drivers.launch_monitor.settings import SimulatorSettings
from drivers.launch_monitor.simulator_link import MAX_WAITING, SimulatorClient
from tests.drivers.launch_monitor.stream import LAUNCH, serving
from tests.waiting import wait_until


@pytest.fixture
def gspro() -> Iterator[socket.socket]:
    """Stand in for GSPro: what listens where it would."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(10.0)
        yield listener


@pytest.fixture
def client(gspro: socket.socket) -> Iterator[SimulatorClient]:
    made = SimulatorClient(
        SimulatorSettings(True, "127.0.0.1", gspro.getsockname()[1]),
        "bench",
        sync_timeout=1.0,
        reconnect=0.05,
    )
    made.open()
    yield made
    made.close()


def accept(gspro: socket.socket) -> socket.socket:
    connection, _ = gspro.accept()
    connection.settimeout(10.0)
    return connection


def message(connection: socket.socket) -> dict[str, object]:
    data = b""
    while not data.endswith(b"}\n"):
        data += connection.recv(65_536)
    tree = json.loads(data)
    assert isinstance(tree, dict)
    return tree


def test_simulator_client_shot_is_sent_and_taken(gspro: socket.socket, client: SimulatorClient) -> None:
    assert client.send(LAUNCH, ClubFigures(speed=45.0), carry=230.0) == 1
    with accept(gspro) as connection:
        tree = message(connection)
        assert tree["ShotNumber"] == 1
        assert tree["DeviceID"] == "bench"
        connection.sendall(write_player("DR") + write_answer(200, "Shot received successfully"))
        wait_until(lambda: client.status().taken == 1)
        passing = client.status()
        assert (passing.connected, passing.fault, passing.waiting) == (True, "", 0)
        assert passing.player is not None
        assert passing.player.club == "DR"


def test_simulator_client_unanswered_shot_is_resent_once(
    gspro: socket.socket, client: SimulatorClient
) -> None:
    client.send(LAUNCH)
    with accept(gspro) as connection:
        assert message(connection) == message(connection)
        wait_until(lambda: client.status().refused == 1)
        assert "not answered" in client.status().fault


def test_simulator_client_disconnects_limit_shot_to_two_sends(
    gspro: socket.socket, client: SimulatorClient
) -> None:
    client.send(LAUNCH)
    client.send(LAUNCH)
    numbers = []
    for _ in range(4):
        with accept(gspro) as connection:
            numbers.append(message(connection)["ShotNumber"])
    wait_until(lambda: client.status().refused == 1)
    with accept(gspro):
        wait_until(lambda: client.status().refused == 2)
    assert numbers == [1, 1, 2, 2]


def test_simulator_client_truncated_answer_keeps_next_answer(
    gspro: socket.socket, client: SimulatorClient
) -> None:
    client.send(LAUNCH)
    with accept(gspro) as connection:
        message(connection)
        connection.sendall(b"not valid json {{{")
        message(connection)
        connection.sendall(write_answer(200, "Shot received successfully"))
        wait_until(lambda: client.status().taken == 1)


def test_simulator_client_answer_with_player_sets_player(
    gspro: socket.socket, client: SimulatorClient
) -> None:
    client.send(LAUNCH)
    with accept(gspro) as connection:
        message(connection)
        connection.sendall(b'{"Code": 200, "Message": "ok", "Player": {"Handed": "LH", "Club": "I7"}}')
        wait_until(lambda: client.status().taken == 1)
    player = client.status().player
    assert player is not None
    assert (player.club, player.handed) == ("I7", "LH")


def test_simulator_client_refused_shot_reports_fault_and_continues(
    gspro: socket.socket, client: SimulatorClient
) -> None:
    client.send(LAUNCH)
    with accept(gspro) as connection:
        message(connection)
        connection.sendall(write_answer(501, "no player"))
        wait_until(lambda: client.status().refused == 1)
        assert "501: no player" in client.status().fault
        client.send(LAUNCH)
        message(connection)
        connection.sendall(write_answer(200, ""))
        wait_until(lambda: client.status().taken == 1)


def test_simulator_client_reconnects_and_resends_shot(gspro: socket.socket, client: SimulatorClient) -> None:
    client.send(LAUNCH)
    with accept(gspro) as connection:
        first = message(connection)
    with accept(gspro) as connection:
        assert message(connection) == first
        connection.sendall(write_answer(200, ""))
        wait_until(lambda: client.status().taken == 1)


def test_simulator_client_endless_answer_reconnects(gspro: socket.socket, client: SimulatorClient) -> None:
    with accept(gspro) as connection, pytest.raises(OSError):  # noqa: PT011, PT012
        while True:
            connection.sendall(b'{"a' + b"x" * 100_000)
    with accept(gspro):
        wait_until(lambda: client.status().connected)


def test_simulator_client_unreachable_drops_out_of_date_shots() -> None:
    now = [0.0]
    with socket.create_server(("127.0.0.1", 0)) as held:
        port = held.getsockname()[1]
    client = SimulatorClient(SimulatorSettings(True, "127.0.0.1", port), clock=lambda: now[0], reconnect=0.01)
    client.open()
    with pytest.raises(DriverError, match="already open"):
        client.open()
    try:
        client.send(LAUNCH)
        wait_until(lambda: "refused" in client.status().fault)
        assert client.status().waiting == 1
        now[0] = 11.0
        wait_until(lambda: client.status().out_of_date == 1)
        assert not client.status().connected
    finally:
        client.close()


def test_simulator_client_bounds_queue_and_rejects_nan() -> None:
    client = SimulatorClient(SimulatorSettings())
    with pytest.raises(ValueError, match="JSON"):
        client.send(LAUNCH._replace(speed=math.nan))
    numbers = [client.send(LAUNCH) for _ in range(MAX_WAITING + 2)]
    assert numbers == list(range(1, MAX_WAITING + 3))
    assert (client.status().waiting, client.status().out_of_date) == (MAX_WAITING, 2)
    client.close()


def test_simulator_client_and_server_exchange_shot_and_player() -> None:
    with serving() as server:
        client = SimulatorClient(SimulatorSettings(True, *server.address), "bench")
        client.open()
        with closing(client):
            server.announce_player("PT")
            client.send(LAUNCH)
            wait_until(lambda: client.status().taken == 1)
            (record,) = server.take()
            assert record.launch == pytest.approx(LAUNCH, abs=1e-4)
            wait_until(lambda: client.status().player is not None)
