"""Notifications of a campaign: webhook contents, number of attempts, and secrets that are never shown."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Event, Thread

import pytest

from bench.base.errors import BenchError
from bench.campaign.run.progress import Notifier, Service, notifying, read_services
from bench.store.rows import CampaignState
from tests.bench.store.test_campaigns import ENTRY

HIDDEN = "k9-of-the-chat"
"""Part of a URL that is shown nowhere."""

pytestmark = pytest.mark.filterwarnings("ignore:'imghdr' is deprecated:DeprecationWarning")  # by apprise


@contextmanager
def webhook(refused: int = 0) -> Iterator[tuple[str, list[dict[str, str]], list[str]]]:
    """Serve a webhook on loopback that refuses the first notifications; yield its URL, bodies and paths."""
    bodies: list[dict[str, str]] = []
    paths: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            paths.append(self.path)
            body = self.rfile.read(int(self.headers["Content-Length"]))
            accepted = len(paths) > refused
            if accepted:
                bodies.append(json.loads(body))
            self.send_response(200 if accepted else 500)
            self.end_headers()

        def log_message(self, format: str, *arguments: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"json://127.0.0.1:{server.server_port}/{HIDDEN}", bodies, paths
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def url_file(folder: Path, text: str, mode: int = 0o600) -> Path:
    file = folder / "notify.urls"
    file.write_text(text)
    file.chmod(mode)
    return file


def test_notifier_sends_states_for_operator_and_retries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    said: list[str] = []
    with webhook(refused=1) as (url, bodies, paths):
        file = url_file(tmp_path, f"# the laboratory's chat\n\n{url}\n")
        with notifying(str(file), ENTRY, said.append, waits=(0.0, 0.0)) as notifier:
            notifier.standing(CampaignState.RUNNING, "")
            notifier.standing(CampaignState.WAITING, "Mount club driver-9 in place of driver.")
            notifier.standing(CampaignState.SUSPENDED, "5 shots in a row not valid")
            notifier.standing(CampaignState.STOPPED, "by Ctrl-C")
            notifier.standing(CampaignState.FINISHED, "")
    name = f"golfbench {ENTRY.bench}: {ENTRY.name}"
    words = ("waits for a person", "is suspended", "is finished")
    assert [body["title"] for body in bodies] == [f"{name} {word}" for word in words]
    assert bodies[0]["message"] == f"Mount club driver-9 in place of driver.\ncampaign {ENTRY.id}"
    assert len(paths) == 4
    assert said == []


def test_notifier_failed_service_reports_line_without_url(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    said: list[str] = []
    with webhook(refused=9) as (url, _, paths):
        file = url_file(tmp_path, f"{url}\n")
        with notifying(str(file), ENTRY, said.append, waits=(0.0, 0.0, 0.0)) as notifier:
            notifier.standing(CampaignState.FINISHED, "")
    assert len(paths) == 3
    (text,) = said
    assert f"not sent ({file}, line 1)" in text
    shown = capfd.readouterr()
    assert HIDDEN not in text + shown.out + shown.err + caplog.text


def test_notifier_hanging_service_does_not_block() -> None:
    end, said = Event(), list[str]()

    def hangs(text: str, title: str) -> bool:
        end.wait(30.0)
        raise RuntimeError("no network")

    notifier = Notifier(ENTRY, [Service("here", hangs)], said.append, waits=(0.0,))
    began = time.monotonic()
    for _ in range(200):
        notifier.standing(CampaignState.WAITING, "Fill the feeder.")
    assert time.monotonic() - began < 1.0
    notifier.close(timeout=0.2)
    assert said == ["Some notifications were not sent by the end; they are discarded."]
    end.set()


@pytest.mark.parametrize(
    ("text", "mode", "location", "found"),
    [
        (f"json://127.0.0.1/{HIDDEN}", 0o644, "notify.urls", "mode 644"),
        (f"# chat\nnosuch://{HIDDEN}", 0o600, "notify.urls, line 2", "does not know"),
    ],
)
def test_read_services_invalid_file_is_refused_without_content(
    tmp_path: Path, text: str, mode: int, location: str, found: str
) -> None:
    with pytest.raises(BenchError) as error:
        read_services(url_file(tmp_path, text, mode))
    assert error.value.location.endswith(location)
    assert found in error.value.found
    assert HIDDEN not in str(error.value)


def test_notifying_without_file_sends_nothing() -> None:
    with notifying("", ENTRY, print) as nobody:
        nobody.standing(CampaignState.FINISHED, "")
    with pytest.raises(BenchError, match="no such file"):
        read_services(Path("no-such-file"))
