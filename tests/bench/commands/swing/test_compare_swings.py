"""`golfbench compare`: swings and configurations side by side, at the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bench.commands.cli import main
from tests.replay.renew import SWING


def _run(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main(["compare", *arguments])
    printed = capsys.readouterr()
    return int(ended.value.code or 0), printed.out, printed.err


def test_compare_record_and_profile_prints_table_plot_and_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plot = tmp_path / "both.png"
    code, out, _ = _run([str(SWING), "default", "--plot", str(plot)], capsys)
    assert code == 0
    for text in ("replay/swing", "club speed", "m/s", "wrist: tracking error, RMS", "aligned at the ball"):
        assert text in out
    assert plot.stat().st_size > 10_000
    code, out, _ = _run([str(SWING), "default", "--json"], capsys)
    found = json.loads(out)
    assert (code, found["aligned_at_ball"]) == (0, True)
    (speed,) = (row for row in found["differences"] if row["name"] == "club speed")
    assert speed["between"] == pytest.approx(speed["second"] - speed["first"])


def test_compare_configurations_lists_differing_keys(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text('base = "shipped"\n[plant]\nwrist_lever = 0.05\n')
    code, out, _ = _run(["shipped", str(mine), "--json"], capsys)
    assert (code, [row["key"] for row in json.loads(out)["differences"]]) == (0, ["plant.wrist_lever"])
    _, out, _ = _run(["shipped", str(mine)], capsys)
    assert "plant.wrist_lever" in out
    _, out, _ = _run([str(mine), str(mine)], capsys)
    assert "equal in all keys" in out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["shipped", "default"], "a configuration, compared with default"),
        (["shipped", "golfers", "--plot", "a.png"], "it draws two swings"),
        (["defualt", "default"], "Did you mean default"),
        (["absent.parquet", "default"], "absent.parquet"),
        (["absent.toml", "default"], "absent.toml"),
        (["default", "driver-100mph", "--plot", "a.txt"], ".png"),
        ([".", "default"], "found:    a folder"),
    ],
)
def test_compare_incompatible_inputs_are_refused(
    arguments: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = _run(arguments, capsys)
    assert (code, out) == (2, "")
    assert told in err
