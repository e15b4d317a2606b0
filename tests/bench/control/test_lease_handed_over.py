"""A lease that is handed over disarms the bench, however quickly it happens."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from bench.base.lifecycle import Phase, Reaction, Request, State
from bench.supervisor._supervision import SUPERVISION, SUPERVISION_FILE, Orders
from drivers.base.compiled import new_record
from drivers.base.shared_memory import SharedRecord
from tests.bench.control.operating import reach
from tests.bench.control.puppet import Puppet, entered


class Led:
    """A puppet whose permissions and requests come the way a running bench's do."""

    def __init__(self, folder: Path) -> None:
        self.shared = SharedRecord.create(folder / SUPERVISION_FILE, SUPERVISION)
        self.record = new_record(SUPERVISION)
        self.shared.write(self.record)
        self.orders = Orders(folder / SUPERVISION_FILE, 0.5)
        self.heartbeat = 0

    def say(self, **values: int) -> None:
        for name, value in values.items():
            self.record[name] = value
        self.shared.write(self.record)

    def ask(self, request: Request) -> None:
        """Put `request` under the lease that is in force."""
        number = int(self.record["request_number"][0]) + 1
        self.say(request=request, request_number=number, request_lease=int(self.record["lease"][0]))

    def run(self, puppet: Puppet, ticks: int) -> None:
        for _ in range(ticks):
            self.heartbeat += 1
            self.say(heartbeat=self.heartbeat, support_ready=1)
            puppet.control["request"] = 0
            self.orders.put(puppet.state.control, puppet.time + puppet.period)
            puppet.step(int(puppet.control["request"]))


@pytest.fixture
def led(tmp_path: Path) -> Iterator[Led]:
    made = Led(tmp_path)
    made.say(lease=1)
    yield made
    made.orders.close()
    made.shared.close()


def grant_access(led: Led) -> None:
    """Let one holder release the bench and another one take it between two ticks."""
    led.say(lease=0)
    led.say(lease=2)


def test_lease_change_disarms_armed_bench_and_refuses_swing_of_new_holder(led: Led) -> None:
    puppet = reach(State.ARMED)
    led.run(puppet, 5)
    assert not puppet.is_without_energy()
    grant_access(led)
    led.ask(Request.SWING)
    led.run(puppet, 1)
    assert puppet.bench is State.READY
    assert puppet.is_without_energy()
    led.run(puppet, 50)
    assert not puppet.control["swings"]


def test_lease_change_during_swing_completes_and_disarms(led: Led) -> None:
    puppet = reach(State.SWINGING, hold_between_swings=True)
    led.run(puppet, 5)
    grant_access(led)
    led.run(puppet, 1)
    assert puppet.bench is State.SWINGING
    led.run(puppet, 2000)
    assert (puppet.bench, puppet.phase) == (State.READY, Phase.STANDING)


def test_lease_lost_during_homing_brakes_and_ends_without_energy() -> None:
    puppet = entered(Phase.HOMING)
    puppet.give(lease_held=False).tick()
    assert (puppet.bench, puppet.reaction) == (State.HOMING, Reaction.BRAKE)
    puppet.run(1600)
    assert puppet.bench is State.SAFE
    assert puppet.is_without_energy()
