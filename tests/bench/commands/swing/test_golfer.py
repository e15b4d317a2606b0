"""`golfbench golfer`: a recording becomes a file, figures and a plot."""

from __future__ import annotations

import json
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.base.errors import BenchError
from bench.golfer.golfer_file import load_golfer
from bench.swing.golfers import GOLFERS
from tests.bench.golfer.synthetic import BALL, MAP, Synthetic, angles, write
from tests.conftest import Run

BODY = "\n".join(line for line in MAP.splitlines() if not line.startswith(("grip", "head")))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    golfer = Synthetic()
    (tmp_path / "map.toml").write_text(MAP)
    return write(tmp_path / "swing.csv", *golfer.recording(), golfer.rate)


def _import(recording: Path, *more: str) -> list[str]:
    folder = str(recording.parent)
    return ["golfer", "import", str(recording), "--markers", f"{folder}/map.toml", "--output", folder, *more]


def _json(recording: Path, run: Run, *more: str) -> dict[str, Any]:
    code, out, err = run(*_import(recording, "--json", *more))
    assert (code, err) == (0, "")
    found: dict[str, Any] = json.loads(out)
    return found


def test_golfer_import_writes_loadable_file_with_true_angles(recording: Path, run: Run) -> None:
    found = _json(recording, run, "--name", "Anna 7")

    assert found["golfer"] == str(recording.with_name("Anna 7.golfer.toml"))
    assert found["source_sha256"] == sha256(recording.read_bytes()).hexdigest()
    assert found["impact_s"] == pytest.approx(BALL, abs=1e-3)
    assert found["lead"] == "left"
    assert found["rate_hz"] == 240
    golfer = load_golfer(Path(found["golfer"]))
    assert golfer.name == "Anna 7"
    assert golfer.time[golfer.top_row] == pytest.approx(found["top_s"] - found["impact_s"], abs=2e-3)
    true = np.degrees(angles(np.array([found["top_s"], BALL])))
    true[:, 1:] %= 360.0
    assert found["theta_top_deg"] == pytest.approx(true[0].tolist(), abs=0.5)
    assert found["theta_ball_deg"] == pytest.approx(true[1].tolist(), abs=0.5)
    assert golfer.head_speed == pytest.approx(found["head_speed_mps"], abs=1e-3)
    assert golfer.head[-1] == pytest.approx([0.0, 0.0], abs=1e-6)


def test_golfer_import_prints_figures_and_limits_and_plots(recording: Path, run: Run) -> None:
    plot = recording.with_name("swing.png")

    code, out, _ = run(*_import(recording, "--plot", str(plot)))

    assert code == 0
    for text in (
        "loss of head speed",
        "slowest hands",
        "lead      left",
        "A planar robot cannot show",
        "Beyond",
    ):
        assert text in out
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_golfer_import_without_club_markers_has_no_wrist(recording: Path, run: Run) -> None:
    recording.with_name("map.toml").write_text(BODY)

    found = _json(recording, run)

    assert found["theta_top_deg"][2] is found["theta_ball_deg"][2] is found["head_speed_mps"] is None
    assert found["beyond_machine"]["wrist_rad"] is None
    assert np.isnan(load_golfer(Path(found["golfer"])).head_speed)


def test_golfer_import_recording_without_impact_writes_no_file(recording: Path, run: Run) -> None:
    lines = recording.read_text().splitlines()
    recording.write_text("\n".join(lines[:300]))

    code, out, err = run(*_import(recording))

    assert (code, out) == (2, "")
    assert "no impact" in " ".join(err.split())
    assert list(recording.parent.glob("*.golfer.*")) == []


@pytest.mark.parametrize(
    "option",
    [
        ("--events", "top=x"),
        ("--events", "finish=1"),
        ("--lead", "west"),
        ("--up", "w"),
        ("--plot", "swing.gif"),
        ("--name", "../other"),
        ("--output", "nowhere"),
    ],
    ids=" ".join,
)
def test_golfer_import_invalid_option_is_refused(option: tuple[str, str], recording: Path, run: Run) -> None:
    code, _, err = run(*_import(recording, *option))

    assert code == 2
    assert option[0] in err


@pytest.mark.parametrize("change", ["table", "digest", "schema", "missing table"])
def test_load_golfer_damaged_file_is_refused(change: str, recording: Path, run: Run) -> None:
    path = Path(_json(recording, run)["golfer"])
    table = path.with_name("swing.golfer.parquet")
    if change == "table":
        table.write_bytes(table.read_bytes()[:-1])
    elif change == "missing table":
        table.unlink()
    else:
        key = "schema" if change == "schema" else "table_sha256"
        path.write_text(path.read_text().replace(f"{key} = ", f"{key} = 'x' # "))

    with pytest.raises(BenchError) as refused:
        load_golfer(path)

    assert "golfbench golfer import" in refused.value.action


def test_golfer_compare_prints_deviation_definition_and_reference(recording: Path, run: Run) -> None:
    golfer = _json(recording, run)["golfer"]
    plot = recording.with_name("compared.png")

    code, out, _ = run("golfer", "compare", golfer, golfer, "tour-male", "--plot", str(plot))

    assert code == 0
    for text in ("swing, measured", "tour-male, robot", "0.0 % 0.0°", "9.6 %", "Root mean square", "Beyond"):
        assert text in out
    assert plot.read_bytes().startswith(b"\x89PNG")
    code, out, _ = run("golfer", "compare", golfer, "tour-male", "--json")
    (found,) = json.loads(out)
    assert (found["reference"]["source"], found["swing"]["name"]) == ("measured", "tour-male")
    assert set(found["deviation"]) == {"shoulder", "arm", "wrist", "head"}
    assert found["rms"]["head_m"] > 0.0
    assert "aligned at the ball" in found["definition"]


def test_golfer_compare_without_swings_compares_each_built_in_golfer(
    run: Run,
) -> None:
    code, out, _ = run("--config", "golfers", "golfer", "compare", "--json")

    assert code == 0
    found = json.loads(out)
    assert [row["reference"]["name"] for row in found] == list(GOLFERS)
    assert {row["swing"]["name"] for row in found} == {f"{name}-full" for name in GOLFERS}
