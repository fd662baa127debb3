"""Indicator lamp: a lens that lights up."""

from __future__ import annotations

from hal.panel import Lamp
from hal.simulated import ObjectTruth
from simbackend.bodies.body import Body, Start
from simbackend.bodies.parts import LENS_M, PAINT, ObjectModel, Shine, disc
from simbackend.canvas import RIM, Canvas
from simbackend.mechanisms import Mechanism


class LampBody(Body[Lamp]):
    """Lamp that is lit or not; a button may switch it."""

    def start(self, panel_object: Lamp, u: float) -> Start:
        """Return a state that is lit with probability one half."""
        return Start(is_on=u < 0.5)

    def showing(self, panel_object: Lamp, value: float) -> Start:
        """Return the lamp lit from 0.5 on."""
        return Start(is_on=value >= 0.5)

    def model(self, panel_object: Lamp, start: Start) -> ObjectModel:
        """Return one round block."""
        colour, radius_m, height_m = panel_object.colour, panel_object.radius_m, panel_object.height_m
        return ObjectModel(
            urdf=disc(radius_m, max(height_m, LENS_M), PAINT[colour]),
            shine=Shine(colour=colour, radius_m=radius_m, height_m=height_m),
        )

    def print_on(self, canvas: Canvas, panel_object: Lamp) -> None:
        """Print a dark bezel and the label."""
        canvas.disc(panel_object.position_m, panel_object.radius_m + 0.0025, RIM)
        canvas.label(panel_object.position_m, panel_object.radius_m + 0.0025, panel_object.label)

    def truth(self, panel_object: Lamp, start: Start, mechanism: Mechanism | None, *, is_lit: bool) -> ObjectTruth:
        """Return on or off."""
        return ObjectTruth(name=panel_object.name, state="on" if is_lit else "off")


BODY = LampBody()
