"""The EDS files against a checker of others: complete, and without entries that CiA 306 does not know."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from sim.nodes.process import EDS


def check(file: Path) -> tuple[int, str]:
    """Return exit code and text of dcfchk, to which a warning is an error."""
    found = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-m", "dcf.cli", "-n", "5", str(file)],
        capture_output=True,
        text=True,
        check=False,
    )
    return found.returncode, found.stdout + found.stderr


@pytest.mark.parametrize("name", ["encoder.eds", "valve_node.eds"])
def test_eds_files_pass_checker(name: str) -> None:
    assert check(EDS / name) == (0, "")


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("PDOMapping=0", "PDOMapping=0\nFactor=0.5", "invalid entry in [6001]: Factor"),
        ("AccessType=rw", "AccessType=always", "AccessType in [6001]"),
        ("DataType=0x0007\n", "", "DataType not specified in [6001]"),
    ],
)
def test_eds_spoiled_object_fails_checker(tmp_path: Path, old: str, new: str, told: str) -> None:
    before, after = (EDS / "encoder.eds").read_text(encoding="ascii").split("[6001]")
    spoiled = tmp_path / "encoder.eds"
    spoiled.write_text(f"{before}[6001]{after.replace(old, new, 1)}", encoding="ascii")
    code, text = check(spoiled)
    assert code != 0
    assert told in text
