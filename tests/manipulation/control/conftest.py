"""A controller with a simulated world, for the tests of this folder."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.manipulation.rig import Rig, make_rig


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = make_rig()
    yield rig
    rig.controller.close()
