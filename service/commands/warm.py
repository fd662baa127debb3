"""`panelwright warm`: compile everything once, so that the first mission is as fast as the second."""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

from service.commands.common import DEFAULT_CELL, CellOption, console, read_cell

PROCESSES = 2


def warm(cell: CellOption = DEFAULT_CELL) -> None:
    """Compile the hot loops and keep them on disk; `make setup` does this. Takes a minute or two, later seconds."""
    from service.supervisor import Supervisor
    from service.warm import STAGES, run_stage

    started_s = time.monotonic()

    def report(stage: str) -> None:
        console.print(f"warm: {stage} ready after {time.monotonic() - started_s:.0f} s")

    with ProcessPoolExecutor(PROCESSES, mp_context=get_context("spawn")) as pool:
        for ended in as_completed([pool.submit(run_stage, name) for name in STAGES]):
            report(ended.result())
    supervisor = Supervisor(read_cell(cell, None))
    try:
        supervisor.start()
    finally:
        supervisor.close()
    report("control and simulation")
