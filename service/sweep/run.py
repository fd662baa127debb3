"""Runs the deeds of one random panel on a server of its own, through the HTTP API."""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from hal.config import load_cell
from hal.errors import CellError
from service.serve import Options, Panelwright
from service.sweep.ask import PanelRun, asked_of
from service.sweep.files import write_files
from service.sweep.options import SweepOptions

log = logging.getLogger(__name__)


def run_panel(seed: int, options: SweepOptions, tell: Callable[[str], None] = lambda _line: None) -> PanelRun:
    """Run and judge the deeds of the panel of a seed; `tell` gets a line for each of them."""
    started_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="panelwright-sweep-") as folder:
        cell = load_cell(write_files(seed, options.cell, Path(folder)), seed=seed)
        panelwright = Panelwright(cell, Options(port=0, runs_dir=Path(folder) / "runs", inline=options.inline))
        try:
            panelwright.start()
            asked = asked_of(panelwright, seed, known_pose=options.known_pose, is_wanted=options.wants)
            done = asked.in_one_mission() if options.mission else asked.one_by_one(tell)
        except CellError as error:
            return PanelRun(seed=seed, deeds=(), problem=f"{error.type_name}: {error.what}")
        except Exception as defect:  # a defect on one panel must not cost the others
            log.exception("panel %d", seed)
            return PanelRun(seed=seed, deeds=(), problem=f"Defect: {type(defect).__name__}: {defect}")
        finally:
            panelwright.close()
    return replace(done, wall_s=time.monotonic() - started_s)
