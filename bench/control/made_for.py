"""What limits of the model-based check were made for: the values that a swing feels, each within a tolerance.

A measured value changes with each calibration. Limits allow for robots within their tolerances around the
model, so they hold as well for a model that is a little different.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

from bench.control.settings import ControlSettings, EnvelopeSettings, EstimatorSettings
from bench.swing.correction import digest_of
from bench.swing.profile import Profile
from sim.plant import ACTUATOR_KEYS, PlantParameters

Values = Mapping[str, Any]
"""Values by their dotted names in files of limits: numbers, texts, truth values, lists of numbers."""

NAMES_IN_FILES: Mapping[str, str] = {}
"""Names of values in files of limits where they are called otherwise in the code: a renamed key keeps its
name there, so that no limits become stale."""

IGNORED_FIELDS = frozenset(
    {
        # They differ from swing to swing, or act only at rest.
        "ball",
        "seed",
        "vent_feedback",
        "shut_off_feedback",
        "spool_feedback",
        "supply.shut_off_delay",
        # No healthy swing reaches them, or no force depends on them.
        "supply.manifold_relief_ratio",
        "supply.manifold_relief_conductance",
        "shoulder.stop.rated",
        "right_arm.stop.rated",
        "wrist.stop.rated",
        "robot.club.name",
        # Counts become angles before anything is compared.
        "encoders.zero_count",
        "encoders.sign",
    }
)
"""Values of the plant, and groups of them, that do not make limits stale."""

MIN_RELEVANT_TEE_SHIFT = 0.013
"""Shift of the tee (m) towards heel or toe from which on it makes limits stale: nearer, the joints' speeds
after the blow differ by less than a third of what their comparison allows for."""
SHARE = 0.02
"""Share by which a value of the plant may differ: less than the tolerances of the drawn robots."""
TOLERANCES: Values = {
    "robot.club.tee_shift": 0.999 * MIN_RELEVANT_TEE_SHIFT,
    "robot.club.face_angle": 0.02,
    "wrist_lever_angle": 0.01,
    "site.ball_x": 0.005,
    "site.ball_y": 0.005,
    "encoders.latency": 1e-4,
    "encoders.noise": 1e-5,
    "encoders.jitter": 2e-6,
    **{f"{joint}.valve.centre": 0.005 for joint in ACTUATOR_KEYS},
    **{f"{joint}.valve.dead_band": 0.002 for joint in ACTUATOR_KEYS},
}
"""Min relevant difference of a value of the plant, where a share says nothing (m, rad, s, openings)."""


class LimitsFingerprint(NamedTuple):
    """A profile, a plant and a controller as far as a swing feels them."""

    profile: str
    """Digest of the tables."""
    plant: Values
    controller: Values

    @classmethod
    def of(
        cls,
        profile: Profile,
        plant: PlantParameters,
        control: ControlSettings,
        envelope: EnvelopeSettings,
        estimator: EstimatorSettings,
    ) -> LimitsFingerprint:
        """Return the values of a bench; IGNORED_FIELDS of its plant are left out."""
        acting = {
            "control": _as_acting(control, plant),
            "estimator": asdict(estimator),
            "envelope": {"max_opening": envelope.max_opening, "max_slew": envelope.max_slew},
        }
        return cls(digest_of(profile), dict(_named(asdict(plant))), dict(_named(acting)))

    def differences(self, bench: LimitsFingerprint) -> list[str]:
        """Return what of `bench` is not as in this one, for people; empty if these limits hold for it."""
        plant = _differing(self.plant, bench.plant, SHARE)
        controller = _differing(self.controller, bench.controller, 0.0)
        return [
            *(["another profile"] if self.profile != bench.profile else []),
            *([f"another plant ({plant})"] if plant else []),
            *([f"another controller ({controller})"] if controller else []),
        ]


def _as_acting(control: ControlSettings, plant: PlantParameters) -> dict[str, Any]:
    """Return `control` without the values that have no effect on `plant`.

    These are manual gains where scheduled ones are used, a factor of 1, and the turf lift on surface "none".
    """
    values = asdict(control)
    if plant.site.surface == "none":
        del values["turf_lift_gain"]
    if values["downswing_gain_factor"] == 1.0:
        del values["downswing_gain_factor"]
    if values.pop("gains") == "machine":
        values |= dict.fromkeys(("pid", "damping", "move_gain"), "machine")
    return values


def _named(values: Mapping[str, Any], group: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the felt values of a nested table by their names in files."""
    for key, value in values.items():
        name = f"{group}.{key}".lstrip(".")
        if name in IGNORED_FIELDS:
            continue
        if isinstance(value, Mapping):
            yield from _named(value, name)
        else:
            yield NAMES_IN_FILES.get(name, name), list(value) if isinstance(value, tuple) else value


def _differing(made: Values, here: Values, share: float) -> str:
    """Return the first value that differs, with how many more; empty without one."""
    names = [
        name
        for name in {**here, **made}
        if not _alike(made.get(name), here.get(name), share, TOLERANCES.get(name, 0.0))
    ]
    if not names:
        return ""
    first, more = names[0], f" and {len(names) - 1} more" if names[1:] else ""
    return f"{first} {_short(made.get(first))}, here {_short(here.get(first))}{more}"


def _alike(made: Any, here: Any, share: float, least: float) -> bool:
    """Return whether two values are the same within a share of them, or `least`."""
    if isinstance(made, list) and isinstance(here, list):
        pairs = zip(made, here, strict=False)
        return len(made) == len(here) and all(_alike(a, b, share, least) for a, b in pairs)
    if type(made) not in (int, float) or type(here) not in (int, float):
        return bool(made == here)
    return bool(abs(made - here) <= max(share * max(abs(made), abs(here)), least))


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else "nothing" if value in (None, "") else str(value)
