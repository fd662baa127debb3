"""Gives access to objects of another process through proxies with the same methods.

The service uses it for the cell's devices, and `hal.host_process` for those of a child: a server with one thread per
connection, one call at a time.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import secrets
import socket
import tempfile
import threading
from collections.abc import Mapping
from multiprocessing.connection import Connection, Listener
from pathlib import Path
from typing import Any

from hal.caller import caller, calling_as
from hal.channel import Channel
from hal.clock import Clock, Deadline, WallClock
from hal.errors import CellError, DeviceTimeout, DeviceUnavailable

ANSWER_MARGIN_S = 0.5  # extra time for an answer after the deadline of the call
CONNECT_TIMEOUT_S = 20.0
SUPERVISED = "the supervisor restarts it; see `panelwright doctor` and the log"


class HostServer:
    """Serves objects to other processes until closed.

    Args:
        objects: by name; their public methods can be called and their plain public attributes read.
        address: path of a Unix socket.
        authkey: secret that both sides must know.
        clock: the clock of deadlines on this side.
    """

    def __init__(self, objects: Mapping[str, object], address: str, authkey: bytes, clock: Clock) -> None:
        self._objects = objects
        self._clock = clock
        self._listener = Listener(address, "AF_UNIX", backlog=64, authkey=authkey)
        self._is_closed = threading.Event()
        self._connections: set[Connection] = set()
        self._thread = threading.Thread(target=self._accept, name="host-accept", daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """Path of the Unix socket."""
        return str(self._listener.address)

    def close(self) -> None:
        """Stop serving; running calls are not interrupted. A second call does nothing."""
        if self._is_closed.is_set():
            return
        self._is_closed.set()
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as bell:
            bell.connect(self.address)  # wakes `accept`; a `Client` would wait without end if the thread has ended
        self._thread.join(timeout=1.0)
        self._listener.close()
        for connection in list(self._connections):
            _hang_up(connection)

    def _accept(self) -> None:
        while not self._is_closed.is_set():
            try:
                connection = self._listener.accept()
            except (OSError, EOFError, multiprocessing.AuthenticationError):
                continue
            threading.Thread(target=self._serve, args=(connection,), name="host-serve", daemon=True).start()

    def _serve(self, connection: Connection) -> None:
        self._connections.add(connection)
        channel = Channel(connection, self._clock)
        try:
            target = self._objects.get(channel.receive())
            channel.send(None if target is None else _describe(target))
            while target is not None and not self._is_closed.is_set():
                method, args, kwargs, name = channel.receive()
                with calling_as(name):
                    answer = _answer(target, method, args, kwargs)
                _send(channel, answer)
        except (EOFError, OSError):
            pass  # the client has disconnected, so its calls end
        finally:
            self._connections.discard(connection)
            channel.close()


def _hang_up(connection: Connection) -> None:
    """Shut down a connection that another thread reads from; that thread notices the end and closes it.

    If it were closed here, the reader would go on waiting and fail with a TypeError at the next byte.
    """
    with contextlib.suppress(OSError), socket.socket(fileno=os.dup(connection.fileno())) as end:
        end.shutdown(socket.SHUT_RDWR)


def _describe(target: object) -> tuple[frozenset[str], dict[str, Any]]:
    """Return the names of the public methods and the values of constant public attributes (`name`, `kind`)."""
    names = [name for name in dir(target) if not name.startswith("_")]
    methods = frozenset(name for name in names if callable(getattr(target, name)))
    constants: dict[str, Any] = {name: getattr(target, name) for name in ("name", "kind") if name in names}
    return methods, constants


def _answer(target: object, method: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[str, Any]:
    try:
        return "value", getattr(target, method)(*args, **kwargs)
    except CellError as error:
        return "error", error
    except Exception as error:  # a defect on this side must reach the caller, not end the server
        return "defect", f"{type(error).__name__}: {error}"


def _send(channel: Channel, answer: tuple[str, Any]) -> None:
    try:
        channel.send(answer)
    except (EOFError, OSError):
        raise
    except Exception as error:  # it cannot be pickled, so nothing was sent yet
        channel.send(("defect", f"its return value cannot be sent to another process: {type(error).__name__}: {error}"))


class Proxy:
    """A proxy for an object of another process; threads may share it, because each call has a connection to itself.

    One connection stays open between calls, so that their number does not depend on the number of threads that call.
    """

    def __init__(self, address: str, authkey: bytes, name: str, clock: Clock, *, gone_hint: str = SUPERVISED) -> None:
        self._gone_hint = gone_hint
        self._address = address
        self._authkey = authkey
        self._name = name
        self._clock = clock
        self._lock = threading.Lock()
        self._idle: Channel | None = None
        channel, (self._methods, self._constants) = self._open(CONNECT_TIMEOUT_S)
        self._keep(channel)

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("_"):
            raise AttributeError(attribute)
        if attribute in self._constants:
            return self._constants[attribute]
        if attribute in self._methods:
            return lambda *args, **kwargs: self._call(attribute, args, kwargs)
        raise AttributeError(f"{self._name} has no {attribute!r}")

    def __dir__(self) -> list[str]:
        return sorted({*self._methods, *self._constants})  # a host serves these names to other processes

    def disconnect(self) -> None:
        """Close the connection that waits for the next call; the remote object stays open."""
        self._keep(None)

    def _open(self, timeout_s: float) -> tuple[Channel, tuple[frozenset[str], dict[str, Any]]]:
        """Return a new connection, and what its other end says of the object.

        Raises:
            DeviceTimeout: the process did not answer in time.
            DeviceUnavailable: it has ended, or has no such object.
        """
        try:
            channel, described = Channel.dial(
                self._address, self._authkey, self._name, self._clock, timeout_s=timeout_s
            )
        except BlockingIOError as error:
            raise self._late("connect") from error
        except (OSError, EOFError, multiprocessing.AuthenticationError) as error:
            raise self._lost(error) from error
        if described is None:
            channel.close()
            raise DeviceUnavailable(
                f"the host has no object called {self._name!r}",
                hint="check the names in the cell file",
                device=self._name,
            )
        return channel, described

    def _call(self, method: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        given = kwargs.get("deadline")
        deadline = given if isinstance(given, Deadline) else None
        channel = self._taken()
        if channel is None:
            channel, _ = self._open(CONNECT_TIMEOUT_S if deadline is None else deadline.remaining_s() + ANSWER_MARGIN_S)
        outcome, value = self._exchange(channel, method, args, kwargs, deadline)
        self._keep(channel)
        if outcome == "value":
            return value
        if outcome == "error":
            raise value
        raise RuntimeError(f"{self._name}.{method} failed in its own process: {value}")

    def _exchange(
        self, channel: Channel, method: str, args: tuple[Any, ...], kwargs: dict[str, Any], deadline: Deadline | None
    ) -> tuple[str, Any]:
        try:
            channel.send((method, args, kwargs, caller()))
            if deadline is not None and not channel.poll(deadline.remaining_s() + ANSWER_MARGIN_S):
                raise self._late(method)
            outcome, value = channel.receive()
        except (OSError, EOFError) as error:
            channel.close()
            raise self._lost(error) from error
        except BaseException:  # late, or Ctrl-C: a late answer must not be taken for the next one
            channel.close()
            raise
        return outcome, value

    def _taken(self) -> Channel | None:
        """Return the connection that waits for a call, which then is the caller's; None while another call has it."""
        with self._lock:
            idle, self._idle = self._idle, None
        return idle

    def _keep(self, channel: Channel | None) -> None:
        """Let a connection wait for the next call, and close the one that did so."""
        with self._lock:
            idle, self._idle = self._idle, channel
        if idle is not None:
            idle.close()

    def _late(self, method: str) -> DeviceTimeout:
        return DeviceTimeout(
            f"{self._name}.{method} did not answer before its deadline",
            hint="its process may be busy or hung; see `panelwright devices`",
            device=self._name,
        )

    def _lost(self, error: BaseException) -> DeviceUnavailable:
        return DeviceUnavailable(
            f"the process of {self._name} has ended ({type(error).__name__})",
            hint=self._gone_hint,
            device=self._name,
        )


def serve(
    objects: Mapping[str, object],
    address: str | None = None,
    authkey: bytes | None = None,
    *,
    clock: Clock | None = None,
) -> HostServer:
    """Serve `objects` on a Unix socket; see `HostServer`."""
    return HostServer(objects, address or new_address(), authkey or _inherited_key(), clock or WallClock())


def connect(
    address: str, authkey: bytes | None, name: str, *, clock: Clock | None = None, gone_hint: str = SUPERVISED
) -> Any:
    """Return a proxy for the object `name` at `address`; `gone_hint` is the remedy when its process has died.

    Raises:
        DeviceUnavailable: nothing serves there, or there is no such object.
    """
    return Proxy(address, authkey or _inherited_key(), name, clock or WallClock(), gone_hint=gone_hint)


def new_address() -> str:
    """Return a new path for a Unix socket in a folder that only this user can access."""
    return str(Path(tempfile.mkdtemp(prefix="panelwright-")) / f"{secrets.token_hex(4)}.sock")


def _inherited_key() -> bytes:
    return bytes(multiprocessing.current_process().authkey)
