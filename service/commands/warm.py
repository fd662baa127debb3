"""`panelwright warm`: compiles the kernels, which is also done before any command that needs them."""

from __future__ import annotations

import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from service.commands.common import console
from service.commands.shutdown import one_interrupt

WORDS = "compiling"
ONCE = "once per installation"
TICK_S = 10.0
err_console = Console(stderr=True, highlight=False, soft_wrap=True)


def warm() -> None:
    """Compile all kernels and store them on disk, so that the first mission is as fast as later ones."""
    started_s = time.monotonic()
    _compile()
    console.print(f"all kernels are compiled ({time.monotonic() - started_s:.0f} s)")


def compile_first() -> None:
    """Compile kernels that are not compiled yet, with progress on standard error; usually there are none."""
    from service.compiling import is_compiled

    if not is_compiled():
        _compile()


def _compile() -> None:
    from service.compiling import compile_kernels

    err_console.print("looking for kernels that are not compiled yet")
    with one_interrupt():
        if not err_console.is_terminal:
            compile_kernels(Lines().tell)
            return
        columns = (TextColumn(WORDS), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn(ONCE))
        with Progress(*columns, console=err_console, transient=True) as progress:
            bar = progress.add_task(WORDS, total=None)
            compile_kernels(lambda done, total: progress.update(bar, completed=done, total=total))


class Lines:
    """Prints progress without a terminal, one line every few seconds."""

    def __init__(self) -> None:
        self._told_s = -TICK_S

    def tell(self, done: int, total: int) -> None:
        """Print a line unless one was printed just before."""
        if time.monotonic() - self._told_s >= TICK_S:
            self._told_s = time.monotonic()
            err_console.print(f"{WORDS} {done} of {total} kernels, {ONCE}")
