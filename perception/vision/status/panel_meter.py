"""Reader of rectangular moving-coil meters: a thin pointer about a pivot that may be behind the lower cover."""

from __future__ import annotations

import numpy as np

from hal.panel import PanelMeter
from perception.vision.patch import Patch
from perception.vision.reading import PatchReading
from perception.vision.status.gauge import STOP_RAD, no_pointer, status_of_pointer
from perception.vision.status.occluder_bands import lying_across
from perception.vision.status.pointer import PointerSearch, find_pointer
from perception.vision.status.reader import Reader

# Share of the needle's length that is visible in the window, up to where the ticks begin.
POINTER_FROM, POINTER_TO = 0.30, 0.85
RIVAL = (0.17, 0.02)  # no numerals are there: of 240 hard synthetic meters read correctly 99 % have less than 0.13
SIGMA_RAD = (0.0125, 0.0015)  # 98 % of them have less than 0.009, half of the misread ones have more


def read_panel_meter(patch: Patch, spec: PanelMeter) -> PatchReading:
    """Return the value of a panel meter. `patch` shows the plane of the face, origin at the middle of the housing."""
    lo, hi = sorted((spec.scale.at_min, spec.scale.at_max))
    a, r = np.linspace(lo, hi, 24), spec.needle_m * np.array([[0.5], [0.65], [0.8], [0.95]])
    seen = patch.seen(r * np.sin(a), r * np.cos(a) - spec.pivot_below_m)  # of the area that the pointer sweeps
    margin = 1.5 * STOP_RAD
    cover = lying_across(patch, half_width_m=spec.width_m / 2, half_height_m=spec.height_m / 2, is_round=False)
    search = PointerSearch(
        pivot_m=(0.0, -spec.pivot_below_m),
        inner_m=POINTER_FROM * spec.needle_m,
        outer_m=POINTER_TO * spec.needle_m,
        fine_m=(POINTER_FROM * spec.needle_m, 0.92 * spec.needle_m),
        limits_rad=(lo - margin, hi + margin),
        width_rad=float(np.deg2rad(14.0)),
        from_hub=True,
    )
    fit = find_pointer(patch, search, cover=cover)
    if fit is None:
        return no_pointer(seen, spec.scale.unit)
    return status_of_pointer(fit, spec.scale, seen, rival=RIVAL, sigma_rad=SIGMA_RAD)


READER = Reader[PanelMeter](read=read_panel_meter, is_telling=True)
