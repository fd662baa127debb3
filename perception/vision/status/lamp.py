"""Reader of indicator lamps: a lit lamp is brighter than the plate around it and brightest in the middle."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from hal.panel import Lamp
from perception.vision.image import WHITE_LEVEL
from perception.vision.patch import Patch, sample_at
from perception.vision.reading import PatchReading, gated, refused
from perception.vision.status.occluder_bands import cables_across
from perception.vision.status.reader import LAMP_MARGIN, Reader

# Radii of the rings on the lens, near its edge, and on the plate, over the lamp's radius.
CORE, RIM, PLATE = (0.0, 0.15, 0.3), (0.5, 0.6, 0.7), (1.45, 1.6, 1.75)
RING_PLACES, LEAST_SEEN = 108, 0.3  # samples per ring; share of them that must be visible
CLEAR_OF_BEZEL = 1.4  # in radii
LIT_RATIO = 0.95  # between an unlit lens (0.2 to 0.9 of the plate) and a lit one (above 1.1)
MOST_WHITE = 0.2  # share of the surrounding plate
# Middle over rim: 95 % of unlit lenses have less than 1.1, 97 % of lit ones that do not saturate have more.
FLAT_RATIO = 1.1


def read_lamp(patch: Patch, spec: Lamp) -> PatchReading:
    """Return the state of a lamp. `patch` shows the plate plane or the lens."""
    light = patch.gray if patch.colour is None else patch.colour.max(axis=2)
    beyond_m = CLEAR_OF_BEZEL * spec.radius_m
    hidden = cables_across(patch, radius_m=beyond_m)
    core, rim, plate = (_ring(patch, light, spec.radius_m, r, hidden) for r in (CORE, RIM, PLATE))
    if min(len(core), len(rim), len(plate)) < LEAST_SEEN * RING_PLACES:
        return refused("something lies across the lamp: move it or look past it")
    around = float(np.median(plate))
    if around >= WHITE_LEVEL - 2 and core.mean() >= LIT_RATIO * WHITE_LEVEL:
        # A lens darker than the plate is certainly unlit
        return refused("glare covers the lamp: change the angle or the light")
    level = max(around, 8.0)
    middle = float(np.median(core))  # an unlit lens may show a reflection
    brightness = np.log(max(middle, 2.0) / level / LIT_RATIO)
    peaked = np.log((middle + 8.0) / (float(np.median(rim)) + 8.0) / FLAT_RATIO)
    peak = 1.5 * np.clip(peaked / 0.1, -1.0, 1.0)
    if middle >= WHITE_LEVEL - 2:  # the peak is clipped; if the surroundings are white too, this may be glare
        peak = 0.5 if (plate >= WHITE_LEVEL - 2).mean() > MOST_WHITE else 1.5
    evidence = brightness / 0.12 + peak
    inside = patch.inside.mean()
    if inside < 0.7:
        return refused("the lamp is outside the image: move the camera")
    confidence = float(1.0 / (1.0 + np.exp(-min(abs(evidence), 8.0))))
    return gated(
        PatchReading(state="on" if evidence > 0 else "off", confidence=float(np.clip(2 * confidence - 1, 0, 1)))
    )


def _ring(
    patch: Patch, light: Image, radius_m: float, radii: tuple[float, ...], hidden: NDArray[np.bool_] | None
) -> Array:
    """Return the brightness (N,) at the unoccluded places of rings around the middle."""
    a = np.linspace(0, 2 * np.pi, RING_PLACES // len(radii), endpoint=False)
    r = np.array(radii)[:, None] * radius_m
    u, v = patch.pixel_of(r * np.sin(a), r * np.cos(a))
    values = np.asarray(sample_at(light, u, v), float).ravel()
    return values if hidden is None else values[(sample_at(hidden.astype(np.uint8), u, v) < 0.5).ravel()]


READER = Reader[Lamp](read=read_lamp, guesses_right=0.4, margin=LAMP_MARGIN)
