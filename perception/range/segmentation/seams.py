"""Detection of grooves between two regions: pixels clearly behind a plane that continues on both sides.

Faces in one plane, such as cushions or boxes side by side, are two faces if a groove separates them, even one of two
pixels. The labels need not end at the groove, because a rounded rim beyond it is often as near to the plane of the other
face as to its own. Therefore the lines tested across a seam extend well beyond it. Pixels in front of the plane, or
without a reading, give no evidence.
"""

from __future__ import annotations

import numpy as np

from hal.arrays import Array, Labels, Mask
from hal.jit import compiled
from perception.range.fitting.surfaces import PLANE, depth_on
from perception.range.segmentation.grid import sigma_at

BEYOND = 0.05  # of the image's shorter side: how far a line extends beyond a seam, because rims are rounded
DEEP_SIGMAS = 4.0  # a pixel farther behind the plane is in a groove
DEEP_PX = 2  # successive pixels that make a groove; a single one may be a gross error
FLANK_SIGMAS = 3.0  # a pixel nearer than this is on the plane
FLANK_PX = 3  # least number of pixels on the plane on either side of a groove
SHARE = 0.33  # of the places on a seam that a groove must cross


@compiled
def is_seam_grooved(
    depth: Array, sen: Array, noise: Array, labels: Labels, own: Mask, th: Array, x: Array, y: Array,
) -> bool:  # fmt: skip
    """Return whether a groove crosses the row or column at more than the share `SHARE` of the rays (x, y) on a seam.

    `own` tells for each label whether it belongs to one of the two regions that meet at the seam; the pixels of a groove
    belong to neither. `th` is the plane.
    """
    grooves = 0
    for k in range(x.shape[0]):
        u, v = x[k] * sen[1] + sen[3], y[k] * sen[2] + sen[4]
        grooves += is_grooved_at(depth, sen, noise, labels, own, th, u, v)
    return bool(grooves > SHARE * x.shape[0])


@compiled
def is_grooved_at(
    depth: Array, sen: Array, noise: Array, labels: Labels, own: Mask, th: Array, u: float, v: float,
) -> bool:  # fmt: skip
    """Return whether a groove crosses the image row or column through pixel (u, v)."""
    image = (depth, sen, noise, labels, own, th, u, v)
    return crosses_groove(*image, 0.0, 1.0, 0) or crosses_groove(*image, 1.0, 0.0, 0)


@compiled
def crosses_groove(
    depth: Array, sen: Array, noise: Array, labels: Labels, own: Mask, th: Array, u0: float, v0: float, du: float,
    dv: float, count: int,
) -> bool:  # fmt: skip
    """Return whether a groove crosses the line from pixel (u0, v0) over `count` steps (du, dv), extended at both ends."""
    H, W = depth.shape
    perspective = sen[0] > 0
    reach = int(BEYOND * min(H, W) + 0.5)
    flank, run, after, is_passed = 0, 0, 0, False
    for k in range(-reach, count + reach + 1):
        u, v = int(np.rint(u0 + k * du)), int(np.rint(v0 + k * dv))
        if not (0 <= u < W and 0 <= v < H and np.isfinite(depth[v, u])):
            run = 0
            continue
        x, y = (u - sen[3]) / sen[1], (v - sen[4]) / sen[2]
        zm = depth_on(PLANE, th, x, y, perspective)
        # The distance along the normal is used, because at grazing rays a fraction of a pixel is many sigmas of depth.
        facing = abs(th[0] * x + th[1] * y + th[2]) if perspective else abs(th[2])
        e = (depth[v, u] - zm) * facing / sigma_at(noise, zm)
        run = run + 1 if e > DEEP_SIGMAS and not own[labels[v, u]] else 0
        if run == DEEP_PX and flank >= FLANK_PX:
            is_passed, after = True, 0
        if not e > -DEEP_SIGMAS:
            flank, is_passed = 0, False  # something in front, or a ray that misses
        elif e < FLANK_SIGMAS and own[labels[v, u]]:
            flank, after = flank + 1, after + 1
            if is_passed and after == FLANK_PX:
                return True
    return False
