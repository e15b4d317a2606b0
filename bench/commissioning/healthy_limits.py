"""Step: limits of the model-based check for the learned swing, from healthy robots like the measured one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from bench.commissioning.steps import LEARNED_FILE, StepResult
from bench.commissioning.swung_robot import SwungRobot
from bench.config import Configuration
from bench.control.model_limits import limits_path, save_limits
from bench.design.model_limits import DRAWS, make_limits
from bench.simulation.local_engine import local_engine
from bench.simulation.series import Bench
from bench.swing.profile import Profile, load_profile


def make_healthy_limits(
    known: Configuration, profile: Profile, file: Path, progress: Callable[[str], None]
) -> Configuration:
    """Return `known` with limits for `profile`, from robots around it; store them beside `file`.

    Raises:
        Refused: robots without a fault are stopped by the envelope.
    """

    def show(part: float) -> None:
        progress(f"limits: {100 * part:.0f} % of the swings of drawn robots")

    limits = make_limits(Bench.of(known, profile), DRAWS, show, local_engine())
    save_limits(limits_path(file), limits)
    return known.for_profile(profile, file)


class HealthyLimits:
    """Limits of the check that compares the robot with its model."""

    name, title = "limits", "Limits of the model-based check"
    bounds_text = "nothing moves: computed from simulated healthy swings"

    def swing(
        self, robot: SwungRobot, known: Configuration, folder: Path, progress: Callable[[str], None]
    ) -> StepResult:
        """Make the limits of the learned profile in `folder`, and store them beside it.

        Raises:
            Refused: robots without a fault are stopped by the envelope.
        """
        file = folder / LEARNED_FILE
        make_healthy_limits(known, load_profile(file), file, progress)
        return StepResult(
            (), (f"limits from {DRAWS} robots around the measured one, {DRAWS // 2} to learn on",)
        )
