"""Tells whoever supervises this process that it is about to do work during which none of its threads can run.

The compiler of the kernels holds the lock of Python for seconds, and importing a large library for tenths of a second. A
process that has said so is not taken for one that hangs.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_lock = threading.Lock()
_tellers: list[Callable[[bool], None]] = []
_depth = 0


def tell(teller: Callable[[bool], None]) -> Callable[[], None]:
    """Call `teller` with True when a pause begins and with False when the last one has ended; returns what ends this."""
    with _lock:
        _tellers.append(teller)

    def end() -> None:
        with _lock:
            if teller in _tellers:
                _tellers.remove(teller)

    return end


def begin() -> None:
    """Begin a pause; pauses of several threads may overlap."""
    _count(1)


def end() -> None:
    """End a pause."""
    _count(-1)


@contextmanager
def declared() -> Iterator[None]:
    """Declare a pause for the time of a block."""
    begin()
    try:
        yield
    finally:
        end()


def _count(change: int) -> None:
    global _depth
    with _lock:
        before, _depth = _depth, _depth + change
        if (before > 0) != (_depth > 0):
            for teller in _tellers:
                teller(_depth > 0)
