"""Listens to the devices of a cell: every call with its answer goes to the recorder, from a thread of its own.

There are two places to listen at. What the control loop reads and sends, thousands of times a second, becomes plain numbers
(`Row`). What tasks, pages and checks ask for becomes a `Call` with everything in it, so that a replay can answer it.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from hal.caller import caller
from hal.clock import Clock, Deadline
from hal.devices import DeviceKind
from hal.readings import Stamped
from service.recording.codec import encode_error
from service.recording.samples import FORMS
from service.recording.sender import Sender

CONTROL = "control"
QUIET = ("health", "capabilities", "now_s")  # recorded for tasks only: pages ask for these all the time
NEVER = ("close", "disconnect", "installed", "install", "sleep", "attach", "set_now_s")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Call:
    """One call of a device, the mover or the clock, with its answer.

    Attributes:
        number: rises with each call of this process, in the order in which they ended.
        caller: the task (`VERB ID`), `control` for the control loop, or empty for pages and checks.
        error: what it raised, as `codec.encode_error` writes it; then `value` is None.
        time_s: cell time at the end of the call; `wall_s` is the same on the monotonic clock.
    """

    number: int
    caller: str
    object: str
    method: str
    arguments: tuple[Any, ...]
    keywords: dict[str, Any]
    value: Any
    error: dict[str, Any] | None
    time_s: float
    wall_s: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Served:
    """An object of the cell as its callers see it: its methods, its constants, and what it can do."""

    methods: tuple[str, ...]
    constants: dict[str, Any]
    capabilities: Any = None
    health: Any = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Started:
    """The beginning of a cell process: its objects, and the times that its clock and the wall clock showed then."""

    objects: dict[str, Served]
    places: tuple[tuple[str, DeviceKind, str], ...]
    time_s: float
    wall_s: float
    epoch_ns: int


class Tapped:
    """Forwards everything to an object, and reports the calls of its public methods."""

    def __init__(self, target: Any, wrap: Callable[[str, Callable[..., Any]], Callable[..., Any]]) -> None:
        self._target = target
        self._wrap = wrap

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        value = getattr(self._target, name)
        if not callable(value) or name in NEVER:
            return value

        def call(*args: Any, **kwargs: Any) -> Any:
            return getattr(self._target, name)(*args, **kwargs)  # looked up at each call: the device may be exchanged

        wrapped = self.__dict__[name] = self._wrap(name, call)  # the next call finds it there
        return wrapped

    def __dir__(self) -> list[str]:
        return dir(self._target)  # a host serves these names to other processes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tap:
    """Makes the objects of a cell report to a sender."""

    sender: Sender
    clock: Clock
    _numbers: itertools.count[int] = field(default_factory=itertools.count)
    _places: list[tuple[str, DeviceKind, str]] = field(default_factory=list)

    def begin(self, objects: Mapping[str, Any]) -> dict[str, Any]:
        """Describe the cell's objects to the recorder, and return them with everything that is asked of them recorded."""
        started = Started(
            objects={name: _served(target) for name, target in objects.items()},
            places=tuple(self._places),
            time_s=self.clock.now_s(),
            wall_s=time.monotonic(),
            epoch_ns=time.time_ns(),
        )
        self.sender.begin(started)
        return {name: self._object(name, target) for name, target in objects.items()}

    def for_control(self, devices: Mapping[str, Any]) -> dict[str, Any]:
        """Return the devices for the control loop; call this before `begin`."""
        return {name: self._for_control(name, device.kind, device) for name, device in devices.items()}

    def _for_control(self, name: str, kind: DeviceKind, target: Any) -> Any:

        def wrap(method: str, call: Callable[..., Any]) -> Callable[..., Any]:
            form = FLAT.get((kind, method))
            if form is None:
                return call if method in QUIET else self._recorded(name, method, call, lambda: CONTROL)
            return self._as_rows(places[method], name, method, call, form)

        methods = [method for of, method in FORMS if of is kind]
        places = {method: len(self._places) + k for k, method in enumerate(methods)}
        self._places.extend((name, kind, method) for method in methods)
        return Tapped(target, wrap)

    def _object(self, name: str, target: Any) -> Any:
        return Tapped(target, lambda method, call: self._recorded(name, method, call, caller))

    def _recorded(
        self, name: str, method: str, call: Callable[..., Any], whose: Callable[[], str]
    ) -> Callable[..., Any]:
        def recorded(*args: Any, **kwargs: Any) -> Any:
            who = whose()
            if not who and method in QUIET:
                return call(*args, **kwargs)
            value, error = None, None
            try:
                value = call(*args, **kwargs)
            except Exception as raised:
                error = encode_error(raised)
                raise
            finally:
                self.sender.put(
                    Call(
                        number=next(self._numbers),
                        caller=who,
                        object=name,
                        method=method,
                        arguments=tuple(given for given in args if not isinstance(given, Deadline)),
                        keywords={key: given for key, given in kwargs.items() if not isinstance(given, Deadline)},
                        value=value,
                        error=error,
                        time_s=self.clock.now_s(),
                        wall_s=time.monotonic(),
                    )
                )
            return value

        return recorded

    def _as_rows(self, place: int, name: str, method: str, call: Callable[..., Any], flat: Flat) -> Callable[..., Any]:
        put, now_s = self.sender.put_row, self.clock.now_s
        failing = self._recorded(name, method, _raise, lambda: CONTROL)

        def recorded(*args: Any, **kwargs: Any) -> Any:
            try:
                value = call(*args, **kwargs)
            except Exception as error:
                failing(error)
                raise
            put((place, now_s(), time.monotonic(), *flat(args, value)))  # a `Row`, without the time to make one
            return value

        return recorded


def _raise(error: Exception) -> None:
    raise error


def _served(target: Any) -> Served:
    """Describe an object without waiting for its device."""
    names = [name for name in dir(target) if not name.startswith("_")]
    methods = tuple(name for name in names if callable(getattr(target, name)))
    return Served(
        methods=methods,
        constants={name: getattr(target, name) for name in ("name", "kind") if name in names},
        capabilities=_told(target, "capabilities") if "capabilities" in methods else None,
        health=_told(target, "health") if "health" in methods else None,
    )


def _told(target: Any, method: str) -> Any:
    try:
        return getattr(target, method)()
    except Exception:  # a device that is not connected: the recording has the errors of its calls
        return None


Flat = Callable[[tuple[Any, ...], Any], tuple[Any, tuple[Any, ...]]]
"""Makes plain numbers of a call's arguments and its answer: the stamp and the values of a `Row`."""


def _stamp(reading: Stamped[Any]) -> tuple[float, float | None, int, str, str]:
    # `_value_` is `value` without the descriptor, which takes as long as the rest of this function
    quality, cause = reading.quality._value_, reading.cause._value_
    return reading.host_time_s, reading.device_time_s, reading.sequence, quality, cause


FLAT: dict[tuple[DeviceKind, str], Flat] = {
    (DeviceKind.ARM, "read_state"): lambda _args, r: (
        _stamp(r),
        (
            r.value.position_rad.tolist(),
            r.value.velocity_rad_per_s.tolist(),
            bool(r.value.is_enabled),
            bool(r.value.is_moving),
        ),
    ),
    (DeviceKind.ARM, "command_position"): lambda args, sent: (None, (args[0].tolist(), sent.tolist())),
    (DeviceKind.GRIPPER, "read_state"): lambda _args, r: (
        _stamp(r),
        (float(r.value.width_m), float(r.value.force_n), bool(r.value.is_moving), bool(r.value.is_holding)),
    ),
    (DeviceKind.PROXIMITY, "read_distance_m"): lambda _args, r: (_stamp(r), (float(r.value),)),
    (DeviceKind.TOUCH, "read_contacts"): lambda _args, r: (_stamp(r), ([bool(c) for c in r.value],)),
    (DeviceKind.FORCE_TORQUE, "read_wrench"): lambda _args, r: (
        _stamp(r),
        (r.value.force_n.tolist(), r.value.torque_nm.tolist()),
    ),
}
