"""The shape of the hand, as collision checks and skills need it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.config import HandSection
from hal.errors import Unsupported
from manipulation.planning.shapes import Capsule, Vector3

CLOSED_M = 0.0005


@dataclass(frozen=True, slots=True, kw_only=True)
class Hand:
    """Two straight parallel fingers, or one rigid finger; grip frame at the tips, z along the fingers, x closing.

    Attributes:
        fingers: 2, or 1 for a rigid finger.
        finger_thickness_m: along x; two closed fingers are twice as thick.
        finger_width_m: along y.
        finger_length_m: from the tips back to the body.
        body_half_m, body_back_m: the body as a box: half its edges, and how far its middle is behind the tips.
        pad_stiffness_n_per_m: stiffness of the pads; under a push of F the finger goes F/k past the surface.
    """

    fingers: int = 2
    finger_thickness_m: float = 0.007
    finger_width_m: float = 0.012
    finger_length_m: float = 0.075
    body_half_m: Vector3 = (0.0475, 0.030, 0.045)
    body_back_m: float = 0.125
    max_width_m: float = 0.080
    pad_stiffness_n_per_m: float = 7_000.0

    @classmethod
    def of(cls, section: HandSection) -> Hand:
        """Return the hand that a cell file describes; one rigid finger has no opening."""
        sizes = section.model_dump()
        return cls(**{**sizes, "max_width_m": sizes["max_width_m"] if section.fingers == 2 else 0.0})

    @property
    def closed_half_m(self) -> tuple[float, float]:
        """Half sizes along x and y of the closed fingertip."""
        return self.fingers * self.finger_thickness_m / 2, self.finger_width_m / 2

    def check_opens(self, width_m: float) -> None:
        """Refuse a stroke for which the hand must open.

        Raises:
            Unsupported: the hand is one rigid finger.
        """
        if self.fingers == 1 and width_m > CLOSED_M:
            raise Unsupported(
                f"this stroke needs fingers that open by {1e3 * width_m:.0f} mm, and the hand is one rigid finger",
                hint="use a cell with a gripper, or leave this control to one (hand.fingers in the cell file)",
            )

    def capsules(self, flange_from_grip: RigidTransform, width_m: float) -> tuple[Capsule, ...]:
        """Return the fingers at an opening, the body and the wrist as capsules in flange axes."""
        radius = float(np.hypot(self.finger_thickness_m, self.finger_width_m)) / 2
        across = width_m / 2 + self.finger_thickness_m / 2
        fingers = [
            _capsule(flange_from_grip, f"finger_{name}", (x, 0.0, -self.finger_length_m), (x, 0.0, -radius), radius)
            for name, x in ((("left", -across), ("right", across)) if self.fingers == 2 else (("left", 0.0),))
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
