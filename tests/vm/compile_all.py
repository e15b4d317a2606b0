"""Compile what loop, nodes and shots run, so that the guest finds it compiled: run in the guest's root."""

from __future__ import annotations

import tempfile
from pathlib import Path

from bench.base.lifecycle import State
from bench.config import load_configuration
from bench.control.settings import build_controller
from bench.loop.loop import Cycle
from bench.records.shot.recorded_shot import FlightConditions, warm_up_shots
from bench.records.telemetry.ring import RingWriter
from bench.supervisor._tick_timing import TickTiming, new_timing
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.canopen.driver import CanopenDriver
from drivers.mock import MockDriver
from sim.nodes.process import run_nodes
from sim.nodes.wall_plant import NodesPlan


def main() -> None:
    """Run a tick of a loop, the nodes until they live, and a shot."""
    c = load_configuration(None)
    warm_up_shots(c.plant, FlightConditions())
    parameters = build_controller(
        c.plant,
        load_profile(find_profile(c.swing.profile)),
        c.control,
        c.envelope,
        c.estimator,
        c.lifecycle,
        c.homing,
    )
    with tempfile.TemporaryDirectory() as name:
        folder, driver = Path(name), MockDriver()
        ring = RingWriter(folder / "ring", 16)
        driver.open()
        cycle = Cycle(driver, parameters, ring, name="mock", state=State.STARTING)
        for tick in range(3):
            cycle.run_tick(0.001 * tick)
        begin = int(cycle.marks[0])
        TickTiming(new_timing(1_000_000)).note(cycle.marks, begin, begin)
        driver.close()
        ring.close()
        bus = c.canopen
        CanopenDriver(bus).native_calls()
        plan = NodesPlan(
            "local_socket",
            str(folder / "bus"),
            bus.bitrate,
            bus.encoders.nodes,
            bus.valve_node.node,
            c.plant,
            folder,
        )
        run_nodes(plan, lambda scheduling: None, lambda: True)


if __name__ == "__main__":
    main()
