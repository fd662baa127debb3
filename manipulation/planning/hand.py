"""The shape of the hand, as collision checks and skills need it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from manipulation.planning.shapes import Capsule, Vector3


@dataclass(frozen=True, slots=True, kw_only=True)
class Hand:
    """A parallel gripper with two straight fingers; grip frame at the finger tips, z along the fingers, x closing.

    Attributes:
        finger_thickness_m: along x; two closed fingers are twice as thick.
        finger_width_m: along y.
        finger_length_m: from the tips back to the body.
        body_half_m, body_back_m: the body as a box: half its edges, and how far its middle is behind the tips.
        pad_stiffness_n_per_m: stiffness of the pads; under a push of F the finger goes F/k past the surface.
    """

    finger_thickness_m: float = 0.007
    finger_width_m: float = 0.012
    finger_length_m: float = 0.075
    body_half_m: Vector3 = (0.0475, 0.030, 0.045)
    body_back_m: float = 0.125
    max_width_m: float = 0.080
    pad_stiffness_n_per_m: float = 7_000.0

    @property
    def closed_half_m(self) -> tuple[float, float]:
        """Half sizes along x and y of the closed fingertip."""
        return self.finger_thickness_m, self.finger_width_m / 2

    def capsules(self, flange_from_grip: RigidTransform, width_m: float) -> tuple[Capsule, ...]:
        """Return the fingers at an opening, the body and the wrist as capsules in flange axes."""
        radius = float(np.hypot(self.finger_thickness_m, self.finger_width_m)) / 2
        across = width_m / 2 + self.finger_thickness_m / 2
        fingers = [
            _capsule(flange_from_grip, f"finger_{name}", (x, 0.0, -self.finger_length_m), (x, 0.0, -radius), radius)
            for name, x in (("left", -across), ("right", across))
        ]
        half_x, half_y, half_z = self.body_half_m
        back = -self.body_back_m
        # The body is wider than deep, so two parallel capsules enclose it tightly.
        x = half_x - half_y
        body = [
            _capsule(
                flange_from_grip,
                f"body_{name}",
                (side, 0.0, back - half_z + half_y),
                (side, 0.0, back + half_z - half_y),
                1.15 * half_y,
            )
            for name, side in (("left", -x), ("right", x))
        ]
        return (*fingers, *body)


def _capsule(flange_from_grip: RigidTransform, name: str, start: Vector3, end: Vector3, radius: float) -> Capsule:
    a, b = (flange_from_grip.apply(np.asarray(p)) for p in (start, end))
    return Capsule(
        name=name,
        start_m=(float(a[0]), float(a[1]), float(a[2])),
        end_m=(float(b[0]), float(b[1]), float(b[2])),
        radius_m=radius,
    )
