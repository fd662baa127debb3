"""Matching named surfaces against models of components: which surface is which, pose, state of its moving part.

A model is a set of primitives in the object's own frame with tolerances, read from TOML. Objects on a panel stand on
its plane, so a model may state `on_plane = true`: its z axis is then the panel's outward normal. Matching starts from
the model's anchor surface, pairs the others greedily by what the pose predicts, and refines the pose on all pairs.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.errors import ConfigError
from perception.range.primitives import SurfaceType

Array = NDArray[np.float64]


class MotionKind(StrEnum):
    """How the moving part of a component moves."""

    NONE = "none"
    SLIDE = "slide"
    TURN = "turn"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModelSurface:
    """One primitive of a component, in the component's frame (z outward from the panel, metres, radians).

    Attributes:
        name: unique in its model.
        point_m: (3,) centre of a sphere, ellipsoid or flat face; a point of an axis; the apex of a cone.
        direction: (3,) outward normal of a plane, axis of a cylinder or cone; zeros where it has no meaning.
        size_m: radius of a sphere or cylinder, or of the disc of equal area for a face; mean radius of an ellipsoid;
            0 for a cone.
        half_angle_rad: of a cone, else 0.
        tolerance_m: of `size_m` and of positions.
        required: whether the component cannot be there without it being seen.
        moves: whether it belongs to the moving part.
    """

    name: str
    type: SurfaceType
    point_m: Array
    direction: Array
    size_m: float
    half_angle_rad: float
    tolerance_m: float
    required: bool
    moves: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ComponentModel:
    """A kind of component: its surfaces, how its part moves, and about which axis it looks the same.

    Attributes:
        symmetric: true when a turn about the z axis changes nothing; the pose then leaves that turn free.
        motion: slide along `motion_axis` or turn about it, between `low` and `high` (metres or radians).
    """

    name: str
    surfaces: tuple[ModelSurface, ...]
    symmetric: bool
    motion: MotionKind
    motion_axis: Array
    low: float
    high: float

    @property
    def anchor(self) -> ModelSurface:
        """The first required surface: matching starts from it."""
        return next(s for s in self.surfaces if s.required)


SURFACE_KEYS = {
    "name",
    "type",
    "point_m",
    "direction",
    "size_m",
    "half_angle_rad",
    "tolerance_m",
    "required",
    "moves",
}
MODEL_KEYS = {"surfaces", "symmetric", "motion", "motion_axis", "low", "high"}


def shipped_models() -> tuple[ComponentModel, ...]:
    """The component models that come with the package (`components.toml`)."""
    return load_models(Path(__file__).with_name("components.toml"))


def load_models(path: Path) -> tuple[ComponentModel, ...]:
    """The component models of a TOML file.

    Raises:
        ConfigError: the file cannot be read or breaks the format; names the key.
    """
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}", hint="check the path of the model file") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: {error}", hint="the file is not valid TOML") from error
    return models_from(document, where=str(path))


def models_from(document: Mapping[str, Any], *, where: str = "models") -> tuple[ComponentModel, ...]:
    """The component models of a parsed TOML document; see `load_models`."""
    tables = document.get("model")
    if not isinstance(tables, dict) or not tables:
        raise ConfigError(f"{where}: no [model.NAME] tables", hint="one table a component")
    return tuple(_model(name, table, where=f"{where}: model.{name}") for name, table in tables.items())


def _model(name: str, table: Mapping[str, Any], *, where: str) -> ComponentModel:
    _only(table, MODEL_KEYS, where)
    rows = table.get("surfaces")
    if not isinstance(rows, list) or not rows:
        raise ConfigError(f"{where}.surfaces is empty", hint="list at least one surface")
    surfaces = tuple(_surface(row, where=f"{where}.surfaces[{k}]") for k, row in enumerate(rows))
    if len({s.name for s in surfaces}) != len(surfaces):
        raise ConfigError(f"{where}: two surfaces share a name", hint="name each surface once")
    if not any(s.required for s in surfaces):
        raise ConfigError(f"{where}: no surface is required", hint="mark the one that is always seen")
    motion = table.get("motion", "none")
    if motion not in set(MotionKind):
        raise ConfigError(f"{where}.motion is {motion!r}", hint=f"one of {[str(m) for m in MotionKind]}")
    low, high = _number(table, "low", 0.0, where), _number(table, "high", 0.0, where)
    if motion != MotionKind.NONE and not low < high:
        raise ConfigError(f"{where}: low {low} is not below high {high}", hint="give the travel of the moving part")
    return ComponentModel(
        name=name,
        surfaces=surfaces,
        symmetric=bool(table.get("symmetric", False)),
        motion=MotionKind(motion),
        motion_axis=_unit(_vector(table, "motion_axis", (0.0, 0.0, 1.0), where), where),
        low=low,
        high=high,
    )


def _surface(row: Mapping[str, Any], *, where: str) -> ModelSurface:
    _only(row, SURFACE_KEYS, where)
    kind = row.get("type")
    if kind not in set(SurfaceType):
        raise ConfigError(f"{where}.type is {kind!r}", hint=f"one of {[str(t) for t in SurfaceType]}")
    direction = _vector(row, "direction", (0.0, 0.0, 0.0), where)
    if kind in (SurfaceType.PLANE, SurfaceType.CYLINDER, SurfaceType.CONE):
        direction = _unit(direction, f"{where}.direction")
    return ModelSurface(
        name=str(row.get("name", kind)),
        type=SurfaceType(kind),
        point_m=_vector(row, "point_m", (0.0, 0.0, 0.0), where),
        direction=direction,
        size_m=_number(row, "size_m", 0.0, where),
        half_angle_rad=_number(row, "half_angle_rad", 0.0, where),
        tolerance_m=_number(row, "tolerance_m", 0.002, where),
        required=bool(row.get("required", False)),
        moves=bool(row.get("moves", False)),
    )


def _only(table: Mapping[str, Any], known: set[str], where: str) -> None:
    unknown = sorted(set(table) - known)
    if unknown:
        raise ConfigError(f"{where}: unknown key {unknown[0]!r}", hint=f"known keys: {sorted(known)}")


def _number(table: Mapping[str, Any], key: str, default: float, where: str) -> float:
    value = table.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f"{where}.{key} is {value!r}", hint="give a finite number")
    return float(value)


def _vector(table: Mapping[str, Any], key: str, default: Sequence[float], where: str) -> Array:
    value = table.get(key, default)
    if not isinstance(value, list | tuple) or len(value) != 3 or not all(isinstance(v, int | float) for v in value):
        raise ConfigError(f"{where}.{key} is {value!r}", hint="give three numbers")
    return np.array(value, float)


def _unit(vector: Array, where: str) -> Array:
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        raise ConfigError(f"{where}: a direction of length zero", hint="give a vector; its length does not matter")
    return vector / length
