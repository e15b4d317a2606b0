from __future__ import annotations

import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType

import pytest

from drivers.base import DriverError
from drivers.mock import MockDriver
from drivers.registry import GROUP, BrokenDriver, choose_driver, find_drivers


def entry(name: str, value: str) -> EntryPoint:
    return EntryPoint(name, value, GROUP)


MOCK = entry("mock", "drivers.mock:MockDriver")


@pytest.fixture
def plug_in(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    module = ModuleType("some_plug_in")
    monkeypatch.setitem(sys.modules, "some_plug_in", module)
    return module


def test_find_drivers_lists_installed_drivers() -> None:
    drivers = find_drivers()
    assert drivers["mock"] is MockDriver
    assert list(drivers) == sorted(drivers)


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("no_such_module:Driver", "ModuleNotFoundError"),
        ("drivers.mock:NoSuchDriver", "AttributeError"),
        ("drivers.mock:ATMOSPHERE", "found float, expected a class or function"),
        ("fractions:Fraction", "class without open, read, write, make_passive, close()"),
        ("not an entry point", ""),
    ],
)
def test_find_drivers_broken_plug_in_keeps_others(value: str, reason: str) -> None:
    drivers = find_drivers([entry("broken", value), MOCK])
    assert drivers["mock"] is MockDriver
    broken = drivers["broken"]
    assert isinstance(broken, BrokenDriver)
    assert broken.name == "broken"
    assert value in broken.origin
    assert reason in broken.reason
    with pytest.raises(DriverError, match=r"'broken' from .* is broken"):
        choose_driver("broken", drivers)


def test_find_drivers_import_error_reports_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "failing_plug_in.py").write_text("raise RuntimeError('no device library')\n")
    broken = find_drivers([entry("failing", "failing_plug_in:Driver"), MOCK])["failing"]
    assert isinstance(broken, BrokenDriver)
    assert broken.reason == "RuntimeError: no device library"


def test_choose_driver_accepts_factory_function(plug_in: ModuleType) -> None:
    plug_in.make = lambda: MockDriver(start=(0.1, 4.0, 6.0))  # type: ignore[attr-defined]
    factory = choose_driver("made", find_drivers([entry("made", "some_plug_in:make")]))
    assert isinstance(factory(), MockDriver)


def test_find_drivers_duplicate_name_is_broken(plug_in: ModuleType) -> None:
    plug_in.Other = type("Other", (MockDriver,), {})  # type: ignore[attr-defined]
    drivers = find_drivers([MOCK, entry("mock", "some_plug_in:Other")])
    broken = drivers["mock"]
    assert isinstance(broken, BrokenDriver)
    assert "two plug-ins" in broken.reason
    assert "drivers.mock:MockDriver" in broken.reason
    assert "some_plug_in:Other" in broken.reason


def test_find_drivers_same_entry_twice_gives_single_driver() -> None:
    assert find_drivers([MOCK, MOCK]) == {"mock": MockDriver}


def test_choose_driver_unknown_name_lists_working_drivers() -> None:
    drivers = find_drivers([MOCK, entry("broken", "no_such_module:Driver")])
    with pytest.raises(DriverError, match=r"'can' is not installed; working drivers: mock$"):
        choose_driver("can", drivers)
    with pytest.raises(DriverError, match="working drivers: none"):
        choose_driver("can", {})
