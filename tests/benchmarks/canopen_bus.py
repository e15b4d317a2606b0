"""The CANopen driver and simulated nodes as two processes over the local bus, in real time.

    python -m tests.benchmarks canopen_bus --seconds 600

A loop of the driver's tick under SCHED_FIFO, the nodes around the moving plant in a process of their own, and
a third process that sees every frame: what of tick, driver and wire must add up, and how long answers take.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from bench.processes.child import Child
from drivers.can_bus import FRAME, LocalSocketBus
from drivers.canopen.counters import CLASSES
from drivers.canopen.driver import CanopenDriver
from drivers.canopen.settings import CanopenSettings
from sim.nodes.plan import NodesPlan
from sim.plant import PlantParameters
from tests.benchmarks.bus_witness import COMMAND, MARK, POSITIONS, SYNC
from tests.benchmarks.driver_loop import DriverLoop, in_real_time, times
from tests.benchmarks.row import Row

PRIORITY, WATCHDOG, WARM_UP = 80, 0.1, 500
_SUBSTEPS_RATE = 4000.0


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Run for the seconds asked."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks canopen_bus")
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--rate", type=float, default=1000.0, help="Hz")
    options = parser.parse_args(arguments)
    period, ticks = 1.0 / options.rate, round(options.seconds * options.rate)
    plant = PlantParameters(tick=period, substeps=max(1, round(_SUBSTEPS_RATE * period)))
    scheduling = os.sched_getscheduler(0), os.sched_getparam(0)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="golfbench-can-")))
        settings = CanopenSettings("local_socket", str(folder / "can"), service_time=1.0)
        plan = NodesPlan(
            settings.interface,
            settings.channel,
            settings.bitrate,
            settings.encoders.nodes,
            settings.valve_node.node,
            plant,
            folder,
            priority=PRIORITY - 1,
        )
        nodes = Child.start("nodes", "sim.nodes.process", plan)
        stack.callback(nodes.end, 5.0)
        nodes.wait_until_ready(200.0)
        witness = subprocess.Popen(
            [sys.executable, "-m", "tests.benchmarks.bus_witness", settings.channel, str(PRIORITY - 2)],
            stdout=subprocess.PIPE,
            text=True,
        )
        stack.callback(witness.wait)
        stack.callback(witness.terminate)
        if witness.stdout is None or witness.stdout.readline() != "here\n":
            raise RuntimeError("the witness did not come to the bus")
        marks = stack.enter_context(
            LocalSocketBus(settings.channel, can_filters=[{"can_id": 0, "can_mask": 0x7FF}])
        )
        driver = CanopenDriver(settings, period=period, watchdog=WATCHDOG)
        driver.open()
        stack.callback(driver.close)
        loop = DriverLoop(driver)
        in_real_time(PRIORITY)
        stack.callback(os.sched_setscheduler, 0, *scheduling)
        mark = FRAME.pack(MARK, 0, bytes(8))
        loop.run(WARM_UP)
        loop.forget()
        before = {name: getattr(driver.counters, name) for name in (*CLASSES, "frames", "syncs", "missing")}
        marks.send_frame(mark)
        loop.run(ticks)
        marks.send_frame(mark)
        new = {name: getattr(driver.counters, name) - before[name] for name in before}
        trouble = driver.trouble
        told = json.loads(witness.stdout.readline())
    title = f"driver and nodes over the local bus, {options.rate:g} Hz for {options.seconds:g} s"
    return rows(title, loop, ticks, new, told, trouble, 100.0 * driver.load)


def rows(
    title: str,
    loop: DriverLoop,
    ticks: int,
    new: dict[str, int],
    told: dict[str, Any],
    trouble: str,
    load: float,
) -> list[Row]:
    """Return the figures: `new` of the driver's counters, `told` by the witness."""
    frames = {int(identifier): count for identifier, count in told["frames"].items()}
    positions, total = sum(frames.get(i, 0) for i in POSITIONS), sum(frames.values())
    third, bitrate = told["third"], loop.driver.settings.bitrate
    return [
        times(title, "wake-up", loop.lateness),
        times(title, "read: SYNC out, three positions in", loop.reading),
        times(title, "write: command out", loop.writing),
        Row(
            title,
            "SYNC to the third position, on the bus",
            third["p50_us"],
            "us",
            f"median; p99 {third['p99_us']:.1f}, longest {third['max_us']:.1f} us",
        ),
        Row(title, "bus: SYNCs less ticks", frames.get(SYNC, 0) - ticks, f"of {ticks}", "", 0, 0),
        Row(title, "bus: commands less ticks", frames.get(COMMAND, 0) - ticks, f"of {ticks}", "", 0, 0),
        Row(
            title,
            "bus: positions less three for each SYNC",
            positions - 3 * ticks,
            f"of {3 * ticks}",
            "",
            0,
            0,
        ),
        Row(
            title,
            "driver: positions less those on the bus",
            new["positions"] + new["late"] + new["duplicates"] - positions,
            f"of {positions}",
            f"in time {new['positions']}, late {new['late']}",
            0,
            0,
        ),
        Row(
            title,
            "driver: frames less those of its classes",
            new["frames"] - sum(new[c] for c in CLASSES),
            f"of {new['frames']}",
            "",
            0,
            0,
        ),
        Row(
            title,
            "positions late or missing",
            new["late"] + new["missing"],
            f"of {3 * ticks}",
            f"{loop.old} ticks without all three",
        ),
        Row(title, "trouble", float(bool(trouble)), "", trouble or "operational to the end", at_most=0),
        Row(
            title,
            "bus load, frames really sent",
            100.0 * told["bits"] / told["seconds"] / bitrate,
            "%",
            f"{total / told['seconds']:.0f} frames a second, stuff bits counted",
            at_most=load,
        ),
    ]
