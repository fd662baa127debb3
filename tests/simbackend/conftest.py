"""One world for the whole package: starting one takes a second."""

from collections.abc import Iterator

import pytest

from tests.simbackend.rig import SimCell, sim_cell


@pytest.fixture(scope="package")
def bench() -> Iterator[SimCell]:
    """The bench cell; tests leave its arm at rest and its panel as they like."""
    with sim_cell() as cell:
        yield cell
