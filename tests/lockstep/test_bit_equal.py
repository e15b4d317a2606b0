"""The Python cycle around the `sim` driver and the compiled loop give the same records, bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.base.lifecycle import Answer, Cause, Phase, Reaction, Refusal, Request
from bench.control.moves.pressure_plan import with_planned_air
from bench.control.settings import ControlSettings
from bench.swing.profile import Profile
from sim.plant import Encoders, PlantParameters
from tests.compiled_only import needs_speed
from tests.sampling import release_except

if TYPE_CHECKING:
    from tests.lockstep.conftest import Mark, Pair

    MakePair = Callable[..., Pair]
    Ready = Callable[[PlantParameters], Pair]

NOISY = Encoders(jitter=5e-6, noise=2e-6)


def armed(pair: Pair) -> None:
    """Take both benches to their address."""
    pair.advance(10)
    pair.advance(1, Request.ARM)
    for _ in range(100):
        pair.advance(100)
        if pair.driver.applied.supply_enable and pair.python.phase is Phase.HOLD:
            return
    pytest.fail(f"not at address: phase {pair.python.phase}, {pair.python.state.control['cause']}")


def aired(pair: Pair) -> None:
    """Tee a ball up and wait until the pressures are as planned."""
    pair.tee(True)
    pair.advance(300)
    control = pair.python.state.control
    planned = pair.compiled.parameters.profile["air_planned"][0]
    for _ in range(200):
        if control["address_air"]["ready"][0] or not planned:
            break
        pair.advance(50)


@pytest.fixture(scope="module")
def ready(make_pair: MakePair, default_profile: Profile) -> Ready:
    """Return a function of a plant that gives its pair, ready to swing: armed and aired once."""
    made: dict[PlantParameters, tuple[Pair, Mark]] = {}

    def of(plant: PlantParameters) -> Pair:
        if plant not in made:
            pair = make_pair(plant, default_profile)
            armed(pair)
            aired(pair)
            made[plant] = pair, pair.mark()
        pair, mark = made[plant]
        return pair.go_back(mark)

    return of


def swung(pair: Pair, until: float) -> None:
    """Start a swing of a pair that is ready, and stop `until` s after its start."""
    pair.advance(1, Request.SWING)
    pair.advance(round(until * 1000))


def finished(pair: Pair) -> np.ndarray:
    """Run until nothing moves any more: back at address, or standing after a stop."""
    records = []
    for _ in range(100):
        records.append(pair.advance(100))
        if pair.python.phase in {Phase.HOLD, Phase.STANDING}:
            return np.concatenate(records)
    pytest.fail("no end of the swing")


@needs_speed
def test_lock_step_whole_swing_is_bit_equal(make_pair: MakePair, default_profile: Profile) -> None:
    pair = make_pair(PlantParameters(encoders=NOISY, seed=7), default_profile)
    armed(pair)
    aired(pair)
    swung(pair, default_profile.impact_time + 0.05)
    assert pair.driver.contact is not None
    assert pair.driver.contact.time == float(pair.compiled.plant_state["impact_time"][0])
    finished(pair)
    assert pair.python.phase is Phase.HOLD
    assert pair.python.state.control["cause"][0] == Cause.NONE
    pair.tee(False)
    pair.advance(1, Request.DISARM)
    assert not pair.advance(500)["supply_enable"].any()


@needs_speed
def test_lock_step_model_feed_forward_is_bit_equal(make_pair: MakePair, default_profile: Profile) -> None:
    plant = PlantParameters(encoders=NOISY, pressure_sensors=False)
    pair = make_pair(plant, default_profile, ControlSettings(feed_forward="kane+pneumatic"))
    armed(pair)
    aired(pair)
    swung(pair, default_profile.impact_time + 0.05)
    finished(pair)


@needs_speed
@pytest.mark.parametrize("sensors", release_except({False}, [True, False]), ids=["sensors", "observer"])
def test_lock_step_planned_air_is_bit_equal(
    make_pair: MakePair, default_profile: Profile, sensors: bool
) -> None:
    plant = PlantParameters(encoders=NOISY, pressure_sensors=sensors)
    pair = make_pair(plant, with_planned_air(default_profile, plant))
    armed(pair)
    control = pair.python.state.control
    assert pair.advance(1, Request.SWING)["refusal"][0] == Refusal.AIR
    for _ in range(2000):
        if (
            control["address_air"]["ready"][0]
            and pair.advance(1, Request.SWING)["answer"][0] == Answer.ACCEPTED
        ):
            break
        pair.advance(10)
    assert control["swinging"][0]
    pair.advance(round(1000 * default_profile.impact_time) + 50)
    finished(pair)
    assert control["cause"][0] == Cause.NONE


@needs_speed
def test_lock_step_other_tick_and_substeps_are_bit_equal(
    make_pair: MakePair, default_profile: Profile
) -> None:
    parameters = replace(PlantParameters(), tick=0.0005, substeps=3, encoders=NOISY)
    pair = make_pair(parameters, default_profile)
    pair.advance(10)
    pair.advance(3000, Request.ARM)
    assert pair.python.state.control["phase"][0] == Phase.RETURN


@needs_speed
@pytest.mark.parametrize("before_impact", release_except({0.10, -0.05}, [0.9, 0.25, 0.10, 0.02, -0.05, -0.3]))
@pytest.mark.parametrize("fault", ["emergency stop", "guard", "lost encoders", "operator"])
def test_lock_step_stop_in_swing_is_bit_equal(
    ready: Ready, default_profile: Profile, before_impact: float, fault: str
) -> None:
    pair = ready(PlantParameters())
    swung(pair, default_profile.impact_time - before_impact)
    assert pair.python.state.control["swinging"][0]
    match fault:
        case "emergency stop":
            pair.set("emergency_stop_clear", False)
        case "guard":
            pair.set("guard_closed", False)
        case "lost encoders":
            pair.set("encoder_valid", 0)
        case "operator":
            pair.advance(1, Request.STOP)
    cycles = finished(pair)
    assert pair.python.state.control["cause"][0] != Cause.NONE
    assert cycles["reaction"].max() >= Reaction.COMPLETE
    assert pair.python.phase is Phase.STANDING
    for field in ("emergency_stop_clear", "guard_closed", "encoder_valid"):
        pair.set(field, 1)
    for _ in range(16):  # a robot that still sinks is not reset
        pair.advance(500, Request.RESET)
        if pair.python.state.control["cause"][0] == Cause.NONE:
            break
    assert pair.python.state.control["cause"][0] == Cause.NONE


@needs_speed
def test_lock_step_short_encoder_loss_completes_swing(ready: Ready) -> None:
    pair = ready(PlantParameters())
    swung(pair, 0.2)
    pair.set("encoder_valid", (1, 0, 1))
    lost = pair.advance(3)
    pair.set("encoder_valid", 1)
    assert not lost["encoder_valid"][:, 1].any()
    assert np.all(np.diff(lost["angle_variance"][:, 1]) > 0)
    finished(pair)
    assert pair.python.phase is Phase.HOLD


FAULTS = st.tuples(
    st.integers(0, 1500),
    st.sampled_from(
        [
            ("emergency_stop_clear", 0, 1),
            ("guard_closed", 0, 1),
            ("encoder_valid", (0, 1, 1), 1),
            ("encoder_valid", (1, 0, 1), 1),
            ("encoder_valid", (1, 1, 0), 1),
            ("local_reset", 1, 0),
            ("ball_present", 0, 0),
        ]
    ),
    st.integers(1, 12),
)


@needs_speed
@settings(max_examples=8, deadline=None)
@given(
    faults=st.lists(FAULTS, min_size=1, max_size=4),
    requests=st.lists(st.tuples(st.integers(0, 1500), st.integers(0, 7))),
)
def test_lock_step_any_faults_and_requests_are_bit_equal(
    ready: Ready,
    faults: list[tuple[int, tuple[str, object, object], int]],
    requests: list[tuple[int, int]],
) -> None:
    pair = ready(PlantParameters(encoders=NOISY))
    swung(pair, 0.1)
    events = [(at, field, bad) for at, (field, bad, _), _ in faults]
    events += [(at + length, field, good) for at, (field, _, good), length in faults]
    asked = dict(requests)
    tick = 0
    for at in sorted({*(at for at, _, _ in events), *asked, 2000}):
        pair.advance(max(at - tick, 0))
        tick = max(at, tick)
        for when, field, value in events:
            if when == at:
                pair.set(field, value)
        if at in asked:
            pair.advance(1, asked[at])
            tick += 1


def test_lock_step_first_ticks_uncompiled_are_bit_equal(
    make_pair: MakePair, default_profile: Profile
) -> None:
    pair = make_pair(PlantParameters(), default_profile)
    pair.advance(5)
    cycles = pair.advance(15, Request.ARM)
    assert cycles["supply_enable"].all()
    assert np.isfinite(cycles["plant_angle"]).all()
