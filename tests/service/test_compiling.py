"""Stages of compiling run in parallel, report their end and their faults, and nothing is done twice."""

from __future__ import annotations

from pathlib import Path

import pytest

from hal import kernel_cache
from service import compiling
from service.compiling import compile_kernels, is_compiled
from service.errors import Defect
from service.warm import survey

WORKER = """
import sys, time
from pathlib import Path
folder = Path({folder!r})
stage = sys.argv[1]
if stage == "survey":
    print("kernel.a-1\\nkernel.b-1", flush=True)
elif stage == "bad":
    sys.exit(3)
else:
    (folder / (stage + "-started")).touch()
    other = folder / ({{"a": "b", "b": "a"}}[stage] + "-started")
    until_s = time.monotonic() + 60.0
    while not other.exists() and time.monotonic() < until_s:
        time.sleep(0.01)
    (folder / ("kernel." + stage + "-1" + {ending!r})).touch()
    sys.exit(0 if other.exists() else 4)
"""


@pytest.fixture
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder of kernels, with workers that only write files there; `a` and `b` wait for each other."""
    folder = tmp_path / "kernels"
    folder.mkdir()
    (tmp_path / "worker_of_test.py").write_text(WORKER.format(folder=str(folder), ending=kernel_cache.ENDINGS[0]))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(kernel_cache, "folder", lambda: folder)
    monkeypatch.setattr(compiling, "WORKER", "worker_of_test")
    return folder


def test_stages_run_side_by_side_and_the_second_time_nothing_runs(kernels: Path) -> None:
    told: list[tuple[int, int]] = []
    assert not is_compiled()
    compile_kernels(lambda done, total: told.append((done, total)), stages=["a", "b"], cores=2)
    assert told[0] == (0, 2)
    assert sorted(told) == told
    assert is_compiled()
    compile_kernels(lambda *_: pytest.fail("nothing is missing"), stages=["bad"], cores=1)


def test_a_stage_that_fails_is_told_and_tried_again_the_next_time(kernels: Path) -> None:
    with pytest.raises(Defect, match="bad ended with exit code 3"):
        compile_kernels(lambda *_: None, stages=["bad"], cores=1)
    assert not is_compiled()


def test_the_survey_names_a_kernel_of_every_room_that_has_some() -> None:
    names = [name.partition("-")[0] for name in survey()]
    for module in ("kernels", "raster", "search", "fit"):  # of planning and world, fusion, vision and range
        assert any(name.startswith(f"{module}.") for name in names), module


@pytest.mark.skipif(not is_compiled(), reason="kernels were edited after `panelwright warm`")
def test_warming_compiles_every_kernel_there_is() -> None:
    """A kernel that nothing calls would be looked for in every later run."""
    assert kernel_cache.missing(survey()) == set()
