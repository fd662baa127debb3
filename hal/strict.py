"""Strict models for files and requests: unknown keys, wrong types and non-finite numbers are refused by key path."""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError

from hal.errors import ConfigError
from hal.fault_words import in_words, is_echo

M = TypeVar("M", bound="Strict")
REFERENCE = "see the file reference in docs/"
IN_DOCS = "the reference is in docs/"


@dataclass(frozen=True, slots=True)
class FieldFault:
    """Fault in a file: the key path, what is wrong with its value, and the remedy."""

    key: str
    text: str
    hint: str
    is_unknown_key: bool = False

    def __str__(self) -> str:
        """Return the fault in one line, with its remedy unless the remedy is a page about all faults."""
        said = _said(self.key, self.text)
        return said if self.hint.startswith("see ") or self.hint.endswith(IN_DOCS) else f"{said}; {self.hint}"

    def below(self, key: str) -> FieldFault:
        """Return the same fault for a table that is under `key` of the file."""
        return replace(self, key=f"{key}.{self.key}".rstrip("."))


class Strict(BaseModel):
    """Base of every model that comes from a file or a request."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)

    @classmethod
    def further_faults(cls, data: dict[str, Any]) -> list[Any]:  # noqa: ARG003 - of use to models that override it
        """Return faults of `data`, in pydantic's form, that validation does not reach if it finds others first."""
        return []


def load_toml(path: Path, model: type[M], what: str) -> M:
    """Read `path` and validate it as `model`.

    Raises:
        ConfigError: the file is missing, is not TOML, or breaks the model; names file, key path and remedy.
    """
    return parse_toml(read_text(path, what), model, source=str(path))


def read_text(path: Path, what: str) -> str:
    """Read the text of a file that a user named."""
    try:
        return path.read_text(encoding="utf-8-sig")  # some editors write a byte-order mark before the first key
    except FileNotFoundError:
        # The file endings are equal and would make any two names look similar.
        near = get_close_matches(path.stem, [p.stem for p in path.parent.glob("*.toml")], n=1, cutoff=0.5)
        hint = f"did you mean {path.parent / near[0]}.toml?" if near else f"give the path of a {what} (TOML)"
        raise ConfigError(f"{what} {path} does not exist", hint=hint, file=str(path)) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{what} {path} cannot be read: {error}",
            hint="check path, permissions and encoding (UTF-8)",
            file=str(path),
        ) from error


def parse_toml(text: str, model: type[M], *, source: str) -> M:
    """Validate TOML text as `model`; `source` names it in errors."""
    return validate(toml_data(text, source=source), model, source=source)


def toml_data(text: str, *, source: str) -> dict[str, Any]:
    """Return TOML text as plain data; `source` names it in errors.

    Raises:
        ConfigError: it is not TOML, or arrays stand within more arrays than Python reads.
    """
    try:
        return tomllib.loads(text.removeprefix("\ufeff"))  # some editors write a byte-order mark before the first key
    except RecursionError as error:
        raise ConfigError(
            f"{source}: lists and tables stand too deep within each other", hint="nest fewer of them", file=source
        ) from error
    except ValueError as error:
        raise ConfigError(
            f"{source} is not valid TOML: {error}", hint="look at that line; strings need quotes", file=source
        ) from error


def validate(data: dict[str, Any], model: type[M], *, source: str) -> M:
    """Validate plain data as `model`, with every fault named by key path.

    TOML has no tuples, so lists stand for them; nothing else is converted.
    """
    try:
        return _parsed(data, model)
    except ValidationError as error:
        raise refusal(_faults(error, data, model), source=source) from error


def faults_in(data: dict[str, Any], model: type[Strict]) -> list[FieldFault]:
    """Return all faults of plain data for `model`; empty when the data are valid."""
    try:
        _parsed(data, model)
    except ValidationError as error:
        return _faults(error, data, model)
    return []


def refusal(faults: list[FieldFault], *, source: str) -> ConfigError:
    """Return one error that names all faults of a file; its remedy is that of the first fault."""
    more = f" (and {len(faults) - 1} more {'fault' if len(faults) == 2 else 'faults'})" if len(faults) > 1 else ""
    first = faults[0]
    return ConfigError(
        f"{_said(source, first.key, first.text)}{more}",
        hint=first.hint,
        file=source,
        key=first.key,
        faults=[str(fault) for fault in faults],
    )


def _parsed(data: dict[str, Any], model: type[M]) -> M:
    # JSON mode is strict about types, but takes a list for a tuple and a string for an enum.
    return model.model_validate_json(json.dumps(data, default=str), strict=True)


def _faults(error: ValidationError, data: dict[str, Any], model: type[Strict]) -> list[FieldFault]:
    found = [item for item in error.errors() if not is_echo(item)]
    known = {(item["loc"], item["msg"]) for item in found}
    found += [item for item in model.further_faults(data) if (item["loc"], item["msg"]) not in known]
    # A misspelt key also makes the correct key missing. The misspelling is what must be corrected, so it comes first.
    return [_fault(item, model) for item in sorted(found, key=lambda item: item["type"] != "extra_forbidden")]


def _fault(item: Any, model: type[BaseModel]) -> FieldFault:
    path = _path_in_file(item["loc"], model)
    key = ".".join(str(part) for part in path)
    if item["type"] == "extra_forbidden":
        hint = item.get("ctx", {}).get("hint") or unknown_key_hint(model, item["loc"])
        return FieldFault(key, f"unknown key {path[-1]!r}", hint, is_unknown_key=True)
    if item["type"] == "missing":
        return FieldFault(key, "is missing", f"add {key}; {IN_DOCS}")
    given, hint = repr(item.get("input")), item.get("ctx", {}).get("hint")
    if hint is not None:  # the model supplies the remedy
        return FieldFault(key, item["msg"], hint)
    if item["type"] == "value_error":
        return FieldFault(key, item["msg"].removeprefix("Value error, "), REFERENCE)
    words = in_words(item)
    if words is not None:
        text, remedy, below = words
        return FieldFault(".".join(filter(None, (key, below))), text, remedy)
    said = f"{item['msg']} (given: {given[:60]})"
    return FieldFault(key, said, f"{REFERENCE} for type, unit and range")


def _said(*parts: str) -> str:
    """Join the non-empty parts of a message with colons; a fault of the whole file has no key."""
    return ": ".join(part for part in parts if part)


def unknown_key_hint(model: type[BaseModel], location: tuple[int | str, ...]) -> str:
    """Return a hint for an unknown key at `location` of data for `model`: the nearest known key, or all of them."""
    return _did_you_mean(str(location[-1]), _fields_at(model, list(location[:-1])))


def _path_in_file(location: tuple[Any, ...], model: type[BaseModel]) -> list[Any]:
    # A discriminated union puts its tag into the path, where a reader of the file sees none.
    tags = {tag for m in reachable(model) if (tag := _tag_of(m))}
    return [
        part for i, part in enumerate(location) if not (part in tags and i > 0 and isinstance(location[i - 1], int))
    ]


def reachable(model: type[BaseModel]) -> set[type[BaseModel]]:
    """Return the model and all models that its fields use."""
    found: set[type[BaseModel]] = set()
    waiting = [model]
    while waiting:
        current = waiting.pop()
        if current not in found:
            found.add(current)
            waiting += [m for field in current.model_fields.values() for m in _models_in(field.annotation)]
    return found


def _did_you_mean(name: str, known: list[str]) -> str:
    near = get_close_matches(name, known, n=1, cutoff=0.5)
    if near:
        return f"did you mean {near[0]!r}?"
    return f"known keys: {', '.join(sorted(known))}" if known else "remove it"


def _fields_at(model: type[BaseModel], location: list[Any]) -> list[str]:
    """Return the field names of the model at `location` inside `model`."""
    models: list[type[BaseModel]] = [model]
    for part in location:
        if isinstance(part, int):
            continue
        stepped = [
            inner for m in models if part in m.model_fields for inner in _models_in(m.model_fields[part].annotation)
        ]
        tagged = [m for m in models if _tag_of(m) == part]
        models = stepped or tagged or models
    return sorted({name for m in models for name in m.model_fields})


def _tag_of(model: type[BaseModel]) -> str | None:
    field = model.model_fields.get("kind")
    return str(field.default) if field is not None and field.default is not None else None


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for argument in get_args(annotation) for m in _models_in(argument)]
