"""State of the seeded panel when the mission begins: initial states, built positions, efforts."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from hal.panel import Panel, PanelObject
from simbackend.bodies.body import Start, body_of
from simbackend.draws import Draws


@dataclass(frozen=True, slots=True, kw_only=True)
class Built:
    """One object as built.

    Attributes:
        offset_m: deviation from its position in the panel file (x, y).
        effort_ratio: its friction, spring or detent force relative to the panel file.
        start: its initial state.
    """

    panel_object: PanelObject
    offset_m: tuple[float, float]
    effort_ratio: float
    start: Start = field(default_factory=Start)


def build(panel: Panel, draws: Draws) -> tuple[Built, ...]:
    """Return all objects of the panel, drawn from the seed.

    Streams are named by object, so the order does not matter.
    """
    worked_by_others = {one.shown_by for one in panel.objects if one.shown_by != one.name}
    return tuple(_built(one, panel, draws, is_worked=one.name in worked_by_others) for one in panel.objects)


def _built(panel_object: PanelObject, panel: Panel, draws: Draws, *, is_worked: bool) -> Built:
    """Return one object; a lamp that a button switches starts off."""
    random = draws.stream(f"object/{panel_object.name}")
    dx, dy = panel.tolerances.position_m * random.standard_normal(2)
    # At least a tenth: a part without any friction would never come to rest.
    ratio = max(0.1, 1.0 + panel.tolerances.effort_ratio * float(random.standard_normal()))
    start = body_of(panel_object.kind).start(panel_object, float(random.uniform()))
    return Built(
        panel_object=panel_object,
        offset_m=(float(dx), float(dy)),
        effort_ratio=ratio,
        start=replace(start, is_on=False) if is_worked else start,
    )
