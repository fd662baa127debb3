"""Runs the cell (devices, emulators, clock and control thread) in a process of its own, or inline for tests."""

from __future__ import annotations

import contextlib
import functools
import logging
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hal.clock import Clock, PacedClock, SimClock, WallClock
from hal.config import Cell, DeviceSection, load_cell
from hal.devices import DeviceKind
from hal.errors import CellError, ConfigError, DeviceError
from hal.gc_freeze import freeze_loaded
from hal.isolated import Report, isolated_device
from hal.malloc_arenas import share_one_heap
from hal.motion import CellSignals
from hal.priorities import Priority, take_priority
from hal.process_state import MOVES, set_memory_priority
from hal.registry import Context, Shared, device_factory, emulator_factory
from hal.registry import connect as connect_device
from hal.simulated import Fault
from hal.spare_process import drop_spare, keep_spare
from hal.strict import validate
from service.errors import DevicesUnavailable
from service.knowledge.calibrations import Calibrations
from service.processes.cell_lines import MISSING, CellOrder, error_to_line, note_to_line
from service.processes.child import Lifeline, kill_own_group
from service.processes.connection import BEHIND, CLOCK, MOVER, PREFIX, SWAPPER
from service.processes.control_watch import ControlWatch
from service.processes.device_slots import (
    Connect,
    DeviceSlot,
    Swapper,
    UnavailableDevice,
    checked,
    failure_of,
    names_another_wire,
)
from service.processes.latch import LATCH, Latch
from service.processes.motion import MotionPort, start_controller
from service.processes.vigil import Vigil
from service.recording.endpoint import Endpoint

if TYPE_CHECKING:
    from service.recording.tap import Tap  # only a recorded cell needs the libraries behind it

CLOSE_TIMEOUT_S = 4.0
WAY_BACK_S = 10.0  # the arm's way back without a service, and its rest
SWITCH_S = 0.0005  # interpreter switch interval: the longest that the control thread waits for another thread
NO_WATCH = ControlWatch(lambda: None)
log = logging.getLogger(__name__)


@dataclass(slots=True, kw_only=True, eq=False)
class CellRuntime:
    """A running cell; `objects` maps names to the objects that are served: devices, the mover and the clock.

    `world_ended` returns how its world was lost, None while it lives; `watch` notices that its control thread is blocked.
    """

    cell: Cell
    clock: Clock
    objects: Mapping[str, Any]
    world_ended: Callable[[], str | None] = lambda: None
    watch: ControlWatch = NO_WATCH
    _closers: list[Callable[[], None]] = field(default_factory=list)

    @classmethod
    def start(
        cls,
        cell: Cell,
        *,
        is_latched: Callable[[], bool],
        signals: CellSignals | None = None,
        swapped: Mapping[str, DeviceSection] | None = None,
        runs_dir: Path | None = None,
        partial: bool = False,
        report: Report = lambda _kind, _data: None,
        record: Endpoint | None = None,
    ) -> CellRuntime:
        """Start the emulators, connect all devices in parallel, then start the control thread.

        Args:
            is_latched: whether the software stop is latched; called by the control thread at each tick, as `signals` are.
            swapped: device sections that replace those of the cell file, for example from before a restart.
            runs_dir: folder of the records of `panelwright calibrate`, which motion uses; devices use those of the cell file.
            partial: whether to continue without devices that do not connect; an invalid cell file is refused in any case.
            report: called when an isolated driver stops or restarts, and for each device that is `MISSING`.
            record: the recorder to which every call is told.

        Raises:
            CellError: lists everything that could not be connected; what had been started is closed again.
        """
        emulated = {name: cell.file.devices[name] for name in cell.file.emulators}
        cell.file.devices.update(swapped or {})
        _import_drivers(cell)
        clock, shared = clock_for(cell), Shared()
        closers = [shared.close]
        try:
            far_sides = start_emulators(cell, clock, shared, closers)

            def complete(name: str, section: DeviceSection) -> DeviceSection:
                own = emulated.get(name)
                if own is None or section.driver != own.driver or names_another_wire(section, own):
                    return section
                return section.model_copy(update={"options": {**section.options, **far_sides[name].address}})

            def connect(name: str, section: DeviceSection) -> Any:
                context = Context(name=name, clock=clock, cell=cell, shared=shared)
                make = functools.partial(isolated_device, report=report) if section.isolate else connect_device
                return checked(name, make(context, section.driver, section.options), section)

            slots = _connect_all(cell, complete, connect, closers, report=report if partial else None)
            objects: dict[str, Any] = {**slots, PREFIX + CLOCK: clock}
            objects |= {PREFIX + BEHIND + name: far_side.backing for name, far_side in far_sides.items()}
            tap = _tap(record, clock, report, closers)
            used = tap.for_control(slots) if tap else slots
            motion = _motion(cell, used, clock=clock, runs_dir=runs_dir, is_latched=is_latched, signals=signals)
            if motion is not None:
                objects[PREFIX + MOVER] = motion
                closers.append(motion.close)
            objects = tap.begin(objects) if tap else objects
            objects[PREFIX + SWAPPER] = Swapper(cell, connect=connect, complete=complete, slots=slots, motion=motion)
        except BaseException:
            _close_all(closers)
            raise
        watch = NO_WATCH if motion is None else motion.watch
        return cls(cell=cell, clock=clock, objects=objects, world_ended=shared.why_ended, watch=watch, _closers=closers)

    def why_ended(self) -> str | None:
        """Return why the cell must be started again: its world has ended, or its control thread will not come back."""
        return self.world_ended() or self.watch.why_ended()

    def close(self) -> None:
        """Stop the arm, then close devices, emulators and world even if some of them fail. Idempotent."""
        closers, self._closers = self._closers, []
        _close_all(closers)


def _motion(
    cell: Cell,
    slots: Mapping[str, Any],
    *,
    clock: Clock,
    runs_dir: Path | None,
    is_latched: Callable[[], bool],
    signals: CellSignals | None,
) -> MotionPort | None:
    """Start the control thread with the calibrations measured here; returns None for a cell without an arm."""
    if not cell.names_of(DeviceKind.ARM):
        return None
    measured = cell if runs_dir is None else Calibrations.of_runs(runs_dir, cell).applied()
    return start_controller(measured, slots, clock=clock, is_latched=is_latched, signals=signals)


def _tap(record: Endpoint | None, clock: Clock, report: Report, closers: list[Callable[[], None]]) -> Tap | None:
    """Return the tap of a recorded cell; its sender is closed before the devices, but after the control thread."""
    if record is None:
        return None
    from service.recording.tap import Tap

    sender = record.sender(report, waits=True)  # the control loop begins before the cell is described
    closers.append(sender.close)
    return Tap(sender=sender, clock=clock)


def _import_drivers(cell: Cell) -> None:
    """Import every driver in one thread, before any device is connected.

    Some libraries (OpenCV) change `sys.path` while they are imported. A process that a driver starts in another thread
    at that time would inherit the changed path and fail to import even the standard library.
    """
    drivers = [section.driver for section in cell.file.devices.values()]
    for driver in [*drivers, *(section.driver for section in cell.file.emulators.values())]:
        with contextlib.suppress(ConfigError):  # raised again, with its key, when the device is connected
            device_factory(driver)


def clock_for(cell: Cell) -> Clock:
    """Return the clock for the cell's mode: simulated, wall, or paced for a simulated world behind emulated wires."""
    clocks: dict[str, Callable[[], Clock]] = {"sim": SimClock, "mixed": PacedClock, "real": WallClock}
    return clocks[cell.file.cell.mode]()


@dataclass(frozen=True, slots=True, eq=False)
class FarSide:
    """An emulated wire: the options with which a driver finds it, the device behind it, and its fault injection."""

    address: dict[str, Any]
    backing: Any
    inject: Callable[[Fault | None], None] | None


def start_emulators(cell: Cell, clock: Clock, shared: Shared, closers: list[Callable[[], None]]) -> dict[str, FarSide]:
    """Start the emulator of each emulated wire; returns the emulators by device name."""
    far_sides: dict[str, FarSide] = {}
    for name, section in cell.file.emulators.items():
        key = f"emulators.{name}"
        context = Context(name=name, clock=clock, cell=cell, shared=shared)
        backing = connect_device(context, section.driver, section.options, key=key)
        closers.append(backing.close)
        try:
            emulator = emulator_factory(section.emulator)(backing, section.emulator_options)
        except ConfigError as error:
            raise ConfigError(f"{cell.path}: {key}: {error.what}", hint=error.hint, **error.details) from error
        closers.append(emulator.close)
        far_sides[name] = FarSide(emulator.address, backing, getattr(emulator, "inject", None))
    return far_sides


def _connect_all(
    cell: Cell,
    complete: Callable[[str, DeviceSection], DeviceSection],
    connect: Connect,
    closers: list[Callable[[], None]],
    *,
    report: Report | None,
) -> dict[str, DeviceSlot]:
    """Connect every device and put it into a slot.

    With a `report`, the slot of a device that did not connect gets an `UnavailableDevice`; without one, it is an error.
    """
    sections = {name: complete(name, section) for name, section in cell.file.devices.items()}
    with ThreadPoolExecutor(len(sections), thread_name_prefix="connect") as pool:
        waiting = {name: pool.submit(connect, name, section) for name, section in sections.items()}
    failed: dict[str, CellError] = {}
    slots: dict[str, DeviceSlot] = {}
    for name, future in waiting.items():
        error = future.exception()
        if error is None:
            slots[name] = DeviceSlot(future.result())
        else:
            failed[name] = failure_of(name, error)
            slots[name] = DeviceSlot(UnavailableDevice(name, sections[name].kind, failed[name]))
        closers.append(slots[name].close)
    if failed and (report is None or not all(isinstance(error, DeviceError) for error in failed.values())):
        raise gathered(failed, total=len(sections), cell=cell)
    for name, error in failed.items():
        assert report is not None  # noqa: S101 - narrowing: without a report the error was raised above
        report(MISSING, {"device": name, "why": error.what, "hint": error.hint})
    return slots


def gathered(failed: Mapping[str, CellError], *, total: int, cell: Cell) -> CellError:
    """Return one error for all devices that did not connect; the error of a single device is returned unchanged."""
    errors = list(failed.values())
    if len(errors) == 1:
        return errors[0]
    is_config = all(isinstance(error, ConfigError) for error in errors)
    same = {error.what.replace(f"devices.{name}: ", "") for name, error in failed.items()}
    if is_config and len(same) == 1:  # a fault of something that they share, such as the simulated world
        return ConfigError(same.pop(), hint=errors[0].hint)
    kind: type[CellError] = ConfigError if is_config else DevicesUnavailable
    return kind(
        f"{len(errors)} of the {total} devices in {cell.path} did not connect",
        hint="correct each of them; `panelwright doctor` tests them again",
        **{name: f"{error.what} (try: {error.hint})" for name, error in failed.items()},
    )


def _close_all(closers: Iterable[Callable[[], None]]) -> None:
    for close in list(closers)[::-1]:
        try:
            close()
        except Exception:  # close the others even if this one fails
            log.exception("closing the cell")


def main() -> None:
    """Run the cell process; this is its entry point."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor handles Ctrl-C and closes the pipe when it ends
    share_one_heap()
    sys.setswitchinterval(SWITCH_S)
    logging.basicConfig(level=logging.WARNING, stream=sys.stderr, format="cell: %(levelname)s %(name)s: %(message)s")
    set_memory_priority(MOVES)  # as its parent had it before it began to compute
    from hal.jit import load_builtins

    load_builtins()  # the simulated world needs them too, and takes them from here
    keep_spare()  # before any thread begins
    lifeline = Lifeline()
    _in_background(_import_control)
    line = lifeline.read_line()
    if line is None:  # the service ended before it had an order
        kill_own_group()
    order = CellOrder.from_line(line)
    folder = Path(order.folder)
    vigil = Vigil(folder, lifeline, silence_s=order.silence_s)
    _in_background(vigil.keep)
    way_back_s = WAY_BACK_S if order.service_lost == "retreat" else 0.0
    _in_background(lambda: _end_with_parent(lifeline, vigil.is_orphan, way_back_s + CLOSE_TIMEOUT_S))
    with Latch(folder / LATCH) as latch:
        try:
            _run(order, lifeline, latch, vigil)
        except CellError as error:
            lifeline.write_line(error_to_line(error))
    kill_own_group()


def _run(order: CellOrder, lifeline: Lifeline, latch: Latch, vigil: Vigil) -> None:
    from hal.host import serve

    swapped = {name: validate(block, DeviceSection, source=f"devices.{name}") for name, block in order.swapped.items()}
    cell = load_cell(Path(order.cell_path), seed=order.seed)
    if cell.file.cell.mode == "sim":
        take_priority(Priority.WORK)
    runs_dir = None if order.runs_dir is None else Path(order.runs_dir)
    runtime = CellRuntime.start(
        cell,
        is_latched=lambda: vigil.is_latched(latch),
        signals=vigil.signals(latch, service_lost=order.service_lost),
        swapped=swapped,
        runs_dir=runs_dir,
        partial=order.partial,
        report=lambda kind, data: lifeline.write_line(note_to_line(kind, data)),
        record=None if order.record is None else Endpoint(*order.record),
    )
    drop_spare()
    server = serve(runtime.objects, order.address, bytes.fromhex(order.authkey), clock=runtime.clock)
    freeze_loaded()
    vigil.watch(runtime.why_ended, runtime.watch.why_blocked)
    lifeline.write_line("ready")
    vigil.is_orphan.wait()
    vigil.watch(lambda: None)  # from now on the world may end
    runtime.close()
    with contextlib.suppress(OSError):
        server.close()


def _import_control() -> None:
    """Import the control thread's modules, while the order is awaited and devices connect."""
    from manipulation import Controller  # noqa: F401 - the import is what is wanted


def _end_with_parent(lifeline: Lifeline, is_orphan: threading.Event, within_s: float) -> None:
    lifeline.wait_for_end()
    is_orphan.set()  # the control thread reads this at its next tick and stops the arm
    threading.Event().wait(within_s)
    kill_own_group()  # a driver that hangs in `close` must not keep the process alive


def _in_background(work: Callable[[], None]) -> None:
    threading.Thread(target=work, daemon=True).start()


if __name__ == "__main__":
    main()
