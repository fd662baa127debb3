"""The panel file: plate, border lights, printed tags and objects, each validated by the model of its kind."""

from __future__ import annotations

import json
import math
from contextlib import suppress
from difflib import get_close_matches
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    Field,
    GetJsonSchemaHandler,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

from hal.errors import InvalidRequest
from hal.panel import kinds
from hal.panel.angles import UNITLESS, Location, again, fault, in_radians
from hal.panel.base import PanelObject
from hal.panel.parts import Light, Name, NotNegative, Positive, Tag
from hal.panel.plate import Part, faults_of
from hal.panel.turn import TURN_RAD, meant_otherwise
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
        raise meant_otherwise("is no table", "write [[objects]] with kind, name and position_m")
    kind = data.get("kind")
    if kind not in kinds.installed_kinds():
        what = "has no kind" if kind is None else f"{kind!r} is no kind of object that is installed"
        at = () if kind is None else ("kind",)
        raise ValidationError.from_exception_data("object", [fault(at, kind, what, kinds.hint_for(str(kind or "")))])
    model = kinds.kind_model(kind)
    if info.mode != "json":
        return model.model_validate(data)
    known = frozenset(name for one in reachable(model) for name in one.model_fields)
    table, faults = in_radians(data, known - UNITLESS if model.places_are_lengths else known)
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


AnyObject = Annotated[PanelObject, _OfItsKind]
_PARTS: dict[str, TypeAdapter[Any]] = {
    "lights": TypeAdapter(Light),
    "tags": TypeAdapter(Tag),
    "objects": TypeAdapter(AnyObject),
}


def _four_or_none(lights: tuple[Light, ...]) -> tuple[Light, ...]:
    if len(lights) not in (0, 4):
        raise meant_otherwise(
            f"a panel has four border lights or none, not {len(lights)}",
            "give all four, or leave the lights out: then tags, the plate's outline or its objects show where it is",
        )
    return lights


def _read_once(tags: tuple[Tag, ...]) -> tuple[Tag, ...]:
    if len({tag.name for tag in tags}) != len(tags):
        raise meant_otherwise("two tags have the same family and id", "print another id for one of them")
    return tags


class Tolerances(Strict):
    """Deviations of a built panel from this file, one sigma each.

    Simulators draw the built panel from them, and the pose of the panel is as uncertain as they make it.
    """

    position_m: NotNegative = 0.0002
    light_m: NotNegative = 0.0001
    tag_m: Annotated[NotNegative, Field(description="place of a printed tag")] = 0.0003
    edge_m: Annotated[NotNegative, Field(description="place of an edge of the plate")] = 0.0
    effort_ratio: NotNegative = 0.2


class Panel(Strict):
    """Panel: plate, border lights, printed tags and objects."""

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    name: Name
    width_m: Positive
    height_m: Positive
    thickness_m: Positive = 0.01
    lights: Annotated[tuple[Light, ...], AfterValidator(_four_or_none)] = ()
    tags: Annotated[tuple[Tag, ...], AfterValidator(_read_once)] = ()
    objects: tuple[AnyObject, ...] = ()
    tolerances: Tolerances = Tolerances()
    to_measure: Annotated[
        tuple[Literal["width_m", "height_m", "thickness_m", "lights", "tags", "objects"], ...],
        Field(description="keys of this file that are still guesses"),
    ] = ()

    @model_validator(mode="after")
    def _parts_have_their_own_names_and_places(self) -> Panel:
        parts: dict[Location, Part] = {("lights", k): light for k, light in enumerate(self.lights)}
        parts |= {("tags", k): tag for k, tag in enumerate(self.tags)}
        parts |= {("objects", k): panel_object for k, panel_object in enumerate(self.objects)}
        faults = faults_of(self.width_m, self.height_m, parts)
        if faults:
            raise ValidationError.from_exception_data(self.name, faults)
        return self

    @classmethod
    def further_faults(cls, data: dict[str, Any]) -> list[Any]:
        """Return faults in the layout of the parts that are valid by themselves, although other parts are not."""
        parts: dict[Location, Part] = {}
        for key, model in _PARTS.items():
            table = data.get(key)
            for k, one in enumerate(table if isinstance(table, list) else ()):
                with suppress(ValidationError):
                    parts[(key, k)] = _as_meant(one, model)
        width, height = data.get("width_m"), data.get("height_m")
        if not isinstance(width, float) or not isinstance(height, float):
            width = height = math.inf
        faults = faults_of(width, height, parts)
        return ValidationError.from_exception_data("panel", faults).errors() if faults else []

    def object(self, name: str) -> PanelObject:
        """Return the object called `name`.

        Raises:
            InvalidRequest: there is no such object; the hint names the nearest one.
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


def _as_meant(table: Any, model: TypeAdapter[Any]) -> Any:
    """Return a part of a panel; read once more without unknown keys and with too large angles as degrees if need be.

    Raises:
        ValidationError: the part has other faults.
    """
    try:
        return model.validate_json(json.dumps(table, default=str))
    except ValidationError as error:
        meant = json.loads(json.dumps(table, default=str))
        for item in error.errors():
            if not item["loc"]:
                continue  # a fault of the object as a whole
            *above, key = item["loc"]
            with suppress(KeyError, IndexError, TypeError):  # the fault is in something that is not in the table
                inner = reduce(getitem, above, meant)
                if item["type"] == "extra_forbidden":
                    del inner[key]
                elif abs(inner[key]) > TURN_RAD:
                    inner[key] = math.radians(inner[key])
        return model.validate_json(json.dumps(meant))


def load_panel(path: Path) -> Panel:
    """Read a panel file.

    Raises:
        ConfigError: the file is missing or malformed; names the file and the key path.
    """
    return load_toml(path, Panel, "panel file")
