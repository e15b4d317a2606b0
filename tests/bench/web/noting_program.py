"""A script in place of `golfbench`, that notes its arguments and answers as the program would."""

from __future__ import annotations

import json
import sys
from pathlib import Path

PROGRAM = """
import json, os, sys, time
from pathlib import Path
def fail(place, found, expected, action):
    assert os.environ["GOLFBENCH_ERRORS"] == "json"
    sys.exit(json.dumps({"location": place, "found": found, "expected": expected, "action": action}))
folder, given = Path(sys.argv[1]), sys.argv[2:]
with (folder / "asked").open("a") as file:
    file.write(json.dumps(given) + "\\n")
if given[:2] == ["campaign", "check"]:
    trial = {"role": "test", "section": 1, "block": 1, "position": 1, "swing": "s", "club": "c", "ball": "b"}
    print(json.dumps({"digest": "0123456789abcdef", "title": "x", "sequence": [trial] * 3}))
elif given[:1] == ["commission"] and "--check" in given:
    if (folder / "fail").exists():
        fail("robot", "no sensors", "some", "Fit them.")
    step = {"name": "s", "title": "T", "bounds": "B", "done": False}
    print(json.dumps({"folder": "f", "robot": "", "steps": [step]}))
elif given[:2] in (["campaign", "run"], ["campaign", "resume"]) or given[:1] == ["commission"]:
    print("campaign x-1")
    while not (folder / "end").exists():
        time.sleep(0.01)
    if (folder / "refuse").exists():
        sys.exit(1)
    if (folder / "fail").exists():
        fail("bench b", "held by Ann", "a free bench", "Wait.")
elif given[:1] == ["calibrate"] and given[3:5] == ["--x", "9"]:
    fail("calibrate ball", "9", "up to 3 m", "Measure again.")
elif given[:1] == ["view"]:
    if (folder / "fail").exists():
        fail("Rerun", "nothing", "it", "Install it.")
    print("http://127.0.0.1:9999/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A9876%2Fproxy", flush=True)
    time.sleep(600)
else:
    print("ball version 1 of bench1 <script>alert(1)</script>")
"""


class NotingProgram:
    """The script in place of `golfbench`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        file = folder / "golfbench.py"
        file.write_text(PROGRAM)
        self.command = (sys.executable, "-S", str(file), str(folder))

    @property
    def asked(self) -> list[list[str]]:
        """Arguments of each call."""
        file = self.folder / "asked"
        return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []

    def note(self, name: str) -> None:
        """Make the script end ("end"), fail ("fail"), or refuse without words ("refuse")."""
        (self.folder / name).touch()
