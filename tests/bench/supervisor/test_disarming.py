"""Why a robot was disarmed, from the records of the loop."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bench.base.lifecycle import Cause, Request, State
from bench.records.telemetry.cycle_record import CYCLE
from bench.supervisor.status import disarmed_for


def cycle(state: State, **values: object) -> Any:
    record = np.zeros(1, CYCLE)[0]
    record["state"], record["lease_held"], record["support_ready"] = state, True, True
    for name, value in values.items():
        record[name] = value
    return record


@pytest.mark.parametrize(
    ("before", "after", "values", "cause"),
    [
        (State.ARMED, State.READY, {"lease_held": False}, Cause.LEASE),
        (State.ARMED, State.RECOVERING, {"lease_held": False}, Cause.LEASE),
        (State.HOMING, State.SAFE, {"lease_held": False}, Cause.LEASE),
        (State.RECOVERING, State.READY, {"lease_held": False}, Cause.LEASE),
        (State.ARMED, State.READY, {"support_ready": False}, Cause.SUPPORT),
        (State.ARMED, State.READY, {}, Cause.ARMED_TIME),
        (State.HOMING, State.READY, {}, Cause.NONE),
        (State.ARMED, State.READY, {"request": Request.DISARM}, Cause.NONE),
        (State.ARMED, State.FAULT, {"cause": Cause.OPERATOR_STOP, "lease_held": False}, Cause.NONE),
        (State.ARMED, State.SWINGING, {}, Cause.NONE),
        (State.RECOVERING, State.READY, {}, Cause.NONE),
        (State.ARMED, State.ARMED, {"lease_held": True}, Cause.NONE),
    ],
)
def test_disarmed_for_state_change_names_cause(
    before: State, after: State, values: dict[str, object], cause: Cause
) -> None:
    assert disarmed_for(cycle(after, **values), before, series=True) is cause


def test_disarmed_for_venting_after_single_swing_names_no_cause() -> None:
    vents = cycle(State.READY, lease_held=False)
    assert disarmed_for(vents, State.RECOVERING, series=False) is Cause.NONE
