"""Limits the heaps among which the C library divides what a process allocates."""

from __future__ import annotations

import ctypes

_M_ARENA_MAX = -8  # malloc.h of glibc


def share_one_heap() -> None:
    """Let all threads of this process allocate from one heap; to be called before the threads begin.

    By default glibc opens a heap, called an arena, for each thread until there are eight per core. Each keeps what its thread
    freed for later, up to its own greatest need. A process of many threads that handle images so holds memory that it does not
    use, and how much depends on which thread had which image: the bench cell held 36 to 54 MB beside the 53 MB that it used.
    With one heap it holds 17 MB. Where the C library has no such limit, this does nothing.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, 1)
