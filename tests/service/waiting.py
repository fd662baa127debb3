"""Waits for results of other processes, without fixed pauses."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


def eventually(probe: Callable[[], T], *, timeout_s: float = 150.0) -> T:
    """Return the first true answer of `probe`; fail if none comes in time. Missing files count as no answer."""
    end_s = time.monotonic() + timeout_s
    pause = threading.Event()
    while True:
        try:
            answer = probe()
        except FileNotFoundError:
            answer = None  # not there yet
        if answer:
            return answer
        if time.monotonic() > end_s:
            raise AssertionError(f"never became true: {probe}")
        pause.wait(0.01)
