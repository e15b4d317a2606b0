"""The tick of a CANopen bench as its libraries invite one to write it: messages, a DBC, canopen's PDOs.

It sends and takes the same frames as `drivers.canopen.driver` and has the same result, without its checks.
"""

from __future__ import annotations

import time
from pathlib import Path

import can
import canopen
import cantools
from cantools.database.can import Database

from drivers.base import CHAMBERS, Command
from drivers.canopen.dbc import describe
from drivers.canopen.settings import CanopenSettings

_EDS = Path(__file__).parents[2] / "drivers" / "canopen" / "valve_node.eds"
_POSITIONS = ("POSITION_SHOULDER", "POSITION_ARM", "POSITION_WRIST")


class NaiveTick:
    """SYNC, three positions, one command, on a bus that is set up."""

    def __init__(self, bus: can.BusABC, settings: CanopenSettings, period: float, watchdog: float) -> None:
        loaded = cantools.database.load_string(describe(settings, period, watchdog), "dbc")
        assert isinstance(loaded, Database)
        self._bus, self._database = bus, loaded
        self._beat = can.Message(arbitration_id=0x700 + settings.master, is_extended_id=False, data=b"\x05")
        self._beaten, self._beat_period = 0.0, watchdog / 3.0
        self._sync = can.Message(arbitration_id=0x80, is_extended_id=False, data=b"")
        network = canopen.Network(bus)
        node = canopen.RemoteNode(settings.valve_node.node, str(_EDS))
        network.add_node(node)
        self._command = node.rpdo[1]
        self._command.cob_id, self._command.enabled = 0x200 + settings.valve_node.node, True
        self._command.clear()
        self._valves = [self._command.add_variable(0x6411, valve) for valve in (1, 2, 3)]
        self._outputs = self._command.add_variable(0x6200, 1)
        self._answer_time = settings.answer_time
        self.values: dict[str, object] = {}

    def run(self, command: Command) -> tuple[object, ...]:
        """Do one tick; return positions, inputs and pressures."""
        if time.monotonic() - self._beaten > self._beat_period:
            self._beaten = time.monotonic()
            self._bus.send(self._beat)
        self._bus.send(self._sync)
        missing, end = set(_POSITIONS), time.monotonic() + self._answer_time
        while missing and (left := end - time.monotonic()) > 0.0:
            message = self._bus.recv(left)
            if message is None:
                break
            kind = self._database.get_message_by_frame_id(message.arbitration_id)
            decoded = kind.decode(bytes(message.data))
            assert isinstance(decoded, dict)
            self.values |= {f"{kind.name}.{name}": value for name, value in decoded.items()}
            missing.discard(kind.name)
        readings = tuple(self.values.get(f"{name}.position") for name in _POSITIONS)
        readings += tuple(
            self.values.get(f"INPUTS.{name}")
            for name in ("emergency_stop_clear", "guard_closed", "guard_locked")
        )
        readings += tuple(self.values.get(f"PRESSURES_1.pressure_{name}") for name in ("supply", *CHAMBERS))
        for variable, opening in zip(self._valves, command.valve, strict=True):
            variable.phys = 5.0 + 5.0 * opening
        self._outputs.raw = (
            command.supply_enable
            | command.exhaust_closed << 1
            | (not command.guard_lock) << 2
            | command.beacon << 3
            | command.tee << 4
        )
        self._command.transmit()
        return readings
