"""Runs the conformance tests on the devices of a cell file, also real ones, with one generated test class per device."""

from __future__ import annotations

import signal
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from hal.clock import Clock
from hal.config import Cell, load_cell
from hal.devices import DeviceKind
from hal.errors import ConfigError
from hal.registry import Context, Shared
from hal.registry import connect as connect_device
from hal.simulated import Fault, FaultInjection
from service.processes.cell import clock_for, start_emulators

LINK = "link"  # test property that holds what the device reports about its connection
SAMPLE_PERIOD_S = {DeviceKind.ARM: 0.02, DeviceKind.CAMERA: 0.2, DeviceKind.RANGE_SCANNER: 0.2}


class Bench:
    """The clock, the world and the emulators that the devices of a cell share while they are tested one by one."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._shared = Shared()
        self._closers: list[Callable[[], None]] = [self._shared.close]
        self.clock: Clock = clock_for(cell)
        self._far_sides = start_emulators(cell, self.clock, self._shared, self._closers)

    def connect(self, name: str) -> Any:
        """Connect the device again and return it."""
        section = self._cell.file.devices[name]
        context = Context(name=name, clock=self.clock, cell=self._cell, shared=self._shared)
        far_side = self._far_sides.get(name)
        address = {} if far_side is None else far_side.address
        return connect_device(context, section.driver, {**section.options, **address})

    def fault_injection(self, name: str, device: Any) -> Callable[[Fault | None], None] | None:
        """Return the function that injects faults; None for a real device on a real wire."""
        if isinstance(device, FaultInjection):
            return device.inject_fault
        far_side = self._far_sides.get(name)
        return None if far_side is None else far_side.inject

    def close(self) -> None:
        """Close the emulators and the world."""
        for close in self._closers[::-1]:
            close()
        self._closers.clear()


def run(
    cell: Cell, *, devices: Sequence[str], level: str, report: Path | None = None, record: Path | None = None
) -> int:
    """Test the named devices (all when empty) up to a level; returns pytest's exit code, or 130 after Ctrl-C.

    Args:
        report: path without suffix under which the results are written as `.md` and `.json`.
        record: folder of the records of drivers, to which the results are added.

    Raises:
        ConfigError: pytest is not installed, or the report cannot be written.
    """
    try:
        import pytest
    except ModuleNotFoundError:
        raise ConfigError("the conformance kit needs pytest", hint="pip install 'panelwright[conform]'") from None
    from service.commissioning.conform_report import Notebook, write_report

    names = tuple(devices) or tuple(cell.file.devices)
    notebook = Notebook(level)
    with tempfile.TemporaryDirectory(prefix="panelwright-conform-") as folder:
        # A separate file and root directory keep pytest from collecting the project's tests.
        path = Path(folder) / f"test_{cell.name}.py"
        call = f"classes_for({str(cell.path.resolve())!r}, {cell.file.cell.seed}, {names!r}, {level!r})"
        path.write_text(f"from service.commissioning.conform import classes_for\n\nglobals().update({call})\n")
        options = ["-p", "no:cacheprovider", "-c", "/dev/null", "--rootdir", folder, "-v", "--tb=short", "--no-header"]
        code = int(pytest.main([str(path), *options], plugins=[notebook]))
    if report is not None:
        write_report(report, cell, names, notebook)
    if record is not None:
        from service.commissioning.conform_record import update_records

        update_records(record, cell, names, notebook)
    return 128 + signal.SIGINT if notebook.is_stopped else code  # pytest's 2 may also mean a file that it cannot load


def classes_for(cell_path: str, seed: int, names: Sequence[str], level: str) -> dict[str, Any]:
    """Return the contents of the generated test module: one class per device, and the bench that they share."""
    import pytest

    cell = load_cell(Path(cell_path), seed=seed)

    @pytest.fixture(scope="module")
    def bench() -> Iterator[Bench]:
        bench = Bench(cell)
        yield bench
        bench.close()

    return {"bench": bench, **{class_name(name): _class(cell, name, may_move=level == "motion") for name in names}}


def class_name(device: str) -> str:
    """Return the name of a device's test class."""
    return f"Test_{device}"


def _class(cell: Cell, name: str, *, may_move: bool) -> type:
    import pytest

    from hal.conformance import CONTRACTS, Rig

    kind = cell.file.devices[name].kind

    @pytest.fixture
    def rig(_self: object, bench: Bench, record_property: Callable[[str, object], None]) -> Iterator[Any]:
        device = bench.connect(name)
        record_property(LINK, device.health().detail)
        inject, period_s = bench.fault_injection(name, device), SAMPLE_PERIOD_S.get(kind, 0.05)
        yield Rig(device=device, clock=bench.clock, sample_period_s=period_s, inject=inject, may_move=may_move)
        if inject is not None:
            inject(None)  # a failed test may have left a fault injected
        device.close()

    return type(class_name(name), (CONTRACTS[kind],), {"rig": rig})
