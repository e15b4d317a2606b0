from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from bench.base.lifecycle import Request
from bench.control.step_records import CONTROL_STATE
from bench.supervisor._supervision import SUPERVISION, SUPERVISION_FILE, Orders
from drivers.base.compiled import new_record
from drivers.base.shared_memory import SharedRecord

SILENCE = 0.25


class Supervisor:
    def __init__(self, folder: Path) -> None:
        self.shared = SharedRecord.create(folder / SUPERVISION_FILE, SUPERVISION)
        self.record = new_record(SUPERVISION)

    def say(self, **values: int) -> None:
        for name, value in values.items():
            self.record[name] = value
        self.shared.write(self.record)


@pytest.fixture
def supervisor(tmp_path: Path) -> Iterator[Supervisor]:
    made = Supervisor(tmp_path)
    yield made
    made.shared.close()


@pytest.fixture
def orders(tmp_path: Path, supervisor: Supervisor) -> Iterator[Orders]:
    supervisor.say(heartbeat=7, request=Request.ARM, request_number=3, stop_count=2, emergency_stop_count=1)
    made = Orders(tmp_path / SUPERVISION_FILE, SILENCE)
    yield made
    made.close()


Put = Callable[[float], np.void]


@pytest.fixture
def put(orders: Orders) -> Put:
    """Put new orders into a controller's state, as the loop does; clear the request, as a step does."""
    control = new_record(CONTROL_STATE)

    def put(time: float) -> np.void:
        orders.put(control, time)
        seen: np.void = control.copy()[0]
        control["request"] = 0
        return seen

    return put


def test_orders_request_before_start_is_ignored(put: Put) -> None:
    assert put(100.0)["request"] == 0


def test_orders_request_is_put_once_with_number(put: Put, supervisor: Supervisor) -> None:
    put(100.0)
    supervisor.say(request=Request.RESET, request_number=4)
    seen = put(100.001)
    assert (seen["request"], seen["request_number"]) == (Request.RESET, 4)
    assert put(100.002)["request"] == 0


def test_orders_stops_precede_request_and_none_is_lost(put: Put, supervisor: Supervisor) -> None:
    supervisor.say(request=Request.SWING, request_number=4, stop_count=3, emergency_stop_count=2)
    found = [int(put(100.0 + 0.001 * k)["request"]) for k in range(4)]
    assert found == [Request.EMERGENCY_STOP, Request.STOP, Request.SWING, 0]


def test_orders_silent_supervisor_drops_lease_and_support(put: Put, supervisor: Supervisor) -> None:
    supervisor.say(heartbeat=8, lease=1, support_ready=True)
    alive = put(100.0)
    assert alive["supervisor_alive"]
    assert alive["lease_held"]
    assert alive["support_ready"]
    assert put(100.0 + 0.9 * SILENCE)["supervisor_alive"]
    dead = put(100.0 + 1.1 * SILENCE)
    assert not any(dead[name] for name in ("supervisor_alive", "lease_held", "support_ready"))
    supervisor.say(heartbeat=9)
    assert put(101.0)["supervisor_alive"]


def test_orders_shutdown_is_read(put: Put, orders: Orders, supervisor: Supervisor) -> None:
    put(100.0)
    assert not orders.shutdown
    supervisor.say(shutdown=True)
    put(100.001)
    assert orders.shutdown


def test_orders_supervisor_declared_dead_stays_dead(put: Put, orders: Orders, supervisor: Supervisor) -> None:
    supervisor.say(heartbeat=8, lease=1)
    assert put(100.0)["supervisor_alive"]
    orders.declare_supervisor_dead()
    seen = put(100.001)
    assert not seen["supervisor_alive"]
    assert not seen["lease_held"]
    supervisor.say(heartbeat=9)
    assert not put(100.002)["supervisor_alive"]


# A lease that is handed over ---------------------------------------------------------------------------

HELD = {"heartbeat": 8, "lease": 1}


@pytest.mark.parametrize(
    ("orders_said", "seen"),
    [
        ([{"heartbeat": 9, "lease": 0}, {"heartbeat": 10, "lease": 2}], [(0, False), (0, True), (0, True)]),
        (  # a request of the new holder waits for a tick
            [{"lease": 2, "request": Request.SWING, "request_number": 4, "request_lease": 2}],
            [(0, False), (Request.SWING, True), (0, True)],
        ),
        (  # one of the old holder is put without a lease: the loop stood still for longer than he waited
            [{"request": Request.ARM, "request_number": 4, "request_lease": 1}, {"lease": 2}],
            [(Request.ARM, False), (0, True), (0, True)],
        ),
        (  # a stop does not wait
            [
                {
                    "lease": 2,
                    "stop_count": 3,
                    "request": Request.SWING,
                    "request_number": 4,
                    "request_lease": 2,
                }
            ],
            [(Request.STOP, False), (Request.SWING, True), (0, True)],
        ),
    ],
)
def test_orders_lease_handover_between_ticks_drops_lease_for_one_tick(
    put: Put, supervisor: Supervisor, orders_said: list[dict[str, int]], seen: list[tuple[int, bool]]
) -> None:
    supervisor.say(**HELD)
    assert put(100.0)["lease_held"]
    for values in orders_said:
        supervisor.say(**values)
    ticks = [put(100.001 + 0.001 * k) for k in range(3)]
    assert [(int(tick["request"]), bool(tick["lease_held"])) for tick in ticks] == seen


def test_orders_lease_follows_grant_release_and_silence(put: Put, supervisor: Supervisor) -> None:
    assert not put(100.0)["lease_held"]
    supervisor.say(**HELD)
    assert put(100.001)["lease_held"]
    supervisor.say(heartbeat=9, lease=0)
    assert not put(100.002)["lease_held"]
    supervisor.say(heartbeat=10, lease=2)
    assert put(100.003)["lease_held"]
    assert not put(100.0 + 2 * SILENCE)["lease_held"]
    supervisor.say(heartbeat=11, lease=3)
    assert [bool(put(101.0 + 0.001 * k)["lease_held"]) for k in range(2)] == [False, True]
