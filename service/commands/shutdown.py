"""Ends the process of a command in a controlled way."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

INTERRUPTED = 128 + signal.SIGINT  # the exit code that shells report for a program ended by Ctrl-C


def leave(code: int) -> NoReturn:
    """End this process at once. Everything is closed already, but a computing thread could delay a normal exit."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


@contextmanager
def one_interrupt() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt only once, so that a second one does not interrupt the closing.

    Use it in the main thread only, as all signal handling.
    """

    def first(_number: int, _frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, first)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
