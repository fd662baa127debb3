"""Compiles all kernels once per installation on all cores, and reports the progress."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from queue import Empty, SimpleQueue

from hal import kernel_cache
from service.errors import Defect
from service.processes.child import Child
from service.warm import STAGES, SURVEY, hash_of_sources

LOOK_S = 0.25
WORKER = "service.warm"
Tell = Callable[[int, int], None]
"""Called several times per second with the number of compiled kernels and the number of all kernels."""


def is_compiled() -> bool:
    """Return whether all kernels were compiled from the present sources; takes a few hundredths of a second."""
    return _marker().is_file()


def compile_kernels(tell: Tell, *, stages: Iterable[str] = STAGES, cores: int | None = None) -> None:
    """Compile the kernels that are not compiled yet; returns within seconds when there are none.

    Args:
        stages: stages of `service.warm` to run, each in its own process.
        cores: number of stages that run at a time; the number of cores of this machine when not given.

    Raises:
        Defect: a stage failed.
    """
    names: list[str] = []
    _run([SURVEY], 1, on_line=names.append, on_look=lambda: None)
    if kernel_cache.missing(names):
        _run(
            list(stages),
            cores or len(os.sched_getaffinity(0)),
            on_line=lambda _line: None,
            on_look=lambda: tell(len(names) - len(kernel_cache.missing(names)), len(names)),
        )
    kernel_cache.bound_size()
    _marker().touch()


def _marker() -> Path:
    return kernel_cache.folder() / f"complete-{hash_of_sources()[:24]}"


def _run(stages: list[str], cores: int, *, on_line: Callable[[str], None], on_look: Callable[[], None]) -> None:
    """Run the stages in child processes, `cores` at a time, until all have ended; an error ends all of them."""
    waiting, running = stages[::-1], dict[str, Child]()
    ended: SimpleQueue[tuple[str, int]] = SimpleQueue()

    def begin() -> None:
        stage = waiting.pop()
        running[stage] = Child(WORKER, [stage], on_line=on_line, on_exit=lambda code: ended.put((stage, code)))

    try:
        while waiting or running:
            while waiting and len(running) < cores:
                begin()
            on_look()
            try:
                stage, code = ended.get(timeout=LOOK_S)
            except Empty:
                continue
            running.pop(stage).kill()
            if code:
                raise Defect(
                    f"compiling stopped: {stage} ended with exit code {code}",
                    hint="the lines above say why; `panelwright warm` tries it again",
                )
    finally:
        for child in running.values():
            child.kill()
