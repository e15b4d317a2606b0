"""What a matrix was made from: commit, configuration, profile, sources, seed and date."""

from __future__ import annotations

import hashlib
import json
import subprocess
from datetime import datetime
from pathlib import Path
from typing import Any

from bench.config import Configuration
from bench.swing.profile import Profile
from drivers.base.machine_code import source_digest

SEED = 1
"""Seed of the faults' random numbers, the same in all cases."""


def origin_of(configuration: Configuration, profile: Profile, now: datetime) -> dict[str, Any]:
    """Return what a matrix made `now` of `profile` and `configuration` can be made from again."""
    effective = json.dumps(configuration.effective(), sort_keys=True, default=str)
    swing = profile.angle.tobytes() + profile.valve.tobytes()
    return {
        "commit": commit(Path(__file__).parent),
        "configuration": _digest(effective.encode()),
        "profile": _digest(swing),
        "sources": source_digest(),
        "seed": SEED,
        "time_utc": now.isoformat(timespec="seconds"),
    }


def commit(folder: Path) -> str | None:
    """Return the commit of the checkout that `folder` is in, "+" where files differ; None outside."""
    try:
        run = subprocess.run(
            ["git", "describe", "--always", "--abbrev=12", "--dirty=+", "--exclude=*"],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=10.0,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return run.stdout.strip() or None


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]
