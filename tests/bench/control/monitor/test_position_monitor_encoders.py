"""Counts that an encoder lost show at rest and where its index passes, without a model of the plant."""

from __future__ import annotations

import numpy as np
import pytest

from bench.base.lifecycle import Cause, State
from bench.control.monitor.position_monitor import index_cause
from tests.bench.control.operating import reach
from tests.bench.control.puppet import Puppet

each_joint = pytest.mark.parametrize("joint", range(3))


@each_joint
@pytest.mark.parametrize("jump", [0.012, -0.02, 0.055])
def test_encoder_monitor_jump_at_rest_latches_fault(joint: int, jump: float) -> None:
    puppet = reach(State.READY)
    puppet.run(100)
    puppet.offset[joint] = jump
    puppet.run(3)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.SHOULDER_JUMP + joint)
    assert not puppet.control["homed"]


@each_joint
def test_encoder_monitor_joint_pushed_by_hand_reports_none(joint: int) -> None:
    puppet = reach(State.READY)
    puppet.run(100)
    for _ in range(200):
        puppet.offset[joint] += 2e-3
        puppet.tick()
    assert puppet.cause is Cause.NONE


@each_joint
def test_index_cause_lost_counts_at_index_reports_joint(joint: int) -> None:
    puppet = reach(State.READY)
    puppet.parameters.control["home_by_index"] = True
    encoder, estimator = puppet.state.encoder, puppet.state.estimator
    span = int(puppet.parameters.encoder["count_range"][0, joint])
    for lost in (0.008, -0.03):
        estimator["innovation"][0, joint], encoder["fresh"][0, joint] = lost, 1
        for beside, found in ((0, True), (2, True), (span - 2, True), (400, False)):
            encoder["unwrapped"][0, joint] = 3 * span + beside
            assert bool(cause_at_index(puppet)) is found
            if found:
                assert cause_at_index(puppet) == Cause.SHOULDER_INDEX + joint


def cause_at_index(puppet: Puppet) -> int:
    p = puppet.parameters
    estimator, encoder = puppet.state.estimator[0], puppet.state.encoder[0]
    return int(index_cause(puppet.control, p.control[0], encoder, p.encoder[0], estimator))


@each_joint
def test_index_cause_small_innovation_reports_none(joint: int) -> None:
    puppet = reach(State.READY)
    puppet.parameters.control["home_by_index"] = True
    puppet.state.encoder["unwrapped"][0] = np.zeros(3)
    puppet.state.estimator["innovation"][0, joint] = 0.004
    assert cause_at_index(puppet) == 0


@each_joint
def test_index_cause_absolute_encoder_reports_none(joint: int) -> None:
    puppet = reach(State.READY)
    puppet.state.encoder["unwrapped"][0] = np.zeros(3)
    puppet.state.estimator["innovation"][0, joint] = 0.02
    assert cause_at_index(puppet) == 0
