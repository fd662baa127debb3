"""One world for all tests of the package, because starting one takes a second."""

from collections.abc import Iterator

import pytest

from tests.simbackend.rig import SimCell, sim_cell


@pytest.fixture(scope="package")
def bench() -> Iterator[SimCell]:
    """Yield the bench cell; every test must leave the arm at rest, but may leave the panel in any state."""
    with sim_cell() as cell:
        yield cell
