from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.base.errors import BenchError, ExitCode, Refused
from bench.commands.swing.records import Format, planned_exports
from bench.records.telemetry.record_file import write_swing
from tests.conftest import Run


@pytest.fixture
def records(tmp_path: Path, make_swing: Callable[[int], np.ndarray[Any, Any]]) -> Path:
    folder = tmp_path / "swings"
    folder.mkdir()
    for number in (1, 2):
        write_swing(folder / f"{number:03d}.parquet", make_swing(number)[:50], {"number": number})
    return folder


@pytest.mark.parametrize("kind", Format)
def test_export_folder_writes_each_record(kind: Format, records: Path, tmp_path: Path, run: Run) -> None:
    assert run("export", records, "--format", kind, "--output", tmp_path / "out").code == ExitCode.OK
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {f"001.{kind}", f"002.{kind}"} <= names


def test_planned_one_record_uses_same_folder_or_output(records: Path, tmp_path: Path) -> None:
    one = records / "001.parquet"
    assert planned_exports([one], Format.MAT, None, False) == [(one, records / "001.mat")]
    assert planned_exports([one], Format.MAT, tmp_path / "x.mat", False) == [(one, tmp_path / "x.mat")]
    assert planned_exports([one], Format.MAT, records, False) == [(one, records / "001.mat")]


def test_export_existing_file_is_refused_without_force(records: Path, tmp_path: Path, run: Run) -> None:
    target = tmp_path / "x.mat"
    target.write_text("mine")
    command = ("export", records / "001.parquet", "--format", "mat", "--output", target)
    code, _, err = run(*command)
    assert (code, "--force" in err) == (ExitCode.REFUSED, True)
    assert target.read_text() == "mine"
    assert run(*command, "--force").code == 0
    assert target.read_bytes()[:6] == b"MATLAB"


def test_planned_colliding_targets_are_refused(records: Path, tmp_path: Path) -> None:
    other = tmp_path / "other" / "001.parquet"
    with pytest.raises(BenchError, match="several records of that name"):
        planned_exports([records / "001.parquet", other], Format.CSV, tmp_path / "out", False)
    (records / "001.csv").touch()
    with pytest.raises(Refused):
        planned_exports([records / "001.parquet"], Format.CSV, None, False)


@pytest.mark.parametrize(
    ("name", "kind", "told"),
    [
        ("x.parquet", "csv", "unreadable"),
        ("y.parquet", "csv", "no such file"),
        ("", "xls", "not one of"),
        ("empty", "csv", "empty"),
    ],
)
def test_export_invalid_record_or_format_is_refused(
    name: str, kind: str, told: str, tmp_path: Path, run: Run
) -> None:
    (tmp_path / "x.parquet").write_text("nothing")
    (tmp_path / "empty").mkdir()
    answer = run("export", tmp_path / name, "--format", kind)
    assert (answer.code, told in answer.words) == (ExitCode.BAD_INPUT, True)
