"""Sweeps on a cluster: same results after any loss; other code, no worker and no scheduler are reported."""

from __future__ import annotations

import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from bench.base.address import identity_files
from bench.base.errors import BenchError, ExitCode, Refused
from bench.commands.common import sweep_engine
from bench.config import load_configuration
from bench.network.certificates import make_authority, make_certificate, write_identity
from bench.simulation import cluster_engine
from bench.simulation.cluster_engine import SharedStudy, connected, security_of
from bench.simulation.sweep import InProcess, SweepStore, sweep
from tests.bench.simulation.studies import BlasThreads, Draws, Slow, as_dict, as_float
from tests.running_cluster import killed_workers, running_cluster

CASES = range(60)


@pytest.mark.live
def test_cluster_sweep_matches_in_process_results() -> None:
    alone = sweep(Draws(), CASES, InProcess())
    with running_cluster(2) as (address, _), connected(address) as engine:
        assert engine.slots() == 2
        assert sweep(Draws(), CASES, engine) == alone
        assert sweep(BlasThreads(), range(4), engine) == [(1, 1)] * 4
        with pytest.raises(Refused, match="found 3"):
            sweep(Draws(refused=3), CASES, engine)


@pytest.mark.release
@pytest.mark.live
@pytest.mark.timeout(300)
def test_cluster_sweep_killed_workers_lose_or_repeat_no_result(tmp_path: Path) -> None:
    alone = sweep(Draws(), CASES, InProcess())
    store = SweepStore(tmp_path / "results.jsonl", "d", as_dict, as_float)
    with (
        running_cluster(2) as (address, cluster),
        connected(address) as engine,
        killed_workers(cluster, every=1.0, at_most=10) as killed,
    ):
        found = sweep(Slow(0.4), CASES, engine, store=store)
    assert len(killed) >= 4
    assert found == alone
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == 1 + len(CASES) + 1


@pytest.mark.live
@pytest.mark.release
@pytest.mark.timeout(300)
def test_cluster_sweep_lost_scheduler_ends_and_resumes_from_store(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    store = SweepStore(path, "d", as_dict, as_float)
    with running_cluster(1) as (address, cluster), connected(address) as engine:

        def end(done: int) -> None:
            if 5 <= done < len(CASES):
                cluster.kill()

        with pytest.raises(BenchError, match="stored cases are skipped") as caught:
            sweep(Slow(0.2), CASES, engine, store=store, progress=end)
    assert caught.value.exit_code is ExitCode.NO_ANSWER
    store, done = SweepStore(path, "d", as_dict, as_float), list[int]()
    kept = len(store.results)
    assert 5 <= kept < len(CASES)
    with running_cluster(1) as (address, _), connected(address) as engine:
        found = sweep(Draws(), CASES, engine, store=store, progress=done.append)
    assert done[0] == kept
    assert found == sweep(Draws(), CASES, InProcess())


@pytest.mark.release
@pytest.mark.live
def test_cluster_with_identity_requires_matching_certificate(tmp_path: Path) -> None:
    now = datetime.now(UTC)
    authority = make_authority(now)
    write_identity(tmp_path, "authority", authority)
    for name in ("sweeper", "stranger"):
        folder = tmp_path / name
        folder.mkdir()
        own = authority if name == "sweeper" else make_authority(now)
        write_identity(folder, "authority", own)
        write_identity(folder, name, make_certificate(own, name, ["127.0.0.1"], now, 1.0))
    file = tmp_path / "config.toml"
    file.write_text(f'base = "shipped"\n[network]\nidentity = "{tmp_path}/sweeper/sweeper"\n')
    with running_cluster(1, config=file) as (address, _):
        assert address.startswith("tls://")
        with sweep_engine(load_configuration(file), 0, address, 9) as engine:
            assert sweep(Draws(), range(9), engine) == sweep(Draws(), range(9), InProcess())
        for files in (None, identity_files(f"{tmp_path}/stranger/stranger")):
            with pytest.raises(BenchError, match="scheduler that answers"), connected(address, files):
                pass


@pytest.mark.release
@pytest.mark.live
def test_cluster_sweep_without_workers_raises_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster_engine, "CONNECT_TIMEOUT", 2.0)
    with running_cluster(0) as (address, _), connected(address) as engine:
        with pytest.raises(BenchError, match="found no workers"):
            sweep(Draws(), CASES, engine)


def test_shared_study_other_code_digest_is_refused() -> None:
    with pytest.raises(Refused, match=r"found code .*, expected code 0123"):
        _ = SharedStudy("bench.simulation.sweep", "0123", b"never read").function
    with pytest.raises(Refused, match="expected code 0123"):
        _ = SharedStudy("not.there", "0123", b"never read").function


def test_connected_without_scheduler_raises_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster_engine, "CONNECT_TIMEOUT", 0.5)
    with pytest.raises(BenchError, match="scheduler that answers"), connected("tcp://127.0.0.1:9"):
        pass


@pytest.mark.parametrize("address", ["127.0.0.1:8786", "http://127.0.0.1:1", "tcp://"])
def test_sweep_engine_invalid_address_raises_error(address: str) -> None:
    configuration = load_configuration()
    with pytest.raises(BenchError, match="expected tcp://HOST:PORT"):
        with sweep_engine(configuration, 0, address, 9):
            pass


@pytest.mark.slow
def test_cluster_command_remote_host_without_certificate_is_rejected() -> None:
    command = [sys.executable, "-m", "bench", "cluster", "--host", "192.0.2.1"]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert run.returncode == ExitCode.BAD_INPUT
    assert "without a certificate" in run.stderr


def test_security_of_requires_tls_for_each_role(tmp_path: Path) -> None:
    now = datetime.now(UTC)
    authority = make_authority(now)
    write_identity(tmp_path, "authority", authority)
    write_identity(tmp_path, "lab", make_certificate(authority, "lab", ["127.0.0.1"], now, 1.0))
    security: Any = security_of(identity_files(f"{tmp_path}/lab"))
    assert security.require_encryption
    for role in ("client", "scheduler", "worker"):
        assert security.get_tls_config_for_role(role)["cert"] == f"{tmp_path}/lab.pem"


def test_slurm_job_script_starts_workers_of_same_python() -> None:
    jobqueue = pytest.importorskip("dask_jobqueue")
    script = jobqueue.slurm.SLURMJob(
        "tcp://10.0.0.1:8786", cores=1, memory="2 GB", walltime="02:00:00", name="golfbench"
    ).job_script()
    assert f"{sys.executable} -m distributed.cli.dask_worker tcp://10.0.0.1:8786" in script
    assert "--nthreads 1" in script
