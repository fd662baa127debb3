"""Python's cycle collector holds the interpreter: what lives as long as the process need not be searched again."""

from __future__ import annotations

import gc


def set_aside() -> None:
    """Take everything that lives now out of all later collections; called when a process has loaded what it needs.

    A full collection walks every object of every library. It stopped all threads of a cell process for 46 ms and of a
    service process for 108 ms of computing time, some twice a minute, and on a busy machine for twice as long.
    """
    gc.freeze()
