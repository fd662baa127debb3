"""`python -m tests.service.chaos.served CELL PORT STOP_PORT RUNS`: serves a cell of fakes with the verbs of the tests."""

from __future__ import annotations

import sys
from pathlib import Path

from hal.config import load_cell
from service.commands.serve import run_to_end
from service.serve import Options, Panelwright
from tests.service.verbs import OPERATIONS

if __name__ == "__main__":
    cell, port, stop_port, runs = sys.argv[1:]
    options = Options(port=int(port), stop_port=int(stop_port), runs_dir=Path(runs), warm=False)
    run_to_end(Panelwright(load_cell(Path(cell)), options, operations=OPERATIONS))
