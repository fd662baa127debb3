"""Component models: bounded primitives with tolerances in the object's own frame, read from TOML.

Components are mounted on a panel: the origin lies on its plane below the centre of the component, and z is the outward
normal.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hal.arrays import Array
from hal.errors import ConfigError
from hal.strict import read_text, toml_data


class Form(StrEnum):
    """Shape of a model surface: the types of `SurfaceType`, and the torus, which the segmentation does not fit."""

    PLANE = "plane"
    SPHERE = "sphere"
    CYLINDER = "cylinder"
    CONE = "cone"
    ELLIPSOID = "ellipsoid"
    TORUS = "torus"


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
        point_m: (3,) centre of a face, cylinder, sphere or torus; the apex of a cone.
        direction: (3,) outward normal of a plane, axis of a cylinder or torus; for a cone, from the apex into it.
        along: (3,) direction of a rectangular face's first side; zeros for others.
        size_m: radius of a sphere, cylinder or disc, or of a torus's centre line; 0 for cones, ellipsoids and
            rectangles.
        half_angle_rad: of a cone, else 0.
        sides_m: lengths of a rectangular face's sides, None for a disc.
        length_m: of a cylinder; 0 = unknown.
        radii_m: (3,) of an ellipsoid along the object's axes.
        tube_m: radius of a torus's tube.
        between_m: least and greatest z of the part of a sphere or cone that exists.
        tolerance_m: by how much sizes and heights may differ between components of this model.
        moves: whether it belongs to the moving part.
    """

    name: str
    type: Form
    point_m: Array
    direction: Array
    along: Array
    size_m: float
    half_angle_rad: float
    sides_m: tuple[float, ...] | None
    length_m: float
    radii_m: Array
    tube_m: float
    between_m: tuple[float, ...]
    tolerance_m: float
    moves: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ComponentModel:
    """A kind of component: its surfaces, the motion of its moving part, and its rotational symmetry.

    Attributes:
        turns: order of the rotational symmetry about z; 0 for full symmetry, where the angle cannot be determined.
        motion, motion_axis: whether the moving part slides along the axis (3,) or turns about it.
        low, high: limits of that motion, m or rad.
    """

    name: str
    surfaces: tuple[ModelSurface, ...]
    turns: int
    motion: MotionKind
    motion_axis: Array
    low: float
    high: float

    @property
    def period_rad(self) -> float:
        """Smallest rotation about z after which the component looks the same; 0 if it looks the same after any."""
        return 2.0 * math.pi / self.turns if self.turns else 0.0


SURFACE_KEYS = {field.name for field in fields(ModelSurface)}
MODEL_KEYS = {field.name for field in fields(ComponentModel)} - {"name"}
NEEDED = {
    Form.SPHERE: {"size_m"},
    Form.CYLINDER: {"size_m", "direction"},
    Form.CONE: {"half_angle_rad", "direction"},
    Form.ELLIPSOID: {"radii_m"},
    Form.TORUS: {"size_m", "tube_m", "direction"},
    Form.PLANE: {"direction"},
}
SHIPPED = Path(__file__).with_name("components.toml")


def load_models(path: Path = SHIPPED) -> tuple[ComponentModel, ...]:
    """Read the component models of a TOML file, by default of the one that comes with the package.

    Raises:
        ConfigError: the file cannot be read or violates the format; the message names the key.
    """
    return models_from(toml_data(read_text(path, "model file"), source=str(path)), where=str(path))


def models_from(document: Mapping[str, Any], *, where: str = "models") -> tuple[ComponentModel, ...]:
    """Return the component models of a parsed TOML document; `where` names it in errors (see `load_models`)."""
    tables = document.get("model")
    if not isinstance(tables, dict) or not tables:
        raise ConfigError(f"{where}: no [model.NAME] tables", hint="one table a component")
    return tuple(_model(name, table, where=f"{where}: model.{name}") for name, table in tables.items())


def _model(name: str, table: Mapping[str, Any], *, where: str) -> ComponentModel:
    """Check the table of a model and build the model."""
    _only(table, MODEL_KEYS, where)
    rows = table.get("surfaces")
    if not isinstance(rows, list) or not rows:
        raise ConfigError(f"{where}.surfaces is empty", hint="list at least one surface")
    surfaces = tuple(_surface(row, where=f"{where}.surfaces[{k}]") for k, row in enumerate(rows))
    if len({s.name for s in surfaces}) != len(surfaces):
        raise ConfigError(f"{where}: two surfaces share a name", hint="name each surface once")
    motion = table.get("motion", "none")
    if motion not in set(MotionKind):
        raise ConfigError(f"{where}.motion is {motion!r}", hint=f"one of {[str(m) for m in MotionKind]}")
    low, high = _number(table, "low", 0.0, where), _number(table, "high", 0.0, where)
    if motion != MotionKind.NONE and not low < high:
        raise ConfigError(f"{where}: low {low} is not below high {high}", hint="give the travel of the moving part")
    return ComponentModel(
        name=name,
        surfaces=surfaces,
        turns=_turns(table, where),
        motion=MotionKind(motion),
        motion_axis=_unit(_numbers(table, "motion_axis", (0.0, 0.0, 1.0), where), where),
        low=low,
        high=high,
    )


def _turns(table: Mapping[str, Any], where: str) -> int:
    """Return the checked order of the rotational symmetry."""
    turns = table.get("turns", 1)
    if isinstance(turns, bool) or not isinstance(turns, int) or turns < 0:
        raise ConfigError(f"{where}.turns is {turns!r}", hint="how many turns look the same: 1, 2, ..., 0 = all")
    return turns


def _surface(row: Mapping[str, Any], *, where: str) -> ModelSurface:
    """Check the table of a surface and build the surface."""
    _only(row, SURFACE_KEYS, where)
    kind = row.get("type")
    if kind not in set(Form):
        raise ConfigError(f"{where}.type is {kind!r}", hint=f"one of {[str(t) for t in Form]}")
    form = Form(kind)
    missing = sorted(NEEDED[form] - set(row))
    if form == Form.PLANE and not {"size_m", "sides_m"} & set(row):
        missing.append("size_m")
    if missing:
        raise ConfigError(f"{where}: a {form} needs {missing[0]}", hint="models are drawn as rays see them")
    direction = np.array(_numbers(row, "direction", (0.0, 0.0, 0.0), where))
    if "direction" in NEEDED[form]:
        direction = _unit(direction, f"{where}.direction")
    sides = _numbers(row, "sides_m", (0.0, 0.0), where) if "sides_m" in row else None
    return ModelSurface(
        name=str(row.get("name", kind)),
        type=form,
        point_m=np.array(_numbers(row, "point_m", (0.0, 0.0, 0.0), where)),
        direction=direction,
        along=_along(row, direction, where) if sides is not None else np.zeros(3),
        size_m=_number(row, "size_m", 0.0, where),
        half_angle_rad=_number(row, "half_angle_rad", 0.0, where),
        sides_m=sides,
        length_m=_number(row, "length_m", 0.0, where),
        radii_m=np.array(_numbers(row, "radii_m", (0.0, 0.0, 0.0), where)),
        tube_m=_number(row, "tube_m", 0.0, where),
        between_m=_numbers(row, "between_m", (-math.inf, math.inf), where),
        tolerance_m=_number(row, "tolerance_m", 0.002, where),
        moves=bool(row.get("moves", False)),
    )


def _along(row: Mapping[str, Any], normal: Array, where: str) -> Array:
    """Return the unit direction of a rectangle's first side, projected into the face."""
    side = np.array(_numbers(row, "along", (1.0, 0.0, 0.0), where))
    return _unit(side - normal * float(normal @ side), f"{where}.along")


def _only(table: Mapping[str, Any], known: set[str], where: str) -> None:
    """Raise ConfigError if the table has a key that is not `known`."""
    unknown = sorted(set(table) - known)
    if unknown:
        raise ConfigError(f"{where}: unknown key {unknown[0]!r}", hint=f"known keys: {sorted(known)}")


def _number(table: Mapping[str, Any], key: str, default: float, where: str) -> float:
    """Return a finite number of the table, or the default."""
    value = table.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f"{where}.{key} is {value!r}", hint="give a finite number")
    return float(value)


def _numbers(table: Mapping[str, Any], key: str, default: Sequence[float], where: str) -> tuple[float, ...]:
    """Return as many numbers of the table as the default has, or the default."""
    value = table.get(key, default)
    if (
        not isinstance(value, list | tuple)
        or len(value) != len(default)
        or not all(isinstance(v, int | float) for v in value)
    ):
        raise ConfigError(f"{where}.{key} is {value!r}", hint=f"give {len(default)} numbers")
    return tuple(float(v) for v in value)


def _unit(vector: ArrayLike, where: str) -> Array:
    """Return the vector (3,) with length one."""
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        raise ConfigError(f"{where}: a direction of length zero", hint="give a vector; its length does not matter")
    return np.asarray(vector) / length
