"""A drawn robot commissioned over the simulated CANopen nodes, all steps, by keys at a terminal.

    python -m tests.benchmarks canopen_commissioning --seed 3

Takes an hour, so only by name. Bench and nodes are processes of this machine on a separate bus; a script
turns the regulator, and manual actions are done at the nodes. With `--folder` an interrupted run
resumes there with `--resume --repaired nothing`.
"""

from __future__ import annotations

import argparse
import os
import pty
import re
import select
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

from bench.commissioning.machine.inputs import ACTS, SERVICE
from bench.config import load_configuration
from sim.plant import PlantParameters
from tests.bench.commissioning.drawn_robots import drawn_robot, drawn_robot_file
from tests.benchmarks.row import Row
from tests.running_bench import played_nodes

_TITLE = "commissioning over CANopen"
_KEPT = 20_000
"""Bytes of the terminal in which a prompt is looked for."""
_PICTURE = re.compile(r"\x1b\[[?0-9;]*[a-zA-Z]|\r")
_AGAIN = re.compile(r"it is armed again|the swing is repeated")


class Terminal:
    """What stands at the terminal of `golfbench commission`, and who answers it."""

    def __init__(self, command: Sequence[str], robot: Path, nodes: Path, truth: PlantParameters) -> None:
        self._robot, self._nodes, self._truth = robot, nodes, truth
        self._master, slave = pty.openpty()
        self.process = subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave)
        os.close(slave)
        self.text = ""
        self._read = 0

    def watch(self) -> int:
        """Answer each prompt until the command ends; return its exit code."""
        while self.process.poll() is None:
            if not select.select([self._master], [], [], 0.5)[0]:
                continue
            try:
                self.text += _PICTURE.sub("", os.read(self._master, 1 << 16).decode("utf-8", "replace"))
            except OSError:  # the command has closed its side
                break
            self._read = max(self._read, len(self.text) - _KEPT)
            self._answer(re.sub(r"\s+", " ", self.text[self._read :]))
        return self.process.wait(30.0)

    def _answer(self, shown: str) -> None:
        for act in ACTS.values():
            if act.text in shown:
                time.sleep(1.0)
                at_nodes(self._robot, self._nodes, "--act", act.key)
                self._read = len(self.text)
                return
        if "bar on the gauge" in shown:
            turned = (self._nodes.parent / "turned").read_text().split()[-1]
            supply = self._truth.supply
            absolute = supply.pressure / 1e5 if turned == SERVICE else float(turned)
            self._type(f"{absolute - supply.atmosphere / 1e5:.2f}\n")
        elif "press Enter" in shown or re.search(r"mark[^.]*: $", shown):
            self._type("\n")

    def _type(self, text: str) -> None:
        os.write(self._master, text.encode())
        self._read = len(self.text)

    def close(self) -> None:
        """End the command, if it runs. Allowed twice."""
        self.process.kill()
        self.process.wait()
        os.close(self._master)


def at_nodes(robot: Path, folder: Path, *what: str) -> None:
    """Do something at the nodes with their files in `folder`."""
    command = [sys.executable, "-m", "bench", "--config", str(robot), "nodes", "--folder", str(folder), *what]
    subprocess.run(command, check=True, capture_output=True)


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Commission the drawn robot; return time, repetitions and exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks canopen_commissioning")
    parser.add_argument("--seed", type=int, default=3, help="seed of the robot")
    parser.add_argument("--folder", type=Path, help="for all files, which stay there")
    options = parser.parse_args(arguments)
    with ExitStack() as stack:
        folder = options.folder or Path(stack.enter_context(TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        bench, robot, nodes, day = (folder / n for n in ("bench.toml", "robot.toml", "nodes", "day"))
        bench.write_text(
            f'base = "local_can"\n[bench]\nid = "drawn-{options.seed}"\ndata_dir = "{folder / "data"}"\n'
            f'[canopen]\nchannel = "{folder / "bus"}"\n'
        )
        configuration = load_configuration(bench)
        truth = drawn_robot(options.seed, configuration.plant)
        robot.write_text(drawn_robot_file(truth, configuration))
        turn = folder / "turn"
        turn.write_text(
            f'#!/bin/sh\necho "$1" >> {folder / "turned"}\nexec {sys.executable} -m bench --config {robot} '
            f'nodes --folder {nodes} --turn-regulator "$1"\n'
        )
        turn.chmod(0o755)
        resume = ["--resume", "--repaired", "nothing"] if (day / "commissioning.json").exists() else []
        command = [sys.executable, "-m", "bench", "--config", str(bench), "commission", "--output", str(day)]
        begun = time.monotonic()
        stack.enter_context(played_nodes(robot, "--folder", str(nodes)))
        terminal = Terminal([*command, "--regulator", str(turn), *resume], robot, nodes, truth)
        stack.callback(terminal.close)
        code = terminal.watch()
        minutes = (time.monotonic() - begun) / 60.0
    (folder / "terminal.txt").write_text(terminal.text)
    print(terminal.text[-4000:])
    return [
        Row(_TITLE, "exit code", code, "", f"robot drawn with seed {options.seed}", at_most=0),
        Row(_TITLE, "time", minutes, "min"),
        Row(_TITLE, "swings and arms repeated after a stall", len(_AGAIN.findall(terminal.text)), ""),
    ]
