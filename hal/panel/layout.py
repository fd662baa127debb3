"""The panel file: plate, border lights and objects, each validated by the model of its kind."""

from __future__ import annotations

import json
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, GetJsonSchemaHandler, ValidationError, ValidationInfo, model_validator
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from hal import kinds
from hal.errors import InvalidRequest
from hal.panel.angles import again, in_radians
from hal.panel.base import PanelObject
from hal.panel.parts import Light, Name, NotNegative, Positive
from hal.strict import Strict, load_toml, reachable


class _OfItsKind:
    """Validates an object by the model that is registered under its `kind`, which may come from any package."""

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> CoreSchema:
        return core_schema.with_info_plain_validator_function(_of_its_kind)

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"oneOf": [kinds.kind_model(kind).model_json_schema() for kind in kinds.installed_kinds()]}


def _of_its_kind(data: Any, info: ValidationInfo) -> PanelObject:
    if isinstance(data, PanelObject):
        return data
    if not isinstance(data, dict):
        raise PydanticCustomError("table_type", "must be a table with kind, name and position_m")
    kind = data.get("kind")
    if kind is None:
        raise PydanticCustomError("kind_missing", "has no kind; {hint}", {"hint": kinds.hint_for("")})
    if kind not in kinds.installed_kinds():
        words = {"kind": repr(kind), "hint": kinds.hint_for(str(kind))}
        raise PydanticCustomError("kind_unknown", "{kind} is no kind that is installed; {hint}", words)
    model = kinds.kind_model(kind)
    if info.mode != "json":
        return model.model_validate(data)
    known = frozenset(name for one in reachable(model) for name in one.model_fields)
    table, faults = in_radians(data, known)
    try:
        # JSON mode takes lists for tuples, as TOML has them, and is strict all the same.
        made = model.model_validate_json(json.dumps(table))
    except ValidationError as error:
        raise ValidationError.from_exception_data(
            kind, [*faults, *(again(item, model) for item in error.errors())]
        ) from None
    if faults:
        raise ValidationError.from_exception_data(kind, faults)
    return made


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
    objects: tuple[Annotated[PanelObject, _OfItsKind], ...] = ()
    tolerances: Tolerances = Tolerances()

    @model_validator(mode="after")
    def _names_are_unique_and_places_on_the_plate(self) -> Panel:
        parts: list[Light | PanelObject] = [*self.lights, *self.objects]
        names = [part.name for part in parts]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"the name {twice[0]!r} is given twice")
        for part in parts:
            x, y = part.position_m[:2]
            if abs(x) > self.width_m / 2 or abs(y) > self.height_m / 2:
                raise ValueError(f"{part.name} at ({x}, {y}) m lies off the plate")
        by_name = {panel_object.name: panel_object for panel_object in self.objects}
        for panel_object in self.objects:
            shown_by = panel_object.shown_by
            if shown_by != panel_object.name and (shown_by not in by_name or by_name[shown_by].kind != "lamp"):
                raise ValueError(f"{panel_object.name} lights {shown_by!r}, which is no lamp of the panel")
        return self

    def object(self, name: str) -> PanelObject:
        """The object called `name`.

        Raises:
            InvalidRequest: no such object; says which name is near.
        """
        for panel_object in self.objects:
            if panel_object.name == name:
                return panel_object
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
