"""Runs emulators in a process of their own, so that their work is not measured as the drivers'.

`python -m benchmarks.drivers.far_process NAME[?KEY=VALUE]..` prints a line of addresses. Then each line of its input is
a command: `inject silent|disconnected|none`, `log NAME` (prints when its frames were sent), `count NAME COUNTER`,
`end`.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from benchmarks.drivers.benches import bench
from hal.gc_freeze import freeze_loaded
from hal.simulated import Fault


class FarProcess:
    """Controls the process of the emulators."""

    def __init__(self, names: tuple[str, ...]) -> None:
        command = [sys.executable, "-m", "benchmarks.drivers.far_process", *names]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.addresses: dict[str, dict[str, Any]] = self._answer()

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    @property
    def pid(self) -> int:
        """Return the process id."""
        return self._process.pid

    def order(self, text: str) -> Any:
        """Send one command and wait for its answer."""
        assert self._process.stdin is not None
        self._process.stdin.write(text + "\n")
        self._process.stdin.flush()
        return self._answer()

    def close(self) -> None:
        """End the process."""
        self.order("end")
        self._process.wait(10.0)


@contextmanager
def far_process(*names: str) -> Iterator[FarProcess]:
    """Run the emulators of these test setups in another process."""
    far = FarProcess(names)
    try:
        yield far
    finally:
        far.close()


def start(text: str) -> tuple[str, Any]:
    """Start the emulator of `NAME` or, with an option, `NAME?KEY=VALUE`; return its name and the emulator."""
    name, _, option = text.partition("?")
    item, (key, _, value) = bench(name), option.partition("=")
    return name, item.start(item.backing(), {**item.far_options, **({key: value} if key else {})})


def main() -> None:
    """Run the emulators named on the command line."""
    sides = dict(map(start, sys.argv[1:]))
    freeze_loaded()  # as in a cell process: a full garbage collection would silence all devices for 50 ms
    print(json.dumps({name: side.address for name, side in sides.items()}), flush=True)
    for text in sys.stdin:
        what, _, rest = text.strip().partition(" ")
        answer: Any = None
        if what == "inject":
            for side in sides.values():
                side.inject(None if rest == "none" else Fault(rest))
        elif what == "count":
            name, _, counter = rest.rpartition(" ")
            answer = getattr(sides[name], counter)
        elif what == "log":
            answer = [sent_s for sent_s, _ in list(sides[rest].sent)]
        print(json.dumps(answer), flush=True)
        if what == "end":
            break
    for side in sides.values():
        side.close()


if __name__ == "__main__":
    main()
