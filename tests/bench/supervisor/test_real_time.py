"""Real-time settings are read back, not assumed; each is tried in a separate process."""

from __future__ import annotations

import errno
import os
import textwrap
from collections.abc import Mapping
from typing import Any

import pytest

from bench.base.errors import ExitCode, Refused
from bench.network.bench_service import SettingStatus
from bench.supervisor import real_time as module
from bench.supervisor.real_time import limit_action, real_time
from tests.bench.supervisor.own_process import printed_json

pytestmark = pytest.mark.live

# What a process without privileges has: neither capabilities nor limits. Capabilities leave at exec only.
WITHOUT_PRIVILEGES = """
    import ctypes, os, resource, sys
    if "without" not in sys.argv:
        resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
        for capability in (14, 23):  # IPC_LOCK, SYS_NICE
            ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP
        os.execv(sys.executable, [sys.executable, "-c", sys.orig_argv[2], "without"])
"""
LOOK = """
    import ctypes, gc, json, os
    from bench.base.errors import Refused
    from bench.supervisor.real_time import real_time

    def look():
        return {
            "scheduler": [os.sched_getscheduler(0), os.sched_getparam(0).sched_priority],
            "locked": [line.split()[1] for line in open("/proc/self/status") if line.startswith("VmLck")],
            "cores": sorted(os.sched_getaffinity(0)),
            "slack": ctypes.CDLL(None).prctl(30, 0, 0, 0, 0),
            "small pages only": ctypes.CDLL(None).prctl(42, 0, 0, 0, 0),
            "collector": [gc.isenabled(), gc.get_freeze_count()],
            "files": sorted(os.readlink(f"/proc/self/fd/{name}") for name in os.listdir("/proc/self/fd")
                            if os.path.exists(f"/proc/self/fd/{name}")),
        }
"""


def _in_a_process(code: str, preamble: str = "") -> Any:
    """Run `code` after LOOK in a separate process; return the JSON it prints."""
    program = textwrap.dedent(preamble) + textwrap.dedent(LOOK) + textwrap.dedent(code)
    return printed_json(program)


@pytest.fixture(scope="module")
def tried() -> dict[str, Any]:
    """A process before, inside and after `prefer` on one core."""
    core = max(os.sched_getaffinity(0))
    found: dict[str, Any] = _in_a_process(f"""
        before = look()
        with real_time("prefer", priority=7, cpu={core}) as granted:
            inside = look()
            child = os.fork()
            if not child:
                os._exit(os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK)
            of_child = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(json.dumps(dict(before=before, inside=inside, after=look(), child=of_child,
                              granted=granted, core={core})))
    """)
    return found


def test_real_time_held_settings_are_in_force(tried: dict[str, Any]) -> None:
    inside, settings = tried["inside"], tried["granted"]["settings"]
    in_force = {
        "scheduling": inside["scheduler"] == [os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, 7],
        "memory lock": int(inside["locked"][0]) > 1000,
        "processor": inside["cores"] == [tried["core"]],
        "timer slack": inside["slack"] <= 1,
        "huge pages": inside["small pages only"] == 1,
        "garbage collector": not inside["collector"][0] and inside["collector"][1] > 0,
        "idle states": "/dev/cpu_dma_latency" in inside["files"],
    }
    assert {name: setting["held"] for name, setting in settings.items()} == in_force
    assert in_force["processor"]
    assert in_force["timer slack"]
    assert in_force["huge pages"]
    assert in_force["garbage collector"]


def test_real_time_forked_child_has_normal_scheduling(tried: dict[str, Any]) -> None:
    assert tried["child"] == os.SCHED_OTHER


def test_real_time_exit_restores_settings(tried: dict[str, Any]) -> None:
    assert tried["after"] == tried["before"]


def test_real_time_json_gives_reason_for_each_setting_not_held(tried: dict[str, Any]) -> None:
    granted = tried["granted"]
    assert granted["mode"] == "prefer"
    assert granted["held"] == all(s["held"] for s in granted["settings"].values() if s["required"])
    for name, setting in granted["settings"].items():
        assert set(setting) == set(SettingStatus.__annotations__)
        assert setting["name"] == name
        assert bool(setting["reason"]) == bool(setting["action"]) == (not setting["held"])


def test_real_time_off_changes_nothing() -> None:
    found = _in_a_process("""
        before = look()
        with real_time("off", priority=7, cpu=0) as granted:
            inside = look()
        print(json.dumps(dict(before=before, inside=inside, granted=granted)))
    """)
    assert found["inside"] == found["before"]
    assert not found["granted"]["held"]
    for setting in found["granted"]["settings"].values():
        assert (setting["asked"], setting["held"], setting["reason"]) == ("nothing", False, "not asked")
    assert found["granted"]["settings"]["scheduling"]["granted"] == "OTHER 0"


def test_real_time_prefer_without_privileges_reports_not_held() -> None:
    found = _in_a_process(
        """
        with real_time("prefer", priority=7) as granted:
            print(json.dumps(granted))
        """,
        WITHOUT_PRIVILEGES,
    )
    held = {name for name, setting in found["settings"].items() if setting["held"]}
    assert held - {"idle states"} == {"garbage collector", "huge pages", "processor", "timer slack"}
    assert not found["held"]
    assert found["settings"]["scheduling"]["reason"] == os.strerror(errno.EPERM)
    assert found["settings"]["scheduling"]["granted"] == "OTHER 0"


def test_real_time_require_without_privileges_names_missing_settings() -> None:
    found = _in_a_process(
        """
        before = look()
        try:
            with real_time("require", priority=7):
                raise SystemExit("entered")
        except Refused as error:
            print(json.dumps(dict(before=before, after=look(), text=str(error), code=error.exit_code)))
        """,
        WITHOUT_PRIVILEGES,
    )
    assert found["after"] == found["before"]
    assert found["code"] == ExitCode.REFUSED
    for part in ("scheduling: Operation not permitted", "memory lock:", "LimitRTPRIO=7", "LimitMEMLOCK"):
        assert part in found["text"]
    assert "garbage" not in found["text"]
    assert "idle states" not in found["text"]


@pytest.mark.parametrize("cpu", [1023, 10**9, 2**70])
def test_real_time_missing_core_is_refused(cpu: int) -> None:
    text = _in_a_process(f"""
        try:
            with real_time("require", priority=7, cpu={cpu}):
                raise SystemExit("entered")
        except Refused as error:
            print(json.dumps(str(error)))
    """)
    assert f"processor: core {cpu}" in text
    assert "set loop.cpu to one of" in text


class _Calls:
    """Stands for the kernel: every call succeeds, and nothing comes of it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        for name, answer in (("call_library", 50_000), ("lock_memory", None), ("unlock_memory", None)):
            monkeypatch.setattr(module, name, lambda *_, answer=answer: answer)
        for name in ("sched_setscheduler", "sched_setaffinity"):
            monkeypatch.setattr(f"os.{name}", lambda *_: None)
        monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1})
        monkeypatch.setattr("os.sched_getscheduler", lambda _: os.SCHED_OTHER)
        for name in ("freeze", "disable", "collect", "unfreeze"):
            monkeypatch.setattr(f"gc.{name}", lambda: None)
        monkeypatch.setattr(module, "locked_memory", lambda: (80 << 20, 100 << 20, False))


def test_real_time_call_without_effect_is_not_held(monkeypatch: pytest.MonkeyPatch) -> None:
    _Calls(monkeypatch)
    with real_time("prefer", priority=7, cpu=1) as granted:
        pass
    required = {name: setting for name, setting in granted["settings"].items() if setting["required"]}
    assert {setting["reason"] for setting in required.values()} == {"not in force after the call"}
    assert not granted["held"]
    with pytest.raises(Refused) as refused, real_time("require", priority=7, cpu=1):
        pass
    assert all(name in str(refused.value) for name in required)


def test_limit_action_names_user_service_and_container() -> None:
    action: Mapping[str, bool] = dict.fromkeys(("@golfbench - rtprio 80", "LimitRTPRIO=80", "SYS_NICE"), True)
    assert all(part in limit_action("rtprio", "80") for part in action)
