"""Readiness: what blocks arming, the same for every caller."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from bench.base.errors import ExitCode
from bench.base.lifecycle import Block, Refusal, Request, State
from bench.calibration.archive import add_calibration
from bench.calibration.calibration import (
    BallPosition,
    Calibration,
    CalibrationProblem,
    ClubInMount,
    EncoderZeros,
    SeenInputs,
    Values,
    ValveCentres,
    wiring_digest,
)
from bench.commands.bench.status_table import status_table
from bench.config import Configuration, database_url, load_configuration
from bench.network.bench_service import CommandAnswer
from bench.network.client import CommandRefused
from bench.network.command import Verb
from bench.network.status_words import ARMING_BLOCKED
from bench.simulation.swing_operator import never
from bench.store.database import open_database
from bench.supervisor.daemon import Daemon
from bench.supervisor.readiness import FEEDBACK_ONLY, HALF_BLIND, NO_MODEL_CHECK, assess_bench
from bench.web._bench_link import state_view
from tests.bench.fake_bench_service import FakeDesk
from tests.conftest import Outcome, Run

NOW = datetime(2026, 11, 26, 12, 0, tzinfo=UTC)
MISSED = BallPosition(0.15, -1.6, 5e-4)
"""107.7 mm from the ball of the shipped swing."""
MET = BallPosition(0.25, -1.56, 5e-4)

MACHINE = (
    '[driver]\nname = "daq"\n[homing]\nmethod = "index"\n[lifecycle]\nlocal_reset = true\n'
    '[loop]\nrealtime = "require"\n'
    '[daq]\nvent_proof = "pressure switches PS1 to PS6"\nshut_off_feedback = "port0/line7"\n'
)
UNWATCHED = '[envelope.model]\noff_reason = "trial of the valves, air at 1.3 bar"\n'

Calibrate = Callable[..., None]


@pytest.fixture
def configuration(tmp_path: Path) -> Configuration:
    c = load_configuration(Path("shipped"))
    return replace(c, bench=replace(c.bench, data_dir=tmp_path / "data"))


@pytest.fixture
def calibrate(configuration: Configuration) -> Calibrate:
    """Return a function that stores a calibration, taken `hours` after NOW and valid for `days`."""

    def add(values: Values, hours: float = -1.0, days: float = 30.0) -> None:
        date = NOW + timedelta(hours=hours)
        settings = configuration.bench
        with open_database(database_url(settings.database, settings.data_dir), date) as database:
            add_calibration(
                database,
                settings.id,
                values,
                date=date,
                expires=date + timedelta(days=days),
                by="test",
                method="rule",
            )

    return add


def codes(configuration: Configuration, **options: Any) -> list[Block]:
    """Return the codes of what blocks arming at NOW."""
    return [block["code"] for block in assess_bench(configuration, NOW, running=True, **options).blocks(NOW)]


def test_assess_shipped_bench_has_no_blocks_and_warns_without_chamber_sensors(
    configuration: Configuration,
) -> None:
    found = assess_bench(configuration, NOW, running=True)
    assert (found.blocks(NOW), found.warnings) == ([], ())
    assert found.limits.endswith("default.limits.toml")
    blind = replace(configuration, plant=replace(configuration.plant, pressure_sensors=False))
    assert HALF_BLIND in assess_bench(blind, NOW, running=True).warnings


@pytest.mark.parametrize("fitted", [True, False])
def test_assess_bench_model_check_off_warns_by_feedback(configuration: Configuration, fitted: bool) -> None:
    off = replace(configuration, envelope=configuration.envelope.with_model_check("off"))
    bench = replace(off, plant=replace(off.plant, spool_feedback=fitted))
    words = FEEDBACK_ONLY if fitted else NO_MODEL_CHECK
    assert assess_bench(bench, NOW, running=True).warnings == (words,)


def test_assess_ball_off_profile_blocks(configuration: Configuration, calibrate: Calibrate) -> None:
    calibrate(MISSED)
    found = assess_bench(configuration, NOW, running=True)
    (block,) = found.blocks(NOW)
    assert block["code"] == Block.SWING
    assert block["location"].endswith("default.toml: ball_m")
    assert "107.7 mm off" in block["found"]
    assert "calibration ball version 1" in block["expected"]
    assert "golfbench calibrate ball" in block["action"]
    with pytest.raises(ExceptionGroup, match="cannot be swung here"):
        found.require_possible()


def test_assess_machine_without_calibrations_blocks(overlay: Callable[[str], Path], tmp_path: Path) -> None:
    c = load_configuration(overlay(f'[bench]\ndata_dir = "{tmp_path}"\n{MACHINE}{UNWATCHED}'))
    found = assess_bench(c, NOW, running=True)
    assert {block["code"] for block in found.blocks(NOW)} == {Block.CALIBRATION_MISSING, Block.INPUTS}
    assert len(found.blocks(NOW)) == 5
    assert found.faults == []  # a simulation of it needs none
    assert any("the reason given: trial of the valves" in warning for warning in found.warnings)
    assert c.effective()["envelope"]["model"]["off_reason"].startswith("trial of")  # as each record has it


@pytest.fixture
def machine(
    configuration: Configuration, calibrate: Calibrate, tmp_path: Path
) -> Callable[[str], Configuration]:
    """Return a function of more TOML: the configuration of a calibrated machine."""
    calibrate(MET)
    calibrate(EncoderZeros((0.0, 0.0, 0.0), (1, 1, 1), 131072, 1e-4))
    calibrate(ClubInMount("driver", 1.09, 0.2617993877991494, 0.9250245035569946, 5e-4, 1e-3))
    calibrate(ValveCentres((0.0, 0.0, 0.0), (0.02, 0.02, 0.02), 1e-4))
    folder = configuration.bench.data_dir

    def load(more: str) -> Configuration:
        file = tmp_path / "machine.toml"
        head = f'base = "shipped"\n[bench]\nid = "{configuration.bench.id}"\ndata_dir = "{folder}"\n'
        file.write_text(head + MACHINE + more, encoding="utf-8")
        found = load_configuration(file)
        calibrate(SeenInputs(("guard closed",), wiring_digest(found)))
        return found

    return load


Machine = Callable[[str], Configuration]


@pytest.mark.parametrize("check", ["", 'check = "off"\n', 'off_reason = " "\n'])
def test_assess_machine_check_off_without_reason_blocks(machine: Machine, check: str) -> None:
    c = machine(f"[envelope.model]\n{check}")
    (block,) = assess_bench(c, NOW, running=True).blocks(NOW)
    assert block["code"] == Block.CONFIGURATION
    assert block["location"].endswith("machine.toml: envelope.model.check")
    assert "envelope.model.off_reason" in block["expected"]
    assert assess_bench(c, NOW).faults == []  # a simulation of it is watched, or need not be


def test_assess_machine_check_on_or_reason_has_no_blocks(machine: Machine) -> None:
    found = assess_bench(machine(f'{UNWATCHED}check = "always"\n'), NOW, running=True)
    assert (found.blocks(NOW), found.warnings) == ([], (HALF_BLIND,))  # it has no chamber sensors
    assert found.limits.endswith("default.limits.toml")
    assert codes(machine(UNWATCHED)) == []


def test_assess_machine_rewired_after_check_of_inputs_blocks(machine: Machine, calibrate: Calibrate) -> None:
    c = machine(UNWATCHED)
    calibrate(SeenInputs(("guard closed",), "other wiring"))
    (block,) = assess_bench(c, NOW, running=True).blocks(NOW)
    assert block["code"] == Block.INPUTS
    assert "with other driver settings" in block["found"]


def test_assess_machine_without_chamber_sensors_or_reason_blocks(machine: Machine) -> None:
    (block,) = assess_bench(machine('[envelope.model]\ncheck = "always"\n'), NOW, running=True).blocks(NOW)
    assert block["found"] == "a chamber without a sensor"
    assert "envelope.model.off_reason" in block["expected"]


def test_assess_stale_limits_block_machine_and_warn_simulated_bench(
    machine: Machine, configuration: Configuration
) -> None:
    stiffer = "[plant.wrist.friction]\ncoulomb = 49.0\n"
    (block,) = assess_bench(machine(f'{UNWATCHED}check = "always"\n{stiffer}'), NOW, running=True).blocks(NOW)
    assert block["location"] == "limits of default"
    assert "another plant (wrist.friction.coulomb 45, here 49)" in block["found"]
    assert "golfbench profile limits default" in block["action"]
    wrist = configuration.plant.wrist
    wrist = replace(wrist, friction=replace(wrist.friction, coulomb=49.0))
    c = replace(configuration, plant=replace(configuration.plant, wrist=wrist))
    found = assess_bench(c, NOW, running=True)
    assert found.blocks(NOW) == []
    assert "wrist.friction.coulomb 45, here 49" in found.warnings[0]


def test_assess_standard_error_of_unknown_value_blocks(configuration: Configuration) -> None:
    model = replace(configuration.envelope.model, standard_errors={"shoulder.aera_a": 1e-6})
    c = replace(configuration, envelope=replace(configuration.envelope, model=model))
    (block,) = assess_bench(c, NOW, running=True).blocks(NOW)
    assert block["location"].endswith("envelope.model.standard_errors.shoulder.aera_a")


def test_assess_expired_and_future_calibrations_block(
    configuration: Configuration, calibrate: Calibrate
) -> None:
    calibrate(MET, hours=-48.0, days=1.0)
    assert codes(configuration) == [Block.CALIBRATION_EXPIRED]
    calibrate(MET, hours=24.0)
    assert codes(configuration) == [Block.CALIBRATION_EXPIRED, Block.CALIBRATION_AHEAD]


def test_assess_unreadable_calibration_refuses_simulation(
    configuration: Configuration, calibrate: Calibrate
) -> None:
    calibrate(MET)
    with (
        open_database(database_url("", configuration.bench.data_dir), NOW) as database,
        database.begin() as connection,
    ):
        connection.exec_driver_sql(
            "INSERT INTO calibrations "
            "SELECT 2, bench, kind, 2, subject, date, expires, \"by\", method, note, '{}' FROM calibrations"
        )
    assert codes(configuration) == [Block.UNREADABLE]
    (fault,) = assess_bench(configuration, NOW).faults
    assert (fault.location, fault.action) == ("calibration ball version 2", "golfbench calibrate ball")


def test_assess_configuration_contradicting_calibration_blocks(
    configuration: Configuration, calibrate: Calibrate
) -> None:
    calibrate(BallPosition(0.25, -1.75, 5e-4))
    blocks = assess_bench(configuration, NOW, running=True).blocks(NOW)
    assert [block["location"] for block in blocks if block["code"] is Block.CONFIGURATION] == [
        "calibration ball version 1: plant.site.ball_y"
    ]


@pytest.mark.parametrize(
    ("driver", "hours", "stale"), [("daq", 0.0, True), ("sim", 0.0, True), ("daq", -2.0, False)]
)
def test_assess_calibration_older_than_commissioning_blocks_machine_and_warns_simulated_bench(
    configuration: Configuration, calibrate: Calibrate, driver: str, hours: float, stale: bool
) -> None:
    bench = replace(configuration.bench, commissioned=(NOW + timedelta(hours=hours)).isoformat())
    c = replace(configuration, bench=bench).with_driver(replace(configuration.driver, name=driver))
    calibrate(EncoderZeros((1.0, 2.0, 3.0), (1, 1, 1), 131072, 1e-3))
    calibrate(BallPosition(0.25, -1.56, 5e-4))  # as configured
    found = assess_bench(c, NOW, running=True)
    (replaced,) = found.replaced
    assert replaced.text == (
        "calibration encoders version 1 of 2026-11-26 11:00 UTC replaces "
        "plant.encoders.zero_count [0.0, 0.0, 0.0] by [1.0, 2.0, 3.0]"
    )
    faults = [fault for fault in found.contradictions if "commissioned later" in fault.found]
    warned = [warning for warning in found.warnings if "commissioned later" in warning]
    assert (len(faults), len(warned)) == (stale and driver == "daq", stale and driver == "sim")
    assert all(fault.action == "Run golfbench calibrate encoders." for fault in faults)


def test_assess_phase_fault_with_canopen_driver_blocks(
    overlay: Callable[[str], Path], tmp_path: Path
) -> None:
    file = overlay(
        f'[bench]\ndata_dir = "{tmp_path}"\n[driver]\nname = "canopen"\n'
        '[canopen]\ninterface = "local_socket"\n'
        '[faults.late]\nsignal = "shoulder valve"\nkind = "stuck"\nvalue = 0.0\nphase = "downswing"\n'
    )
    assert codes(load_configuration(file)) == [Block.CONFIGURATION]


def test_assess_other_rate_warns_running_bench_and_refuses_lock_step(configuration: Configuration) -> None:
    c = replace(configuration, loop=replace(configuration.loop, rate=2000.0))
    c = replace(c, plant=replace(c.plant, tick=0.0005))
    assert codes(c) == []
    assert any("values between the samples" in text for text in assess_bench(c, NOW, running=True).warnings)
    (fault,) = assess_bench(c, NOW).faults
    assert fault.location.endswith("default.toml: period_s")


def test_assess_club_other_loft_passes_and_other_mass_blocks(configuration: Configuration) -> None:
    driver = configuration.clubs["driver"]
    lofted = replace(driver, name="lofted", loft=driver.loft + 0.02)
    heavy = replace(driver, name="heavy", head_mass=driver.head_mass + 0.05)
    c = replace(configuration, clubs=configuration.clubs | {"lofted": lofted, "heavy": heavy})
    assert codes(c, club="lofted") == []
    assert codes(c, club="heavy") == [Block.SWING]


def test_assess_calibrations_within_tolerance_keep_limits(
    configuration: Configuration, calibrate: Calibrate
) -> None:
    calibrate(BallPosition(0.2503, -1.5602, 5e-4))
    calibrate(EncoderZeros((11.0, 22.0, 33.0), (1, 1, 1), 131072, 1e-4))
    found = assess_bench(configuration, NOW, running=True)
    calibrate(ClubInMount("driver", 1.0905, 0.2617993877991494, 0.9250245035569946, 5e-4, 1e-3))
    calibrate(ValveCentres((5e-4, -5e-4, 5e-4), (0.02, 0.0205, 0.02), 1e-4))
    found = assess_bench(configuration, NOW, running=True)
    assert (found.blocks(NOW), found.warnings) == ([], ())
    calibrate(ClubInMount("driver", 1.092, 0.18, 0.92, 5e-4, 1e-3))
    (warning,) = assess_bench(configuration, NOW, running=True).warnings
    assert "made for another plant (robot.club.loft" in warning


def test_assess_tee_calibration_applies_to_mounted_club_only(tmp_path: Path) -> None:
    c = load_configuration(Path("bag"))
    c = replace(c, bench=replace(c.bench, data_dir=tmp_path))
    with open_database(database_url("", tmp_path), NOW) as database:
        add_calibration(
            database, c.bench.id, MET, date=NOW, expires=NOW + timedelta(days=1), by="test", method="rule"
        )
    assert codes(c, profile="iron7-78mph", club="iron7") == []
    mounted = replace(c, plant=c.plant_with(club="iron7"), swing=replace(c.swing, club="iron7"))
    assert Block.SWING in codes(mounted, profile="iron7-78mph")


# The callers -------------------------------------------------------------------------------------------


class AcceptingLink:
    """A loop that accepts every request."""

    state, correction = State.READY.name, 0

    def __init__(self) -> None:
        self.asked: list[Request] = []

    def request(self, request: Request) -> CommandAnswer:
        self.asked.append(request)
        return CommandAnswer(True, self.state)

    def beat(self, **_: Any) -> None:
        """Take a heartbeat."""


@pytest.fixture
def start(configuration: Configuration) -> Callable[[], tuple[Daemon, AcceptingLink]]:
    def make() -> tuple[Daemon, AcceptingLink]:
        daemon, link = Daemon(configuration, now=lambda: NOW), AcceptingLink()
        daemon._link = link  # type: ignore[assignment]
        daemon._plane = SimpleNamespace(lease=lambda: None)  # type: ignore[assignment]
        return daemon, link

    return make


Start = Callable[[], tuple[Daemon, AcceptingLink]]


def test_daemon_start_logs_values_replaced_by_calibration(
    start: Start, calibrate: Calibrate, caplog: pytest.LogCaptureFixture
) -> None:
    calibrate(BallPosition(0.2503, -1.56, 5e-4))
    with caplog.at_level("INFO"):
        start()
    assert "replaces plant.site.ball_x 0.25 by 0.2503" in caplog.text


@pytest.mark.parametrize(
    ("code", "accepted"),
    [(Block.INPUTS, False), (Block.UNREADABLE, False), (Block.CALIBRATION_MISSING, True)],
)
def test_daemon_homing_requires_valid_check_of_inputs(
    start: Start, calibrate: Calibrate, monkeypatch: pytest.MonkeyPatch, code: Block, accepted: bool
) -> None:
    calibrate(MET)
    daemon, link = start()
    due = CalibrationProblem(code, "inputs of bench b", "never calibrated", "a check", "check them")
    monkeypatch.setattr(Calibration, "problems", lambda *_: [due])
    reply = daemon.request(Request.HOME, never)
    assert (reply.accepted, link.asked) == (accepted, [Request.HOME] if accepted else [])
    assert accepted or reply.reason.startswith("homing blocked: inputs of bench b")
    assert daemon.request(Request.ARM, never).refusal == Refusal.BLOCKED.name


def test_daemon_new_calibration_applies_at_next_arming(start: Start, calibrate: Calibrate) -> None:
    calibrate(MET, hours=-2.0)
    daemon, link = start()
    assert daemon.request(Request.ARM, never).accepted
    calibrate(MISSED)
    refused = daemon.request(Request.ARM, never)
    assert not refused.accepted
    assert [block["code"] for block in refused.content["arming_blocks"]] == [
        Block.SWING,
        Block.CALIBRATION_NOT_LOADED,
    ]
    assert "golfbench run" in refused.content["arming_blocks"][1]["action"]
    calibrate(MET, hours=-0.5)  # as the loop has it
    assert daemon.request(Request.ARM, never).accepted
    assert daemon.request(Request.HOME, never).accepted
    assert link.asked == [Request.ARM, Request.ARM, Request.HOME]


def test_daemon_renewed_calibration_arms_without_restart(start: Start, calibrate: Calibrate) -> None:
    calibrate(MET, hours=-48.0, days=1.0)
    daemon, _ = start()
    assert [b["code"] for b in daemon.request(Request.ARM, never).content["arming_blocks"]] == [
        Block.CALIBRATION_EXPIRED
    ]
    calibrate(MET)
    assert daemon.request(Request.ARM, never).accepted


def test_daemon_unreadable_calibrations_block_arming(
    start: Start, calibrate: Calibrate, configuration: Configuration
) -> None:
    calibrate(MET)
    daemon, _ = start()
    (configuration.bench.data_dir / "golfbench.sqlite").write_bytes(b"not a database" * 100)
    reply = daemon.request(Request.ARM, never)
    assert (reply.accepted, [block["code"] for block in reply.content["arming_blocks"]]) == (
        False,
        [Block.UNREADABLE],
    )


@pytest.mark.parametrize("request_", [Request.ARM, Request.SWING])
def test_daemon_request_late_after_assessment_is_refused(
    start: Start, monkeypatch: pytest.MonkeyPatch, request_: Request
) -> None:
    daemon, link = start()
    monkeypatch.setattr(daemon, "_assess_again", list)
    reply = daemon.request(request_, lambda: True)
    assert (reply.accepted, reply.refusal, link.asked) == (False, "TOO_LATE", [])


def blocked_status() -> Any:
    status = FakeDesk(State.READY).status()
    status["arming_blocks"] = [
        {
            "code": Block.SWING,
            "location": "default.toml: ball_m",
            "found": "107.7 mm off",
            "expected": "0.5 mm",
            "action": "Move the tee.",
        }
    ]
    return status


def test_status_and_page_report_arming_blocks() -> None:
    console = Console(width=80, file=StringIO())
    console.print(status_table(blocked_status(), 0.0))
    shown = " ".join(console.file.getvalue().split())  # type: ignore[attr-defined]
    assert "arming blocked: default.toml: ball_m" in shown
    view = state_view(blocked_status())
    assert view["warnings"][0].startswith("arming blocked: default.toml: ball_m: found 107.7 mm off")
    assert view["next"] == ARMING_BLOCKED
    assert "arming" not in " ".join(state_view(FakeDesk(State.READY).status())["warnings"])


def test_command_refused_blocked_arming_carries_block_parts() -> None:
    content = {"arming_blocks": blocked_status()["arming_blocks"]}
    answer = CommandAnswer(False, "READY", Refusal.BLOCKED.name, content=content)
    error = CommandRefused("b", Verb.ARM, answer)
    assert (error.location, error.found) == ("arm of bench b", "default.toml: ball_m 107.7 mm off")
    assert (error.expected, error.action) == ("0.5 mm", "Move the tee.")


@pytest.fixture
def golfbench(
    configuration: Configuration,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    run: Run,
) -> Run:
    """Return a function that runs a command with the data of `configuration`."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")

    def command(*arguments: str, more: str = "") -> Outcome:
        settings = configuration.bench
        text = f'base = "shipped"\n[bench]\nid = "{settings.id}"\ndata_dir = "{settings.data_dir}"\n'
        (tmp_path / "mine.toml").write_text(text + more, encoding="utf-8")
        return run("--config", "mine.toml", *arguments)

    return command


@pytest.mark.parametrize(
    "command",
    [
        ["check"],
        ["campaign", "check", "two-balls"],
        ["campaign", "run", "two-balls", "--sim"],
        ["profile", "simulate", "default"],
        ["profile", "check", "default"],
        ["profile", "limits", "default"],
        ["learn", "default", "--sim"],
    ],
    ids=" ".join,
)
def test_command_ball_off_profile_is_refused(
    command: list[str], golfbench: Run, calibrate: Calibrate
) -> None:
    calibrate(MISSED)
    code, out, errors = golfbench(*command)
    assert (code, "107.7 mm off" in errors) == (ExitCode.BAD_INPUT, True), errors
    assert "holds" not in out


def test_check_uncalibrated_machine_counts_all_blocks(golfbench: Run) -> None:
    code, out, errors = golfbench("check", more=MACHINE + UNWATCHED)
    assert code == ExitCode.REFUSED
    assert out.splitlines()[-1].startswith("Arming blocked for 5 reasons")
    assert errors.count("never calibrated") == 5


def test_check_with_warnings_reports_count(golfbench: Run) -> None:
    code, out, _ = golfbench("check", more='[envelope.model]\ncheck = "off"\n')
    assert (code, out.splitlines()[-1]) == (0, "Nothing blocks arming; 1 warning, see above.")
    code, out, _ = golfbench("check")
    assert (code, out.splitlines()[-1].startswith("Everything holds")) == (0, True)


def test_campaign_check_expired_calibration_previews_and_refuses(
    golfbench: Run, configuration: Configuration
) -> None:
    settings, past = configuration.bench, datetime(2020, 1, 1, tzinfo=UTC)
    with open_database(database_url("", settings.data_dir), past) as database:
        expires = past + timedelta(days=1)
        add_calibration(database, settings.id, MET, date=past, expires=expires, by="test", method="rule")
    code, out, errors = golfbench("campaign", "check", "two-balls")
    assert (code, "shots in" in out, "expired on 2020-01-02" in errors) == (ExitCode.REFUSED, True, True)


def test_campaign_check_machine_without_model_check_previews_and_refuses(golfbench: Run) -> None:
    code, out, errors = golfbench("campaign", "check", "two-balls", more=MACHINE)
    assert (code, "shots in" in out) == (ExitCode.BAD_INPUT, True)
    assert (errors.count("off with a real robot"), errors.count("never calibrated")) == (1, 5)
    code, _, errors = golfbench("campaign", "check", "two-balls", more=MACHINE + UNWATCHED)
    assert (code, errors.count("never calibrated"), "real robot" in errors) == (ExitCode.REFUSED, 5, False)
