"""Warming up runs the hot loops on realistic data."""

from __future__ import annotations

import subprocess
import sys

import pytest

from perception.vision import warm as vision
from perception.vision.photographs.photo_display import read_photographed_display
from service.warm import STAGES

IMPORTED = """
import sys
from service.warm import load_modules, sources, warm
load_modules()
before = set(sys.modules)
warm()
kernels = {str(path) for path in sources()}
print([name for name in sorted(set(sys.modules) - before) if getattr(sys.modules[name], "__file__", None) in kernels])
"""


def test_the_thread_that_loads_kernels_imports_no_module_that_may_hold_some() -> None:
    found = subprocess.run([sys.executable, "-c", IMPORTED], capture_output=True, text=True, timeout=300, check=False)
    assert (found.stdout.strip(), found.returncode) == ("[]", 0), found.stderr


@pytest.mark.parametrize("stage", ["planning", "vision"])
def test_a_stage_runs_through(stage: str) -> None:
    STAGES[stage]()


def test_the_picture_that_warms_the_display_reader_is_read() -> None:
    assert read_photographed_display(vision.three_eights(), scene=True).text == "88.8"


def test_a_service_starts_without_the_libraries_that_only_computing_needs() -> None:
    """Each of them takes 0.1 to 1 s of the processor, which a service that was killed does not have until it is back."""
    heavy = ("scipy.stats", "scipy.interpolate", "scipy.optimize", "cv2", "matplotlib", "pybullet", "pandas")
    code = f"import sys, service.serve, service.http.app; print([name for name in {heavy} if name in sys.modules])"
    told = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "[]"


def test_a_command_begins_without_the_libraries_that_only_some_commands_need() -> None:
    """`panelwright stop` is as fast as the slowest of these imports lets it be, because every command is imported first."""
    heavy = ("numpy", "scipy", "cv2", "PIL", "fastapi", "service.core", "service.schema.results")
    code = f"import sys, service.cli; service.cli._app(); print([name for name in {heavy} if name in sys.modules])"
    told = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "[]"


FIRST_CALL = """
import sys
import numpy as np
from hal.jit import load_builtins
from manipulation.planning.timing_kernels import distances
{load}
before = set(sys.modules)
distances(np.ones(5), 0.1, 0.01)
print(len([name for name in set(sys.modules) - before if name.startswith("numba.")]))
"""


def test_the_first_call_of_a_kernel_loads_nothing_of_numba_that_was_loaded_before() -> None:
    def imported(load: str) -> int:
        code = FIRST_CALL.format(load=load)
        return int(
            subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True).stdout
        )

    assert (imported("load_builtins()"), imported("") > 0) == (0, True)
