"""Runs a device in its own process (`isolate = true`) and starts it again when its driver crashes."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from hal.clock import WallClock
from hal.config import Cell
from hal.devices import DeviceKind, Health
from hal.errors import CellError, ConfigError, DeviceUnavailable
from hal.host import connect
from hal.host_process import EXIT, HostProcess
from hal.readings import Cause, Quality
from hal.registry import Context
from hal.registry import connect as connect_device

FIRST_PAUSE_S = 0.5  # before the first restart; twice as long before each further one
LONGEST_PAUSE_S = 5.0
MAX_RESTARTS = 3  # of a driver that crashes again and again, within
CRASHES_COUNT_S = 60.0
SOON = "nothing to do: it is connected again automatically; the log says how the driver crashed"
BY_HAND = "correct the cause (the log says how the driver crashed), then run `panelwright devices connect NAME`"
CLEAR_THE_HAND = "make sure that nothing is between the jaws, then run `panelwright devices connect NAME`"
log = logging.getLogger(__name__)

Report = Callable[[str, dict[str, Any]], None]
"""Called for each event to record, with its kind and plain data."""


class IsolatedDevice:
    """Device in a process of its own, with the interface of its kind; closing it ends the process.

    When the process ends by itself, every call raises `DeviceUnavailable` at once, and the driver is started again
    after 0.5 s, then 1 s, and so on up to 5 s. A driver that cannot connect is retried without limit, because its
    device may be unplugged; one that crashes for the fourth time within a minute stays down. Motion is never resumed
    automatically: an arm waits for `enable`, and a gripper, whose jaws may move when it is connected, is not restarted.

    Args:
        report: called with `driver-down`, `driver-restarted` or `driver-stays-down`, from a thread of this object.
        pause_s: pause before the first restart.
        max_restarts: how often a driver that keeps crashing is restarted within a minute.
    """

    def __init__(
        self,
        context: Context,
        driver: str,
        options: dict[str, Any],
        *,
        report: Report = lambda _kind, _data: None,
        pause_s: float = FIRST_PAUSE_S,
        max_restarts: int = MAX_RESTARTS,
    ) -> None:
        self._pause_s = pause_s
        self._max_restarts = max_restarts
        self._name = context.name
        self._driver = driver
        self._order = (context.name, context.cell, driver, options)
        self._report = report
        self._is_closed = threading.Event()
        self._down: tuple[str, str] | None = None  # what and hint, while there is no process
        self._crashes_s: list[float] = []
        self._restarts = 0
        self._begin()
        self._watcher = threading.Thread(target=self._watch, name=f"watch-{self._name}", daemon=True)
        self._watcher.start()

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("_"):
            raise AttributeError(attribute)
        value = getattr(self._proxy, attribute)
        return (lambda *args, **kwargs: self._call(attribute, *args, **kwargs)) if callable(value) else value

    def __dir__(self) -> list[str]:
        return dir(self._proxy)

    def health(self) -> Health:
        """Return the state of the device, or of its driver while that is down; returns at once."""
        try:
            health: Health = self._call("health")
        except DeviceUnavailable as gone:
            lost = Health(connected=False, quality=Quality.INVALID, cause=Cause.COMM)
            return replace(lost, detail=gone.what, reconnects=self._restarts)
        return replace(health, reconnects=health.reconnects + self._restarts)

    def close(self) -> None:
        """Close the device and end its process; a second call does nothing."""
        self._is_closed.set()
        self._process.close()
        self._watcher.join()  # ends a restart that is in progress
        self._process.close()
        self._down = (f"{self._name} is closed", "connect it again")

    def _call(self, method: str, *args: Any, **kwargs: Any) -> Any:
        down = self._down
        if down is not None:
            raise DeviceUnavailable(down[0], hint=down[1], device=self._name)
        return getattr(self._proxy, method)(*args, **kwargs)

    def _begin(self) -> None:
        """Start a process, and make a proxy for its device, which keeps its names while the process is down."""
        process = HostProcess(_make_device, *self._order, name=self._name, give_up=self._is_closed)
        try:
            self._proxy = connect(process.address, None, self._name, gone_hint=SOON)
        except CellError as error:
            process.close()
            error.details[EXIT] = process.await_end()
            raise
        self._process = process

    def _watch(self) -> None:
        while True:
            how = self._process.await_end()
            if self._is_closed.is_set() or not self._comes_back(how):
                return

    def _comes_back(self, how: str) -> bool:
        """Clean up after the process and start another one; returns False when it must stay down."""
        crashed = f"the driver of {self._name}, {self._driver}, has crashed ({how})"
        log.error("%s", crashed)
        self._report("driver-down", {"device": self._name, "driver": self._driver, "exit": how})
        self._process.close()
        if self._proxy.kind == DeviceKind.GRIPPER:
            why = "it is not restarted automatically, because its jaws may move when it connects"
            return self._stay_down(f"{crashed}; {why}", CLEAR_THE_HAND)
        pause_s, last = self._pause_s, crashed
        self._crashes_s.append(time.monotonic())
        while not self._crashes_too_often():
            self._down = (f"{last}; it is restarted in {pause_s:g} s", SOON)
            if self._is_closed.wait(pause_s):
                return False
            try:
                self._begin()
            except CellError as error:
                if self._is_closed.is_set():
                    return False
                last = f"{crashed} and could not be connected again yet: {error.what}"
                if EXIT in error.details:
                    self._crashes_s.append(time.monotonic())
                pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)
                continue
            self._restarts += 1
            self._down = None
            log.warning("%s is connected again", self._name)
            self._report("driver-restarted", {"device": self._name, "restarts": self._restarts})
            return True
        times = len(self._crashes_s)
        return self._stay_down(
            f"{last}; {times} crashes within {CRASHES_COUNT_S:.0f} s, so it is not restarted again", BY_HAND
        )

    def _crashes_too_often(self) -> bool:
        since_s = time.monotonic() - CRASHES_COUNT_S
        self._crashes_s = [moment_s for moment_s in self._crashes_s if moment_s > since_s]
        return len(self._crashes_s) > self._max_restarts

    def _stay_down(self, what: str, hint: str) -> bool:
        self._down = (what, hint.replace("NAME", self._name))
        log.error("%s", what)
        self._report("driver-stays-down", {"device": self._name, "why": what})
        return False


def isolated_device(
    context: Context, driver: str, options: dict[str, Any], *, report: Report = lambda _kind, _data: None
) -> IsolatedDevice:
    """Connect a device in a process of its own; see `IsolatedDevice`.

    Raises:
        ConfigError: the device cannot be isolated, because a simulated driver shares its world with other devices, and
            only the wall clock can be shared between processes.
        CellError: the device did not connect.
    """
    if not driver.startswith("sim:") and isinstance(context.clock, WallClock):
        return IsolatedDevice(context, driver, options, report=report)
    raise ConfigError(
        f"devices.{context.name}: {driver} cannot be isolated in a cell with a simulated world",
        hint="remove isolate = true; it is for cell.mode = 'real'",
        key=f"devices.{context.name}.isolate",
    )


def _make_device(name: str, cell: Cell | None, driver: str, options: dict[str, Any]) -> Mapping[str, object]:
    return {name: connect_device(Context(name=name, cell=cell), driver, options)}
