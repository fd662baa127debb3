"""All threads of a process allocate from its one heap, and what is free in it goes back to the operating system."""

from __future__ import annotations

import ctypes
import subprocess
import sys
import weakref

import pytest

from hal import malloc_arenas

IS_GLIBC = hasattr(ctypes.CDLL(None), "gnu_get_libc_version")
ALLOCATES = """
import ctypes
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from hal.malloc_arenas import share_one_heap

{call}
malloc = ctypes.CDLL(None).malloc
malloc.restype, malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
with ThreadPoolExecutor(1) as other_thread:
    addresses = [other_thread.submit(malloc, 100_000).result() for _ in range(20)]
line = next(line for line in Path("/proc/self/maps").read_text().splitlines() if line.endswith("[heap]"))
first, last = (int(end, 16) for end in line.split()[0].split("-"))
print(sum(first <= address < last for address in addresses))
"""

FREES = """
import ctypes
import psutil
from hal.malloc_arenas import return_free_memory

BLOCK, COUNT = 100_000, 400
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]
def held_mb():
    return psutil.Process().memory_info().rss / 1e6
before = held_mb()
blocks = [libc.malloc(BLOCK) for _ in range(COUNT)]
for block in blocks:
    ctypes.memset(block, 1, BLOCK)
for block in blocks[:-1]:  # the last one keeps the heap from being cut
    libc.free(block)
freed = held_mb() - before
return_free_memory()
print(freed, held_mb() - before)
"""


@pytest.mark.skipif(not IS_GLIBC, reason="the C library is not glibc")
@pytest.mark.parametrize(("call", "in_the_heap"), [("share_one_heap()", "20"), ("", "0")])
def test_another_thread_allocates_from_the_one_heap(call: str, in_the_heap: str) -> None:
    program = ALLOCATES.format(call=call)
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert told.stdout.strip() == in_the_heap


def test_garbage_in_cycles_is_collected() -> None:
    class Owner:
        own: Owner

    owner = Owner()
    owner.own = owner
    garbage = weakref.ref(owner)
    del owner
    assert garbage() is not None
    malloc_arenas.return_free_memory()
    assert garbage() is None


@pytest.mark.skipif(not IS_GLIBC, reason="the C library is not glibc")
def test_memory_that_is_free_below_a_used_block_is_returned() -> None:
    told = subprocess.run([sys.executable, "-c", FREES], capture_output=True, text=True, check=True, timeout=60)
    freed_mb, returned_mb = (float(number) for number in told.stdout.split())
    assert freed_mb > 35.0
    assert returned_mb < 5.0


def test_a_c_library_without_these_functions_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(malloc_arenas.ctypes, "CDLL", lambda _name: object())
    malloc_arenas.share_one_heap()
    malloc_arenas.return_free_memory()
