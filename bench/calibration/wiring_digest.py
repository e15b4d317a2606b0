"""Digest of what says where each input is wired: a check of the inputs holds for one wiring."""

from __future__ import annotations

import json
from dataclasses import asdict
from hashlib import sha256

from bench.calibration.values import SeenInputs, Values
from bench.config import Configuration


def wiring_digest(configuration: Configuration) -> str:
    """Return the digest of the driver's settings and of whether the local reset is wired."""
    c = configuration
    settings = c.driver_arguments().get("settings")
    wired = [c.driver.name, c.lifecycle.local_reset, None if settings is None else asdict(settings)]
    return sha256(json.dumps(wired, sort_keys=True).encode()).hexdigest()[:16]


def is_rewired(values: Values, configuration: Configuration) -> bool:
    """Return whether `values` are a check of inputs that were wired otherwise than `configuration` has it."""
    return isinstance(values, SeenInputs) and values.wiring != wiring_digest(configuration)
