"""The valve node's watchdog, on a clock of ticks."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from drivers.base import PASSIVE, Command
from sim.live.valve_watchdog import Mode, ValveNode

WATCHDOG = 5
MOVING = Command(valve=(0.3, -0.2, 0.1), supply_enable=True, exhaust_closed=True)


def enabled(session: int = 1) -> ValveNode:
    node = ValveNode(WATCHDOG)
    for number in range(1, session + 1):
        node.receive(0, number, number, Mode.START, MOVING)
    return node


def run(node: ValveNode, first: int, last: int) -> list[Command]:
    """Watch over the ticks and return the command in force in each."""
    in_force = []
    for tick in range(first, last):
        node.watch(tick)
        in_force.append(node.applied)
    return in_force


def test_it_is_passive_until_it_is_set_operational_and_then_until_a_command() -> None:
    node = ValveNode(WATCHDOG)
    node.receive(0, 1, 0, Mode.OPERATE, MOVING)
    assert (node.operational, node.applied) == (False, PASSIVE)
    node.receive(1, 2, 1, Mode.OPERATE, MOVING)
    assert (node.operational, node.applied) == (False, PASSIVE)
    node.receive(1, 2, 1, Mode.START, MOVING)
    assert (node.operational, node.applied) == (True, PASSIVE)
    assert run(node, 1, 100) == [PASSIVE] * 99
    assert (node.operational, node.trips) == (True, 0)  # nothing was asked of it, nothing is missed
    node.receive(100, 3, 1, Mode.OPERATE, MOVING)
    assert node.applied == MOVING


def test_silence_of_the_watchdogs_time_makes_it_passive() -> None:
    node = enabled()
    node.receive(7, 2, 1, Mode.OPERATE, MOVING)
    assert run(node, 7, 15) == [MOVING] * WATCHDOG + [PASSIVE] * 3
    assert (node.operational, node.passive_by_watchdog, node.trips) == (False, True, 1)
    assert node.passive_tick - node.command_tick == WATCHDOG


def test_the_same_counter_again_is_no_new_command() -> None:
    node = enabled()
    for tick in range(10):
        node.receive(tick, 2, 1, Mode.OPERATE, MOVING)
        node.watch(tick)
    assert node.passive_by_watchdog


def test_a_late_command_does_not_revive_it_but_a_new_session_does() -> None:
    node = enabled()
    node.receive(0, 2, 1, Mode.OPERATE, MOVING)
    run(node, 0, 10)
    for tick in range(10, 20):
        node.receive(tick, tick, 1, Mode.OPERATE, MOVING)
        node.watch(tick)
        assert node.applied == PASSIVE
    assert node.passive_tick - node.command_tick == WATCHDOG  # what is not obeyed is not counted
    node.receive(20, 20, 1, Mode.START, MOVING)
    assert not node.operational
    node.receive(20, 20, 2, Mode.START, MOVING)
    assert (node.operational, node.passive_by_watchdog, node.applied) == (True, False, PASSIVE)
    node.receive(21, 21, 2, Mode.OPERATE, MOVING)
    assert node.applied == MOVING


def test_a_loop_that_was_followed_by_another_is_not_heard() -> None:
    node = enabled(session=2)
    node.receive(0, 10, 2, Mode.OPERATE, MOVING)
    for session in (1, 0, 4, -2):
        node.receive(1, 11, session, Mode.OPERATE, PASSIVE)
        node.receive(1, 12, session, Mode.STOP, PASSIVE)
    assert (node.operational, node.applied, node.command_tick) == (True, MOVING, 0)


def test_taken_out_of_operation_it_is_passive_and_has_not_tripped() -> None:
    node = enabled()
    node.receive(0, 2, 1, Mode.OPERATE, MOVING)
    node.receive(1, 3, 1, Mode.STOP, MOVING)
    assert run(node, 1, 20) == [PASSIVE] * 19
    assert (node.operational, node.passive_by_watchdog, node.trips) == (False, False, 0)


def test_it_applies_its_limits() -> None:
    node = enabled()
    node.receive(0, 2, 1, True, MOVING._replace(valve=(7.0, -1e300, 0.5)))
    assert node.applied == MOVING._replace(valve=(1.0, -1.0, 0.5))
    node.receive(0, 3, 1, True, MOVING._replace(valve=(math.nan, 0.0, 0.0)))
    assert node.applied == PASSIVE


_HEARD = st.tuples(st.integers(0, 6), st.integers(0, 3), st.integers(0, 4))


@given(st.lists(st.one_of(st.none(), _HEARD), max_size=60))
def test_whatever_it_hears_it_moves_only_on_a_command_of_its_session_and_not_for_long(
    heard: list[tuple[int, int, int] | None],
) -> None:
    node = ValveNode(WATCHDOG)
    last = -math.inf
    for tick, message in enumerate(heard):
        if message is not None:
            counter, session, mode = message
            if counter != node.counter and session == node.session and mode == Mode.OPERATE:
                last = tick
            node.receive(tick, counter, session, mode, MOVING)
        node.watch(tick)
        if node.applied != PASSIVE:
            assert node.operational
            assert tick - last < WATCHDOG
