"""All threads of a process allocate from its one heap."""

from __future__ import annotations

import ctypes
import subprocess
import sys

import pytest

from hal import malloc_arenas

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


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "gnu_get_libc_version"), reason="the C library is not glibc")
@pytest.mark.parametrize(("call", "in_the_heap"), [("share_one_heap()", "20"), ("", "0")])
def test_another_thread_allocates_from_the_one_heap(call: str, in_the_heap: str) -> None:
    program = ALLOCATES.format(call=call)
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert told.stdout.strip() == in_the_heap


def test_a_c_library_without_the_limit_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(malloc_arenas.ctypes, "CDLL", lambda _name: object())
    malloc_arenas.share_one_heap()
