"""Panel files: the description of a panel that perception, manipulation and simulation share.

Panel frame: origin at the centre of the plate's front face, x right and y up as the viewer sees it, z out of the plate
towards the viewer. Angles of needles, levers and knobs are clockwise from straight up as the viewer sees them, so a
positive angle is a negative rotation about z.

There is one module per kind of object. Kinds are found by name through the entry-point group `panelwright.kinds` (see
`kinds`), so that other packages can add kinds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hal.face import load_on_first_use

if TYPE_CHECKING:
    from hal.panel.base import PanelObject
    from hal.panel.button import Button
    from hal.panel.display import Display
    from hal.panel.families import Rectangular, Round
    from hal.panel.form import Cap, Envelope, Face, Relief, Rim, circle
    from hal.panel.gauge import Gauge
    from hal.panel.goals import GAUGE_SHARE, Goal, NumberGoal, Shown, StateGoal
    from hal.panel.handwheel import Handwheel
    from hal.panel.lamp import Lamp
    from hal.panel.layout import Panel, Tolerances, load_panel
    from hal.panel.lever import Lever
    from hal.panel.mushroom import Mushroom
    from hal.panel.panel_meter import PanelMeter
    from hal.panel.parts import (
        LATCHED_SHARE,
        Light,
        Name,
        NotNegative,
        Positive,
        Scale,
        State,
        States,
        Tag,
        Vector2,
        Vector3,
    )
    from hal.panel.questions import Question, Taught
    from hal.panel.rotary import Rotary
    from hal.panel.slider import Slider
    from hal.panel.toggle import Toggle
    from hal.panel.turn import Tilt

__all__ = [
    "GAUGE_SHARE",
    "LATCHED_SHARE",
    "Button",
    "Cap",
    "Display",
    "Envelope",
    "Face",
    "Gauge",
    "Goal",
    "Handwheel",
    "Lamp",
    "Lever",
    "Light",
    "Mushroom",
    "Name",
    "NotNegative",
    "NumberGoal",
    "Panel",
    "PanelMeter",
    "PanelObject",
    "Positive",
    "Question",
    "Rectangular",
    "Relief",
    "Rim",
    "Rotary",
    "Round",
    "Scale",
    "Shown",
    "Slider",
    "State",
    "StateGoal",
    "States",
    "Tag",
    "Taught",
    "Tilt",
    "Toggle",
    "Tolerances",
    "Vector2",
    "Vector3",
    "circle",
    "load_panel",
]
if not TYPE_CHECKING:
    __getattr__ = load_on_first_use(__name__, __file__)
