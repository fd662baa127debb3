"""Values written as TOML are read back unchanged, and comments of an edited text are preserved."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.toml_text import toml_edited, toml_text

NAMES = st.text(st.characters(categories=["L", "N"]), min_size=1, max_size=8)
VALUES = st.one_of(
    st.text(), st.booleans(), st.integers(-(2**62), 2**62), st.floats(allow_nan=False, allow_infinity=False)
)
LISTS = st.lists(VALUES, max_size=4)
INLINE = st.dictionaries(st.text(min_size=1), st.one_of(VALUES, LISTS), max_size=4)
ROWS = st.lists(st.dictionaries(NAMES, st.one_of(VALUES, LISTS, INLINE), max_size=4), min_size=1, max_size=3)
DOCUMENTS = st.dictionaries(NAMES, st.one_of(VALUES, LISTS, INLINE, ROWS), max_size=6)

EDITED = """\
# measured by hand
version = 1  # counted up

[mount]  # on the flange
position_m = [0.1, 0.0, 0.2]  # with a rule
rpy_rad = [0.0, 0.0, 0.0]

[[lights]]
name = "a"  # the left one
"""


@given(DOCUMENTS)
def test_what_is_written_is_read_back(data: dict[str, Any]) -> None:
    back = tomllib.loads(toml_text(data, remarks=["a remark"]))
    assert back == data
    assert repr(sorted(back.items())) == repr(sorted(data.items())), "1 and 1.0 and True are three values"


@given(DOCUMENTS, DOCUMENTS)
def test_an_edited_text_says_the_new_values_and_nothing_else(before: dict[str, Any], after: dict[str, Any]) -> None:
    assert tomllib.loads(toml_edited(toml_text(before), after)) == after


def test_an_edited_text_keeps_its_comments() -> None:
    data = tomllib.loads(EDITED)
    data["version"] = 2
    data["mount"]["rpy_rad"] = [0.0, 0.0, 0.5]
    data["lights"].append({"name": "b\nc"})
    text = toml_edited(EDITED, data)
    assert tomllib.loads(text) == data
    for comment in ("# measured by hand", "# counted up", "# on the flange", "# with a rule", "# the left one"):
        assert comment in text


def test_what_is_no_toml_cannot_be_edited() -> None:
    with pytest.raises(ValueError):
        toml_edited("a = [", {"a": 1})
