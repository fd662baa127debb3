"""Says in plain words what is wrong with one value of a file or a request, and what to write instead.

pydantic speaks about its own types and tags, which mean nothing to whoever wrote the file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

LONGEST = 60  # characters of a value that are repeated
BOUNDS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}
TYPES = {
    "string": "a text in quotes",
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
    "tuple": "a list in square brackets",
    "list": "a list in square brackets",
    "model": "a table of keys and values",
    "dict": "a table of keys and values",
}
LENGTHS = {
    "too_short": ("entries", "at least", "min_length"),
    "too_long": ("entries", "at most", "max_length"),
    "string_too_short": ("characters", "at least", "min_length"),
    "string_too_long": ("characters", "at most", "max_length"),
}
ONE_LINE = r"^[^\x00-\x1f\x7f]*$"
NAME = re.compile(r"\^\[a-z\]\[a-z0-9(_-?)\]\{0,(\d+)\}\$")


def is_echo(item: Mapping[str, Any]) -> bool:
    """Return whether a fault only repeats those of the entries of a list, which pydantic does not count if they are faulty."""
    given = item.get("input")
    return (
        item["type"] == "too_short"
        and isinstance(given, list)
        and len(given) >= item.get("ctx", {}).get("min_length", 1)
    )


def in_words(item: Mapping[str, Any]) -> tuple[str, str, str] | None:
    """Return what is wrong, what to do, and the key below the fault's own if it has one; None for a fault without words here.

    Args:
        item: a fault as pydantic tells it.
    """
    kind, given, more = str(item["type"]), repr(item.get("input"))[:LONGEST], item.get("ctx", {})
    told = _of_range(kind, given, more) or _of_length(kind, item.get("input"), more)
    if told is not None:
        return *told, ""
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        return _of_tag(item, more)
    if kind in ("literal_error", "enum"):
        near = get_close_matches(str(item.get("input")), re.findall(r"'([^']*)'", more["expected"]), n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}?" if near else f"give {more['expected']}"
        return f"{given} is not {more['expected']}", hint, ""
    if kind == "string_pattern_mismatch":
        return f"{given} is not written as it must be", _of_pattern(more["pattern"]), ""
    wanted = TYPES.get(kind.removesuffix("_type").removesuffix("_from_float"))
    return None if wanted is None else (f"{given} is not {wanted}", f"give {wanted}", "")


def _of_range(kind: str, given: str, more: Mapping[str, Any]) -> tuple[str, str] | None:
    if kind == "finite_number":
        return f"{given} is not a finite number", "give a finite number"
    if kind not in BOUNDS:
        return None
    key, words = BOUNDS[kind]
    return f"{given} is not {words} {more[key]:g}", f"give a number that is {words} {more[key]:g}"


def _of_length(kind: str, given: Any, more: Mapping[str, Any]) -> tuple[str, str] | None:
    if kind not in LENGTHS:
        return None
    things, words, key = LENGTHS[kind]
    has = len(given) if isinstance(given, list | tuple | str) else more.get("actual_length", 0)
    return (
        f"it has {has} {things}, and needs {words} {more[key]}",
        "add what is missing" if "least" in words else "shorten it",
    )


def _of_tag(item: Mapping[str, Any], more: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return a fault of the key that says what an entry is, such as `kind`."""
    key = str(more["discriminator"]).strip("'")
    if item["type"] == "union_tag_not_found":
        return "is missing", f"add {key}", key
    known = re.findall(r"'([^']*)'", more["expected_tags"])
    near = get_close_matches(str(more["tag"]), known, n=1, cutoff=0.5)
    return (
        f"there is no {key} {str(more['tag'])[:LONGEST]!r}",
        f"did you mean {near[0]!r}?" if near else f"{key}: {', '.join(known)}",
        key,
    )


def _of_pattern(pattern: str) -> str:
    if pattern == ONE_LINE:
        return "write one line without control characters"
    found = NAME.fullmatch(pattern)
    if found is None:
        return f"write it as the pattern {pattern} says"
    others = ", _ and -" if found[1] == "_-" else " and _"
    return f"use lower-case letters, digits{others}, at most {int(found[2]) + 1} characters, and begin with a letter"
