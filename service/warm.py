"""Compiles or loads the hot loops before somebody waits for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping


def _imports() -> None:
    from importlib import import_module

    # Everything that a mission computes, plans and draws with.
    for name in ("service.operations.mission", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        import_module(name)


def _vision() -> None:
    from perception.vision import warm_up

    warm_up()


def _range() -> None:
    from perception.range import warm_up

    warm_up()


def _fusion() -> None:
    from fusion import warm_up

    warm_up()


def _planning() -> None:
    from manipulation import warm_up

    warm_up()


STAGES: Mapping[str, Callable[[], None]] = {
    "imports": _imports,
    "range": _range,
    "vision": _vision,
    "fusion": _fusion,
    "planning": _planning,
}
"""What the service process computes with. The cell and world processes warm their own loops when they start."""


def warm() -> None:
    """Run each stage in this process. The first time on a machine this compiles for minutes; the result stays on disk."""
    for name in STAGES:
        run_stage(name)


def run_stage(name: str) -> str:
    """Run one stage of `STAGES`; returns its name, so that a pool can tell which one has ended."""
    STAGES[name]()
    return name
