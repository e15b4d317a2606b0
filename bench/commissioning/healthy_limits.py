"""Step: limits of the model-based check for the learned swing, from healthy robots like the measured one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from bench.commissioning.learned_swing import LEARNED_FILE
from bench.commissioning.steps import StepResult
from bench.commissioning.swung_robot import SwungRobot
from bench.config import Configuration
from bench.control.model_limits import limits_path, save_limits
from bench.design.model_limits import DRAWS, make_limits
from bench.simulation.local_engine import local_engine
from bench.simulation.series import Bench
from bench.swing.profile import load_profile


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
        file, c = folder / LEARNED_FILE, known
        bench = Bench(c.plant, load_profile(file), c.control, c.envelope, c.estimator)

        def show(part: float) -> None:
            progress(f"limits: {100 * part:.0f} % of the swings of drawn robots")

        save_limits(limits_path(file), make_limits(bench, DRAWS, show, local_engine()))
        return StepResult(
            (), (f"limits from {DRAWS} robots around the measured one, {DRAWS // 2} to learn on",)
        )
