"""Excludes objects that live as long as the process from garbage collection."""

from __future__ import annotations

import gc


def freeze_loaded() -> None:
    """Exclude every existing object from later collections; to be called when a process has loaded its libraries.

    A full collection visits every object of every library and holds the interpreter lock meanwhile. Without this, it
    stops all threads of a cell process for 46 ms and of a service process for 108 ms of computing time, about twice per
    minute, and for twice as long on a busy machine.
    """
    gc.freeze()
