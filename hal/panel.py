"""The panel file: what a panel is. Perception recognises with it, manipulation acts with it, simulators build it.

Panel frame: origin in the middle of the plate's front face, x right and y up as the viewer sees it, z out of the plate
towards the viewer. Angles of needles, levers and knobs are clockwise from straight up as the viewer sees them (so a
positive angle is a negative turn about z).
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from hal.strict import Strict, load_toml

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,40}$")]
Vector2 = tuple[float, float]
Vector3 = tuple[float, float, float]


class Light(Strict):
    """One border light: a lamp whose centre is known."""

    name: Name
    position_m: Vector3
    radius_m: Positive = 0.008


class Scale(Strict):
    """How an angle (or a length) shows a value.

    `at_min` and `at_max` are the pointer's places at `minimum` and `maximum`; `table` holds further (place, value)
    pairs of a scale that is not linear, in rising order of place.
    """

    minimum: float
    maximum: float
    unit: str
    at_min: float
    at_max: float
    major_ticks: Annotated[int, Field(ge=2, le=50)] = 6
    table: tuple[Vector2, ...] = ()

    @model_validator(mode="after")
    def _is_a_scale(self) -> Scale:
        if self.maximum <= self.minimum:
            raise ValueError("maximum must be greater than minimum")
        if self.at_max == self.at_min:
            raise ValueError("at_max must differ from at_min")
        steps = [(p1 - p0, v1 - v0) for (p0, v0), (p1, v1) in pairwise(self._points())]
        if any(place == 0.0 or value == 0.0 or (value > 0.0) != (steps[0][1] > 0.0) for place, value in steps):
            raise ValueError("the values of a scale and its table must all rise, or all fall, from place to place")
        return self

    def value_at(self, place: float) -> float:
        """The value shown at a place (rad or m), linear between taught pairs, going on straight beyond the ends."""
        points = self._points()
        for (p0, v0), (p1, v1) in pairwise(points):
            if place <= p1 or (p1, v1) == points[-1]:
                return v0 + (place - p0) * (v1 - v0) / (p1 - p0)
        raise AssertionError("a scale has two points")

    def place_of(self, value: float) -> float:
        """The inverse of `value_at`."""
        points = sorted((v, p) for p, v in self._points())
        for (v0, p0), (v1, p1) in pairwise(points):
            if value <= v1 or (v1, p1) == points[-1]:
                return p0 + (value - v0) * (p1 - p0) / (v1 - v0)
        raise AssertionError("a scale has two points")

    def _points(self) -> list[Vector2]:
        return sorted([(self.at_min, self.minimum), *self.table, (self.at_max, self.maximum)])


class State(Strict):
    """A named resting place of a control; `angle_rad` clockwise from straight up (toggle: tilt, up positive)."""

    name: Name
    angle_rad: float = 0.0


def _all_different(states: tuple[State, ...]) -> tuple[State, ...]:
    if len({state.name for state in states}) != len(states):
        raise ValueError("two states have the same name")
    return states


States = Annotated[tuple[State, ...], Field(min_length=2), AfterValidator(_all_different)]


class ObjectBase(Strict):
    """What every object on the panel has. `position_m` is the object's middle on the plate (x, y)."""

    name: Name
    label: str = ""
    position_m: Vector2

    @property
    def point_m(self) -> Vector3:
        """The middle of the object on the plate, in the panel frame."""
        return (self.position_m[0], self.position_m[1], 0.0)


class Gauge(ObjectBase):
    """Round pointer instrument; the scale's places are needle angles."""

    kind: Literal["gauge"] = "gauge"
    radius_m: Positive
    scale: Scale
    depth_m: NotNegative = 0.004


class PanelMeter(ObjectBase):
    """Rectangular moving-coil meter; the pivot lies `pivot_below_m` under the middle; places are needle angles."""

    kind: Literal["panel_meter"] = "panel_meter"
    width_m: Positive
    height_m: Positive
    pivot_below_m: NotNegative
    needle_m: Positive
    scale: Scale
    depth_m: NotNegative = 0.004


class Display(ObjectBase):
    """Seven-segment display."""

    kind: Literal["display"] = "display"
    width_m: Positive
    height_m: Positive
    digits: Annotated[int, Field(ge=1, le=8)]
    decimals: Annotated[int, Field(ge=0, le=7)] = 0
    style: Literal["led", "lcd"] = "led"
    unit: str = ""
    minimum: float = 0.0
    maximum: float = 9999.0

    @model_validator(mode="after")
    def _has_a_range(self) -> Display:
        if self.maximum <= self.minimum:
            raise ValueError("maximum must be greater than minimum")
        return self


class Lamp(ObjectBase):
    """Indicator lamp with states `on` and `off`."""

    kind: Literal["lamp"] = "lamp"
    radius_m: Positive
    colour: Literal["red", "green", "amber", "blue", "white"] = "green"
    height_m: NotNegative = 0.006


LATCHED_SHARE = 0.6
"""Of its travel: how far a cap that latches stays in."""


class Button(ObjectBase):
    """Push button; `latching` ones stay in. States `pressed` and `released`."""

    kind: Literal["button"] = "button"
    radius_m: Positive
    height_m: Positive = 0.008
    travel_m: Positive = 0.005
    spring_n_per_m: Positive = 1000.0
    preload_n: NotNegative = 2.0
    latching: bool = False
    colour: Literal["red", "green", "amber", "blue", "white", "black"] = "green"
    lights_lamp: Name | None = None

    @property
    def pressed_depth_m(self) -> float:
        """How much lower the cap is where it is read as pressed: held down, or latched."""
        return LATCHED_SHARE * self.travel_m if self.latching else self.travel_m


class Toggle(ObjectBase):
    """Two-way toggle switch; the bat tilts up or down by `tilt_rad`. States `on` (up) and `off` (down)."""

    kind: Literal["toggle"] = "toggle"
    bat_length_m: Positive = 0.020
    bat_radius_m: Positive = 0.004
    tilt_rad: Positive = 0.40
    force_n: Positive = 6.0


class Rotary(ObjectBase):
    """Selector with detents."""

    kind: Literal["rotary"] = "rotary"
    radius_m: Positive
    height_m: Positive = 0.018
    states: States
    torque_nm: Positive = 0.15


class Slider(ObjectBase):
    """Slider on a straight track; the scale's places are metres from the track's middle along `angle_rad` from +x."""

    kind: Literal["slider"] = "slider"
    angle_rad: float = 0.0
    travel_m: Positive
    cap_size_m: Vector3 = (0.012, 0.024, 0.016)  # along the track, across it, out of the plate
    scale: Scale
    friction_n: Positive = 4.0


class Lever(ObjectBase):
    """Quarter-turn lever valve: a bar that turns about its hub."""

    kind: Literal["lever"] = "lever"
    length_m: Positive = 0.070
    width_m: Positive = 0.014
    height_m: Positive = 0.030
    states: States
    torque_nm: Positive = 2.0


class Handwheel(ObjectBase):
    """Valve wheel with spokes; turns between two stops. One spoke is marked and shows the angle."""

    kind: Literal["handwheel"] = "handwheel"
    radius_m: Positive = 0.035
    rim_m: Positive = 0.005
    height_m: Positive = 0.030
    spokes: Annotated[int, Field(ge=2, le=8)] = 3
    minimum_rad: float = -6.2832
    maximum_rad: float = 6.2832
    torque_nm: Positive = 0.8

    @model_validator(mode="after")
    def _can_turn(self) -> Handwheel:
        if self.maximum_rad <= self.minimum_rad:
            raise ValueError("maximum_rad must be greater than minimum_rad")
        return self


class Mushroom(ObjectBase):
    """Emergency mushroom; pressing it latches. States `pressed` and `released`."""

    kind: Literal["mushroom"] = "mushroom"
    radius_m: Positive = 0.020
    height_m: Positive = 0.026
    travel_m: Positive = 0.006
    spring_n_per_m: Positive = 2000.0
    preload_n: NotNegative = 8.0

    @property
    def pressed_depth_m(self) -> float:
        """How much lower a latched head is."""
        return LATCHED_SHARE * self.travel_m


PanelObject = Annotated[
    Gauge | PanelMeter | Display | Lamp | Button | Toggle | Rotary | Slider | Lever | Handwheel | Mushroom,
    Field(discriminator="kind"),
]
OBJECT_KINDS = (
    "gauge",
    "panel_meter",
    "display",
    "lamp",
    "button",
    "toggle",
    "rotary",
    "slider",
    "lever",
    "handwheel",
    "mushroom",
)


class Tolerances(Strict):
    """How far a built panel differs from this file: one sigma each. Only a simulator draws from them."""

    position_m: NotNegative = 0.0002
    light_m: NotNegative = 0.0001
    effort_ratio: NotNegative = 0.2


class Panel(Strict):
    """One panel: plate, border lights and objects."""

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    name: Name
    width_m: Positive
    height_m: Positive
    thickness_m: Positive = 0.01
    lights: Annotated[tuple[Light, ...], Field(min_length=4, max_length=4)]
    objects: tuple[PanelObject, ...] = ()
    tolerances: Tolerances = Tolerances()

    @model_validator(mode="after")
    def _names_are_unique_and_places_on_the_plate(self) -> Panel:
        names = [panel_object.name for panel_object in (*self.lights, *self.objects)]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"the name {twice[0]!r} is given twice")
        for panel_object in (*self.lights, *self.objects):
            x, y = panel_object.position_m[:2]
            if abs(x) > self.width_m / 2 or abs(y) > self.height_m / 2:
                raise ValueError(f"{panel_object.name} at ({x}, {y}) m lies off the plate")
        lamps = {panel_object.name for panel_object in self.objects if isinstance(panel_object, Lamp)}
        for panel_object in self.objects:
            if isinstance(panel_object, Button) and panel_object.lights_lamp not in (None, *lamps):
                raise ValueError(
                    f"{panel_object.name} lights {panel_object.lights_lamp!r}, which is no lamp of the panel"
                )
        return self

    def object(self, name: str) -> PanelObject:
        """The object called `name`.

        Raises:
            InvalidRequest: no such object; says which name is near.
        """
        for panel_object in self.objects:
            if panel_object.name == name:
                return panel_object
        from difflib import get_close_matches

        from hal.errors import InvalidRequest

        names = [panel_object.name for panel_object in self.objects]
        near = get_close_matches(name, names, n=1)
        raise InvalidRequest(
            f"no object called {name!r} on panel {self.name!r}",
            hint=f"did you mean {near[0]!r}?" if near else f"objects: {', '.join(names)}",
        )


def load_panel(path: Path) -> Panel:
    """Read a panel file.

    Raises:
        ConfigError: missing or malformed; names file and key path.
    """
    return load_toml(path, Panel, "panel file")
