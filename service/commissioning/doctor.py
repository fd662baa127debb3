"""Checks what works on this machine and says what to do about the rest, for `panelwright doctor`."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable
from functools import partial
from http import HTTPStatus
from importlib.metadata import PackageNotFoundError, entry_points, version
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape

from hal.clock import Deadline
from hal.config import Cell, load_cell
from hal.errors import REINSTALL, CellError, ConfigError, detail_lines
from hal.registry import installed_drivers
from service.client import ApiError, Client
from service.commissioning.cell_check import objects_in_reach
from service.commissioning.outlets import checked_outlets
from service.commissioning.preflight import check_machine, check_python, check_simulator
from service.commissioning.to_measure import to_measure
from service.knowledge.calibrations import Calibrations
from service.processes.stop_host import bound_socket
from service.terminal import console, find_cell

if TYPE_CHECKING:
    from service.processes.supervisor import Supervisor

PINNED = {"pybullet": "3.2.7", "numpy": "2.", "opencv-python-headless": "4."}
READS = 20
ANSWER_S = 1.0  # a running service answers within this time


def examine(cell: Path, port: int, *, connect: bool) -> bool:
    """Run all checks and print their results; returns whether everything is in order.

    Args:
        connect: whether to connect the devices too, unless a service on `port` uses them.
    """
    served = _served_cell(port)
    checks: list[tuple[str, Callable[[], str]]] = [
        ("python", _python),
        *((name, lambda name=name, wanted=wanted: _package(name, wanted)) for name, wanted in PINNED.items()),
        ("simulator", _simulator),
        ("drivers", lambda: ", ".join(installed_drivers())),
        (f"port {port}", lambda: _ports(port, served)),
        ("cell file", lambda: _cell_file(cell)),
        ("outlets", lambda: _outlets(cell)),
        ("runs folder", _writable),
        ("timer", _timer),
    ]
    results = [_check(name, check) for name, check in checks]
    if all(results):
        _list_guesses(cell)
    may_connect = connect and served is None  # two programs must not control one arm
    if may_connect and all(results):  # one broken device hides no other: ports and all devices are examined
        loaded = load_cell(find_cell(cell))
        results += [_wires(loaded), _devices(loaded)]
    return all(results)


def _list_guesses(path: Path) -> None:
    """Print what the files of the cell, and the records measured here, list as not measured."""
    cell = load_cell(find_cell(path))
    guesses = tuple(to_measure(Calibrations.of_runs(Path("runs"), cell).applied()))
    for guess in guesses:
        console.print(f"[yellow]measure[/] {escape(guess.where):<24} {escape(guess.what)}: {escape(guess.how)}")
    if guesses:
        console.print(f"{len(guesses)} values are still guesses; the lists `to_measure` in the files hold them\n")


def _check(name: str, check: Callable[[], str]) -> bool:
    try:
        words = check()
    except CellError as error:
        _show_wrong(name, error.what, error.hint)
        for line in detail_lines(error.details):
            console.print(f"{'':<29} {escape(line)}")
        return False
    console.print(f"[green]good[/]   {name:<24} {escape(words)}")
    return True


def _show_wrong(name: str, what: str, hint: str) -> None:
    console.print(f"[red]wrong[/]  {name:<24} {escape(what)}\n{'':<31} try: {escape(hint)}")


def _wires(cell: Cell) -> bool:
    """Run the checks of ports and wires that installed packages register as entry points."""
    is_good = True
    for point in entry_points(group="panelwright.doctor"):
        for finding in point.load()(cell):
            word = "[green]good[/] " if finding.is_good else "[red]wrong[/]"
            console.print(f"{word}  {escape(finding.subject):<24} {escape(finding.what)}")
            if finding.hint:
                console.print(f"{'':<31} try: {escape(finding.hint)}")
            is_good &= finding.is_good or finding.subject not in cell.file.devices
    return is_good


def _python() -> str:
    check_python()
    return f"{platform.python_version()} on {platform.system()} {platform.machine()}"


def _package(name: str, wanted: str) -> str:
    try:
        found = version(name)
    except PackageNotFoundError:
        raise ConfigError(f"{name} is not installed", hint=REINSTALL) from None
    if not found.startswith(wanted):
        raise ConfigError(f"{name} is {found}, not {wanted}", hint=f"{REINSTALL}, with its constraints.txt")
    return found


def _simulator() -> str:
    check_simulator("the shipped cell")
    return "PyBullet is there"


def _served_cell(port: int) -> str | None:
    """Return the name of the cell that a service on this machine runs at `port`; None without one."""
    try:
        info = Client(url=f"http://127.0.0.1:{port}", timeout_s=ANSWER_S).get("/v1/info")
    except ApiError as error:
        return "of another user (it needs a key)" if error.problem.get("status") == HTTPStatus.UNAUTHORIZED else None
    except CellError:  # nothing answers, or another program does
        return None
    return str(info["cell"]) if isinstance(info, dict) and "cell" in info else None


def _ports(port: int, served: str | None) -> str:
    if served is not None:
        return f"panelwright serves cell {served} there and uses the devices, so they are not tested"
    for number in (port, port + 1):
        bound_socket("127.0.0.1", number).close()
    return f"{port} and {port + 1} are free"


def _cell_file(path: Path) -> str:
    cell = load_cell(find_cell(path))
    check_machine(cell)
    objects, reached = len(cell.panel.objects), objects_in_reach(cell)
    reach = "" if reached is None else f", {sum(reached.values())} in reach"
    return f"{cell.name}: {len(cell.file.devices)} devices, panel {cell.panel.name} ({objects} objects{reach})"


def _outlets(path: Path) -> str:
    cell = load_cell(find_cell(path))
    asked = [name for name, section in cell.file.outlets if section is not None]
    checked_outlets(cell.file.outlets, cell.path.parent, source=str(cell.path))
    return ", ".join(asked) or "none"


def _writable() -> str:
    folder = Path("runs")
    try:
        folder.mkdir(exist_ok=True)
        probe = folder / ".probe"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise ConfigError(
            f"{folder.resolve()} cannot be written: {error}", hint="choose another with --runs"
        ) from error
    return str(folder.resolve())


def _timer() -> str:
    """Measure how late sleeps of 2 ms return, which limits the accuracy of every control period."""
    lates_s = []
    for _ in range(200):
        due_s = time.monotonic() + 0.002
        time.sleep(0.002)
        lates_s.append(time.monotonic() - due_s)
    lates_s.sort()
    return f"2 ms sleeps return late by {1e3 * lates_s[100]:.2f} ms (median), {1e3 * lates_s[197]:.2f} ms (p99)"


def _devices(cell: Cell) -> bool:
    """Start the cell with the devices that connect, and time each of them; returns whether all answer."""
    from service.processes.supervisor import Supervisor

    supervisor = Supervisor(cell, partial=True)
    try:
        started_s = time.monotonic()
        if not _check("cell process", lambda: _started(supervisor, started_s)):
            return False
        missing = {one.device: one for one in supervisor.missing}
        for one in missing.values():
            _show_wrong(one.device, one.why, one.hint)
        there = [name for name in cell.file.devices if name not in missing]
        answers = [_check(name, partial(_timed, supervisor, cell, name)) for name in there]
        return not missing and all(answers)
    finally:
        supervisor.close()


def _started(supervisor: Supervisor, started_s: float) -> str:
    supervisor.start()
    return f"ready in {time.monotonic() - started_s:.1f} s"


def _timed(supervisor: Supervisor, cell: Cell, name: str) -> str:
    """Read the device `name` several times; returns in words how long that took."""
    from service.readings import READS as METHODS

    device = supervisor.connection.device(name)
    times_s = []
    for _ in range(READS):
        read_s = time.monotonic()
        getattr(device, METHODS[cell.file.devices[name].kind])(
            deadline=Deadline.after(supervisor.connection.clock, 2.0)
        )
        times_s.append(time.monotonic() - read_s)
    times_s.sort()
    return f"read in {1e3 * times_s[READS // 2]:.1f} ms (median), {1e3 * times_s[-1]:.1f} ms (worst of {READS})"
