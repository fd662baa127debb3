"""A fault of a file is told in plain words with a remedy, whatever pydantic calls it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import pytest
from pydantic import Field

from hal.errors import ConfigError
from hal.fault_words import ONE_LINE
from hal.strict import Strict, validate


class Leaf(Strict):
    """An entry of one kind."""

    kind: Literal["leaf"] = "leaf"
    size: Annotated[float, Field(gt=0.0, le=5.0)] = 1.0


class Twig(Strict):
    """An entry of another kind."""

    kind: Literal["twig"] = "twig"


Part = Annotated[Leaf | Twig, Field(discriminator="kind")]


class Tree(Strict):
    """A file with every type of value."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,60}$")] = "a"
    title: Annotated[str, Field(pattern=ONE_LINE, min_length=2)] = "ab"
    code: Annotated[str, Field(pattern=r"^\d$")] = "1"
    when: Literal["late", "early"] = "late"
    count: int = 1
    is_old: bool = False
    parts: Annotated[tuple[Part, ...], Field(min_length=1, max_length=2)] = (Twig(),)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (
            {"name": "A b"},
            "name: 'A b' is not written as it must be; use lower-case letters, digits, _ and -, at most 61",
        ),
        ({"title": "a\0b"}, "write one line without control characters"),
        ({"title": "a"}, "title: it has 1 characters, and needs at least 2; add what is missing"),
        ({"code": "x"}, r"write it as the pattern ^\d$ says"),
        ({"when": "lte"}, "when: 'lte' is not 'late' or 'early'; did you mean 'late'?"),
        ({"when": "xyz"}, "give 'late' or 'early'"),
        ({"count": "1"}, "count: '1' is not a whole number; give a whole number"),
        ({"count": 1.5}, "count: 1.5 is not a whole number; give a whole number"),
        ({"is_old": 1}, "is_old: 1 is not true or false; give true or false"),
        ({"parts": []}, "parts: it has 0 entries, and needs at least 1"),
        ({"parts": [{"kind": "twig"}] * 3}, "parts: it has 3 entries, and needs at most 2; shorten it"),
        ({"parts": {}}, "parts: {} is not a list in square brackets"),
        ({"parts": [{}]}, "parts.0.kind: is missing; add kind"),
        ({"parts": [{"kind": "lef"}]}, "parts.0.kind: there is no kind 'lef'; did you mean 'leaf'?"),
        ({"parts": [{"kind": 5}]}, "parts.0.kind: there is no kind '5'; kind: leaf, twig"),
        ({"parts": [{"kind": "leaf", "size": 0.0}]}, "parts.0.size: 0.0 is not greater than 0"),
        ({"parts": [{"kind": "leaf", "size": float("nan")}]}, "parts.0.size: nan is not a finite number"),
    ],
)
def test_each_fault_is_told_once_in_plain_words(given: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError) as caught:
        validate(given, Tree, source="tree.toml")
    (fault,) = caught.value.details["faults"]
    assert told in fault
