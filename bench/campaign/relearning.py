"""When a swing is relearned: between blocks, when its delivery has drifted.

A block's deliveries of one swing and club are compared with those of the first block after it was learned
last, small blocks taken together, by the same measuring chain: what the chain sees wrongly it sees wrongly
in both. The ball's results are never looked at.
"""

from __future__ import annotations

from collections import defaultdict
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.campaign.gate import delivered
from bench.campaign.plan import CampaignPlan
from bench.campaign.randomization import Role
from bench.campaign.shot_sequence import Step
from bench.learning.delivery_metrics import Tolerance
from bench.learning.store import drifted
from bench.shot.shot import Shot, ShotStatus

Array = NDArray[np.float64]
Arm = tuple[str, str]
"""Swing and club."""

_MIN_SHOTS = 3
"""Min number of shots of a swing and club that are judged; smaller blocks are added to the next one."""
_NAMES = ("head speed", "attack angle", "shaft lean", "strike heel to toe", "strike low to high")


class Drift(NamedTuple):
    """A drift after which a swing is relearned."""

    arm: Arm
    text: str


class Drifts:
    """Receives every shot in order and is asked before each step; its state follows from the shots alone."""

    def __init__(self, plan: CampaignPlan) -> None:
        self._plan = plan
        self._block = (0, 0)
        self._seen: dict[Arm, list[tuple[int, Array]]] = defaultdict(list)
        """(block, figures) of the shots that are not judged yet."""
        self._baseline: dict[Arm, Array] = {}
        self._open: dict[Arm, Drift] = {}

    def before(self, step: Step) -> Drift | None:
        """Return the drift after which the swing of `step` is relearned, seen in an earlier block.

        It is returned once, when this swing is next: its club is mounted then.
        """
        if not self._plan.learning.refresh:
            return None
        block, arm = (step.trial.section, step.trial.block), step.trial.arm
        if block != self._block:
            self._block = block
            for key in [key for key, shots in self._seen.items() if len(shots) >= _MIN_SHOTS]:
                deliveries = [figures for _, figures in self._seen.pop(key)]
                if (drift := self._drift_of(key, deliveries)) is not None:
                    self._open[key] = drift
        return self._open.pop((arm.swing, arm.club), None)

    def note(self, shot: Shot) -> None:
        """Note a shot; warm-up and invalid shots are ignored."""
        if shot.status is not ShotStatus.VALID or shot.role == Role.WARM_UP:
            return
        centre = delivered(shot, self._plan.clubs[shot.club])
        figures = np.array([np.nan if value is None else value for value in centre])
        if np.isfinite(figures).all():
            self._seen[shot.swing, shot.club].append((shot.block, figures))

    def set_aside(self, block: int) -> None:
        """Forget the shots of `block`: it restarts."""
        for arm, shots in self._seen.items():
            self._seen[arm] = [shot for shot in shots if shot[0] != block]

    def _drift_of(self, arm: Arm, shots: list[Array]) -> Drift | None:
        now, before = np.array(shots), self._baseline.get(arm)
        if before is None:
            self._baseline[arm] = now
            return None
        scale, middle = _scale(before), before.mean(axis=0)
        errors = (now - middle) / scale
        within = np.concatenate([now - now.mean(axis=0), before - middle]) / scale
        scatter = np.sqrt(np.sum(within**2, axis=0) / (len(within) - 2))
        # The baseline is a mean of some shots, too.
        if not drifted(scatter * np.sqrt(1 + len(now) / len(before)), errors):
            return None
        del self._baseline[arm]
        mean = errors.mean(axis=0)
        worst = int(np.abs(mean).argmax())
        return Drift(arm, f"{_NAMES[worst]} has drifted by {mean[worst]:+.1f} tolerances")


def _scale(before: Array) -> Array:
    """Return the tolerances in the units of a gate's figures."""
    t = Tolerance()
    speed = float(before[:, 0].mean())
    return np.array([t.speed * speed, t.attack, t.lean, t.strike, t.strike])
