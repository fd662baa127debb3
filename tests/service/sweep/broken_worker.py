"""What a sweep runs in the tests of broken workers; a module of its own, because workers import it by its name."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from service.sweep.ask import PanelRun
from service.sweep.options import SweepOptions

DIES = "PANELWRIGHT_TEST_DIES_ONCE"  # file of which the first worker that takes it dies


def run_or_die(seed: int, options: SweepOptions) -> PanelRun:
    """Return an empty panel; with seed 3, the first worker is killed in the middle of it."""
    if seed == 3:
        try:
            Path(os.environ[DIES]).unlink()
        except FileNotFoundError:
            pass
        else:
            os.kill(os.getpid(), signal.SIGKILL)
    return PanelRun(seed=seed, deeds=(), cell_s=float(os.getpid()))
