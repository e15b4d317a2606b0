"""Terms of a learned correction without numpy, which clients of a bench do without: bounds, sources."""

from __future__ import annotations

from typing import Literal

MAX_WEIGHT = 1.5
"""Max weight of a function of a correction, in units of its opening or shift."""
MAX_WEIGHTS = 128
"""Max number of weights of a correction: a downswing of half a second."""


Source = Literal["encoders+model", "launch-monitor", "impact-marks"]
