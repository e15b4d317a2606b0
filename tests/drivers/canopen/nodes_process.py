"""The simulated nodes as a process on the local bus, and the command in force at its valve node."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from drivers.base import Command
from drivers.base.records import unpack_command
from drivers.base.shared_memory import SharedRecord
from drivers.canopen.settings import CanopenSettings
from sim.exchange import PLANT_REPORT, REPORT_FILE
from tests.drivers.canopen.in_step import nodes_plan
from tests.ready_child import ready_child


def rounded(command: Command) -> Command:
    """Return `command` to the outputs' resolution."""
    a, b, c = (round(opening, 4) + 0.0 for opening in command.valve)
    return command._replace(valve=(a, b, c))


class NodesProcess:
    """The process and its report; patient: the machine may be busy."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.settings = CanopenSettings(
            "local_socket", str(folder / "can"), sdo_timeout=2.0, heartbeat=0.1, interlock_period=0.3
        )
        self._plan = nodes_plan(settings=self.settings, folder=folder)
        self.child = ready_child("sim.nodes.process", self._plan)
        self._shared = SharedRecord.open(folder / REPORT_FILE, PLANT_REPORT)
        self.report = np.zeros(1, PLANT_REPORT)

    @property
    def node(self) -> np.void:
        """The newest report on the valve node."""
        self._shared.read(self.report)
        found: np.void = self.report["node"][0]
        return found

    @property
    def in_force(self) -> Command:
        """The newest command in force."""
        self._shared.read(self.report)
        return rounded(unpack_command(self.report["node"]["applied"]))

    def settled(self) -> Command:
        """Return the command in force once the plant has lived for more ticks than it makes up in one go."""
        self._shared.read(self.report)
        heard, deadline = self.report["ticks"][0] + self._plan.max_catch_up + 1, time.monotonic() + 20.0
        while self.report["ticks"][0] < heard:
            assert time.monotonic() < deadline
            time.sleep(0.0005)
            self._shared.read(self.report)
        return self.in_force

    def end(self) -> None:
        """End the process."""
        self._shared.close()
        self.child.end(5.0)
