"""Script in every name: each text of each message to the page is markup, and stays text."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from bench.web._bench_link import accepted_commands, event_text, state_view
from tests.bench.fake_bench_service import FakeDesk, loopback_configuration, running_plane
from tests.bench.web.browser_tab import Tab, open_tab
from tests.bench.web.running_page import RunningPage, running_page

pytestmark = [pytest.mark.live, pytest.mark.paced, pytest.mark.requires("chromium"), pytest.mark.timeout(400)]

SCRIPT = "<img src=x onerror=alert(1)><script>alert(2)</script>"
KEPT = frozenset({"role", "column"})
"""Keys of texts that the page compares or splits, and never shows unchanged."""

CHART = {
    "column": "carry_m",
    "shots": [1, 2],
    "values": [1.0, 2.0],
    "centre": 1.5,
    "sd": 0.2,
    "signals": [2],
}
SHOT = {
    "shot": 1,
    "ball": "b",
    "status": "valid",
    "reason": "r",
    "club_speed_mps": 40.0,
    "ball_speed_mps": 60.0,
    "launch_angle_deg": 9.0,
    "spin_rpm": 2500.0,
    "carry_m": 180.0,
}
PROGRESS = {
    "campaign": "c-1",
    "state": "running",
    "reason": "why",
    "planned": 4,
    "done": 1,
    "valid": 1,
    "block": 1,
    "blocks": 2,
    "seconds_left": 60.0,
    "next_work": {"text": "mount", "shots": 2, "seconds": 30.0},
    "balls": {"b": {"valid": 1, "planned": 2}},
    "last_shot": SHOT,
    "event": {"text": "said"},
}
PAIR = {"first": "a", "second": "b", "difference": 1.0, "low": 0.5, "high": 1.5, "verdict": "open"}
CAMPAIGNS = [
    {
        "progress": PROGRESS,
        "detail": {
            "prompt": {"number": 1, "text": "load", "places": ["1 tour"]},
            "charts": [CHART],
            "interim": {"block": 1, "blocks": 2, "column": "carry_m", "pairs": [PAIR]},
        },
    }
]
FIGURES = {"club_speed_mps": 40.0, "attack_angle_deg": 0.3, "ball_speed_mps": 60.0, "carry_m": 180.0}
SWING = {
    "name": "n",
    "number": 1,
    "time_utc": "t",
    "stored": True,
    "club": "c",
    "ball": "b",
    "status": "valid",
    "reason": "r",
    "figures": FIGURES,
    "sources": {"launch": "l", "carry": "c"},
    "ball_at": [0.0, 0.0],
    "path": [[0.0, 0.0], [1.0, 1.0], [2.0, 0.0]],
    "down": [[0.0, 0.0], [1.0, 1.0]],
    "time": [0.0, 0.1, 0.2],
    "speed": {"curve": [0.0, 10.0, 20.0], "max_mps": 20.0},
    "to_ball": 3,
    "tracking": [{"name": "j", "error_deg": [0.0, 0.1, 0.2], "max_deg": 0.2}],
    "pressures": [{"name": "a", "side": "A", "pa": [1e5, 2e5, 1e5]}],
}
STEP = {"title": "t", "done": True, "seconds": 1.0, "values": 2, "notes": ["n"]}
COMMISSIONING = {
    "robots": ["r"],
    "folder": "f",
    "commissionings": [
        {
            "name": "one",
            "process": None,
            "unreadable": "",
            "robot": "r",
            "steps": [STEP, STEP | {"done": False}],
            "done": 1,
            "wrong": {
                "step": "s",
                "date": "d",
                "location": "p",
                "found": "f",
                "expected": "e",
                "action": "c",
            },
            "files": ["report", "robot"],
        },
        {"name": "two", "process": None, "unreadable": "why"},
    ],
}
LANDING = {
    "section": "s",
    "points": [{"level": "l", "side": 1.0, "carry": 2.0}],
    "ellipses": [{"level": "l", "centre": [1.0, 2.0], "long": 3.0, "short": 1.0, "tilt": 0.1, "area": 2.0}],
}
CAMPAIGN = {"id": "c-1", "title": "t", "date": "d", "state": "s", "shots": 4, "valid": 3}
ANSWERS: dict[str, Any] = {
    "/api/archive": {
        "campaigns": [
            CAMPAIGN | {"report": True, "ended": True, "runner": False},
            CAMPAIGN | {"report": False, "ended": False, "runner": False},
        ],
        "records": [{"name": "r", "bytes": 1000}, {"name": "s", "bytes": 1000}],
    },
    "/api/swing/*": SWING,
    "/api/wear": {
        "swings": 2,
        "parts": [
            {
                **{"part": "p", "value": "v", "unit": "u", "before": 0.0, "latest": 1.0, "error": 0.1},
                **{"growth": None, "most": 1.0, "worn": True, "swings_left": None},
            }
        ],
        "worn": True,
        "margins": [],
        "near": False,
    },
    "/api/campaign/*": {
        "campaign": "c-1",
        "title": "t",
        "state": "s",
        "charts": [CHART],
        "landing": [LANDING],
    },
    "/api/plans": [{"name": "p", "title": "t", "about": "a", "shipped": False, "lacks": ["l"]}],
    "/api/plan/*/check": {
        "plan": "p",
        "digest": "0123456789abcdef",
        "title": "t",
        "shots": 4,
        "warm_up_at_most": 2,
        "expected_duration_s": 60.0,
        "needs": {"hand_work": 1.0, "club_changes": 1, "feeder_fills": 1},
        "warnings": ["w"],
        "series_warning": "",
        "outlook_words": ["o"],
        "needs_words": ["n"],
        "hits": {"b": 2},
        "seed": 1,
        "order": [{"section": 1, "block": 1, "shots": [["test", "s", "c", "b"], ["control", "s", "c", "b"]]}],
        "hand_work": [{"shot": 1, "text": "mount"}],
    },
    "/api/values": {
        "club": "c",
        "entries": [
            {
                "kind": "club",
                "words": "w",
                "version": 1,
                "by": "b",
                "date": "d",
                "expires": "e",
                "expired": True,
            }
        ],
        "problems": ["p"],
        "air": {
            "temperature_c": 20.0,
            "pressure_hpa": 1013.0,
            "humidity_percent": 40.0,
            "date": "d",
            "by": "b",
        },
        "clubs": ["c"],
    },
    "/api/commissioning/check": {"steps": [{"name": "n", "title": "t", "bounds": "b", "done": False}]},
}


def poisoned(content: Any, key: str = "") -> Any:
    """Return `content` with SCRIPT in place of each text and each key that is a name."""
    if isinstance(content, dict):
        names = key in ("balls", "hits")
        return {f"{SCRIPT}{k}" if names else k: poisoned(v, k) for k, v in content.items()}
    if isinstance(content, list | tuple):
        return [poisoned(one, key) for one in content]
    return SCRIPT if isinstance(content, str) and content and key not in KEPT else content


def state() -> dict[str, Any]:
    status = FakeDesk().status() | {"drift": ["d"], "air_faults": ["a"]}
    status["wear"] = [{"part": "p", "text": "w", "time_utc": "2026"}]
    view: dict[str, Any] = poisoned(
        state_view(status) | {"lease": {"holder": "h", "seconds_left": 9.0}, "seen": 1.0}
    )
    return view | {"accepts": accepted_commands(FakeDesk().state), "chambers": poisoned(view["chambers"])}


def messages() -> bytes:
    """Return one message of each topic; the bench is never silent."""
    topics = {
        "you": {"role": "operator", "sign_in": False, "bench": "b"},
        "link": {"silent_s": -1e6},
        "state": state(),
        "events": poisoned(
            [{"event": "said", "text": "t", "at_utc": "u"}, {"event": "change", "state": "s", "cause": "c"}]
        ),
        "swing": poisoned(SWING),
        "campaigns": poisoned(CAMPAIGNS),
        "runner": poisoned({"what": "w", "running": False, "text": "t"}),
        "commissioning": poisoned(COMMISSIONING),
        "commissioner": poisoned({"what": "w", "running": False, "text": "t"}),
        "viewer": {"open": True},
    }
    return b"".join(event_text(topic, content) for topic, content in topics.items())


@pytest.fixture
def page() -> Iterator[RunningPage]:
    with ExitStack() as stack:
        running = stack.enter_context(running_plane(FakeDesk(), loopback_configuration()))
        yield stack.enter_context(running_page(running.configuration))


def answer_all(tab: Tab) -> None:
    """Answer the page's questions with poisoned content."""
    for path, content in ANSWERS.items():
        tab.page.route(
            re.compile(f"{path.replace('*', '[^/]*')}$"), _answering(json.dumps(poisoned(content)))
        )
    stream = messages()
    tab.page.route(
        "**/api/stream",
        lambda route: route.fulfill(status=200, content_type="text/event-stream; charset=utf-8", body=stream),
    )


def test_page_prompt_waits_for_access(browser: Any, page: RunningPage) -> None:
    reason = "Read the gauges."

    def stream(route: Any) -> None:
        progress = PROGRESS | {"state": "waiting", "reason": reason}
        body = messages() + event_text("campaigns", [CAMPAIGNS[0] | {"progress": progress}])
        route.fulfill(status=200, content_type="text/event-stream; charset=utf-8", body=body)

    with open_tab(browser, page.url) as tab:
        answer_all(tab)
        tab.page.route("**/api/stream", stream)
        tab.page.reload()
        tab.text("#campaign").to_contain_text("waiting: Read the gauges.")
        assert tab.page.locator("#campaign .prompt").count() == 0
        reason = "load"
        tab.text("#campaign .prompt").to_contain_text("load")
        tab.text("#campaign").not_to_contain_text("waiting: load")


def _answering(body: str) -> Callable[[Any], None]:
    return lambda route: route.fulfill(status=200, content_type="application/json", body=body)


def test_page_script_in_every_name_stays_text(browser: Any, page: RunningPage) -> None:
    with open_tab(browser, page.url) as tab:
        dialogs: list[str] = []
        tab.page.on("dialog", lambda dialog: dialogs.append(dialog.message))
        answer_all(tab)
        tab.page.reload()
        for location in (
            "#state-words",
            "#lease",
            "#warnings",
            "#events",
            "#swing",
            "#campaign .prompt",
            "#campaign .interim",
        ):
            tab.text(location).to_contain_text(SCRIPT)
        for location in ("#runner", "#commissionings .prompt", "#archive", "#values"):
            tab.text(location).to_contain_text(SCRIPT)
        tab.page.locator("#archive button:has-text('Figures')").first.click()
        tab.text("#archive .plots").to_contain_text(SCRIPT)
        for box in tab.page.locator("#archive input[type=checkbox]").all():
            box.check()
        tab.page.click("#lay-over")
        tab.text("#overlay").to_contain_text(SCRIPT)
        assert tab.page.locator("#overlay svg").count() == 3
        tab.page.click("#wear-of")
        tab.text("#wear").to_contain_text(SCRIPT)
        tab.page.click("#commission-check")
        tab.text("#commission-preview").to_contain_text(SCRIPT)
        tab.page.evaluate("() => { document.getElementById('plans-card').hidden = false; }")
        tab.page.click("#plan-check")
        tab.text("#plan-preview").to_contain_text(SCRIPT)
        assert tab.page.locator("img").count() == 0
        assert tab.page.locator("script").count() == 1
        assert dialogs == []
