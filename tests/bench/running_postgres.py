"""A PostgreSQL server for a test, which can be restarted in the middle of it."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory


class PostgresServer:
    """A server below `data` with an empty database."""

    def __init__(self, programs: Path, data: Path) -> None:
        self._programs, self._data = programs, data
        self.folder = data
        """Folder of its socket."""
        self._prefix: list[str] = []
        as_root = shutil.which("setpriv") if Path("/proc/self").stat().st_uid == 0 else None
        if as_root:  # the server refuses to run as root
            shutil.chown(data, "nobody")
            self._prefix = [as_root, "--reuid", "nobody", "--clear-groups"]
        self.url = f"postgresql+psycopg://test@/postgres?host={data}"
        self._call("initdb", "-D", str(data / "db"), "-U", "test", "-A", "trust", "--no-sync")

    def start(self) -> None:
        """Start it and wait until it answers."""
        options = f"-c listen_addresses='' -c unix_socket_directories={self._data} -c fsync=off"
        self._control("-l", str(self._data / "log"), "-o", options, "start")

    def stop(self) -> None:
        """Stop it as a crash would: connections are cut."""
        self._control("-m", "immediate", "stop")

    def _control(self, *arguments: str) -> None:
        self._call("pg_ctl", "-D", str(self._data / "db"), "-w", *arguments)

    def _call(self, program: str, *arguments: str) -> None:
        command = [*self._prefix, str(self._programs / program), *arguments]
        done = subprocess.run(
            command, capture_output=True, text=True, cwd=self._data, timeout=100, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr


@contextmanager
def running_postgres(tool: Path) -> Iterator[PostgresServer]:
    """Run the server from the folder of PostgreSQL's program `tool`."""
    with TemporaryDirectory(prefix="golfbench-postgres-", ignore_cleanup_errors=True) as folder:
        server = PostgresServer(tool.resolve().parent, Path(folder))
        server.start()
        try:
            yield server
        finally:
            server.stop()
