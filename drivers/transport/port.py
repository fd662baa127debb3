"""Owner thread of one port: opens it, runs its tenant's `set_up` and `serve`, and reopens it after every loss."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from drivers.transport.link import Cancellable, LinkLost, WireError
from hal.errors import CellError
from hal.priorities import ask_for_realtime

log = logging.getLogger(__name__)

FIRST_RETRY_S = 0.02
LAST_RETRY_S = 0.15  # a port that comes back is in use again within 0.5 s
JOIN_S = 1.0


class Closable(Protocol):
    """Anything that a port can hold: a link or a camera."""

    def close(self) -> None:
        """Release the resource."""
        ...


L = TypeVar("L", bound=Closable)
L_contra = TypeVar("L_contra", bound=Closable, contravariant=True)


class Tenant(Protocol[L_contra]):
    """User of a port; only the owner thread calls these three methods."""

    def set_up(self, link: L_contra) -> None:
        """Bring the device to the state that `serve` needs; called again after each loss.

        Raises:
            WireError, CellError: set-up failed; the port is closed and opened again.
        """
        ...

    def serve(self, link: L_contra) -> None:
        """Do one piece of work of at most about 50 ms.

        Raises:
            WireError, CellError: the port is closed and opened again.
        """
        ...

    def lost(self, error: Exception) -> None:
        """Handle that the port could not be opened or set up, or was lost while serving."""
        ...


class Port(Generic[L]):
    """Keeps a tenant connected to its link.

    Args:
        name: name of the device or bus; used as the thread's name.
        open_link: opens the port; raises `DeviceUnavailable`.
        realtime_priority: priority of the owner thread, 1 to 99, where the system allows it; 0 requests none.
    """

    def __init__(self, name: str, *, open_link: Callable[[], L], tenant: Tenant[L], realtime_priority: int = 0) -> None:
        self._open_link = open_link
        self._tenant = tenant
        self._closing = threading.Event()
        self._link: L | None = None
        self._held: L | None = None  # set during set-up too
        self._sessions = 0
        self._realtime_priority = realtime_priority
        self.is_realtime = False
        self._thread = threading.Thread(target=self._run, name=f"port {name}", daemon=True)

    def start(self) -> None:
        """Start the owner thread, which opens the port."""
        self._thread.start()

    @property
    def link(self) -> L | None:
        """Return the link while it is open and set up, else None."""
        return self._link

    @property
    def reconnects(self) -> int:
        """Return how many times the port was set up again after the first time."""
        return max(0, self._sessions - 1)

    def close(self) -> None:
        """End the thread and release the port, in bounded time; a second call does nothing."""
        self._closing.set()
        held = self._held
        if isinstance(held, Cancellable):
            held.cancel()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(JOIN_S)

    def _run(self) -> None:
        if self._realtime_priority:
            self.is_realtime = ask_for_realtime(self._realtime_priority)
        retry_s = FIRST_RETRY_S
        while not self._closing.is_set():
            try:
                self._session()
            except (WireError, CellError) as error:
                retry_s = self._rest(error, retry_s)
            except Exception as error:  # a driver bug must not silence a device for good
                log.exception("%s failed", self._thread.name)
                retry_s = self._rest(LinkLost(f"its driver failed: {error!r}"), retry_s)

    def _rest(self, error: Exception, retry_s: float) -> float:
        """Report the error to the tenant, wait, and return the next waiting time in seconds."""
        retry_s = FIRST_RETRY_S if self._link is not None else min(2.0 * retry_s, LAST_RETRY_S)
        self._link = None
        if self._closing.is_set():
            return retry_s  # the port was closed
        self._tenant.lost(error)
        self._closing.wait(retry_s)
        return retry_s

    def _session(self) -> None:
        link = self._held = self._open_link()
        try:
            if self._closing.is_set():
                return  # closed while the link was being opened, so nobody cancelled it
            self._tenant.set_up(link)
            self._link = link
            self._sessions += 1
            while not self._closing.is_set():
                self._tenant.serve(link)
        finally:
            self._held = None
            link.close()
