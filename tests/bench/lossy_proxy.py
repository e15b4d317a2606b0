"""A way to a PostgreSQL server that loses the answer to a commit, as a restart of the server may."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress
from pathlib import Path
from typing import Self

_SOCKET = ".s.PGSQL.5432"
_COMMIT = b"COMMIT"


class LossyProxy:
    """Forwards all data from a socket in `folder` to the one in `server`; cuts connections on request."""

    def __init__(self, folder: Path, server: Path) -> None:
        self._target = str(server / _SOCKET)
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(folder / _SOCKET))
        self._listener.listen()
        self.url = f"postgresql+psycopg://test@/postgres?host={folder}"
        self.before = self.after = 0
        """Number of commits to be cut off before they reach the server, and after it has made them."""
        threading.Thread(target=self._accept, daemon=True).start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with client, socket.socket(socket.AF_UNIX) as server, suppress(OSError):
            server.connect(self._target)
            threading.Thread(target=self._answer, args=(server, client), daemon=True).start()
            while data := client.recv(65536):
                if _COMMIT in data and self.before:
                    self.before -= 1
                    break
                if _COMMIT in data and self.after:
                    self.after -= 1
                    client.shutdown(socket.SHUT_RDWR)  # its answer has nowhere to go
                    server.sendall(data)
                    server.recv(65536)
                    break
                server.sendall(data)
            server.shutdown(socket.SHUT_RDWR)

    @staticmethod
    def _answer(server: socket.socket, client: socket.socket) -> None:
        with suppress(OSError):
            while data := server.recv(65536):
                client.sendall(data)
            client.shutdown(socket.SHUT_RDWR)
