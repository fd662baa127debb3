"""A body with a number that is not finite is refused even where its model sets no bounds."""

from __future__ import annotations

import pytest
from pydantic import BaseModel

from service.http.body import parse
from service.http.problems import BadBody


class Row(BaseModel):
    """A model that, unlike ours (`hal.strict.Strict`), takes infinity."""

    values: list[float] = []
    inner: dict[str, tuple[float, ...]] = {}


def test_finite_numbers_are_let_in() -> None:
    assert parse(b'{"values": [1e300, -0.0], "inner": {"a": [2]}}', Row).values == [1e300, 0.0]


@pytest.mark.parametrize("number", [b"NaN", b"Infinity", b"-Infinity", b"1e400", b"-1e400"])
@pytest.mark.parametrize("body", [b'{"values": [0.0, %s]}', b'{"inner": {"a": [%s]}}'])
def test_a_number_that_is_not_finite_is_refused_wherever_it_stands(body: bytes, number: bytes) -> None:
    with pytest.raises(BadBody) as caught:
        parse(body % number, Row)
    assert caught.value.status in (400, 422)
