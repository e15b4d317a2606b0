"""A short run of the fuzz that `python -m tests.benchmarks command_fuzz` does at length."""

from __future__ import annotations

import pytest

from bench.network.client import BenchClient
from bench.network.zenoh_session import open_client
from tests.bench.fake_bench_service import FakeDesk, loopback_configuration, running_plane
from tests.benchmarks.command_fuzz import fuzz, uncounted, use_up

pytestmark = pytest.mark.live

MESSAGES = 3000


def test_command_fuzz_each_message_is_answered_or_counted() -> None:
    configuration = loopback_configuration()
    with (
        running_plane(FakeDesk(), configuration) as running,
        BenchClient.connect(configuration) as client,
        open_client(configuration.network, "bench1") as session,
    ):
        key = use_up(client)
        before = client.status()["counts"]
        tally = fuzz(session, "bench1", MESSAGES, key)
        after = client.status()["counts"]
        requests = set(running.service.requests)
    assert tally.sent.total() == tally.answered.total() == MESSAGES
    assert uncounted(tally, before, after) == 0
    assert tally.unreadable == []
    assert set(tally.answered) <= {"accepted", "refused", "malformed", "0 answers"}
    assert tally.answered["malformed"] > MESSAGES / 2
    # Nothing of all that went to the loop but what anybody may ask.
    assert {request.name for request in requests} <= {"DISARM"}
