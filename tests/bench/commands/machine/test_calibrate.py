"""`golfbench calibrate` as typed, and what `golfbench check` says about it."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from datetime import UTC, datetime, timedelta
from functools import partial
from math import pi, radians
from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np
import pytest

from bench.base.errors import ExitCode, Refused
from bench.base.lifecycle import Phase, State
from bench.calibration.calibration import standing_counts
from bench.records.telemetry.cycle_record import CYCLE
from bench.records.telemetry.encoder_preset import write_shifts
from bench.records.telemetry.ring import NoRing, RingWriter
from bench.supervisor.ownership import bench_folder
from drivers.base import Launch
from sim.ball import Ball
from sim.flight import fly
from tests.conftest import Run

BALL = ["ball", "--x", "0.2503", "--y", "-1.5602", "--uncertainty-mm", "0.5"]
CLUB = [
    *("club", "--length", "1.0902", "--loft-deg", "10.4", "--lie-deg", "53.1"),
    *("--length-uncertainty-mm", "0.5", "--angle-uncertainty-deg", "0.2"),
]
POSE = ["encoders", "--uncertainty-deg", "0.02", "--from-pose", "-30", "237", "350"]


@pytest.fixture
def golfbench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run) -> Run:
    """Return a function that runs a command of a bench with an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    (tmp_path / "mine.toml").write_text('base = "shipped"\n[bench]\nid = "testbench"\n', encoding="utf-8")
    return partial(run, "--config", "mine.toml")


def test_calibrate_list_new_bench_shows_nominal_without_data_folder(golfbench: Run, tmp_path: Path) -> None:
    code, text, _ = golfbench("calibrate", "list")
    assert (code, "testbench was never calibrated" in text) == (0, True)
    code, text, _ = golfbench("calibrate", "show")
    assert (code, text.count("nominal")) == (0, 5)
    assert not (tmp_path / "data").exists()


def test_calibrate_ball_second_version_supersedes_first(golfbench: Run) -> None:
    assert golfbench("calibrate", *BALL, "--by", "Ada", "--note", "new tee", "--expires-days", "7")[0] == 0
    assert golfbench("calibrate", *BALL, "--by", "Bob", "--method", "laser")[0] == 0
    code, text, _ = golfbench("calibrate", "list", "--json")
    first, second = json.loads(text)
    assert (code, first["version"], first["by"], first["note"]) == (0, 1, "Ada", "new tee")
    assert (second["version"], second["by"], second["method"]) == (2, "Bob", "laser")
    assert second["values"] == {"x": 0.2503, "y": -1.5602, "uncertainty": 0.0005, "club": "driver"}
    days = [datetime.fromisoformat(e["expires"]) - datetime.fromisoformat(e["date"]) for e in (first, second)]
    assert days == [timedelta(days=7), timedelta(days=30)]
    text = golfbench("calibrate", "list")[1]
    assert "superseded" in text
    assert "in force" in text
    code, text, _ = golfbench("calibrate", "show", "--json")
    shown = json.loads(text)
    assert (code, shown["problems"], shown["nominal"]) == (0, [], ["encoders", "club", "valves", "inputs"])
    assert [entry["version"] for entry in shown["in_force"]] == [2]


def test_check_command_expired_calibration_is_refused(
    golfbench: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert golfbench("calibrate", *BALL)[0] == 0
    code, text, _ = golfbench("check")
    assert (code, "ball version 1 of" in text, "warning" in text) == (0, True, False)
    replaced = "replaces plant.site.ball_x 0.25 by 0.2503, plant.site.ball_y -1.56 by -1.5602"
    assert replaced in text
    assert replaced in golfbench("calibrate", "show")[1]
    import bench.commands.bench.run as report

    class Later(datetime):
        @classmethod
        def now(cls, tz: Any = None) -> Later:
            return cls(2100, 1, 1, tzinfo=UTC)

    monkeypatch.setattr(report, "datetime", Later)
    code, text, errors = golfbench("check")
    assert (code, text.splitlines()[-1]) == (
        ExitCode.REFUSED,
        "Arming blocked for 1 reason: this bench does not swing.",
    )
    assert "error: calibration ball version 1" in errors


@pytest.mark.parametrize(
    ("command", "option", "value"),
    [
        *((CLUB, "--loft-deg", value) for value in ("80", "-1", "nan")),
        *((CLUB, option, "90") for option in ("--lie-deg", "--length", "--angle-uncertainty-deg")),
        *((BALL, option, "60") for option in ("--x", "--y", "--uncertainty-mm")),
        (POSE, "--uncertainty-deg", "6"),
        (BALL, "--uncertainty-mm", "0_5"),
        (POSE, "--from-pose", "-3_0"),
    ],
)
def test_calibrate_value_out_of_range_names_option(
    golfbench: Run, command: list[str], option: str, value: str
) -> None:
    given = list(command)
    given[given.index(option) + 1] = value
    code, _, errors = golfbench("calibrate", *given)
    assert (code, option in errors) == (ExitCode.BAD_INPUT, True)
    assert "rad" not in errors


def test_calibrate_club_stores_length_and_lie(golfbench: Run) -> None:
    code, text, _ = golfbench("calibrate", *CLUB, "--json")
    values = json.loads(text)["values"]
    assert (code, values["club"], values["length_to_face"]) == (0, "driver", 1.0902)
    assert values["lie"] == pytest.approx(radians(53.1))


def test_calibrate_encoders_from_pose_computes_zero_counts_and_keeps_sign(golfbench: Run) -> None:
    golfbench("calibrate", "encoders", "--uncertainty-deg", "0.02", "--zero-counts", "5", "6.5", "-7")
    shown = [*POSE, "--counts", "1", "20000", "131071", "--remounted"]
    code, text, _ = golfbench("calibrate", *shown, "--sign", "1", "-1", "1", "--json")
    entry = json.loads(text)
    assert (code, entry["version"], entry["values"]["sign"]) == (0, 2, [1, -1, 1])
    per_degree = 131072 / 360
    expected = [1.5 + 30 * per_degree, 20000.5 + 237 * per_degree, (131071.5 - 350 * per_degree) % 131072]
    assert entry["values"]["zero_count"] == pytest.approx(expected)
    # The sign in force goes on until another one is given.
    text = golfbench("calibrate", *shown, "--json")[1]
    assert json.loads(text)["values"]["sign"] == [1, -1, 1]


@pytest.mark.parametrize(
    ("joint", "sign", "found"),
    [
        (("20", "237", "350"), (), "shoulder\n  found:    zero 50.0 deg"),
        (("-30", "237", "350"), ("1", "-1", "1"), "sign -1 (+1 in force)"),
    ],
    ids=["other pose", "other sign"],
)
def test_calibrate_encoders_zero_far_from_present_one_needs_option(
    golfbench: Run, joint: tuple[str, ...], sign: tuple[str, ...], found: str
) -> None:
    counts = ["--counts", "1", "20000", "131071"]
    assert golfbench("calibrate", *POSE, *counts)[0] == 0
    other = [*POSE[:4], *joint, *counts, *(("--sign", *sign) if sign else ())]
    code, _, errors = golfbench("calibrate", *other)
    assert (code, found in errors, "--remounted" in errors) == (ExitCode.BAD_INPUT, True, True)
    near = [*POSE[:4], "-30.5", "236.5", "350.5", *counts]
    assert golfbench("calibrate", *near)[0] == 0
    assert golfbench("calibrate", *other, "--remounted")[0] == 0


def test_calibrate_encoders_configured_zeros_of_before_remounting_need_option(
    golfbench: Run, tmp_path: Path
) -> None:
    with (tmp_path / "mine.toml").open("a", encoding="utf-8") as file:
        file.write("[plant.encoders]\nzero_count = [1000.0, 2000.0, 3000.0]\n")
    zeros = ["encoders", "--uncertainty-deg", "0.05", "--zero-counts"]
    assert golfbench("calibrate", *zeros, "1000", "9000", "3000", "--remounted")[0] == 0
    code, _, errors = golfbench("calibrate", *zeros, "1000", "2000", "3000")
    assert (code, "--remounted" in errors) == (ExitCode.BAD_INPUT, True)


def test_calibration_unreadable_row_is_shown_with_cure_and_superseded(golfbench: Run, tmp_path: Path) -> None:
    assert golfbench("calibrate", *POSE, "--counts", "100", "131000", "7")[0] == 0
    with closing(sqlite3.connect(tmp_path / "data" / "golfbench.sqlite")) as plain, plain:
        plain.execute(
            "INSERT INTO calibrations "
            "SELECT 2, bench, 'ball', 1, '', date, expires, \"by\", method, note, '{}' FROM calibrations"
        )
    code, text, _ = golfbench("calibrate", "list")
    assert (code, "in force" in text, "calibration ball version 1 in the database is unreadable" in text) == (
        0,
        True,
        True,
    )
    code, text, _ = golfbench("calibrate", "show")
    assert (code, "in force" in text, "golfbench calibrate ball" in text) == (1, True, True)
    code, text, errors = golfbench("check")
    assert (code, "unreadable: ball version 1" in text, "golfbench calibrate ball" in errors) == (
        1,
        True,
        True,
    )
    assert [one["version"] for one in json.loads(golfbench("calibrate", "list", "--json")[1])] == [1, 1]
    assert golfbench("calibrate", *BALL)[0] == 0
    assert golfbench("check")[0] == 0


def test_calibrate_encoders_after_exchange_supersedes_other_resolution(
    golfbench: Run, tmp_path: Path
) -> None:
    assert golfbench("calibrate", *POSE, "--counts", "100", "131000", "7", "--sign", "1", "-1", "1")[0] == 0
    with (tmp_path / "mine.toml").open("a", encoding="utf-8") as file:
        file.write("[plant.encoders]\ncounts_per_revolution = 65536\n")
    code, text, _ = golfbench("calibrate", "show")
    assert (code, "encoders of 131072 counts per revolution" in text) == (1, True)
    code, text, _ = golfbench("calibrate", *POSE, "--counts", "100", "65000", "7", "--json")
    assert (code, json.loads(text)["values"]["sign"]) == (0, [1, -1, 1])
    assert golfbench("calibrate", "show")[0] == 0


def test_calibrate_encoders_stores_device_presets(golfbench: Run, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('base = "local_can"\n[bench]\nid = "testbench"\n', encoding="utf-8")
    counts = ["calibrate", "encoders", "--uncertainty-deg", "0.02", "--zero-counts", "5", "6.5", "-7"]
    code, text, errors = golfbench(*counts, "--json")
    assert (code, json.loads(text)["values"]["zero_shift"]) == (0, ["", "", ""])
    assert "presets of the encoders are unknown" in errors
    folder = bench_folder("testbench")
    folder.mkdir()
    try:
        write_shifts(folder, ("preset 0, offset 0", "preset 7, offset -7", ""))
        code, text, errors = golfbench(*counts)
        assert (code, errors) == (0, "")
        assert "in the devices preset 0, offset 0; preset 7, offset -7; " in text
    finally:
        rmtree(folder)
    kept = json.loads(golfbench("calibrate", "list", "--json")[1])[1]["values"]["zero_shift"]
    assert kept == ["preset 0, offset 0", "preset 7, offset -7", ""]


@pytest.mark.parametrize(
    ("arguments", "code", "texts"),
    [
        (
            ["ball", "--x", "0.6", "--y", "-1.5", "--uncertainty-mm", "1"],
            2,
            ["configured as (0.25, -1.56) m in plant.site", "0.15 m from it"],
        ),
        ([*BALL, "--by", " "], 2, ["--by"]),
        ([*CLUB, "hickory"], 2, ['"hickory"', "driver, thesis, iron7"]),
        (["encoders", "--uncertainty-deg", "1"], 2, ["no measurement", "Give one of the two"]),
        ([*POSE, "--zero-counts", "1", "2", "3"], 2, ["Give one of the two"]),
        ([*POSE], 1, ["no bench testbench running", "golfbench run"]),
        ([*POSE[:4], "0", "0", "350"], 2, ["arm", "180.0 to 288.0"]),
        ([*POSE, "--counts", "-1", "5", "5"], 2, ["--counts[0]", "0 to 131071"]),
        ([*POSE, "--counts", "1", "5", "5", "--sign", "1", "0", "1"], 2, ["sign: 1 or -1"]),
        (["valves", "--centre", "0", "0", "0"], 2, ["--dead-band"]),
        (
            ["valves", "--centre", "0", "0.5", "0", "--dead-band", "0", "0", "0", "--uncertainty", "0"],
            2,
            ["centre[1]", "-0.2 to 0.2"],
        ),
        ([*BALL, "--expires-days", "0"], 2, []),
    ],
)
def test_calibrate_invalid_arguments_are_refused_without_record(
    golfbench: Run, arguments: list[str], code: int, texts: list[str]
) -> None:
    found, _, errors = golfbench("calibrate", *arguments)
    assert found == code
    assert "Traceback" not in errors
    for text in texts:
        assert text in errors
    assert golfbench("calibrate", "list", "--json")[1] == "[]\n"


# Counts of a running bench ---------------------------------------------------------------------------


class Ticking:
    """A ring that gets new cycles while `standing_counts` sleeps."""

    def __init__(self, path: Path, counts: Any, valid: bool = True, **fields: Any) -> None:
        self.ring, self.counts, self.valid = RingWriter(path, 1024), np.asarray(counts), valid
        self.fields = {"vented": True, "state": State.ACCESS} | fields

    def __call__(self, seconds: float) -> None:
        cycle = np.zeros(1, CYCLE)
        for name, value in self.fields.items():
            cycle[name] = value
        for count in self.counts:
            cycle["encoder_count"], cycle["encoder_valid"] = count, self.valid
            self.ring(cycle)


@pytest.fixture
def ticking(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    made: list[Ticking] = []

    def make(counts: Any, valid: bool = True, path: Path = tmp_path / "ring", **fields: Any) -> Path:
        ticking = Ticking(path, counts, valid, **fields)
        made.append(ticking)
        monkeypatch.setattr("bench.calibration.calibration.time.sleep", ticking)
        return path

    yield make
    for ticking in made:
        ticking.ring.close()


def test_standing_counts_return_median_across_range_end(ticking: Any) -> None:
    wobble = np.array([-2, -1, 0, 1, 1] * 20)
    counts = np.stack([1000 + wobble, wobble % 4096, (4095 + wobble) % 4096], axis=1)
    assert standing_counts(ticking(counts), 4096) == (1000, 0, 4095)


@pytest.mark.parametrize(
    ("counts", "valid", "text"),
    [
        ([[1, 2, 3]] * 5, True, "5 cycles"),
        ([[1, 2, 3]] * 50, False, "shoulder: invalid readings"),
        ([[1, 2, n] for n in range(50)], True, "wrist: it moved by 49 counts"),
    ],
)
def test_standing_counts_moving_or_invalid_readings_are_refused(
    ticking: Any, counts: Any, valid: bool, text: str
) -> None:
    with pytest.raises(Refused, match=text):
        standing_counts(ticking(counts, valid), 4096)


@pytest.mark.parametrize(
    "fields",
    [{"vented": False, "state": State.ARMED}, {"phase": Phase.HOLD, "state": State.ARMED}],
    ids=["air on", "warning before air"],
)
def test_standing_counts_armed_robot_is_refused(ticking: Any, fields: dict[str, Any]) -> None:
    with pytest.raises(Refused, match="ARMED, robot not vented"):
        standing_counts(ticking([[1, 2, 3]] * 50, **fields), 4096)


def test_standing_counts_without_ring_raises(tmp_path: Path) -> None:
    with pytest.raises(NoRing):
        standing_counts(tmp_path / "ring", 4096)


def test_calibrate_encoders_from_pose_reads_counts_of_running_bench(golfbench: Run, ticking: Any) -> None:
    folder = bench_folder("testbench")
    folder.mkdir()
    try:
        ticking([[100, 200, 300]] * 50, path=folder / "ring")
        code, text, _ = golfbench("calibrate", *POSE, "--json")
    finally:
        rmtree(folder)
    entry = json.loads(text)
    assert (code, entry["method"]) == (0, "locked at the mechanical reference, counts read")
    assert entry["values"]["zero_count"][0] == pytest.approx(100.5 + 30 * 131072 / 360)


def test_calibrate_aerodynamics_fits_stores_and_lists_drag(golfbench: Run, tmp_path: Path) -> None:
    rows = ["ball_speed_mps,launch_angle_deg,spin_rpm,carry_m,apex_m,time_s"]
    for speed in (58.0, 61.0, 64.0, 67.0, 70.0):
        flight = fly(Launch(speed, radians(11.0), 0.0, 280.0, 0.0), ball=Ball(drag_factor=1.03))
        rows.append(f"{speed},11,{280 * 30 / pi:.3f},{flight.carry},{flight.apex},{flight.time}")
    (tmp_path / "flights.csv").write_text("\n".join(rows))
    command = [
        "calibrate",
        "aerodynamics",
        "tour",
        "flights.csv",
        "--by",
        "Ann",
        "--source",
        "radar, range 2",
    ]
    code, text, _ = golfbench(*command, "--no-store")
    assert (code, "not stored" in text) == (0, True)
    assert golfbench("calibrate", "list", "--json")[1].strip() == "[]"
    code, text, _ = golfbench(*command, "--measured", "2026-10-02")
    assert (code, "tour: drag 1.0300 ±" in text, "2026-10-02, version 1, by Ann" in text) == (0, True, True)
    assert "aerodynamics of tour: drag 1.0300" in golfbench("calibrate", "list")[1]
    (record,) = json.loads(golfbench("calibrate", "list", "--json")[1])
    assert (record["kind"], record["subject"], record["source"]) == ("aerodynamics", "tour", "radar, range 2")
    for ball in ("", " ", "tour ", "Tour"):
        code, _, errors = golfbench("calibrate", "aerodynamics", ball, *command[3:])
        assert (code, "aerodynamics: BALL" in errors, repr(ball) in errors) == (2, True, True)
    code, _, errors = golfbench("calibrate", "aerodynamics", "premium", *command[3:], "--no-store")
    assert (code, "no ball premium" in errors) == (0, True)
    for day in ("tomorrow", "2999-01-01", "1900-01-01"):
        code, _, errors = golfbench(*command, "--measured", day)
        assert (code, "--measured" in errors) == (2, True)
    wider = golfbench(*command, "--no-store", "--scatter", "carry=3", "--uncertainty", "carry=2")[1]
    assert wider != golfbench(*command, "--no-store")[1]
    for wrong in ("carry", "carry=-1", "carry=nan", "length=1"):
        code, _, errors = golfbench(*command, "--scatter", wrong)
        assert (code, f"'{wrong}'" in errors) == (2, True)
    (tmp_path / "flights.csv").write_text("\n".join(rows[:3]))
    code, _, errors = golfbench(*command)
    assert (code, "expected at least 3" in errors) == (2, True)
