"""Converts the project's values to plain JSON values: finite numbers, strings, lists and objects."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel
from scipy.spatial.transform import RigidTransform

from hal.geometry import to_json

MAX_ARRAY = 4096  # elements; longer arrays belong in artefacts, and JSON gives only their shape


def jsonable(value: Any) -> Any:
    """Return plain JSON values for dataclasses, models, enums, arrays and poses; NaN and infinity become null."""
    if value is None or isinstance(value, str | bool | int):
        return value.value if isinstance(value, Enum) else value
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.bool_ | np.integer):
        return value.item()
    if isinstance(value, dict):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [jsonable(item) for item in value]
    return _object(value)


def _array(value: np.ndarray[Any, Any]) -> Any:
    if value.size > MAX_ARRAY:
        return {"shape": list(value.shape), "dtype": str(value.dtype)}
    return jsonable(value.tolist())


def _object(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return _array(value)
    if isinstance(value, RigidTransform):
        return to_json(value)
    if isinstance(value, BaseModel):
        return jsonable(value.model_dump(mode="python", by_alias=True))
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: jsonable(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Enum):
        return jsonable(value.value)
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")
