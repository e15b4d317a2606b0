"""The sole on the ground: what turf, a mat or a bare floor take from a head that touches them.

The ground pushes the sole up with a spring that is damped by depth (`sim.pneumatics.stop_force`). On turf and
mats it also drags: dry friction of the push; the ploughing of soil, whose strength acts on the area that the
sole cuts, its width times its depth; and the acceleration of that soil, which grows with the square of the
speed. All three act against the motion of the sole, so the ground gives no energy back but what its spring
stores. Depth is measured in the swing plane.

The values are assumptions: no measured force of a golf head in turf was found. Their order: an undrained root
zone has a shear strength of about 20 kPa, and a blade cut through it meets about five times that; loam weighs
1,600 kg/m3, of which half is taken along at the head's speed.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import Any, Literal

from drivers.base.compiled import compiled

SurfaceName = Literal["none", "turf", "mat"]

_SLIDING = 0.5
"""Speed (m/s) below which the drag fades, so that a resting head is not shaken."""


@dataclass(frozen=True)
class Surface:
    """A surface on which a ball may lie, as the sole meets it."""

    friction: float = 0.0
    """Friction of the sole."""
    strength: float = 0.0
    """Resistance to a cut, Pa."""
    density: float = 0.0
    """Mass that is taken along at the head's speed, kg/m3 of the cut."""
    width: float = 0.05
    """Width of the cut, m: the middle of a sole that is curved from heel to toe."""


SURFACES: dict[SurfaceName, Surface] = {
    "none": Surface(),
    "turf": Surface(friction=0.4, strength=1.0e5, density=800.0),
    "mat": Surface(friction=0.35),
}
"""A bare floor without drag; turf; a mat of artificial turf, which is pressed in but not cut."""


@compiled
def ground_drag(p: Any, push: float, depth: float, speed: float) -> float:
    """Return the force (N) along the ground on a sole at `depth` (m) with `speed` (m/s) along it.

    `push` (N) is the ground's force upwards. The sign is against `speed`.
    """
    size = p.ground_friction * push + (p.ground_strength + p.ground_density * speed * speed) * depth
    force: float = -size * speed / sqrt(speed * speed + _SLIDING * _SLIDING)
    return force
