"""Reader of push buttons: pressed or released."""

from __future__ import annotations

import numpy as np

from hal.panel import Button, Mushroom
from perception.vision.patch import Patch
from perception.vision.reading import ALIKE, NO_EDGE, PatchReading, doubted, gated, refused
from perception.vision.status.press import cap_height
from perception.vision.status.reader import LAMP_MARGIN, Reader
from perception.vision.status.shade import cap_shades

# 95 % of 179 synthetic flush caps have less than 0.062, half of the others more than 0.068.
SHADE_HALF, SHADE_SCALE = 0.06, 0.03
MOST_SHADE = 0.17  # 98 % of 182 raised caps in hard light have less; a dark cap whose position is wrong has more
SPOT_HALF, SPOT_SCALE = 1.12, 0.1  # 95 % of flush caps have less than 0.96, 95 % of the others more than 1.28
SHADE_ODDS, SPOT_ODDS = (-1.5, 3.0), (-2.5, 6.0)  # a cap whose position is wrong by a pixel has a shade, too
# Of 230 flush caps none has more than 0.002 below, except for some synthetic ones beside glare (0.004 to 0.014).
BELOW_FROM, BELOW_SCALE, BELOW_ODDS = 0.0075, 0.0015, 4.5
# Least confidence of an answer. A black cap in a black ring, pressed, was measured between its two heights: 6.9 +- 0.6 mm.
SURE_SHADE, SURE_HEIGHT = 0.75, 0.9
ALONE = 1.3  # largest log odds of a shade without a visible face, or of missing shine without a visible ring
UNSEEN = "the button cannot be seen (glare, shadow or cover): change the angle or the light"


def read_button(patch: Patch, spec: Button) -> PatchReading:
    """Return the state of a push button. `patch` may show any plane near the cap."""
    return read_cap(patch, spec, foot_m=0.0)


def read_cap(patch: Patch, spec: Button | Mushroom, *, foot_m: float | None) -> PatchReading:
    """Return `pressed` or `released` by the height of the cap, or else by its one-sided shade.

    Args:
        foot_m: height of the foot of its wall; None if the wall moves with the cap.
    """
    R = spec.radius_m
    a = np.linspace(0, 2 * np.pi, 24)
    seen = patch.seen(np.outer([0.5, 0.8, 1.0], np.sin(a)) * R, np.outer([0.5, 0.8, 1.0], np.cos(a)) * R)
    by_height = patch.growth_per_m > 0
    if seen < 0.4 and not by_height:  # beside saturation edges can be measured, but shades cannot
        return refused(UNSEEN)
    evidence = _by_height(patch, spec, foot_m) if by_height else _by_shade(patch, R)
    if evidence is None:
        return refused(UNSEEN if seen < 0.4 else NO_EDGE)
    confidence = float(1.0 / (1.0 + np.exp(-abs(evidence)))) * (1.0 if by_height else min(1.0, seen + 0.2))
    state = "pressed" if evidence < 0 else "released"
    if confidence < (SURE_HEIGHT if by_height else SURE_SHADE):
        return doubted(PatchReading(state=state, confidence=max(0.0, 2 * confidence - 1)), ALIKE)
    return gated(PatchReading(state=state, confidence=confidence))


def _by_height(patch: Patch, spec: Button | Mushroom, foot_m: float | None) -> float | None:
    """Return the log odds of `released` from the measured height; None if the height cannot be measured."""
    lowest, high = spec.height_m - spec.travel_m, spec.height_m
    cap = cap_height(patch, radius_m=spec.radius_m, low_m=lowest, high_m=high, foot_m=foot_m)
    if cap is None:
        return None
    return spec.cap.released_log_odds(cap.height_m, cap.sigma_m)


def _by_shade(patch: Patch, radius_m: float) -> float | None:
    """Return the log odds of `released` from a shadow on one side and a highlight; None if neither is visible."""
    seen = cap_shades(patch, radius_m)
    shade = 0.0 if seen.shade > MOST_SHADE else float(np.clip((seen.shade - SHADE_HALF) / SHADE_SCALE, *SHADE_ODDS))
    spot = float(np.clip((seen.spot - SPOT_HALF) / SPOT_SCALE, *SPOT_ODDS))
    below = float(np.clip((seen.below - BELOW_FROM) / BELOW_SCALE, 0.0, BELOW_ODDS))
    if np.isnan(spot):
        return None if np.isnan(shade) else float(np.clip(shade, -ALONE, ALONE)) + below
    return (max(spot, -ALONE) if np.isnan(shade) else shade + spot) + below


READER = Reader[Button](read=read_button, guesses_right=0.42, margin=LAMP_MARGIN)
