"""The system's Chromium for tests."""

from __future__ import annotations

import os
from typing import Any

from tests.bench.web.browser_tab import TIMEOUT


def launched(playwright: Any, program: str | None) -> Any:
    """Start Chromium; its sandbox refuses to run as root, which containers are: only there it is off."""
    options = ["--disable-gpu", *(["--no-sandbox"] if os.geteuid() == 0 else [])]
    return playwright.chromium.launch(executable_path=program, args=options, timeout=TIMEOUT)
