"""The tests' own rules hold: leaks fail, absent tools are listed, demanded ones fail."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

CONFTEST = Path(__file__).with_name("conftest.py").read_text()
INI = """
[pytest]
addopts = --import-mode=importlib -p no:cacheprovider
markers =
    requires(*tools): x
    live: x
"""


@pytest.fixture
def project(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> pytest.Pytester:
    """A small project with this project's conftest, where leaks are given 0.2 s to go away."""
    monkeypatch.delenv("GOLFBENCH_REQUIRE", raising=False)
    pytester.makeconftest(CONFTEST.replace("GRACE = 2.0", "GRACE = 0.2"))
    pytester.makeini(INI)
    return pytester


def test_leak_check_fails_leaking_tests_only(project: pytest.Pytester) -> None:
    project.makepyfile(
        """
        import os, subprocess, sys, threading, time, pytest
        from pathlib import Path

        def test_clean():
            thread = threading.Thread(target=time.sleep, args=(0.01,))
            thread.start()
            subprocess.run([sys.executable, "-c", "pass"], check=True)

        def test_thread():
            threading.Thread(target=time.sleep, args=(2,), daemon=True, name="left-thread").start()

        def test_child():
            global child
            child = subprocess.Popen(["sleep", "97"])

        def test_detached():
            subprocess.run(["sh", "-c", "setsid sleep 98 & exit 0"], check=True)

        def test_shared_memory():
            Path(f"/dev/shm/golfbench-leak-{os.getppid()}").touch()

        def test_next_is_clean():
            Path(f"/dev/shm/golfbench-leak-{os.getppid()}").unlink()

        @pytest.fixture(scope="module")
        def service():
            with subprocess.Popen(["sleep", "60"]) as process:
                yield process
                process.terminate()

        def test_first_use_of_wider_fixture(service): pass
        def test_second_use(service): pass
        """
    )
    result = project.runpytest_subprocess()
    result.assert_outcomes(passed=8, errors=4)
    result.stdout.fnmatch_lines_random(
        [
            "*thread left-thread",
            "*process *: sleep 97",
            "*process *: sleep 98",
            "*file /dev/shm/golfbench-leak-*",
        ]
    )


def test_leak_check_parallel_workers_report_separate_leaks(project: pytest.Pytester) -> None:
    """Two workers leak and clean up at the same time; a file without a process id shows at the end."""
    name = f"golfbench-unowned-{os.getpid()}x"
    project.makepyfile(
        test_one="""
        import os, subprocess, time
        from pathlib import Path

        def test_own_file():
            Path(f"/dev/shm/golfbench-leak-{os.getpid()}").touch()

        def test_own_process():
            global child
            child = subprocess.Popen(["sleep", "96"])

        def test_removes_it():
            Path(f"/dev/shm/golfbench-leak-{os.getpid()}").unlink()
        """,
        test_two=f"""
        import time, pytest
        from pathlib import Path

        @pytest.mark.parametrize("number", range(20))
        def test_clean_beside_leaks(number):
            time.sleep(0.03)

        def test_unowned_file():
            Path("/dev/shm/{name}").touch()
        """,
    )
    result = project.runpytest_subprocess("-n", "2", "--dist", "loadfile")
    Path(f"/dev/shm/{name}").unlink()  # noqa: S108
    result.assert_outcomes(passed=24, errors=2)
    result.stdout.fnmatch_lines_random(
        ["*file /dev/shm/golfbench-leak-*", "*process *: sleep 96", f"*the run left behind: file *{name}"]
    )
    assert result.ret == pytest.ExitCode.TESTS_FAILED


def test_tool_requirement_marks_test_live(project: pytest.Pytester) -> None:
    project.makepyfile(TOOL_TESTS)
    result = project.runpytest_subprocess("-m", "live", "--collect-only", "-q")
    result.stdout.fnmatch_lines(["*test_marked", "*test_fixture", "*2/3 tests collected*"])


def test_live_test_after_reported_stall_is_repeated(project: pytest.Pytester) -> None:
    project.makepyfile(
        """
        import pytest
        runs = []

        def run(name, report):
            runs.append(name)
            assert runs.count(name) == 2, report

        @pytest.mark.live
        def test_live_stalled(): run("stalled", "a stall of this machine: run golfbench doctor")

        @pytest.mark.live
        def test_live_failed(): run("failed", "cut the cable")

        def test_fast_stalled(): run("fast", "a stall of this machine: run golfbench doctor")
        """
    )
    result = project.runpytest_subprocess("-v")
    result.assert_outcomes(passed=1, failed=2)
    result.stdout.fnmatch_lines(["*test_live_stalled PASSED*"])


TOOL_TESTS = """
    import pytest

    @pytest.mark.requires("qemu")
    def test_marked(): raise RuntimeError("ran")

    def test_fixture(tool): tool("qemu"); raise RuntimeError("ran")

    def test_other(): pytest.skip("for a reason of its own")
"""


def test_absent_tool_skips_tests_and_lists_skips(
    project: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    project.makepyfile(TOOL_TESTS)
    result = project.runpytest_subprocess()
    result.assert_outcomes(skipped=3)
    result.stdout.fnmatch_lines(
        [
            "missing tool qemu: 2 skipped",
            "*test_marked",
            "*test_fixture",
            "*test_other: Skipped: for a reason of its own",
        ]
    )


def test_demanded_tool_absent_fails_run(project: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.setenv("GOLFBENCH_REQUIRE", "chromium,qemu")
    project.makepyfile(TOOL_TESTS)
    result = project.runpytest_subprocess()
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.stdout.fnmatch_lines_random(["*qemu is absent, and GOLFBENCH_REQUIRE demands it"])
    assert "RuntimeError" not in result.stdout.str()


def test_demanded_tool_misspelt_stops_run(project: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GOLFBENCH_REQUIRE", "chromiun")
    result = project.runpytest_subprocess()
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*GOLFBENCH_REQUIRE names chromiun; known tools: *chromium,*"])
