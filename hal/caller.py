"""Names the program part on whose behalf a call is made; `hal.host` passes the name on to the other process.

A recording uses it to tell the calls of a task from those of pages and checks that look at the same devices.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_caller: ContextVar[str] = ContextVar("caller", default="")


def caller() -> str:
    """Return the name of the present thread's caller; empty when nobody has set one."""
    return _caller.get()


@contextmanager
def calling_as(name: str) -> Iterator[None]:
    """Make the calls of this thread in the name of `name`."""
    token = _caller.set(name)
    try:
        yield
    finally:
        _caller.reset(token)
