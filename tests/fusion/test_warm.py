"""The hot loops are compiled before somebody waits for them."""

from __future__ import annotations

from fusion import warm_up


def test_warming_up_twice_is_harmless() -> None:
    warm_up()
    warm_up()
