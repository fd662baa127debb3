"""Compiles or loads the kernels before they are needed.

`service.compiling` runs this module as a worker process: `python -m service.warm STAGE`, or `survey`.
"""

from __future__ import annotations

import hashlib
import sys
import threading
from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from pathlib import Path

from service.processes.child import Lifeline, kill_own_group

ROOT = Path(__file__).parents[1]
ROOMS = ("fusion", "hal", "manipulation", "perception", "simbackend")
SURVEY = "survey"


def load_modules() -> None:
    """Import every module with which a mission computes, plans and draws.

    Call it before the threads that compute start. A module with kernels that is imported holds the lock of its import and
    may wait for the compiler's; a thread that compiles holds the compiler's lock and imports.
    """
    for name in (
        "service.operations.mission",
        "scipy.interpolate",
        "matplotlib.figure",
        "matplotlib.backends.backend_agg",
    ):
        import_module(name)
    _warm_ups()


def _warm_ups() -> dict[str, Callable[[], None]]:
    """Return each stage of the service process with its function, whose modules are imported with it, the longest first.

    The cell and world processes load their own kernels when they start.
    """
    import fusion
    import manipulation
    import perception.range
    import perception.vision

    return {
        "range": perception.range.warm_up,
        "vision": perception.vision.warm_up,
        "fusion": fusion.warm_up,
        "planning": manipulation.warm_up,
    }


def _warm_up(stage: str) -> None:
    _warm_ups()[stage]()


def _cell() -> None:
    """Start the simulated bench: control loop and world compile their own kernels when they start."""
    from hal.config import load_cell
    from service.processes.supervisor import Supervisor

    supervisor = Supervisor(load_cell(ROOT / "cells" / "bench.toml"))
    try:
        supervisor.start()
    finally:
        supervisor.close()


OF_SERVICE = ("range", "vision", "fusion", "planning")
STAGES: Mapping[str, Callable[[], None]] = {
    **{stage: partial(_warm_up, stage) for stage in OF_SERVICE},
    "cell": _cell,
    "imports": load_modules,
}
"""The stages that can be compiled in parallel, the longest first."""


def warm() -> None:
    """Load the kernels of the service process into it, after `load_modules`, and compile those that are not compiled yet."""
    for stage in OF_SERVICE:
        STAGES[stage]()


def sources() -> list[Path]:
    """Return the files that hold compiled kernels or determine how kernels are compiled."""
    files = sorted(file for room in ROOMS for file in (ROOT / room).rglob("*.py"))
    return [file for file in files if b"numba" in (text := file.read_bytes()) or b"hal.jit" in text]


def hash_of_sources() -> str:
    """Return a hash of the kernels' files and Python's version, which tells whether everything was compiled before."""
    digest = hashlib.sha256(sys.version.encode())
    for file in sources():
        digest.update(file.relative_to(ROOT).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()


def survey() -> tuple[str, ...]:
    """Import every module that holds kernels, and return the names under which the kernels are kept."""
    from hal.kernel_cache import expected

    for file in sources():
        import_module(".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"))
    return expected()


def main() -> None:
    """Run one stage, or print the names of all kernels; end when the parent ends."""
    lifeline = Lifeline()

    def end_with_parent() -> None:
        lifeline.wait_for_end()
        kill_own_group()

    threading.Thread(target=end_with_parent, daemon=True).start()
    stage = sys.argv[1]
    if stage == SURVEY:
        for name in survey():
            lifeline.write_line(name)
    else:
        STAGES[stage]()


if __name__ == "__main__":
    main()
