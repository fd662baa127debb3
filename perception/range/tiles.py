"""Division of an image into horizontal tiles, whose pixels are processed in parallel."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def tile_rows(rows: int, tiles: int) -> list[tuple[int, int]]:
    """Return the row ranges [top, bottom) of at most `tiles` horizontal tiles, none of them empty."""
    count = min(max(tiles, 1), max(rows, 1))
    return [(rows * k // count, rows * (k + 1) // count) for k in range(count)]


def for_each_tile(
    work: Callable[[int, int], object], rows: int, tiles: int, *, pool: ThreadPoolExecutor | None
) -> None:
    """Call `work(top, bottom)` for every tile, on the threads of `pool` if there is one."""
    if tiles == 1:
        work(0, rows)
        return
    ranges = tile_rows(rows, tiles)
    if pool is None or len(ranges) == 1:
        for top, bottom in ranges:
            work(top, bottom)
        return
    for done in [pool.submit(work, top, bottom) for top, bottom in ranges]:
        done.result()
