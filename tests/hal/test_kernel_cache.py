"""Compiled kernels are reused if and only if their sources are the same."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hal import kernel_cache

CALLEE = """
from hal.jit import compiled, inlined
FACTOR = {factor}

@inlined
def doubled(x: float) -> float:
    return {doubled} * x
"""
CALLER = """
import sys
from hal import kernel_cache
from hal.jit import compiled
from numba.core import event
from callee import FACTOR, doubled

@compiled
def product(x: float) -> float:
    return FACTOR * doubled(x)

before = len(kernel_cache.missing(kernel_cache.expected()))
with event.install_recorder("numba:compile") as compiling:
    answer = product(1.0)
mine = [1 for _, e in compiling.buffer if e.is_start and e.data["dispatcher"] is product]
print(answer, "compiled" if mine else "kept", before, len(kernel_cache.missing(kernel_cache.expected())))
"""


class Project:
    """Two modules with kernels, which are run in separate processes with their own folder of compiled kernels."""

    def __init__(self, folder: Path, kernels: Path) -> None:
        self.folder, self.kernels = folder, kernels
        folder.mkdir()
        self.write()

    def write(self, *, factor: str = "3.0", doubled: str = "2.0", head: str = "") -> None:
        """Write the sources."""
        (self.folder / "callee.py").write_text(CALLEE.format(factor=factor, doubled=doubled))
        (self.folder / "caller.py").write_text(head + CALLER)

    def run(self) -> list[str]:
        """Call the kernel; return its result, whether it was compiled, and the kernels missing before and after."""
        # A command that another test of this process ran may have asked for a path without the script's folder.
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(self.kernels), "PYTHONSAFEPATH": ""}
        done = subprocess.run(
            [sys.executable, "caller.py"], cwd=self.folder, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.split()


@pytest.fixture
def project(tmp_path: Path) -> Project:
    made = Project(tmp_path / "one", tmp_path / "kernels")
    assert made.run() == ["6.0", "compiled", "1", "0"]
    return made


def test_the_same_sources_in_another_folder_are_not_compiled_again(project: Project, tmp_path: Path) -> None:
    assert project.run() == ["6.0", "kept", "0", "0"]
    assert Project(tmp_path / "two", project.kernels).run() == ["6.0", "kept", "0", "0"]


def test_a_change_in_a_helper_or_a_constant_of_another_file_compiles_the_caller_again(project: Project) -> None:
    project.write(doubled="20.0")
    assert project.run() == ["60.0", "compiled", "1", "0"]
    project.write(factor="5.0")
    assert project.run() == ["10.0", "compiled", "1", "0"]
    project.write()
    assert project.run() == ["6.0", "kept", "0", "0"]  # both versions stay


def test_empty_and_cut_off_files_are_compiled_again(project: Project) -> None:
    files = sorted(project.kernels.glob("caller.product*"))
    assert [file.suffix for file in files] == [".nbc", ".nbi"]
    for file in files:
        whole = file.read_bytes()
        for damaged in (b"", whole[: len(whole) // 2]):
            file.write_bytes(damaged)
            assert project.run()[:2] == ["6.0", "compiled"]


def test_without_a_folder_to_write_to_kernels_still_run(project: Project, tmp_path: Path) -> None:
    in_the_way = tmp_path / "file"
    in_the_way.write_text("")
    project.kernels = in_the_way / "kernels"
    assert project.run() == ["6.0", "compiled", "1", "0"]


def test_the_oldest_files_go_when_the_folder_is_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache, "folder", lambda: tmp_path)
    for age, name in enumerate(("new.nbc", "middle.nbc", "old.nbc")):
        (tmp_path / name).write_bytes(bytes(10))
        os.utime(tmp_path / name, (1000 - age, 1000 - age))
    (tmp_path / "notes.txt").write_bytes(bytes(100))
    kernel_cache.bound_size(20)
    assert {file.name for file in tmp_path.iterdir()} == {"new.nbc", "middle.nbc", "notes.txt"}
