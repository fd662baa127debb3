"""Runs the conformance kit over the devices of a cell file, real ones too: one generated test class a device."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from hal.clock import Clock
from hal.config import Cell, load_cell
from hal.devices import DeviceKind, Fault, FaultInjection
from hal.errors import ConfigError
from hal.registry import Context, Shared
from hal.registry import connect as connect_device
from service.cell import clock_for, start_emulators

SAMPLE_PERIOD_S = {DeviceKind.ARM: 0.02, DeviceKind.CAMERA: 0.2, DeviceKind.RANGE_SCANNER: 0.2}


class Bench:
    """What the devices of a cell share while they are tried one after another."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._shared = Shared()
        self._closers: list[Callable[[], None]] = [self._shared.close]
        self.clock: Clock = clock_for(cell)
        self._far_sides = start_emulators(cell, self.clock, self._shared, self._closers)

    def connect(self, name: str) -> Any:
        """The device, connected anew."""
        section = self._cell.file.devices[name]
        context = Context(name=name, clock=self.clock, cell=self._cell, shared=self._shared)
        far_side = self._far_sides.get(name)
        address = {} if far_side is None else far_side.address
        return connect_device(context, section.driver, {**section.options, **address})

    def close(self) -> None:
        """End emulators and world."""
        for close in self._closers[::-1]:
            close()
        self._closers.clear()


def run(cell: Cell, *, devices: Sequence[str], level: str, arguments: Sequence[str] = ()) -> int:
    """Try the named devices (all when empty) up to a level; returns pytest's exit code.

    Raises:
        ConfigError: pytest is not installed.
    """
    try:
        import pytest
    except ModuleNotFoundError:
        raise ConfigError("the conformance kit needs pytest", hint="pip install 'panelwright[test]'") from None
    names = tuple(devices) or tuple(cell.file.devices)
    with tempfile.TemporaryDirectory(prefix="panelwright-conform-") as folder:
        # A file and a root of its own keep pytest from collecting the project's tests.
        path = Path(folder) / f"test_{cell.name}.py"
        call = f"classes_for({str(cell.path.resolve())!r}, {cell.file.cell.seed}, {names!r}, {level!r})"
        path.write_text(f"from service.conform import classes_for\n\nglobals().update({call})\n")
        options = ["-p", "no:cacheprovider", "-c", "/dev/null", "--rootdir", folder, "-v", "--tb=short", "--no-header"]
        return int(pytest.main([str(path), *options, *arguments], plugins=[_UpToLevel(level)]))


class _UpToLevel:
    """A pytest plugin that leaves out the promises above a level."""

    def __init__(self, level: str) -> None:
        self._level = level

    def pytest_configure(self, config: Any) -> None:
        config.addinivalue_line("markers", "conformance(level): level of a promise")

    def pytest_collection_modifyitems(self, config: Any, items: list[Any]) -> None:
        from hal.conformance import LEVELS

        allowed = LEVELS[: [str(item) for item in LEVELS].index(self._level) + 1]
        above = [
            item for item in items if (mark := item.get_closest_marker("conformance")) and mark.args[0] not in allowed
        ]
        config.hook.pytest_deselected(items=above)
        items[:] = [item for item in items if item not in above]


def classes_for(cell_path: str, seed: int, names: Sequence[str], level: str) -> dict[str, Any]:
    """What the generated test file holds: one class a device, and the bench that they share."""
    import pytest

    cell = load_cell(Path(cell_path), seed=seed)

    @pytest.fixture(scope="module")
    def bench() -> Iterator[Bench]:
        bench = Bench(cell)
        yield bench
        bench.close()

    return {"bench": bench, **{f"Test_{name}": _class(cell, name, may_move=level == "motion") for name in names}}


def _class(cell: Cell, name: str, *, may_move: bool) -> type:
    import pytest

    from hal.conformance import CONTRACTS, Rig

    kind = cell.file.devices[name].kind

    @pytest.fixture
    def rig(_self: object, bench: Bench) -> Iterator[Any]:
        device = bench.connect(name)
        inject: Callable[[Fault | None], None] | None = None
        if isinstance(device, FaultInjection):
            inject = device.inject_fault
        period_s = SAMPLE_PERIOD_S.get(kind, 0.05)
        yield Rig(device=device, clock=bench.clock, sample_period_s=period_s, inject=inject, may_move=may_move)
        device.close()

    return type(f"Test_{name}", (CONTRACTS[kind],), {"rig": rig})
