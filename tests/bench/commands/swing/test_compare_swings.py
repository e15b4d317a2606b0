"""`golfbench compare`: swings and configurations side by side, at the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.conftest import Run
from tests.replay.renew import SWING


def test_compare_record_and_profile_prints_table_plot_and_json(tmp_path: Path, run: Run) -> None:
    plot = tmp_path / "both.png"
    code, out, _ = run("compare", str(SWING), "default", "--plot", str(plot))
    assert code == 0
    for text in ("replay/swing", "club speed", "m/s", "wrist: tracking error, RMS", "aligned at the ball"):
        assert text in out
    assert plot.stat().st_size > 10_000
    code, out, _ = run("compare", str(SWING), "default", "--json")
    found = json.loads(out)
    assert (code, found["aligned_at_ball"]) == (0, True)
    (speed,) = (row for row in found["differences"] if row["name"] == "club speed")
    assert speed["between"] == pytest.approx(speed["second"] - speed["first"])


def test_compare_configurations_lists_differing_keys(tmp_path: Path, run: Run) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text('base = "shipped"\n[plant]\nwrist_lever = 0.05\n')
    code, out, _ = run("compare", "shipped", str(mine), "--json")
    assert (code, [row["key"] for row in json.loads(out)["differences"]]) == (0, ["plant.wrist_lever"])
    _, out, _ = run("compare", "shipped", str(mine))
    assert "plant.wrist_lever" in out
    _, out, _ = run("compare", str(mine), str(mine))
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
def test_compare_incompatible_inputs_are_refused(arguments: list[str], told: str, run: Run) -> None:
    code, out, err = run("compare", *arguments)
    assert (code, out) == (2, "")
    assert told in err
