"""Start and resume campaigns; request a pause, stop or abort of a running one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from functools import partial, reduce
from operator import getitem
from typing import Any

from bench.base.errors import Refused
from bench.campaign.interruptions import differences, software_versions
from bench.campaign.plan.carry import Measured, measured_of
from bench.campaign.plan.gate import planned_delivery
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.plan_file import plan_from_record
from bench.campaign.plan.shot_sequence import Course, course
from bench.campaign.run._corrections import CampaignCorrections
from bench.campaign.run._live_shots import LiveShots, require_live
from bench.campaign.run._simulated_shots import SimulatedShots
from bench.campaign.run.campaign_control import bench_lock, runner_lock
from bench.campaign.run.plan_requirements import (
    START_SERIES,
    Profiles,
    calibrated,
    calibration_warnings,
    calibrations_in_force,
    needs,
    needs_series,
    require_swings,
    series_words,
    speed_sensitivities,
)
from bench.campaign.run.progress import CampaignProgress
from bench.campaign.run.runner import BATCH, Runner, RunOutcome
from bench.campaign.run.shot_source import Operator, ShotSource, Watcher
from bench.campaign.statistics.analysis import decide
from bench.config import Configuration
from bench.network.bench_service import BenchStatus
from bench.network.client import BenchClient
from bench.store.campaigns import CampaignStore
from bench.store.rows import ENDED, CampaignEntry, CampaignRun, CampaignState
from sim.ball import Air

_LASTING = ("driver", "profile", "club", "series", "launch_monitor", "calibrations")
"""Facts of the running bench that a mere restart does not change."""
_AIR_VALID = timedelta(hours=1)
"""Validity of a reading of the air."""
CANNOT_CHANGE_A_SHOT = (
    *("files", "bench.data_dir", "bench.database", "loop.priority", "loop.cpu", "network", "notifications"),
    *("launch_monitor.address", "launch_monitor.port", "launch_monitor.clients", "launch_monitor.simulator"),
)
"""Keys and sections of the configuration that change no shot: a campaign may be resumed after a change of
them. Every other key can."""


def new_entry(
    plan: CampaignPlan,
    configuration: Configuration,
    now: datetime,
    *,
    simulated: bool,
    real_time: Mapping[str, Any] | None = None,
    measured: Measured | None = None,
    calibrated: Mapping[str, Any] | None = None,
    profiles: Profiles | None = None,
) -> CampaignEntry:
    """Return a campaign that begins `now`; its id is name and time.

    `real_time` are the facts of the running bench that takes its shots; None: lock-step. `measured` are the
    measured aerodynamics of its balls, `calibrated` the bench's calibrations in force, `profiles` those of
    its swings.
    """
    return CampaignEntry(
        id=f"{plan.campaign.name}-{now:%Y%m%dT%H%M%S}{now.microsecond // 1000:03d}",
        bench=configuration.bench.id,
        name=plan.campaign.name,
        title=plan.campaign.title or plan.campaign.name,
        date=now,
        simulated=simulated,
        seed=plan.design.seed,
        plan=plan.record(),
        digest=plan.digest,
        configuration=configuration.effective(),
        versions=software_versions(),
        real_time=real_time or {},
        calibrations=({"bench": calibrated} if calibrated else {})
        | ({"aerodynamics": {ball: one.record() for ball, one in measured.items()}} if measured else {}),
        golfers={
            ", ".join(arm): {"golfer": profile.golfer, **profile.followed}
            for arm, profile in (profiles or {}).items()
            if profile.followed is not None
        },
    )


def bench_calibrations(
    plan: CampaignPlan, configuration: Configuration, store: CampaignStore, now: datetime
) -> dict[str, Any]:
    """Return the bench's calibrations in force `now`; raises as `require_swings`."""
    profiles = require_swings(plan, configuration, now)
    found = calibrations_in_force(store.database, configuration, plan.design.clubs, now)
    return found | {"club_speed": speed_sensitivities(profiles, plan.clubs, configuration.plant.robot)}


def course_of(plan: CampaignPlan, profiles: Profiles, lie: float) -> Course:
    """Return the course of `plan` from its first shot."""
    return course(plan, {arm: planned_delivery(profile, lie) for arm, profile in profiles.items()}, decide)


def run_campaign(
    entry: CampaignEntry,
    configuration: Configuration,
    store: CampaignStore,
    watcher: Watcher,
    interrupted: Callable[[], bool],
    operator: Operator | None = None,
    start: CampaignRun | None = None,
    cause: Callable[[], str] = lambda: "Ctrl-C",
) -> RunOutcome:
    """Start or resume a campaign where it was started; run it until its end or a stop.

    On the running bench every shot is stored at once. A bench in lock-step has the calibrations that were in
    force when the campaign began. `cause` names what `interrupted` it.

    Raises:
        Refused: another runner has the campaign or the bench.
        NoAnswer: no bench is running. One that goes away later suspends the campaign.
        BenchError: a shot cannot be stored; stored shots are complete.
        ExceptionGroup: one BenchError per swing that does not fit this bench.
    """
    plan, live = plan_from_record(entry.plan, f"campaign {entry.id}"), bool(entry.real_time)
    profiles = require_swings(plan, configuration, None if live else entry.date)
    if not live:
        plan, configuration = calibrated(plan, configuration, entry.date)
    data_dir, measured = configuration.bench.data_dir, measured_of(entry.calibrations, entry.id)
    with runner_lock(data_dir, entry.id), ExitStack() as stack:
        corrections = CampaignCorrections(entry, plan, configuration, store.database, profiles)
        source: ShotSource
        if not live:
            shots = SimulatedShots(plan, configuration, corrections, interrupted, measured)
            source = stack.enter_context(shots)
        else:
            stack.enter_context(bench_lock(data_dir, entry.bench, entry.id))
            client = stack.enter_context(BenchClient.connect(configuration))
            publish = stack.enter_context(client.publish_campaign(entry.id))
            watcher = Watcher(watcher, CampaignProgress(entry, plan, publish))
            air = partial(_air_now, entry, store)
            found = _warnings(plan, configuration, profiles, entry, store, client.status(), air())
            for warning in found:
                watcher.say(warning)
            source = stack.enter_context(
                LiveShots(
                    *(entry, plan, corrections, configuration.clubs, client),
                    measured=measured,
                    interrupted=interrupted,
                    aborted=lambda: store.standing(entry.id).requested == "abort",
                    air=air,
                )
            )
        batch = 1 if live else BATCH
        runner = Runner(entry, plan, store, data_dir, source, watcher, batch, operator, start, cause)
        return runner.run(course_of(plan, profiles, configuration.plant.robot.lie), interrupted)


def _air_now(entry: CampaignEntry, store: CampaignStore) -> Air | None:
    """Return the air at the bench by its newest reading, None if that is too old."""
    reading = store.newest_air(entry.bench, datetime.now(UTC) - _AIR_VALID)
    return None if reading is None else reading.air


def _warnings(
    plan: CampaignPlan,
    configuration: Configuration,
    profiles: Profiles,
    entry: CampaignEntry,
    store: CampaignStore,
    status: BenchStatus,
    air: Air | None,
) -> Iterator[str]:
    """Yield what at the running bench does not suit the plan, but may end well."""
    if not entry.simulated and air is None:
        yield (
            "No recent reading of the air: shots have none, carry is for the configured air. "
            "Enter one with golfbench campaign air, at any time."
        )
    now, needed = datetime.now(UTC), needs(plan)
    lasts = timedelta(seconds=needed.swings * plan.design.seconds_per_shot + needed.hand_work)
    yield from calibration_warnings(
        store.database, configuration, plan.design.clubs, now, now + lasts, required=not entry.simulated
    )
    if needs_series(plan, profiles.values()) and not status["series"]:
        yield f"This is {series_words(plan)}. {START_SERIES}"


def bench_facts(
    plan: CampaignPlan,
    configuration: Configuration,
    status: BenchStatus,
    measured: Measured | None = None,
    *,
    simulated: bool | None = None,
) -> dict[str, Any]:
    """Return the facts a campaign records about the running bench that takes its shots.

    `simulated` is whether the campaign began on a simulated robot; None before its start.

    Raises:
        Refused: the bench cannot take them, or is held by another runner or person.
    """
    settings = configuration.bench
    with bench_lock(settings.data_dir, settings.id):
        pass
    profiles = require_swings(plan, configuration)
    require_live(plan, profiles, configuration.clubs, status, measured, simulated=simulated)
    facts = {name: status[name] for name in ("driver", "profile", "club", "series")}
    return {**facts, "launch_monitor": status["launch_monitor"] is not None, **status["real_time"]}


def run_start(by: str, configuration: Configuration, facts: Mapping[str, Any]) -> CampaignRun:
    """Return the beginning of a run by `by` on the bench with `facts`."""
    lasting = {name: facts[name] for name in _LASTING if name in facts}
    facts = {**lasting, **_harmless(configuration)}
    return CampaignRun(0, datetime.now(UTC), by, software_versions(), facts)


def _harmless(configuration: Configuration) -> dict[str, Any]:
    """Return the values that change no shot by their keys: a change from run to run is an event."""
    effective = configuration.effective()
    return {key: reduce(getitem, key.split("."), effective) for key in CANNOT_CHANGE_A_SHOT if key != "files"}


def require_resumable(
    entry: CampaignEntry, state: CampaignState, configuration: Configuration, plan: CampaignPlan | None
) -> None:
    """Refuse to resume a finished campaign, or one with another plan or configuration.

    Raises:
        Refused: the text says which.
    """
    location = f"campaign {entry.id}"
    if state in ENDED:
        raise Refused(location, str(state), "an unfinished campaign", "Begin a new one.")
    if plan is not None and plan != plan_from_record(entry.plan, location):
        found = "a different plan"
        action = "Omit the file to continue as planned, or start a new campaign."
        raise Refused(location, found, f"the plan {entry.digest}, which is stored with it", action)
    harmless = tuple(f"{key}." for key in CANNOT_CHANGE_A_SHOT)
    changed = [key for key, _, _ in differences(entry.configuration, configuration.effective())]
    if changed := [key for key in changed if not f"{key}.".startswith(harmless)]:
        found = f"a configuration that differs in {', '.join(changed[:5])}"
        action = "Continue with --config and that configuration, or start a new campaign."
        raise Refused(location, found, "the configuration stored with it", action)
