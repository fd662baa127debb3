"""`panelwright warm`: compile everything once, so that the first mission is as fast as the second."""

from __future__ import annotations

import time
from concurrent.futures import Future, ProcessPoolExecutor, wait
from multiprocessing import get_context

from service.commands.common import DEFAULT_CELL, CellOption, console, read_cell

PROCESSES = 2
REMINDER_S = 20.0


def warm(cell: CellOption = DEFAULT_CELL) -> None:
    """Compile the hot loops and keep them on disk; `make setup` does this. Takes a minute or two, later seconds."""
    from service.processes.supervisor import Supervisor
    from service.warm import STAGES, run_stage

    started_s = time.monotonic()

    def report(stage: str) -> None:
        console.print(f"warm: {stage} ready after {time.monotonic() - started_s:.0f} s")

    def report_ended(stage: Future[str]) -> None:
        if stage.exception() is None:
            report(stage.result())

    with ProcessPoolExecutor(PROCESSES, mp_context=get_context("spawn")) as pool:
        stages = [pool.submit(run_stage, name) for name in STAGES]
        for stage in stages:
            stage.add_done_callback(report_ended)
        supervisor = Supervisor(read_cell(cell, None))
        try:
            supervisor.start()  # beside the pool: its own processes compile the control loop and the world
        finally:
            supervisor.close()
        report("control and simulation")
        waiting = set(stages)
        while waiting:
            _, waiting = wait(waiting, timeout=REMINDER_S)
            names = [name for name, stage in zip(STAGES, stages, strict=True) if stage in waiting]
            if names:
                console.print(f"warm: at work on {', '.join(names)} ({time.monotonic() - started_s:.0f} s)")
        for stage in stages:
            stage.result()
