"""`panelwright warm`: compile everything once, so that the first mission is as fast as the second."""

from __future__ import annotations

import time

from service.commands.common import DEFAULT_CELL, CellOption, console, read_cell


def warm(cell: CellOption = DEFAULT_CELL) -> None:
    """Compile the hot loops and keep them on disk; `make setup` does this. Takes a minute or two, later a second."""
    from service.supervisor import Supervisor
    from service.warm import warm as warm_all

    started_s = time.monotonic()
    warm_all(lambda stage: console.print(f"warm: {stage}"))
    console.print("warm: control and simulation")
    supervisor = Supervisor(read_cell(cell, None))
    try:
        supervisor.start()
    finally:
        supervisor.close()
    console.print(f"warm: done in {time.monotonic() - started_s:.1f} s")
