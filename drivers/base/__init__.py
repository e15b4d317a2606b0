"""The driver contract and what drivers and the plant share: compiled numerics and shared memory."""

from drivers.base.contract import (
    ABSENT,
    ACTUATORS,
    CHAMBERS,
    INVALID,
    JOINTS,
    PASSIVE,
    SPOOL_RANGE,
    Command,
    Driver,
    DriverError,
    Launch,
    Readings,
    RecordReader,
    Triple,
    believed,
    device_limited,
)

__all__ = [
    "ABSENT",
    "ACTUATORS",
    "CHAMBERS",
    "INVALID",
    "JOINTS",
    "PASSIVE",
    "SPOOL_RANGE",
    "Command",
    "Driver",
    "DriverError",
    "Launch",
    "Readings",
    "RecordReader",
    "Triple",
    "believed",
    "device_limited",
]
