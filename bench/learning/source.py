"""Sources of a delivery; a module of its own, as the command line needs it before anything is loaded."""

from __future__ import annotations

from typing import Literal

Source = Literal["encoders+model", "launch-monitor", "impact-marks"]
