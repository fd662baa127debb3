"""Tests of the link to the world process: a world of another format is not used."""

from __future__ import annotations

import pytest

from simbackend.link import complaint_of
from simbackend.wire import REQUEST, SNAPSHOT


@pytest.mark.parametrize("answer", [(REQUEST, SNAPSHOT + 1), (REQUEST - 1, SNAPSHOT), None])
def test_a_world_whose_vectors_have_another_length_is_refused(answer: object) -> None:
    told = complaint_of(answer)
    assert told is not None and str(answer) in told and str(SNAPSHOT) in told


def test_a_world_that_says_why_it_did_not_start_is_quoted_and_one_of_the_same_format_is_used() -> None:
    assert complaint_of("ConfigError: no panel") == "ConfigError: no panel"
    assert complaint_of((REQUEST, SNAPSHOT)) is None
